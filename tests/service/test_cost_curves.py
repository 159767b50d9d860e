"""Cost curves for people: sentences and tables from rows, the record, the page's section, the plot, the command."""

import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner

import workers.cost_curves
from service.benchmark_page import render_page
from service.benchmarks import write_page
from service.cli import app
from service.cost_curves import CURVES, cost_curves_table, exponent_cells, sentence
from service.cost_curves_cli import parse_counts
from service.cost_curves_plot import cost_curves_plot
from service.errors import OptionError
from service.page_records import RecordError
from storage.store import Store
from workers.cost_curves import fitted


def make_row(kind: str, n: int, power: float, **values: Any) -> dict[str, Any]:
    return {
        "kind": kind, "target": n, "triangles": n, "rule": "tessellated", "elements": 50 * n**power,
        "elements_seconds": 2.0, "bake_paths": int(1e6 * n**power), "bake_seconds": 3.0 * n**power,
        "bake_seconds_error": 0.5, "nbytes": int(4096 * n**power), "memory_nbytes": 1e6, "query_ms": 12.5,
        "sampled_paths": 100, **values,
    }  # fmt: skip


@pytest.fixture
def result() -> dict[str, Any]:
    rows = [make_row(kind, n, power) for n in (100, 1000, 10_000) for kind, power in (("lattice", 0), ("triangle", 1))]
    rows[-1] |= {"query_ms": None, "memory_nbytes": None}
    return {
        "scene": "hall", "digest": "d1", "triangles": 5000, "preset": "draft", "width": 64, "height": 48,
        "frame": {"width": 640, "height": 360}, "repeats": 7, "max_elements": 60_000, "rows": rows,
        "exponents": fitted(rows), "notes": ["a | note"], "machine": "2 CPU threads", "commit": "0123abc",
        "load": {"other_cpus": 0.0, "cpus": 2.0},
    }  # fmt: skip


def test_sentence_is_computed_from_the_fits(result: dict[str, Any]) -> None:
    text = sentence(result)
    assert text.startswith("From 100 to 10,000 triangles costs grow, ours, budget fixed: bake paths as n^0.00")
    assert "paper, an element a triangle: bake paths as n^1.00, bytes as n^1.00, query time as n^0.00." in text


def test_exponents_stand_with_their_error(result: dict[str, Any]) -> None:
    cells = {row[0]: row[1:] for row in exponent_cells(result["exponents"])}
    assert cells["bake, paths"] == ["0.00 ± 0.00", "1.00 ± 0.00"]
    assert cells["query, ms"] == ["0.00 ± 0.00", "0.00"]  # two points have no error


def test_table_shows_rows_exponents_and_notes(result: dict[str, Any]) -> None:
    console = Console(width=220, record=True)
    console.print(cost_curves_table(result))
    text = console.export_text()
    for words in ("10,000", "paper, an element a triangle", "1.00 ± 0.00", "note: a | note", "640x360"):
        assert words in text


def test_record_returns_as_it_went_and_stands_on_the_page(result: dict[str, Any], tmp_path: Path) -> None:
    store = Store.open(tmp_path / "store", create=True)
    CURVES.keep(store.files, result, "lightwell cost-curves hall")
    (record,) = CURVES.load(store.files)
    assert record["result"] == json.loads(json.dumps(result))
    assert store.verify() == []
    assert write_page(store, tmp_path / "page.md") == 0
    page = (tmp_path / "page.md").read_text()
    assert "## Cost curves" in page and "lightwell cost-curves hall" in page and "a \\| note" in page
    assert "| bake, paths | 0.00 ± 0.00 | 1.00 ± 0.00 |" in page
    assert "No scene has been measured yet" not in page
    assert "(cost-curves/hall.png)" in page and (tmp_path / "cost-curves" / "hall.png").read_bytes()[1:4] == b"PNG"
    rows = [line for line in page.splitlines() if line.startswith("| 10,000")]
    assert len(rows) == 2


def test_page_without_curves_has_no_such_section() -> None:
    assert "Cost curves" not in render_page([])


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b'{"schema": 9}'])
def test_record_that_is_not_ours_is_named(data: bytes, tmp_path: Path) -> None:
    store = Store.open(tmp_path / "store", create=True)
    store.files.write(f"{CURVES.folder}/hall.json", data)
    with pytest.raises(RecordError, match=r"hall\.json"):
        CURVES.load(store.files)


@pytest.mark.parametrize(("suffix", "start"), [(".png", b"\x89PNG"), (".svg", b"<?xml")])
def test_plot_is_a_file_of_its_kind(result: dict[str, Any], suffix: str, start: bytes) -> None:
    assert cost_curves_plot(result, suffix).startswith(start)


def test_counts_are_numbers() -> None:
    assert parse_counts("10_000,5") == (10_000, 5)
    with pytest.raises(OptionError, match="got '1,x'"):
        parse_counts("1,x")


def test_command_measures_keeps_and_writes(
    result: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def run(scene: Any, settings: Any, budget: Any, progress: Any) -> dict[str, Any]:
        asked.extend([scene.name, settings, budget])
        return result

    monkeypatch.setattr(workers.cost_curves, "run_cost_curves", run)
    files = {name: tmp_path / f"out.{name}" for name in ("json", "png")}
    line = ["cost-curves", "tiny", "--triangles", "100,200", "--preset", "tiny", "--resolution", "24x16",
            "--set", "cache.polar=3", "--store", str(tmp_path / "store"), "--json", str(files["json"]),
            "--plot", str(files["png"])]  # fmt: skip
    answer = CliRunner().invoke(app, line)
    assert answer.exit_code == 0, answer.output
    name, settings, budget = asked
    assert name == "tiny" and (settings.width, settings.height, settings.cache.polar) == (24, 16, 3)
    assert budget.triangles == (100, 200) and dict(budget.overrides) == {"cache.polar": "3"}
    assert json.loads(files["json"].read_text())["scene"] == "hall"
    assert files["png"].read_bytes().startswith(b"\x89PNG")
    (record,) = CURVES.load(Store.open(tmp_path / "store").files)
    assert "--triangles 100,200" in record["command"] and str(tmp_path.parent) not in record["command"]


@pytest.mark.parametrize("words", [["--triangles", "x"], ["--plot", "a.gif"], ["--triangles", "5"]])
def test_command_refuses_what_it_cannot_do(words: list[str]) -> None:
    answer = CliRunner().invoke(app, ["cost-curves", "tiny", *words])
    assert answer.exit_code == 2 and "must" in answer.output
