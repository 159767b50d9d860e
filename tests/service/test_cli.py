"""The commands, with stand-ins for what workers do: what they write and print, and how they fail."""

import dataclasses
import io
import json
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner, Result

import workers.settings
from service.cli import app
from storage.store import Store
from workers.camera import Camera
from workers.errors import SceneError
from workers.settings import Settings

COMMANDS = ("demo", "plan", "run", "frame", "evaluate", "serve")


@dataclasses.dataclass
class FakeScene:
    name: str = "tabletop"
    digest: str = "d1"
    camera: Camera = dataclasses.field(
        default_factory=lambda: Camera.look_at([0, 1, 5], [0, 1, 0], [0, 1, 0], 40.0, 24, 16)
    )
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ("a light was added",)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch, evaluation: Any, backend: Any) -> list[tuple[str, dict[str, Any]]]:
    """Replaces the modules of workers that load and render; returns what they were called with."""
    calls: list[tuple[str, dict[str, Any]]] = []

    def load_scene(source: str, *, width: int | None, height: int | None) -> FakeScene:
        calls.append(("load_scene", {"source": source, "width": width, "height": height}))
        if source == "broken.xml":
            raise SceneError("scene must hold a sensor,\ngot none")
        scene = FakeScene(settings={"cache.polar": 5, "cache.azimuth": 6} if source == "asks.yaml" else {})
        return dataclasses.replace(scene, camera=scene.camera.resized(width or 24, height or 16))

    def run_scene(scene: Any, store: Store, settings: Any, progress: Any, *, camera_size: tuple[int, int]) -> Any:
        calls.append(("run_scene", {"settings": settings, "size": camera_size, "store": store}))
        with progress.track("bake", 1):
            pass
        return evaluation

    def evaluate_scene(scene: Any, store: Store, settings: Any, progress: Any) -> Any:
        calls.append(("evaluate_scene", {"settings": settings}))
        return evaluation

    def published_settings(scene: Any, store: Store) -> Any:
        return Settings.preset_named("draft").override({"width": 48, "height": 32, "cache.polar": 7})

    def plan_scene(scene: Any, settings: Any) -> dict[str, Any]:
        return {"rows": [{"item": "elements", "choice": "lattice", "reason": "walls are large"}],
                "cost": {"paths": 1e6, "seconds": 60, "nbytes": 1024}}  # fmt: skip

    def open_renderer(store: Store, name: str) -> Any:
        calls.append(("open_renderer", {"name": name}))
        return backend.open(name)

    modules = {
        "workers.scene": {"load_scene": load_scene},
        "workers.pipeline": {
            "run_scene": run_scene,
            "evaluate_scene": evaluate_scene,
            "plan_scene": plan_scene,
            "published_settings": published_settings,
        },
        "workers.renderer": {"FrameRenderer": types.SimpleNamespace(open=open_renderer)},
    }
    for name, contents in modules.items():
        module = types.ModuleType(name)
        module.__dict__.update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    return calls


@pytest.fixture
def store(tmp_path: Path) -> str:
    return str(tmp_path / "store")


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


def assert_mistake(result: Result, words: str) -> None:
    """One line on standard error that holds the words, exit code 2."""
    assert result.exit_code == 2, (result.output, result.exception)
    lines = [line for line in result.stderr.strip().splitlines() if not line.startswith("note: ")]
    assert len(lines) == 1 and lines[0].startswith("lightwell: ") and words in lines[0], result.stderr


def read_picture(path: Path) -> Image.Image:
    return Image.open(io.BytesIO(path.read_bytes()))


def test_help_lists_the_commands() -> None:
    output = invoke("--help").output
    assert [command for command in COMMANDS if command not in output] == []


def test_help_imports_neither_mitsuba_nor_torch() -> None:
    code = ("import sys\nfrom typer.testing import CliRunner\nfrom service.cli import app\n"
            "assert CliRunner().invoke(app, ['run', '--help']).exit_code == 0\n"
            "print([m for m in ('mitsuba', 'torch', 'fastapi') if m in sys.modules])")  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"


def test_run_writes_json_report_and_picture(calls: Any, store: str, tmp_path: Path, evaluation: Any) -> None:
    files = {name: tmp_path / name for name in ("out.json", "out.html", "out.png")}
    result = invoke("run", "scene.xml", "--store", store, "--json", str(files["out.json"]),
                    "--report", str(files["out.html"]), "--picture", str(files["out.png"]))  # fmt: skip
    assert result.exit_code == 0, result.output
    assert json.loads(files["out.json"].read_text()) == evaluation.result
    assert files["out.html"].read_text().startswith("<!doctype html>")
    assert read_picture(files["out.png"]).size == (4 * 24 + 3 * 4, 16)
    assert "≈34.25" in result.stdout and f"report: {files['out.html']}" in result.stdout
    assert "bake" in result.stderr and "note: a light was added" in result.stderr


