"""The measured trade: table, plot, HTTP, and frames that are asked for by quality, time or PSNR."""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from PIL import Image
from rich.console import Console
from typer.testing import CliRunner

from service.benchmarks import write_page
from service.cli import app as command
from service.errors import OptionError, UnknownSceneError
from service.frame_choice import Demand, choose_point, point_headers
from service.problems import add_problem_handlers
from service.routes_tradeoff import add_tradeoff_routes, store_tables
from service.tradeoff import TRADES, dominance, tradeoff_table, write_tradeoff
from service.tradeoff_plot import plot_suffix, tradeoff_plot
from storage.store import Store
from workers.errors import NoOperatingPointsError, UnreachableTargetError
from workers.operating_points import FrameTime, OperatingPoint
from workers.operating_table import OperatingTable, save_table
from workers.renderer import Frame
from workers.tradeoff import mark_fronts


def row(name: str, kind: str, psnr: float | None, flip: float, ms: float, **values: Any) -> dict[str, Any]:
    facts = {"temporal": 0.02, "bake_seconds": None, "bake_paths": None, "nbytes": None, "train_seconds": None,
             "non_finite": 0, "times": [{"width": 100, "height": 100, "ms": ms}]}  # fmt: skip
    return {"name": name, "kind": kind, "psnr": psnr, "flip": flip, "ms": ms, **facts, **values}


def make_table() -> OperatingTable:
    baked = {"bake_seconds": 12.0, "nbytes": 5000}
    rows = [
        row("ours", "ours", 34.0, 0.05, 20.0, train_seconds=60.0, **baked),
        row("no network", "ours", 29.0, 0.09, 5.0, **baked),
        row("1/4 samples", "ours", 33.0, 0.06, 20.5, bake_seconds=3.0, nbytes=5000),
        row("paper-exact", "paper", 28.0, 0.10, 30.0, bake_seconds=90.0, nbytes=90_000),
        row("pt-1+oidn-fast", "path tracing", 31.0, 0.08, 40.0),
        row("pt-8+oidn-high", "path tracing", 36.0, 0.04, 400.0),
        row("pt-1", "path tracing", None, 0.5, 25.0, non_finite=3),
    ]
    mark_fronts(rows)
    points = tuple(
        OperatingPoint(
            name=r["name"], overrides={}, network="n1", precision="fp32", scale=1, psnr=r["psnr"], flip=r["flip"],
            temporal=r["temporal"], times=tuple(FrameTime(**t) for t in r["times"]), bake_seconds=12.0, nbytes=5000,
        )
        for r in rows if r["kind"] == "ours"
    )  # fmt: skip
    result = {"scene": "hall", "width": 100, "height": 100, "preset": "draft", "rows": rows, "machine": "two cores",
              "repeats": 3, "num_frames": 6, "reference_error_db": 44.0, "notes": ["trained briefly"],
              "commit": "0123abc", "load": {"other_cpus": 0.2, "cpus": 2.0}}  # fmt: skip
    return OperatingTable(base={}, points=points, result=result)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store.open(tmp_path / "store", create=True)
    store.register_scene("d1", {"name": "hall", "network": "n1"})
    save_table(store, "d1", make_table())
    return store


# ------------------------------------------------- fronts -------------------------------------------------


def test_fronts_and_beaten_rows_are_what_the_numbers_say() -> None:
    rows = {r["name"]: r for r in make_table().result["rows"]}
    assert rows["ours"]["pareto"]["ms"] == ["psnr", "flip"]
    assert rows["1/4 samples"]["pareto"]["ms"] == []
    assert rows["1/4 samples"]["pareto"]["bake_seconds"] == ["psnr", "flip", "temporal"]
    assert rows["1/4 samples"]["pareto"]["nbytes"] == ["temporal"]  # as good as ours: both stand there
    assert rows["pt-8+oidn-high"]["pareto"]["ms"] == ["psnr", "flip"]
    assert rows["pt-8+oidn-high"]["pareto"]["nbytes"] == []
    assert rows["pt-1+oidn-fast"]["beaten_by"] == "ours"
    assert rows["pt-8+oidn-high"]["beaten_by"] is None
    assert rows["pt-1"]["beaten_by"] is None  # it has no score to compare
    assert "beaten_by" not in rows["ours"]


