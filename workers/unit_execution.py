"""Executes one unit of a run. A unit may be run again at any time: what is committed is left as it is."""

import copy
import dataclasses
import json
from collections.abc import Callable
from typing import Any

from storage.layout import UnitRef
from workers.bake import bake_sets, bake_units, seal_bake
from workers.camera import Camera
from workers.element_stage import elements_ref, run_elements
from workers.errors import ChangedSceneError
from workers.evaluate import Evaluation
from workers.inputs import inputs_ref, run_inputs
from workers.job_spec import JobSpec
from workers.loaded_run import LoadedRun, forget_runs, open_run
from workers.pipeline import RENDER_STAGES, evaluate_run, known_facts
from workers.progress import Progress
from workers.render import render_ref, run_render
from workers.renderer import publish
from workers.run_state import RunState
from workers.train import run_train
from workers.units import PATHS, Unit

EVALUATION_STAGE = "evaluation"
RESULT_FILE, REPORT_FILE = "evaluation.json", "report.html"
Answer = str | dict[str, Any]
Report = Callable[[Evaluation], bytes]


def execute(unit: Unit, spec: JobSpec, store_url: str, progress: Progress, report: Report | None = None) -> Answer:
    """Does one unit's work.

    Args:
        unit: what to do.
        spec: the run that it belongs to.
        store_url: where everything goes.
        progress: told about it, and asked between passes whether to go on.
        report: makes the page that is stored beside an evaluation.

    Returns:
        Key of the store's unit; for a census or an inventory, its JSON.

    Raises:
        StoppedError: `progress` said so; nothing that was committed is lost.
        ChangedSceneError: the scene's files are no longer what was planned for.
        WorkerError, StorageError: the unit failed.
    """
    for last_try in (False, True):
        loaded = open_run(spec, store_url, progress)
        try:
            return _execute(unit, spec, loaded, report)
        except ChangedSceneError:
            # This process may have loaded the scene before its files changed, or another one after.
            forget_runs()
            if last_try:
                raise
    raise AssertionError("unreachable")


def _execute(unit: Unit, spec: JobSpec, loaded: LoadedRun, report: Report | None) -> Answer:
    run = loaded.run
    match unit.stage:
        case "census":
            return _census(run)
        case "inventory":
            return _inventory(run, loaded)
        case "elements":
            _expect(unit, elements_ref(run))
            run_elements(run)
            return unit.key
        case "bake" | "seal":
            return _bake(unit, loaded)
        case "render":
            camera = frames_of(run)[unit.part][unit.first][1]
            _expect(unit, render_ref(run, camera, spp_of(run, unit.part)))
            return run_render(run, [camera], spp_of(run, unit.part), RENDER_STAGES[unit.part])[0].key
        case "inputs":
            camera = frames_of(run)[unit.part][unit.first][1]
            _expect(unit, inputs_ref(run, loaded.elements, camera))
            return run_inputs(run, loaded.elements, loaded.program, [camera])[0].key
        case "train":
            network = _train(unit, loaded)
            if spec.last_stage == "train":
                publish(run, network, None)
            return network.key
        case "evaluate":
            return _evaluate(unit, loaded, report)
    raise AssertionError(f"stage {unit.stage} has no units")


def _expect(unit: Unit, ref: UnitRef) -> None:
    if ref.key != unit.key:
        raise ChangedSceneError(
            f"{unit.name} must still be what was planned, but scene {ref.scene_digest} gives it key {ref.key} and not "
            f"{unit.key}; the scene's files changed, submit the job again"
        )


def frames_of(run: RunState) -> dict[str, list[tuple[str, Camera]]]:
    """Name ("train/3") and camera of every frame, by path."""
    cameras = {path: getattr(run.paths, path) for path in PATHS}
    return {path: [(f"{path}/{i}", camera) for i, camera in enumerate(found)] for path, found in cameras.items()}


