"""Benchmarks: sentences against numbers worked out by hand, records that merge, the page, the commands."""

import dataclasses
import json
import sys
import types
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from service import trade
from service.ablations import HEAD, OURS, PLANNED, UNIFORM, ablation_cells, requirement
from service.benchmark_page import render_page, table
from service.benchmarks import (
    BenchmarkError,
    BenchmarkRequest,
    keep_ablation,
    load_all,
    measure,
    merge,
    record_file,
    save,
    shown_path,
    write_page,
)
from service.cli import app
from storage.store import Store
from workers.ablation import variants
from workers.camera import Camera
from workers.progress import Progress
from workers.settings import Settings

FRAME_TIMES = {
    "width": 1920, "height": 1080, "repeats": 7, "samples": 2,
    "ms": {"primary": 25.0, "query-1x1": 70.0, "query": 120.0, "network": 350.0, "frame": 470.0,
           "pt-1": 900.0, "oidn-fast": 1000.0, "oidn-balanced": 1800.0, "oidn-high": 5000.0},
    "ratios": {"query / primary": 4.8, "frame / oidn-fast": 0.47},
    "network": {"choice": "bf16 compiled", "gflop": 82.0, "gflop_per_s": 234.3, "share": 0.31, "threads": 2,
                "peak_gflop_per_s": {"fp32": 190.0, "bf16": 755.0}},
}  # fmt: skip
BAKE = {
    "max_depth": 12, "repeats": 7, "paths": {"diffuse": 2097152, "mi.render path": 2097152},
    "paths_per_s": {"diffuse": 1.5e6, "mi.render path": 2.0e6}, "ratios": {"diffuse": 0.75},
}  # fmt: skip
MEASURED = {"frame_times": FRAME_TIMES, "bake": BAKE, "load": {"other_cpus": 0.0, "cpus": 2.0}}


def frame_row(name: str, psnr: float | None, flip: float, ms: float, **more: Any) -> dict[str, Any]:
    return {"name": name, "psnr": psnr, "flip": flip, "ms": ms, "non_finite": 0, **more}


def make_result(*rows: dict[str, Any], **more: Any) -> dict[str, Any]:
    default = [
        frame_row("ours", 32.0, 0.05, 20.0),
        frame_row("ir", 29.5, 0.08, 8.0),
        frame_row("ir+oidn", 31.0, 0.06, 80.0),
        frame_row("pt-1+oidn-fast", 28.0, 0.09, 125.0),
        frame_row("pt-1+oidn-high", 29.0, 0.04, 250.0),
        frame_row("pt-16+oidn-high", 32.5, 0.045, 2000.0),
    ]
    return {
        "scene": "hall", "width": 256, "height": 256, "rows": list(rows) or default, "preset": "draft",
        "stages": [{"name": "bake", "seconds": 90.0}, {"name": "train", "seconds": 600.0}],
        "cache_nbytes": 3 * 2**20, "network_nbytes": 2**20, "reference_error_db": 40.0,
        "reference_denoised": False, "coverage": 0.999, "commit": "0123abc", "machine": "2 CPU threads",
        "settings": {"preset": "draft", "train": {"widths": [32, 48, 64]}}, "notes": [], **more,
    }  # fmt: skip


def make_record(scene: str = "hall", **more: Any) -> dict[str, Any]:
    result = make_result(scene=scene)
    return {
        "schema": 1, "scene": scene, "source": f"scenes/{scene}/scene.xml", "digest": "d1",
        "command": "lightwell a", "commit": "0123abc", "machine": "2 CPU threads", "result": result,
        **MEASURED, **more,
    }  # fmt: skip


def ablation_row(name: str, ir_psnr: float, psnr: float, network: bool = True) -> dict[str, Any]:
    return {"name": name, "network": network, "ir_psnr": ir_psnr, "psnr": psnr, "ssim": 0.9, "flip": 0.1,
            "bake_paths": 2.5e6, "bake_seconds": 12.0, "cache_nbytes": 2048}  # fmt: skip


ABLATION_ROWS = [
    ablation_row("paper", 24.0, 28.0),
    ablation_row("paper, 1 ray", 23.0, 23.0, network=False),
    ablation_row("ours", 29.0, 31.5),
]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store.open(tmp_path / "store", create=True)