# ---------------------------------------------- table and plot ----------------------------------------------


def test_table_tells_every_row_front_and_note() -> None:
    console = Console(file=io.StringIO(), width=200)
    console.print(tradeoff_table(make_table().result))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    lines = {line.split("│")[1].strip(): line for line in text.splitlines() if line.startswith("│")}
    assert list(lines)[:2] == ["ours, no network", "ours (caches + network)"]  # fastest first
    assert "34.00" in lines["ours (caches + network)"] and "1 min 00 s" in lines["ours (caches + network)"]
    assert "refused" in lines["path tracing 1 spp"]
    assert lines["path tracing 1 spp + OIDN fast"].rstrip("│ ").endswith("ours")
    assert "note: trained briefly" in text and "44.00 dB" in text


def test_dominance_counts_denoised_rows_of_few_samples() -> None:
    result = make_table().result
    said = "Of the 2 denoised path-traced rows up to 8 spp, 1 are beaten by one of ours"
    assert dominance(result).startswith(said) and dominance(result).endswith("not beaten: pt-8+oidn-high.")
    few = result | {"rows": [r for r in result["rows"] if "pt-8" not in r["name"]]}
    assert dominance(few).endswith("no worse in PSNR and FLIP.")
    assert dominance(result | {"rows": []}) == ""


def test_a_kept_tradeoff_stands_on_the_page_with_its_plot(store: Store, tmp_path: Path) -> None:
    result, page = make_table().result, tmp_path / "docs" / "page.md"
    TRADES.keep(store.files, result, "lightwell tradeoff hall")
    write_page(store, page)
    text = page.read_text()
    assert dominance(result) in text and "lightwell tradeoff hall" in text and "Commit 0123abc." in text
    assert text.index("| ours, no network | 29.00") < text.index("| path tracing 1 spp + OIDN fast | 31.00")
    with Image.open(page.parent / "tradeoffs" / "hall.png") as picture:
        assert picture.size[0] > 1000
    assert "(tradeoffs/hall.png)" in text
    other = Store.open(tmp_path / "other", create=True)
    assert write_page(other, page) == 0
    assert page.read_text() == text, "a store without it leaves it"


@pytest.mark.parametrize(("suffix", "magic"), [(".pdf", b"%PDF"), (".svg", b"<?xml")])
def test_plot_is_a_file_of_its_kind(suffix: str, magic: bytes) -> None:
    assert tradeoff_plot(make_table().result, suffix).startswith(magic)


def test_plot_shows_something_else_when_the_numbers_are_others() -> None:
    pictures = []
    for psnr in (34.0, 20.0):
        table = make_table()
        table.result["rows"][0]["psnr"] = psnr
        pictures.append(np.asarray(Image.open(io.BytesIO(tradeoff_plot(table.result)))))
    assert pictures[0].shape == pictures[1].shape
    assert (pictures[0] != pictures[1]).any()


def test_plot_refuses_other_files() -> None:
    with pytest.raises(OptionError, match=r"--plot must name one of \.png"):
        plot_suffix(Path("trade.bmp"))


def test_files_hold_the_table_and_the_plot(tmp_path: Path) -> None:
    table = make_table().to_json()
    write_tradeoff(table, tmp_path / "t.json", tmp_path / "t.png")
    assert json.loads((tmp_path / "t.json").read_text()) == json.loads(json.dumps(table))
    with Image.open(tmp_path / "t.png") as picture:
        assert picture.size[0] > 1000


# --------------------------------------------------- HTTP ---------------------------------------------------


@pytest.fixture
def client(store: Store) -> Iterator[TestClient]:
    async def resolve(name: str) -> dict[str, Any]:
        digests = {"hall": "d1", "never measured": "d2"}
        if name not in digests:
            raise UnknownSceneError(f"scene must be known, got {name}")
        return {"digest": digests[name]}

    app = FastAPI()
    add_problem_handlers(app)
    add_tradeoff_routes(app, resolve, store_tables(store.url))

    @app.get("/choose")
    def choose(max_ms: float) -> dict[str, str]:
        choice = choose_point(store, "d1", Demand(max_ms=max_ms), 100, 100)
        return point_headers(choice and choice.point, 100, 100)

    with TestClient(app, raise_server_exceptions=False) as client:
        yield client