def test_json_has_null_for_what_is_not_finite(calls: Any, store: str, tmp_path: Path, evaluation: Any) -> None:
    evaluation.result["rows"][0]["psnr"] = float("inf")
    evaluation.result["rows"][1]["psnr"] = np.float32("nan")
    result = invoke("run", "scene.xml", "--store", store, "--json", str(tmp_path / "out.json"))
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert rows[0]["psnr"] is None and rows[1]["psnr"] is None and rows[2]["psnr"] == 12.0


def test_report_goes_into_the_store_unless_told_otherwise(calls: Any, store: str) -> None:
    assert invoke("run", "scene.xml", "--store", store).exit_code == 0
    assert Path(store, "reports", "tabletop-24x16.html").is_file()


def test_settings_come_from_preset_then_file_then_command_line(calls: Any, store: str) -> None:
    result = invoke("run", "asks.yaml", "--store", store, "--preset", "draft", "--resolution", "40x30",
                    "--set", "cache.azimuth=7")  # fmt: skip
    assert result.exit_code == 0, result.output
    (_, loaded), (_, ran) = calls
    assert loaded == {"source": "asks.yaml", "width": 40, "height": 30}
    settings = ran["settings"]
    assert (settings.preset, settings.cache.polar, settings.cache.azimuth) == ("draft", 5, 7)
    assert ran["size"] == (settings.width, settings.height) == (40, 30)
    assert settings.frames == workers.settings.Settings.preset_named("draft").frames


def test_demo_ends_with_table_report_and_a_frame_request_that_works(calls: Any, store: str, tmp_path: Path) -> None:
    result = invoke("demo", "--store", store)
    assert result.exit_code == 0, result.output
    assert calls[0][1] == {"source": "tabletop", "width": 256, "height": 256}
    lines = result.stdout.strip().splitlines()
    assert lines[-3].startswith("report: ")
    assert "curl" in lines[-2] and "/v1/scenes/tabletop/frame" in lines[-2]
    body = json.loads(lines[-2].split("-d '")[1].split("'")[0])
    from service.schemas import FrameRequest

    assert np.allclose(FrameRequest.model_validate(body).to_camera().origin, [0, 1, 5])
    arguments = lines[-1].split("lightwell ")[1].split()
    arguments[arguments.index("-o") + 1] = str(tmp_path / "frame.png")
    assert invoke(*arguments).exit_code == 0
    assert read_picture(tmp_path / "frame.png").size == (256, 256)


def test_plan_prints_choices_and_cost_and_makes_no_store(calls: Any, tmp_path: Path) -> None:
    result = invoke("plan", "scene.xml", "--json", str(tmp_path / "plan.json"))
    assert result.exit_code == 0 and "walls are large" in result.stdout and "1 min 00 s" in result.stdout
    assert [name for name, _ in calls] == ["load_scene"]
    assert json.loads((tmp_path / "plan.json").read_text())["rows"][0]["item"] == "elements"


def test_planned_run_asks_for_a_plan_and_keeps_what_was_set(calls: Any, store: str) -> None:
    assert invoke("run", "scene.xml", "--store", store, "--planned", "--set", "cache.polar=6").exit_code == 0
    assert invoke("run", "scene.xml", "--store", store).exit_code == 0
    plans = [facts["settings"].plan for name, facts in calls if name == "run_scene"]
    assert [(plan.mode, plan.keep) for plan in plans] == [("adaptive", ("cache.polar",)), ("preset", ())]


def test_evaluate_measures_the_served_run_with_its_own_settings(calls: Any, store: str) -> None:
    Store.open(store, create=True)
    result = invoke("evaluate", "scene.xml", "--store", store, "--set", "evaluation.spp=2,64")
    assert result.exit_code == 0 and "pt-1+oidn-high" in result.stdout
    assert calls[-1][0] == "evaluate_scene"
    used = calls[-1][1]["settings"]
    assert (used.width, used.cache.polar, used.evaluation.spp, used.preset) == (48, 7, (2, 64), "draft")
    assert calls[-2] == ("load_scene", {"source": "scene.xml", "width": 48, "height": 32})


def test_evaluate_of_a_named_preset_measures_that_run(calls: Any, store: str) -> None:
    Store.open(store, create=True)
    assert invoke("evaluate", "scene.xml", "--store", store, "--preset", "reference").exit_code == 0
    used = calls[-1][1]["settings"]
    assert (used.preset, used.width, used.cache.polar) == ("reference", 24, 16)


