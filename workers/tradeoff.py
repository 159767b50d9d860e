"""The trade of a scene, measured: error against bake seconds, bytes and milliseconds a frame.

Every way to make a frame (`workers/tradeoff_variants.py`), path tracing with and without Open Image Denoise, and
the caches' radiance denoised, are scored on the same test frames and timed interleaved in one run. Renders,
elements, caches and networks come from the store where it has them, and stay there.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from storage.keys import plain
from storage.store import Store
from workers.backend import dr
from workers.camera import Camera
from workers.evaluate import (
    Reference,
    commit,
    compared_methods,
    find_perceptual,
    load_reference,
    machine,
    positions_of,
    score_row,
)
from workers.network_record import load_network
from workers.operating_points import FrameTime, OperatingPoint
from workers.operating_table import OperatingTable, save_table
from workers.pareto import pareto_front
from workers.plan_stage import planned_run
from workers.point_parts import derived_run
from workers.progress import Progress
from workers.reconstruct import Reconstructor
from workers.render import run_render
from workers.renderer import FrameRenderer, publish
from workers.run_state import RunState
from workers.scene import Scene
from workers.settings import Settings
from workers.timing import interleaved_seconds, other_load, spread_of
from workers.tradeoff_preparation import PreparedVariant, base_run, network_ref, prepare_variants
from workers.tradeoff_variants import TradeoffBudget

Method = Callable[[Camera, int], np.ndarray]
COSTS = ("ms", "bake_seconds", "nbytes")
ERRORS = ("psnr", "flip", "temporal")


def run_tradeoff(
    scene: Scene, store: Store, settings: Settings, progress: Progress, budget: TradeoffBudget | None = None
) -> OperatingTable:
    """Sweeps, measures and keeps a scene's operating points.

    A scene that was never run is published with the sweep's base, so that it can be served.

    Returns:
        The table that is also kept in the store; its result's "rows" are evaluation
        rows with "kind", costs, "times" and fronts (`mark_fronts`).
    """
    budget = budget or TradeoffBudget()
    torch.set_num_threads(dr.thread_count())
    known = next((entry for entry in store.scenes() if entry["digest"] == scene.digest), None)
    if known is None:
        store.register_scene(scene.digest, {"name": scene.name, "source": scene.address})
    base = base_run(planned_run(RunState(scene, store, settings, progress)), budget)
    prepared = prepare_variants(base, budget)
    test_refs = run_render(base, base.paths.test, base.settings.frames.test_spp, "render test references")
    reference = load_reference(base, test_refs, prepared[0].exposure)
    network_key = str(prepared[0].network)  # the base always has one
    renderer = FrameRenderer(prepared[0].program, Reconstructor(*load_network(base, network_ref(base, network_key))))
    methods = _methods(base, renderer, prepared, budget)
    rows = _score(base, renderer, methods, reference)
    with other_load() as load:
        times, spread = _times(base, prepared, methods, budget)
    table = _table(base, budget, prepared, rows, times, spread, reference, load)
    save_table(store, scene.digest, table)
    if known is None or "network" not in known:
        publish(base, network_ref(base, network_key), rows[0]["psnr"])
    return table


# ------------------------------------------------ measurement ------------------------------------------------


def _methods(
    base: RunState, renderer: FrameRenderer, prepared: list[PreparedVariant], budget: TradeoffBudget
) -> dict[str, Method]:
    """Every row's function from camera and frame index to radiance."""
    compared = derived_run(base, base.settings.override({"evaluation.spp": budget.spp}))
    others = compared_methods(compared, renderer)
    methods: dict[str, Method] = {one.variant.name: one.render for one in prepared}
    return methods | {name: method for name, method in others.items() if name not in ("ours", "ir")}


def _score(
    base: RunState, renderer: FrameRenderer, methods: dict[str, Method], reference: Reference
) -> list[dict[str, Any]]:
    cameras, perceptual = base.paths.test, find_perceptual()
    exposure = renderer.reconstructor.encoding.exposure
    positions = [positions_of(renderer, camera) for camera in cameras]
    near_cameras = [base.scene.frame.near_camera(camera) for camera in cameras]
    rows = []
    with base.progress.track("score", len(methods)) as advance:
        for name, method in methods.items():
            frames = [method(camera, index) for index, camera in enumerate(cameras)]
            rows.append(score_row(name, frames, reference.frames, exposure, perceptual, near_cameras, positions, 0.0))
            advance(note=name)
    return rows


Times = dict[str, dict[tuple[int, int], float]]