def test_route_answers_json_and_png_by_accept(client: TestClient) -> None:
    as_json = client.get("/v1/scenes/hall/tradeoff")
    assert as_json.status_code == 200 and as_json.headers["content-type"] == "application/json"
    assert [point["name"] for point in as_json.json()["points"]] == ["ours", "no network", "1/4 samples"]
    as_png = client.get("/v1/scenes/hall/tradeoff", headers={"Accept": "image/png"})
    assert as_png.status_code == 200 and Image.open(io.BytesIO(as_png.content)).format == "PNG"


@pytest.mark.parametrize(
    ("scene", "accept", "status"), [("other", "*/*", 404), ("never measured", "*/*", 404), ("hall", "text/html", 406)]
)
def test_route_refuses_as_a_problem(client: TestClient, scene: str, accept: str, status: int) -> None:
    response = client.get(f"/v1/scenes/{scene}/tradeoff", headers={"Accept": accept})
    assert response.status_code == status == response.json()["status"]
    assert response.headers["content-type"] == "application/problem+json"


def test_unreachable_demand_is_422_and_names_the_nearest(client: TestClient) -> None:
    assert client.get("/choose?max_ms=6").json()["X-Lightwell-Point"] == "no network"
    refused = client.get("/choose?max_ms=1")
    assert refused.status_code == 422
    assert refused.json()["reachable"]["fastest"] == {"point": "no network", "ms": 5.0, "psnr": 29.0}


# ------------------------------------------------- the choice -------------------------------------------------


def test_choose_point_leaves_an_empty_demand_to_the_published_run(store: Store) -> None:
    assert choose_point(store, "d1", Demand(), 100, 100) is None
    assert point_headers(None, 100, 100) == {}
    with pytest.raises(NoOperatingPointsError):
        choose_point(store, "d2", Demand(quality="best"), 100, 100)
    with pytest.raises(UnreachableTargetError):
        choose_point(store, "d1", Demand(min_psnr=35.0), 100, 100)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--quality", "best"], "operating point 'ours': 34.00 dB measured, 20.0 ms predicted"),
        (["--max-ms", "10"], "operating point 'no network'"),
        (["--min-psnr", "33"], "operating point 'ours'"),
    ],
)
def test_frame_command_names_the_point_it_used(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], words: str
) -> None:
    import workers.point_renderer

    class Opened:
        def render(self, camera: Any, point: OperatingPoint) -> Frame:
            assert f"'{point.name}'" in words
            return Frame(np.ones((camera.height, camera.width, 3), np.float32), {"query": 0.001}, 1.0, 1.0, 0)

    monkeypatch.setattr(workers.point_renderer.PointRenderer, "open", lambda *_, **__: Opened())
    arguments = ["frame", "hall", "--store", store.url, "--look-at", "0,1,5,0,1,0", "--size", "100x100",
                 "-o", str(tmp_path / "frame.png")]  # fmt: skip
    result = CliRunner().invoke(command, [*arguments, *options])
    assert result.exit_code == 0, result.output
    assert words in result.output


@pytest.mark.parametrize(
    ("options", "words"), [(["--max-ms", "1"], "nearest: 'no network'"), (["--quality", "great"], "draft, balanced")]
)
def test_frame_command_refuses_in_one_line(store: Store, tmp_path: Path, options: list[str], words: str) -> None:
    arguments = ["frame", "hall", "--store", store.url, "--look-at", "0,1,5,0,1,0", "--size", "100x100",
                 "-o", str(tmp_path / "frame.png")]  # fmt: skip
    result = CliRunner().invoke(command, [*arguments, *options])
    assert result.exit_code == 2
    assert words in result.output and "Traceback" not in result.output


def test_demand_is_falsy_only_when_empty() -> None:
    assert not Demand() and Demand(min_psnr=0.0) and Demand(quality="draft")