@pytest.mark.parametrize(("name", "kind"), [("f.png", "PNG"), ("f.jpg", "JPEG")])
def test_frame_writes_the_picture_and_tells_its_times(
    calls: Any, store: str, tmp_path: Path, name: str, kind: str
) -> None:
    Store.open(store, create=True)
    result = invoke("frame", "tabletop", "--store", store, "--look-at=-1,2,3,0,0,0,0,1,0", "--size", "20x10",
                    "--fov", "30", "-o", str(tmp_path / name))  # fmt: skip
    assert result.exit_code == 0, result.output
    picture = read_picture(tmp_path / name)
    assert picture.format == kind and picture.size == (20, 10)
    assert "query 4.0 ms, network 1.5 ms, coverage 97.5 %, non-finite values 0" in result.stdout
    assert calls == [("open_renderer", {"name": "tabletop"})]


def test_frame_of_a_scene_file_goes_by_its_digest(calls: Any, store: str, tmp_path: Path) -> None:
    Store.open(store, create=True)
    file = tmp_path / "scene.xml"
    file.write_text("<scene/>")
    result = invoke("frame", str(file), "--store", store, "--look-at", "0,1,5,0,1,0", "-o", str(tmp_path / "f.exr"))
    assert result.exit_code == 0, result.output
    assert calls[-1] == ("open_renderer", {"name": "d1"})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--resolution", "640"], "--resolution must be WIDTHxHEIGHT"),
        (["--preset", "best"], "preset must be one of"),
        (["--set", "cache.colour=1"], "cache.colour"),
        (["--set", "cache"], "--set must be key=value"),
        (["--json", "no/such/folder/out.json"], "--json must lie in a folder that exists"),
    ],
)
def test_bad_options_are_one_line_and_touch_nothing(calls: Any, store: str, arguments: list[str], words: str) -> None:
    assert_mistake(invoke("run", "scene.xml", "--store", store, *arguments), words)
    assert not Path(store).exists() and "run_scene" not in dict(calls)


def test_a_broken_scene_is_one_line_and_leaves_no_store(calls: Any, store: str) -> None:
    assert_mistake(invoke("run", "broken.xml", "--store", store), "scene must hold a sensor, got none")
    assert not Path(store).exists()


@pytest.mark.parametrize(
    "arguments",
    [("evaluate", "scene.xml"), ("frame", "tabletop", "--look-at", "0,1,5,0,1,0", "-o", "f.png")],
)
def test_a_store_that_is_missing_is_one_line(calls: Any, store: str, arguments: tuple[str, ...]) -> None:
    assert_mistake(invoke(*arguments, "--store", store), store)
    assert not Path(store).exists()


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            MemoryError("Unable to allocate 9 TiB"),
            "not enough memory: Unable to allocate 9 TiB; choose a smaller size",
        ),
        (PermissionError(13, "Permission denied", "/store/x"), "/store/x: Permission denied"),
        (FileNotFoundError("plain\ntext"), "plain text"),
    ],
)
def test_failures_of_the_system_are_one_line(
    calls: Any, store: str, monkeypatch: pytest.MonkeyPatch, error: Exception, words: str
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(sys.modules["workers.pipeline"], "run_scene", fail)
    assert_mistake(invoke("run", "scene.xml", "--store", store), words)


def test_a_bug_keeps_its_traceback(calls: Any, store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(sys.modules["workers.pipeline"], "run_scene", fail)
    result = invoke("run", "scene.xml", "--store", store)
    assert isinstance(result.exception, ZeroDivisionError)


def test_an_interrupt_is_130_and_says_what_is_kept(calls: Any, store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["workers.pipeline"], "run_scene", interrupt)
    result = invoke("run", "scene.xml", "--store", store)
    assert result.exit_code == 130 and "interrupted" in result.stderr


def test_serve_refuses_a_port_in_use(store: str) -> None:
    from service.serving import bind

    Store.open(store, create=True)
    with bind("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        assert_mistake(invoke("serve", "--store", store, "--port", str(port)), "choose another --host or --port")


def test_serve_beyond_this_machine_wants_a_token(store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    Store.open(store, create=True)
    monkeypatch.delenv("LIGHTWELL_TOKEN", raising=False)
    assert_mistake(invoke("serve", "--store", store, "--host", "0.0.0.0", "--port", "0"), "set LIGHTWELL_TOKEN")
    monkeypatch.setenv("LIGHTWELL_TOKEN", "two words")
    assert_mistake(invoke("serve", "--store", store), "token must be printable ASCII")