# ------------------------------------------------ sentences -----------------------------------------------


def test_sentences_tell_wins_and_losses_in_numbers() -> None:
    assert trade.sentences(make_result()) == [
        "At equal time: no denoised path-traced row is as fast as our frame (20.0 ms); the fastest, "
        "pt-1+oidn-fast, takes 6.25 times as long, and ours is 4.00 dB better in PSNR and 0.0400 better in "
        "FLIP.",
        "The fastest denoised row with a higher PSNR than ours is pt-16+oidn-high: 0.50 dB more, in 100.00 "
        "times our time.",
        "Against pt-1+oidn-high: ours is 3.00 dB better in PSNR and 0.0100 worse in FLIP, in 0.08 times its "
        "time.",
        "The network adds 2.50 dB to the caches alone (ir: 29.50 dB in 8.0 ms).",
        "Against ir+oidn: ours is 1.00 dB better in PSNR and 0.0100 better in FLIP, in 0.25 times its time.",
        "The raw references' own noise would score 40.00 dB.",
    ]  # fmt: skip


def test_sentences_at_equal_time_compare_with_the_best_of_each_score() -> None:
    rows = [
        frame_row("ours", 30.0, 0.05, 130.0),
        frame_row("pt-1+oidn-fast", 31.0, 0.04, 120.0),
        frame_row("pt-1+oidn-high", 30.5, 0.03, 130.0),
        frame_row("pt-4+oidn-high", 40.0, 0.01, 131.0),
    ]
    assert trade.sentences(make_result(*rows))[0] == (
        "At equal time: pt-1+oidn-fast, pt-1+oidn-high take no more time than our frame (130.0 ms); against "
        "the best of them in PSNR, pt-1+oidn-fast, ours is 1.00 dB worse in PSNR and 0.0100 worse in FLIP; "
        "against the best in FLIP, pt-1+oidn-high, ours is 0.50 dB worse in PSNR and 0.0200 worse in FLIP."
    )


def test_sentences_do_not_hide_a_network_that_harms() -> None:
    rows = [frame_row("ours", 28.0, 0.1, 20.0), frame_row("ir", 29.0, 0.1, 8.0)]
    assert "The network takes 1.00 dB from the caches alone (ir: 29.00 dB in 8.0 ms)." in trade.sentences(
        make_result(*rows)
    )


def test_sentences_compare_nothing_where_ours_is_refused() -> None:
    rows = [frame_row("ours", 30.0, 0.05, 20.0, non_finite=3), frame_row("ir", 29.0, 0.1, 8.0)]
    assert trade.sentences(make_result(*rows)) == [
        "Our frames get no score (3 non-finite values): nothing is compared."
    ]


def test_sentences_leave_out_rows_that_are_refused() -> None:
    rows = [
        frame_row("ours", 30.0, 0.05, 20.0),
        frame_row("pt-1+oidn-high", 20.0, 0.2, 10.0, non_finite=1),
        frame_row("pt-4+oidn-high", 29.0, 0.2, 40.0),
    ]
    text = " ".join(trade.sentences(make_result(*rows)))
    assert "pt-1+oidn-high" not in text and "the fastest, pt-4+oidn-high, takes 2.00 times" in text


@pytest.mark.parametrize(
    ("error_db", "denoised", "told"),
    [
        (40.0, False, set()),
        (34.0, False, {"within 3 dB"}),
        (34.0, True, {"within 3 dB", "were denoised, which favours"}),
    ],
)
def test_sentences_tell_what_the_reference_is_worth(error_db: float, denoised: bool, told: set[str]) -> None:
    last = trade.sentences(make_result(reference_error_db=error_db, reference_denoised=denoised))[-1]
    assert {words for words in ("within 3 dB", "were denoised, which favours") if words in last} == told


# ------------------------------------------------- records ------------------------------------------------


def test_shown_path_is_never_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "project"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert shown_path("../scenes/hall/scene.xml") == "../scenes/hall/scene.xml"
    assert shown_path(str(folder / "a.xml")) == "a.xml"
    assert shown_path(str(tmp_path / "hall" / "scene.xml")) == "../hall/scene.xml"
    assert shown_path("/far/away/hall/scene.xml") == "hall/scene.xml"
    assert shown_path("file:///far/away/store") == "away/store"
    assert shown_path("/store") == "store"
    assert shown_path("s3://bucket/store") == "s3://bucket/store"
    assert shown_path("tabletop") == "tabletop"