def spp_of(run: RunState, path: str) -> int:
    """Paths a pixel of a camera path's ground truth."""
    return run.settings.frames.test_spp if path == "test" else run.settings.frames.train_spp


def _census(run: RunState) -> dict[str, Any]:
    """What the scene alone decides; registers the scene, so that the store knows its name from the start."""
    facts = {"name": run.scene.name, "source": run.scene.address}
    known = known_facts(run.store, run.scene)
    if known | facts != known:
        run.store.register_scene(run.scene.digest, known | facts)
    renders = {path: [render_ref(run, camera, spp_of(run, path)).key for _, camera in frames]
               for path, frames in frames_of(run).items()}  # fmt: skip
    return {"digest": run.scene.digest, "elements": elements_ref(run).key, "renders": renders}


def _inventory(run: RunState, loaded: LoadedRun) -> dict[str, Any]:
    sets = bake_sets(run, loaded.elements)
    lobes = {name: {"key": found.ref.key, "num_units": found.num_units, "lanes_per_unit": found.lanes_per_unit,
                    "after": found.after}
             for name, found in sets.items()}  # fmt: skip
    inputs = {path: [inputs_ref(run, loaded.elements, camera).key for _, camera in frames]
              for path, frames in frames_of(run).items() if path != "test"}  # fmt: skip
    return {"lobes": lobes, "inputs": inputs}


def _bake(unit: Unit, loaded: LoadedRun) -> str:
    found = bake_sets(loaded.run, loaded.elements).get(unit.part)
    if found is None or found.ref.key != unit.key:
        raise ChangedSceneError(
            f"{unit.name} must still be what was planned, got other elements; the scene's files changed, "
            "submit the job again"
        )
    if unit.stage == "seal":
        return seal_bake(loaded.run, loaded.elements, unit.part).key
    return bake_units(loaded.run, loaded.elements, unit.part, range(unit.first, unit.first + unit.count)).key


def _kept(run: RunState, path: str, unit: Unit) -> list[Camera]:
    return [camera for name, camera in frames_of(run)[path] if name not in unit.without]


def _pairs(loaded: LoadedRun, path: str, unit: Unit) -> tuple[list[UnitRef], list[UnitRef]]:
    """Inputs and renders of the frames that were not set aside."""
    run, cameras = loaded.run, _kept(loaded.run, path, unit)
    inputs = [inputs_ref(run, loaded.elements, camera) for camera in cameras]
    return inputs, [render_ref(run, camera, spp_of(run, path)) for camera in cameras]


def _train(unit: Unit, loaded: LoadedRun) -> UnitRef:
    return run_train(loaded.run, _pairs(loaded, "train", unit), _pairs(loaded, "validation", unit))


def _evaluate(unit: Unit, loaded: LoadedRun, report: Report | None) -> str:
    """Measures once, keeps what was measured, and makes the run the one that its scene is served from."""
    run = copy.copy(loaded.run)  # with what it has loaded, but other test frames
    tests = _kept(run, "test", unit)
    run.paths = dataclasses.replace(loaded.run.paths, test=tests)
    network = _train(unit, loaded)
    renders = [render_ref(run, camera, spp_of(run, "test")) for camera in tests]
    params = {"network": network.key, "tests": [ref.key for ref in renders],
              "evaluation": dataclasses.asdict(run.settings.evaluation)}  # fmt: skip
    ref = run.ref(EVALUATION_STAGE, params)
    if run.store.committed(ref) is None:
        evaluation = evaluate_run(run, loaded.elements, loaded.program, network, renders)
        files = {RESULT_FILE: json.dumps(evaluation.result, default=float).encode()}
        if report is not None:
            files[REPORT_FILE] = report(evaluation)
        run.store.commit(ref, files, {"seconds": run.seconds["evaluate"], "params": params})
    result = json.loads(run.store.read(ref, RESULT_FILE))
    publish(run, network, result["rows"][0]["psnr"])
    return ref.key
