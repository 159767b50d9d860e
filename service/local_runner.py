"""Jobs in the service's own process, one at a time: the pipeline as `lightwell run` runs it, told about as events."""

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from service.job_runner import JobStopped, Stop
from service.outcome import json_values
from storage.store import Store, UnitRef
from workers.progress import Progress

if TYPE_CHECKING:
    from workers.job_spec import JobSpec
    from workers.pipeline import Evaluation
    from workers.scene import Scene
    from workers.settings import Settings

OnEvent = Callable[[dict[str, Any]], None]
ShouldStop = Callable[[], Stop | None]
_FOUND_WITHIN_S = 0.05
"""A stage that advances at once says what it found in the store, which tells nothing about the time left."""


class EventProgress(Progress):
    """The stages' progress as events; a wish to stop is raised between two steps.

    Args:
        on_event: told about it.
        should_stop: asked at every step.

    Raises:
        JobStopped: from `track` and from its value.
    """

    def __init__(self, on_event: OnEvent, should_stop: ShouldStop) -> None:
        self._on_event, self._should_stop = on_event, should_stop

    def check(self) -> None:
        """Raises JobStopped where the job was asked to stop."""
        stop = self._should_stop()
        if stop is not None:
            raise JobStopped(stop)

    @contextmanager
    def track(self, description: str, total: float) -> Iterator[Callable[..., None]]:
        """Tells of every step; the time left is that of the steps of this run, those found in the store apart."""
        self.check()
        start_s, found, done = time.monotonic(), None, 0.0

        def advance(amount: float = 1.0, note: str = "") -> None:
            nonlocal found, done
            done += amount
            elapsed_s = time.monotonic() - start_s
            if found is None:
                found = done if elapsed_s < _FOUND_WITHIN_S else 0.0
            computed = done - found
            eta_s = elapsed_s / computed * max(total - done, 0.0) if computed > 0 else None
            self._tell(description, done, total, eta_s, note)
            self.check()

        self._tell(description, 0.0, total, None, "")
        yield advance
        if done < total:
            self._tell(description, total, total, 0.0, "")

    def message(self, text: str) -> None:
        """One line that is no progress."""
        self._on_event({"kind": "message", "text": text})

    def _tell(self, stage: str, done: float, total: float, eta_s: float | None, note: str) -> None:
        done, total = float(min(done, total)), float(total)
        self._on_event({"kind": "progress", "stage": stage, "done": done, "total": total, "eta_s": eta_s, "note": note})


class _ToldStore(Store):
    """A store that counts what is committed and shows every frame that is rendered.

    Bake units are chunks of a cache set and are not counted here but by their stage's progress.
    """

    on_event: OnEvent
    num_commits = 0

    def commit(self, ref: UnitRef, files: Mapping[str, bytes], record: Mapping[str, Any]) -> dict[str, Any]:
        fields = super().commit(ref, files, record)
        self.num_commits += 1
        if ref.stage == "render" and "frame.exr" in files:
            self.on_event({"kind": "preview", "png": frame_preview(files["frame.exr"])})
        return fields


def frame_preview(exr: bytes) -> bytes:
    """A rendered frame as PNG, exposed by itself: the scene's own exposure is known after training only."""
    import numpy as np

    from models.metrics import exposure_from_luminance, luminance
    from service.images import PNG, encode
    from storage.frames import decode_frame

    radiance = decode_frame(exr)["radiance"]
    finite = radiance[np.isfinite(radiance).all(axis=-1)]
    return encode(radiance, exposure_from_luminance([luminance(finite)]) if finite.size else 1.0, PNG)


class LocalRunner:
    """Runs the pipeline on the calling thread; a second job waits for the first.

    Args:
        store_url: where everything goes.
    """

    def __init__(self, store_url: str) -> None:
        self._store_url = store_url
        self._lock = threading.Lock()

    def run(self, job_id: str, spec: "JobSpec", on_event: OnEvent, should_stop: ShouldStop) -> dict[str, Any]:
        """See `JobRunner.run`."""
        del job_id
        progress = EventProgress(on_event, should_stop)
        while not self._lock.acquire(timeout=0.5):
            progress.check()
        try:
            return self._run(spec, progress, on_event)
        finally:
            self._lock.release()

    def close(self) -> None:
        """There is nothing to give up."""

    def _run(self, spec: "JobSpec", progress: EventProgress, on_event: OnEvent) -> dict[str, Any]:
        from workers.pipeline import run_scene
        from workers.scene import load_scene
        from workers.settings import Settings

        settings = Settings.from_json(spec.settings)
        store = _ToldStore.open(self._store_url, create=True)
        assert isinstance(store, _ToldStore)  # `open` makes the class that it is called on
        store.on_event = on_event
        progress.check()
        scene = load_scene(spec.scene, width=settings.width, height=settings.height)
        for note in scene.notes:
            progress.message(f"note: {note}")
        progress.check()
        evaluation = None
        if "evaluate" in spec.stages:
            evaluation = run_scene(scene, store, settings, progress)
            _show(evaluation, on_event)
        else:
            run_stages(spec.stages, scene, store, settings, progress)
        result = None if evaluation is None else json_values(evaluation.result)
        return {"evaluation": result, "units": store.num_commits, "set_aside": []}


def run_stages(stages: tuple[str, ...], scene: "Scene", store: Store, settings: "Settings", progress: Progress) -> None:
    """The stages of `run_scene` without the last ones: what was made is found by the job that goes further."""
    from workers.bake import load_caches, run_bake
    from workers.element_stage import run_elements
    from workers.inputs import run_inputs
    from workers.pipeline import RENDER_STAGES
    from workers.plan_stage import planned_run
    from workers.query import QueryProgram
    from workers.render import run_render
    from workers.run_state import RunState
    from workers.train import run_train

    run = planned_run(RunState(scene, store, settings, progress))
    if scene.digest not in {entry["digest"] for entry in store.scenes()}:
        store.register_scene(scene.digest, {"name": scene.name, "source": str(scene.source)})
    elements = run_elements(run)
    run_bake(run, elements)
    if "render" not in stages:
        return
    frames, paths = settings.frames, run.paths
    train = run_render(run, paths.train, frames.train_spp, RENDER_STAGES["train"])
    validation = run_render(run, paths.validation, frames.train_spp, RENDER_STAGES["validation"])
    run_render(run, paths.test, frames.test_spp, RENDER_STAGES["test"])
    if "train" not in stages:
        return
    program = QueryProgram(scene.mi_scene, run.table, elements, load_caches(run, elements), settings.query)
    inputs = [run_inputs(run, elements, program, cameras) for cameras in (paths.train, paths.validation)]
    run_train(run, (inputs[0], train), (inputs[1], validation))


def _show(evaluation: "Evaluation", on_event: OnEvent) -> None:
    """The page with pictures, and the first picture as the last preview."""
    from service.report import contact_sheet, render_report

    on_event({"kind": "report", "html": render_report(evaluation)})
    if evaluation.pictures:
        on_event({"kind": "preview", "png": contact_sheet(evaluation.pictures[0])})