def test_request_names_a_command_that_asks_for_the_same() -> None:
    request = BenchmarkRequest(
        source="/far/away/my hall/scene.xml", store_url="store", preset="draft", resolution="64x48",
        assignments=("cache.polar=4",), size=(128, 96), repeats=3, ablate=True,
    )  # fmt: skip
    assert request.command == (
        "lightwell benchmark --scene 'my hall/scene.xml' --store store --preset draft --resolution 64x48 "
        "--set cache.polar=4 --size 128x96 --repeats 3 --ablate"
    )


def test_merge_keeps_an_ablation_that_was_not_asked_for_again() -> None:
    old, new = make_record(ablation={"rows": [1]}), make_record(commit="new")
    merged = merge(old, new)
    assert (merged["ablation"], merged["commit"]) == ({"rows": [1]}, "new")
    assert merge(old, new | {"ablation": {"rows": [2]}})["ablation"] == {"rows": [2]}


def test_merge_forgets_everything_of_a_scene_that_has_changed() -> None:
    new = make_record(digest="d2")
    assert merge(make_record(ablation={"rows": [1]}), new) == new


def test_merge_keeps_seconds_of_stages_that_were_resumed_with_the_same_settings() -> None:
    new = make_record()
    new["result"]["settings"]["train"] = {"widths": (32, 48, 64)}  # a tuple here, a list in the stored record
    new["result"]["stages"] = [{"name": "train", "seconds": 1.0}, {"name": "evaluate", "seconds": 2.0}]
    seconds = {stage["name"]: stage["seconds"] for stage in merge(make_record(), new)["result"]["stages"]}
    assert seconds == {"bake": 90.0, "train": 1.0, "evaluate": 2.0}
    new["result"]["settings"] = {"preset": "balanced"}
    assert merge(make_record(), new)["result"]["stages"] == new["result"]["stages"]


def test_records_survive_the_store_in_the_order_of_names(store: Store) -> None:
    assert load_all(store.files) == []
    for scene in ("hall", "ajar", "tabletop"):
        save(store.files, make_record(scene))
    assert load_all(store.files) == [make_record(scene) for scene in ("ajar", "hall", "tabletop")]
    save(store.files, make_record("hall", commit="later"))
    assert [record["commit"] for record in load_all(store.files)] == ["0123abc", "later", "0123abc"]


@pytest.mark.parametrize("content", [b"{", b"[]", b'{"schema": 0}'])
def test_a_record_that_cannot_be_read_names_file_and_remedy(store: Store, content: bytes) -> None:
    store.files.write(record_file("hall"), content)
    with pytest.raises(BenchmarkError, match=r"benchmarks/hall\.json; delete it"):
        load_all(store.files)


# -------------------------------------------------- page --------------------------------------------------


def section(page: str, title: str) -> str:
    """What stands below a heading, up to the next one."""
    return page.split(f" {title}\n")[1].split("\n#")[0]


def test_page_of_nothing_says_so() -> None:
    assert render_page([]).endswith("No scene has been measured yet.\n")


def test_page_holds_every_measurement_of_every_scene() -> None:
    page = render_page([make_record("ajar"), make_record("hall")])
    assert page.index("## ajar") < page.index("## hall")
    hall = page[page.index("## hall") :]
    assert "`scenes/hall/scene.xml`, 256x256, preset draft." in hall
    assert trade.sentences(make_result())[0] in hall
    assert "```sh\nlightwell a\n```\n\nCommit 0123abc; 2 CPU threads." in hall
    assert "| ours | 32.00 |" in section(hall, "Frames") and "| **32.50** |" in section(hall, "Frames")
    assert "40.00 dB, used as rendered" in section(hall, "Frames")
    assert "| bake | 1 min 30 s |" in hall and "| **all** | 11 min 30 s |" in hall
    assert "Caches 3.0 MiB, network 1.0 MiB." in hall
    times = section(hall, "Time of a 1920x1080 frame")
    assert "| **whole frame** | 470.0 |" in times and "query with G-buffers, 2x2 (this run) | 120.0 |" in times
    assert "82.00 GFLOP at 234 GFLOP/s: 31 % of the bf16 peak" in times
    bake = section(hall, "Throughput of the bake")
    assert "| diffuse | 1.50 | 0.75 | 2,097,152 |" in bake and "| mi.render path | 2.00 | 1 |" in bake
    assert "Ablation" not in hall and "busy" not in hall