def _times(
    base: RunState, prepared: list[PreparedVariant], methods: dict[str, Method], budget: TradeoffBudget
) -> tuple[Times, float]:
    """Median milliseconds by row and size: all rows at the run's own size, ours at the others too; and the spread of
    single frames of ours (`spread_of`).

    All of them in the same rounds: a slow minute must not bend the line through a point's sizes.
    """
    own = (base.settings.width, base.settings.height)
    calls: dict[str, Callable[[int], object]] = {}
    places: dict[str, tuple[str, tuple[int, int]]] = {}
    for size in dict.fromkeys((own, *budget.sizes)):
        timed = methods if size == own else {one.variant.name: one.render for one in prepared}
        cameras = [camera.resized(*size) for camera in base.paths.test]
        for name, method in timed.items():
            call = f"{name} at {size[0]}x{size[1]}"
            places[call] = (name, size)
            calls[call] = lambda index, method=method, cameras=cameras: (  # type: ignore[misc]
                method(cameras[index % len(cameras)], index)
            )
    times: Times = {name: {} for name in methods}
    rounds = interleaved_seconds(calls, budget.repeats, base.progress, "time frames")
    for call, seconds in rounds.items():
        name, size = places[call]
        times[name][size] = 1e3 * float(np.median(seconds))
    own_names = {one.variant.name for one in prepared}
    return times, spread_of(seconds for call, seconds in rounds.items() if places[call][0] in own_names)


# -------------------------------------------------- the table --------------------------------------------------


def _table(
    base: RunState, budget: TradeoffBudget, prepared: list[PreparedVariant], rows: list[dict[str, Any]], times: Times,
    spread: float, reference: Reference, load: dict[str, float],
) -> OperatingTable:  # fmt: skip
    own = (base.settings.width, base.settings.height)
    made = {one.variant.name: one for one in prepared}
    for row in rows:
        one = made.get(row["name"])
        row["kind"] = one.variant.kind if one else "path tracing" if row["name"].startswith("pt-") else "caches + OIDN"
        row["ms"] = times[row["name"]][own]
        row["times"] = [{"width": w, "height": h, "ms": ms} for (w, h), ms in times[row["name"]].items()]
        row |= one.costs if one else {"bake_seconds": None, "bake_paths": None, "nbytes": None, "train_seconds": None}
        if row["kind"] == "caches + OIDN":
            row |= {key: prepared[0].costs[key] for key in ("bake_seconds", "bake_paths")}
            row["nbytes"] = made["no network"].costs["nbytes"] if "no network" in made else prepared[0].costs["nbytes"]
    mark_fronts(rows)
    ours = [row for row in rows if row["kind"] == "ours"]
    points = [_point(made[row["name"]], row, spread) for row in ours if row["psnr"] is not None]
    refused = [row["name"] for row in ours if row["psnr"] is None]
    settings = base.settings
    result = {
        "scene": base.scene.name, "digest": base.scene.digest, "width": own[0], "height": own[1], "rows": rows,
        "preset": settings.preset, "exposure": prepared[0].exposure, "reference_error_db": reference.error_db,
        "reference_denoised": reference.denoised, "num_frames": len(base.paths.test), "repeats": budget.repeats,
        "spread": spread, "network_seconds": budget.network_seconds, "machine": machine(), "commit": commit(),
        "load": load, "notes": _notes(budget, refused, reference),
    }  # fmt: skip
    return OperatingTable(base=plain(settings.to_json(), "settings"), points=tuple(points), result=result)


def _point(one: PreparedVariant, row: dict[str, Any], spread: float) -> OperatingPoint:
    times = tuple(FrameTime(**time) for time in row["times"])
    return OperatingPoint(
        name=row["name"], overrides=plain(one.variant.overrides, "overrides"), network=one.network,
        precision=one.precision, scale=one.variant.scale, psnr=row["psnr"], flip=row["flip"],
        temporal=row["temporal"], times=times, bake_seconds=row["bake_seconds"], nbytes=row["nbytes"],
        spread=spread,
    )  # fmt: skip


def _notes(budget: TradeoffBudget, refused: list[str], reference: Reference) -> list[str]:
    notes = [
        f"networks other than the base's were trained for at most {budget.network_seconds:g} s each; networks are "
        "not compiled; bake seconds and bytes of path tracing are none, of IR + OIDN those of the caches"
    ]
    if refused:
        notes.append(f"no operating points, for their frames are not finite: {', '.join(refused)}")
    if reference.denoised:
        notes.append("references were denoised (Open Image Denoise, high): methods that use it are favoured by that")
    return notes


def mark_fronts(rows: list[dict[str, Any]]) -> None:
    """Adds to every row "pareto" (cost -> errors on whose front it stands, among the rows that have both) and,
    to rows of others, "beaten_by": one of ours with no more time and no worse PSNR and FLIP, or None."""
    for row in rows:
        row["pareto"] = {cost: [] for cost in COSTS}
    for cost in COSTS:
        for error in ERRORS:
            having = [row for row in rows if row[cost] is not None and row[error] is not None]
            sign = -1.0 if error == "psnr" else 1.0
            front = pareto_front([(row[cost], sign * row[error]) for row in having])
            for row, on_front in zip(having, front, strict=True):
                if on_front:
                    row["pareto"][cost].append(error)
    ours = [row for row in rows if row["kind"] == "ours"]
    for row in rows:
        if row["kind"] != "ours":
            row["beaten_by"] = next((one["name"] for one in ours if _no_worse(one, row)), None)


def _no_worse(ours: dict[str, Any], other: dict[str, Any]) -> bool:
    scores = [ours["psnr"], other["psnr"], ours["flip"], other["flip"]]
    if any(score is None for score in scores):
        return False
    return ours["ms"] <= other["ms"] and ours["psnr"] >= other["psnr"] and ours["flip"] <= other["flip"]
