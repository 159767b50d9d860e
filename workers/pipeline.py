"""The main job, stage by stage: elements, bake, render, inputs, train, evaluate.

Every stage asks the store what is there and does the rest, so a run that was stopped goes on where it was.
"""

import time
from typing import Any

import torch

from storage.caches import CacheSet
from storage.store import Store, UnitRef
from workers.backend import dr
from workers.bake import bake_refs, cache_nbytes, load_caches, run_bake
from workers.code_versions import check_versions
from workers.element_stage import elements_ref, run_elements
from workers.elements import ElementSet
from workers.errors import WorkerError
from workers.evaluate import Evaluation, Picture, run_evaluation
from workers.inputs import inputs_ref, run_inputs
from workers.network_record import WEIGHTS_FILE, load_network
from workers.plan_stage import planned_run
from workers.progress import Progress
from workers.query import QueryProgram
from workers.reconstruct import Reconstructor
from workers.render import render_ref, run_render
from workers.renderer import FrameRenderer, publish
from workers.run_state import RunState
from workers.scene import Scene
from workers.scene_plan import plan_rows
from workers.settings import Settings
from workers.train import run_train, train_ref

__all__ = ["Evaluation", "Picture", "evaluate_scene", "plan_scene", "published_settings", "run_scene"]

RENDER_STAGES = {"train": "render training frames", "validation": "render validation frames",
                 "test": "render test references"}  # fmt: skip


def plan_scene(scene: Scene, settings: Settings) -> dict[str, Any]:
    """What a run would do and cost; nothing is rendered."""
    return plan_rows(scene, settings)


def run_scene(
    scene: Scene, store: Store, settings: Settings, progress: Progress,
    *, camera_size: tuple[int, int] | None = None,
) -> Evaluation:  # fmt: skip
    """Runs every stage and evaluates.

    Args:
        scene: a loaded scene.
        store: where everything goes.
        settings: what to do.
        progress: told about it.
        camera_size: (width, height) of all frames; the settings' where None.
    """
    width, height = camera_size or (settings.width, settings.height)
    run = RunState(scene, store, settings.override({"width": width, "height": height}), progress)
    store.register_scene(scene.digest, known_facts(store, scene) | {"name": scene.name, "source": scene.address})
    run = planned_run(run)
    elements = run_elements(run)
    run_bake(run, elements)
    frames = run.settings.frames
    renders = {
        "train": run_render(run, run.paths.train, frames.train_spp, RENDER_STAGES["train"]),
        "validation": run_render(run, run.paths.validation, frames.train_spp, RENDER_STAGES["validation"]),
        "test": run_render(run, run.paths.test, frames.test_spp, RENDER_STAGES["test"]),
    }
    program = query_program(run, elements)
    inputs = {
        "train": run_inputs(run, elements, program, run.paths.train),
        "validation": run_inputs(run, elements, program, run.paths.validation),
    }
    network = run_train(run, (inputs["train"], renders["train"]), (inputs["validation"], renders["validation"]))
    evaluation = evaluate_run(run, elements, program, network, renders["test"])
    publish(run, network, evaluation.result["rows"][0]["psnr"])
    return evaluation


def evaluate_scene(scene: Scene, store: Store, settings: Settings, progress: Progress) -> Evaluation:
    """Evaluates what `run_scene` prepared.

    Args:
        scene: the scene.
        store: where its stages lie.
        settings: those that the run used (`published_settings`), but for `evaluation`, which may be others.
        progress: told about it.

    Raises:
        WorkerError: a stage has not run with these settings, or another version ran it.
    """
    entry = known_facts(store, scene)
    if "network" in entry:
        check_versions(entry, store.url)
    run = planned_run(RunState(scene, store, settings, progress))
    elements = run_elements(run)
    renders = {name: [render_ref(run, camera, spp) for camera in cameras] for name, cameras, spp in (
        ("train", run.paths.train, run.settings.frames.train_spp),
        ("test", run.paths.test, run.settings.frames.test_spp))}  # fmt: skip
    network = train_ref(run, [inputs_ref(run, elements, camera) for camera in run.paths.train], renders["train"])
    needed = [network, *renders["test"], *bake_refs(run, elements).values()]
    if any(store.committed(ref) is None for ref in needed):
        raise WorkerError(
            f"scene {scene.name!r} must be run with these settings before it is evaluated; "
            f"run: lightwell run {scene.source} --store {store.url}"
        )
    return evaluate_run(run, elements, query_program(run, elements), network, renders["test"])