def test_page_begins_with_a_line_a_scene() -> None:
    page = render_page([make_record()])
    assert "| [hall](#hall) | 32.00 | +3.00 | 12.50 | +2.50 | +1.00 | 40.00 |" in page


def test_page_tells_that_the_machine_was_busy_and_what_is_not_known() -> None:
    record = make_record(load={"other_cpus": 1.4, "cpus": 2.0})
    record["result"]["stages"] = [{"name": "train", "seconds": 600.0}]
    page = render_page([record])
    assert "Other processes kept 1.4 of 2 CPU threads busy" in page
    assert "stages that were in the store before the first benchmark are not known" in page


def test_keep_ablation_needs_a_record_of_the_same_scene(tmp_path: Path) -> None:
    store = Store.open(tmp_path, create=True)
    ablation = {"scene": "hall", "rows": [ablation_row("ours", 30.0, 32.0)]}
    assert not keep_ablation(store, "d1", ablation)
    save(store.files, make_record())
    assert not keep_ablation(store, "another digest", ablation)
    assert keep_ablation(store, "d1", ablation)
    assert load_all(store.files)[0]["ablation"] == ablation


def test_page_shows_the_ablation_with_its_own_command() -> None:
    own = {"command": "lightwell b", "commit": "fff", "machine": "other", "width": 64, "height": 64,
           "preset": "tiny", "rows": ABLATION_ROWS}  # fmt: skip
    ablation = section(render_page([make_record(ablation=own)]), "Ablation")
    assert "64x64, preset tiny." in ablation and "lightwell b" in ablation and "Commit fff; other." in ablation
    assert "| paper, 1 ray | 23.00 | - | -6.00* | 0.9000* | 0.1000* | 2.5 M | 12.0 s | 2.0 KiB |" in ablation
    same = own | {key: make_record()[key] for key in ("command", "commit", "machine")}
    assert "```sh" not in section(render_page([make_record(ablation=same)]), "Ablation")


def whole_row(name: str, psnr: float, paths: float, whole: float) -> dict[str, Any]:
    costs = {"bake_paths": paths, "cache_nbytes": paths / 10, "whole_paths": whole, "whole_nbytes": whole / 20}
    return ablation_row(name, 20.0, psnr) | costs


def test_page_says_what_a_plan_saves_against_uniform_caches_on_every_triangle() -> None:
    names = {row.name for row in variants(Settings.preset_named("tiny"))}
    assert {OURS, UNIFORM, *PLANNED} <= names
    rows = [whole_row(UNIFORM, 30.0, 5e8, 1e9), whole_row("ours, planned", 32.5, 4e7, 4e7)]
    said = "Planned caches: 1/25 of the paths, 1/12.5 of the bytes, final PSNR +2.50 dB."
    own = {"command": "b", "commit": "fff", "machine": "other", "width": 64, "height": 64, "preset": "tiny"}
    page = render_page([make_record(ablation=own | {"rows": ABLATION_ROWS}, selection=own | {"rows": rows})])
    assert said in section(page, "Ablation, selected rows")
    assert "every triangle: Planned" not in section(page, "Ablation")
    assert requirement(rows[:1]) == "" and requirement([rows[0] | {"psnr": None}, rows[1]]) == ""


def test_selected_rows_do_not_replace_an_ablation_of_all(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "store", create=True)
    page = tmp_path / "docs" / "page.md"
    whole, some = ({"scene": "hall", "command": name, "commit": "fff", "machine": "m", "width": 64, "height": 64,
                    "preset": "tiny", "rows": ABLATION_ROWS} for name in ("whole", "some"))  # fmt: skip
    save(store.files, make_record())
    keep_ablation(store, "d1", whole)
    keep_ablation(store, "d1", some | {"selected": True})
    write_page(store, page)
    assert [load_all(store.files)[0][key]["command"] for key in ("ablation", "selection")] == ["whole", "some"]
    another = Store.open(tmp_path / "another", create=True)
    save(another.files, make_record(measured_at="9999"))
    write_page(another, page)  # measured again in a store that knows no ablation
    assert "whole" in section(page.read_text(), "Ablation")


