"""Jobs in the service's process: progress as events, stops between steps, what the pipeline is handed."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.job_runner import JobStopped
from service.local_runner import EventProgress, LocalRunner, frame_preview
from storage.frames import encode_frame
from storage.store import Store, UnitRef
from workers.job_spec import JobSpec
from workers.settings import Settings

Told = list[dict[str, Any]]


def spec(*stages: str) -> JobSpec:
    settings = Settings.preset_named("tiny").to_json()
    return JobSpec(scene="builtin:tiny", settings=settings, stages=stages or ("bake", "render", "train", "evaluate"))


def test_progress_is_told_step_by_step_with_the_time_left() -> None:
    told: Told = []
    progress = EventProgress(told.append, lambda: None)
    with progress.track("bake", 10) as advance:
        advance(6)  # found in the store
        time.sleep(0.06)
        advance(2, note="n")
    assert [event["done"] for event in told] == [0, 6, 8, 10]
    assert {event["kind"] for event in told} == {"progress"} and {event["total"] for event in told} == {10.0}
    assert told[1]["eta_s"] is None and told[2]["note"] == "n"
    assert 0.05 < told[2]["eta_s"] < 1.0  # two of four in 0.06 s: about as long again


@pytest.mark.parametrize("stop", ["cancel", "pause"])
def test_a_stop_is_raised_at_the_next_step(stop: Any) -> None:
    wish: list[Any] = [None]
    progress = EventProgress(lambda _: None, lambda: wish[0])
    with pytest.raises(JobStopped) as caught, progress.track("bake", 3) as advance:
        advance()
        wish[0] = stop
        advance()
    assert caught.value.stop == stop
    with pytest.raises(JobStopped), progress.track("render", 1):
        pytest.fail("a step began after the stop")


@pytest.fixture
def pipeline(monkeypatch: pytest.MonkeyPatch, evaluation: Any) -> list[tuple[str, Any]]:
    """Stands in for loading and running; returns the calls."""
    import workers.pipeline
    import workers.scene

    calls: list[tuple[str, Any]] = []

    def load_scene(source: str, *, width: int, height: int) -> Any:
        calls.append(("load", (source, width, height)))
        return SimpleNamespace(notes=("a light was added",), digest="d1", name="tiny", source=source)

    def run_scene(scene: Any, store: Store, settings: Settings, progress: Any) -> Any:
        calls.append(("run", settings))
        frame = {"radiance": np.full((4, 6, 3), 0.5, np.float32)}
        store.commit(UnitRef("d1", "render", "k1"), {"frame.exr": encode_frame(frame)}, {})
        with progress.track("bake", 1) as advance:
            advance()
        return evaluation

    monkeypatch.setattr(workers.scene, "load_scene", load_scene)
    monkeypatch.setattr(workers.pipeline, "run_scene", run_scene)
    return calls


def test_a_job_runs_the_pipeline_and_hands_over_scores_page_and_pictures(pipeline: Any, tmp_path: Path) -> None:
    told: Told = []
    result = LocalRunner(str(tmp_path / "store")).run("j1", spec(), told.append, lambda: None)
    assert pipeline[0] == ("load", ("builtin:tiny", 64, 64)) and pipeline[1][1] == Settings.preset_named("tiny")
    assert result["units"] == 1 and result["set_aside"] == [] and result["evaluation"]["rows"][0]["psnr"] == 34.25
    kinds = [event["kind"] for event in told]
    assert kinds == ["message", "preview", "progress", "progress", "report", "preview"]
    assert told[0]["text"] == "note: a light was added"
    assert told[1]["png"].startswith(b"\x89PNG") and told[-1]["png"].startswith(b"\x89PNG")
    assert "34.25" in told[4]["html"]


def test_a_job_that_was_asked_to_stop_loads_nothing(pipeline: Any, tmp_path: Path) -> None:
    with pytest.raises(JobStopped):
        LocalRunner(str(tmp_path / "store")).run("j1", spec(), lambda _: None, lambda: "cancel")
    assert pipeline == []


def test_a_second_job_waits_for_the_first_and_can_be_stopped_meanwhile(
    pipeline: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import workers.pipeline

    run_scene: Callable[..., Any] = workers.pipeline.run_scene
    inside, gate = threading.Event(), threading.Event()

    def wait_and_run(*arguments: Any) -> Any:
        inside.set()
        gate.wait(10)
        return run_scene(*arguments)

    monkeypatch.setattr(workers.pipeline, "run_scene", wait_and_run)
    runner = LocalRunner(str(tmp_path / "store"))
    first = threading.Thread(target=runner.run, args=("j1", spec(), lambda _: None, lambda: None))
    first.start()
    assert inside.wait(10)
    with pytest.raises(JobStopped):
        runner.run("j2", spec(), lambda _: None, lambda: "pause")
    gate.set()
    first.join(10)
    assert [name for name, _ in pipeline] == ["load", "run"]


def test_a_preview_shows_a_frame_even_where_it_is_not_finite() -> None:
    radiance = np.full((4, 6, 3), np.inf, np.float32)
    assert frame_preview(encode_frame({"radiance": radiance})).startswith(b"\x89PNG")