def published_settings(scene: Scene, store: Store) -> Settings:
    """Settings of the run that the scene is served from.

    Raises:
        WorkerError: it was never run to its end.
    """
    entry = known_facts(store, scene)
    if "settings" not in entry:
        raise WorkerError(
            f"scene {scene.name!r} must be run before it is evaluated; "
            f"run: lightwell run {scene.source} --store {store.url}"
        )
    return Settings.from_json(entry["settings"])


def known_facts(store: Store, scene: Scene) -> dict[str, Any]:
    """What the store says of the scene, without the fields that the store adds itself."""
    for entry in store.scenes():
        if entry["digest"] == scene.digest:
            return {key: value for key, value in entry.items() if key != "digest"}
    return {}


def query_program(run: RunState, elements: ElementSet) -> QueryProgram:
    """The query over the caches of a run.

    Raises:
        StorageError: a bake unit is missing or damaged.
    """
    caches = load_caches(run, elements)
    return QueryProgram(run.scene.mi_scene, run.table, elements, caches, run.settings.query)


def evaluate_run(
    run: RunState, elements: ElementSet, program: QueryProgram, network_ref: UnitRef, test_refs: list[UnitRef]
) -> Evaluation:
    """Scores and times the network of a run against the adversaries on some of the test frames."""
    start = time.perf_counter()
    torch.set_num_threads(dr.thread_count())
    network, encoding = load_network(run, network_ref)
    precision, compile_ = run.settings.train.precision, run.settings.evaluation.compile
    renderer = FrameRenderer(program, Reconstructor(network, encoding, precision=precision, compile=compile_))
    sizes = {"cache": cache_nbytes(run, elements), "network": len(run.store.read(network_ref, WEIGHTS_FILE))}
    evaluation = run_evaluation(run, renderer, test_refs, stage_seconds(run, elements, network_ref), sizes)
    run.seconds["evaluate"] = time.perf_counter() - start
    evaluation.result["stages"].append({"name": "evaluate", "seconds": run.seconds["evaluate"]})
    return evaluation


def stage_seconds(run: RunState, elements: ElementSet, network_ref: UnitRef) -> dict[str, float]:
    """Seconds of preprocessing by stage, summed over the records of the units: a resumed run tells them too."""
    frames, paths = run.settings.frames, run.paths
    poses = {"train": (paths.train, frames.train_spp), "validation": (paths.validation, frames.train_spp),
             "test": (paths.test, frames.test_spp)}  # fmt: skip
    seconds = {"elements": _recorded(run, [elements_ref(run)])}
    for lobe, ref in bake_refs(run, elements).items():
        caches = CacheSet.open(run.store, ref)
        records = [caches.unit_record(index) or {} for index in range(caches.num_units)]
        seconds[f"bake {lobe}"] = sum(float(record.get("seconds", 0.0)) for record in records)
    for name, (cameras, spp) in poses.items():
        seconds[RENDER_STAGES[name]] = _recorded(run, [render_ref(run, camera, spp) for camera in cameras])
    inputs = [inputs_ref(run, elements, camera) for camera in paths.train + paths.validation]
    return seconds | {"query inputs": _recorded(run, inputs), "train": _recorded(run, [network_ref])}


def _recorded(run: RunState, refs: list[UnitRef]) -> float:
    records = [run.store.committed(ref) or {} for ref in refs]
    return sum(float(record.get("seconds", 0.0)) for record in records)