def test_table_cells_cannot_break_the_table() -> None:
    lines = table(("a|b", "c"), [["x\ny", "1 | 2"]])
    assert lines == ["| a\\|b | c |", "| --- | ---: |", "| x y | 1 \\| 2 |", ""]


def test_ablation_cells_compare_like_with_like() -> None:
    cells = ablation_cells(ABLATION_ROWS)
    assert all(len(row) == len(HEAD) for row in cells)
    assert [row[3] for row in cells] == ["-3.50", "-6.00*", "+0.00"]
    refused = ablation_cells([ABLATION_ROWS[0] | {"psnr": None, "ssim": None}, ABLATION_ROWS[2]])[0]
    assert refused[2:5] == ["refused", "-", "refused"]


# ------------------------------------------------- commands -----------------------------------------------


@dataclasses.dataclass
class FakeScene:
    name: str = "hall"
    digest: str = "d1"
    source: str = "hall.xml"
    address: str = "/scenes/hall.xml"
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()
    camera: Camera = dataclasses.field(
        default_factory=lambda: Camera.look_at([0, 1, 5], [0, 1, 0], [0, 1, 0], 40.0, 24, 16)
    )


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Any]]:
    """Replaces what loads, renders and measures; returns what it was called with."""
    calls: list[tuple[str, Any]] = []

    def load_scene(source: str, *, width: int | None, height: int | None) -> FakeScene:
        return FakeScene(name=Path(source).stem)

    def run_scene(scene: Any, store: Store, settings: Any, progress: Any, *, camera_size: Any) -> Any:
        calls.append(("run_scene", scene.name))
        return types.SimpleNamespace(result=make_result(scene=scene.name), pictures=[])

    def measure_scene(scene: Any, store: Store, size: Any, repeats: int, progress: Any) -> dict[str, Any]:
        calls.append(("measure_scene", (size, repeats)))
        return json.loads(json.dumps(MEASURED))

    def run_ablation(scene: Any, store: Store, settings: Any, progress: Any, names: Any) -> list[dict[str, Any]]:
        calls.append(("run_ablation", [entry["name"] for entry in store.scenes()]))
        return [row for row in ABLATION_ROWS if not names or row["name"] in names]

    contents = {
        "workers.scene": {"load_scene": load_scene},
        "workers.pipeline": {"run_scene": run_scene},
        "workers.benchmark": {"measure_scene": measure_scene},
        "workers.ablation": {"run_ablation": run_ablation},
        "workers.evaluate": {"commit": lambda: "0123abc", "machine": lambda: "2 CPU threads"},
    }
    for name, values in contents.items():
        module = types.ModuleType(name)
        module.__dict__.update(values)
        monkeypatch.setitem(sys.modules, name, module)
    return calls


def invoke(*arguments: str) -> Result:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, (result.output, result.exception)
    return result


def test_benchmark_measures_scenes_one_at_a_time_and_keeps_them_all(calls: Any, tmp_path: Path) -> None:
    url, page = str(tmp_path / "store"), tmp_path / "benchmarks.md"
    invoke("benchmark", "--store", url, "-o", str(page), "--scene", "b.xml", "--size", "64x48", "--repeats", "2")
    assert calls == [("run_scene", "b"), ("measure_scene", ((64, 48), 2))]
    invoke("benchmark", "--store", url, "-o", str(page), "--scene", "c.xml", "--scene", "a.xml")
    text = page.read_text()
    assert [line for line in text.splitlines() if line.startswith("## ")] == ["## a", "## b", "## c"]
    assert str(tmp_path) not in text
    assert (tmp_path / "store" / "benchmarks" / "b.json").is_file()


def test_benchmark_without_a_scene_only_writes_the_page(calls: Any, tmp_path: Path, store: Store) -> None:
    save(store.files, make_record())
    page = tmp_path / "benchmarks.md"
    result = invoke("benchmark", "--store", store.url, "--output", str(page))
    assert calls == [] and "measured scenes: 1" in result.stdout
    assert page.read_text() == render_page([make_record()])


def test_benchmark_keeps_the_run_when_its_ablation_fails(
    calls: Any, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(sys.modules["workers.ablation"], "run_ablation", fail)
    request = BenchmarkRequest(source="hall", store_url=store.url, preset="draft", resolution=None, ablate=True)
    settings = Settings.preset_named("draft")
    with pytest.raises(ZeroDivisionError):
        measure(FakeScene(), store, settings, request, Progress())  # type: ignore[arg-type]
    assert [record["scene"] for record in load_all(store.files)] == ["hall"]


def test_benchmark_adds_the_ablation_when_asked(calls: Any, tmp_path: Path) -> None:
    page = tmp_path / "benchmarks.md"
    invoke("benchmark", "--store", str(tmp_path / "s"), "-o", str(page), "--scene", "hall.xml", "--ablate")
    assert "### Ablation" in page.read_text()
    invoke("benchmark", "--store", str(tmp_path / "s"), "-o", str(page), "--scene", "hall.xml")
    assert [name for name, _ in calls].count("run_ablation") == 1
    assert "### Ablation" in page.read_text()


def test_benchmark_refuses_a_page_it_cannot_write_before_it_measures(calls: Any, tmp_path: Path) -> None:
    output = str(tmp_path / "missing" / "page.md")
    result = CliRunner().invoke(app, ["benchmark", "--store", str(tmp_path / "s"), "-o", output, "--scene", "a.xml"])
    assert result.exit_code == 2 and "--output must lie in a folder that exists" in result.stderr
    assert calls == []


def test_ablate_prints_the_table_and_writes_json(calls: Any, tmp_path: Path) -> None:
    file = tmp_path / "ablation.json"
    result = invoke("ablate", "hall.xml", "--store", str(tmp_path / "s"), "--json", str(file),
                    "--resolution", "24x16")  # fmt: skip
    assert calls == [("run_ablation", ["hall"])]  # the scene is registered before its units are written
    assert "paper, 1 ray" in result.stdout and "-6.00*" in result.stdout
    written = json.loads(file.read_text())
    assert written["rows"] == ABLATION_ROWS
    assert (written["width"], written["height"], written["preset"]) == (24, 16, "draft")
    assert written["command"].startswith("lightwell ablate hall.xml --store ")


def test_ablate_takes_the_rows_that_are_named(calls: Any, store: Store, tmp_path: Path) -> None:
    file = tmp_path / "rows.json"
    invoke("ablate", "hall.xml", "--store", store.url, "--row", "ours", "--json", str(file))
    written = json.loads(file.read_text())
    assert [row["name"] for row in written["rows"]] == ["ours"]
    assert written["command"].endswith("--row ours")


def test_ablate_leaves_what_the_store_knows_of_a_scene(calls: Any, store: Store) -> None:
    store.register_scene("d1", {"name": "hall", "network": "abc"})
    invoke("ablate", "hall.xml", "--store", store.url)
    assert store.find_scene("d1")["network"] == "abc"


def test_write_page_tells_how_many(store: Store, tmp_path: Path) -> None:
    assert write_page(store, tmp_path / "page.md") == 0
    save(store.files, make_record())
    assert write_page(store, tmp_path / "page.md") == 1


def test_page_keeps_the_scenes_of_other_stores_and_the_later_record(tmp_path: Path) -> None:
    stores = [Store.open(tmp_path / name, create=True) for name in ("one", "other")]
    page = tmp_path / "docs" / "benchmarks.md"
    save(stores[0].files, make_record("ajar"))
    save(stores[0].files, make_record("hall", commit="first", measured_at="2026-01-01T00:00:00Z"))
    save(stores[1].files, make_record("hall", commit="second", measured_at="2026-01-02T00:00:00Z"))
    assert [write_page(store, page) for store in (*stores, stores[0])] == [2, 2, 2]
    text = page.read_text()
    assert "## ajar" in text and "Commit second" in text and "Commit first" not in text
    assert sorted(file.name for file in (page.parent / "benchmarks").iterdir()) == ["ajar.json", "hall.json"]
