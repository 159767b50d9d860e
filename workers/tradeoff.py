"""The trade of a scene, measured: error against bake seconds, bytes and milliseconds a frame.

Every way to make a frame (`workers/tradeoff_variants.py`), path tracing with and without Open Image Denoise, and
the caches' radiance denoised, are scored on the same test frames and timed interleaved in one run. Renders,
elements, caches and networks come from the store where it has them, and stay there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from storage.store import Store, UnitRef
from workers.ablation import bake_cost, training_exposure
from workers.backend import dr
from workers.camera import Camera
from workers.element_stage import run_elements
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
from workers.operating_points import FrameTime, OperatingPoint
from workers.operating_table import OperatingTable, save_table
from workers.pareto import pareto_front
from workers.point_renderer import PointParts, Reconstruct, derived_run
from workers.progress import Progress
from workers.query import QueryProgram
from workers.reconstruct import Reconstructor
from workers.render import run_render
from workers.renderer import FrameRenderer, make_frame, publish
from workers.run_state import RunState
from workers.scene import Scene
from workers.settings import Settings
from workers.timing import interleaved_medians, other_load
from workers.tradeoff_variants import (
    SweepVariant,
    TradeoffBudget,
    affordable,
    bake_variant,
    sweep_variants,
    train_variant,
    trained,
)
from workers.train import WEIGHTS_FILE, load_network

Method = Callable[[Camera, int], np.ndarray]
COSTS = ("ms", "bake_seconds", "nbytes")
ERRORS = ("psnr", "flip", "temporal")


@dataclass
class _Prepared:
    """A variant with its caches baked and its network trained."""

    variant: SweepVariant
    network: str | None
    precision: str
    program: QueryProgram
    reconstruct: Reconstruct
    costs: dict[str, Any]
    exposure: float

    def render(self, camera: Camera, index: int = 0) -> np.ndarray:
        del index
        return make_frame(self.program, self.reconstruct, self.exposure, camera).radiance


def run_tradeoff(
    scene: Scene, store: Store, settings: Settings, progress: Progress, budget: TradeoffBudget | None = None
) -> OperatingTable:
    """Sweeps, measures and keeps a scene's operating points.

    A scene that was never run is published with the sweep's base, so that it can be served.

    Returns:
        The table that is also kept in the store; its result's rows are as `_finish_rows` leaves them.
    """
    budget = budget or TradeoffBudget()
    torch.set_num_threads(dr.thread_count())
    known = next((entry for entry in store.scenes() if entry["digest"] == scene.digest), None)
    if known is None:
        store.register_scene(scene.digest, {"name": scene.name, "source": str(scene.source)})
    base = _base_run(RunState(scene, store, settings, progress), budget)
    prepared = _prepare_all(base, budget)
    test_refs = run_render(base, base.paths.test, base.settings.frames.test_spp, "render test references")
    reference = load_reference(base, test_refs, prepared[0].exposure)
    methods = _methods(base, prepared, budget)
    rows = _score(base, methods, reference, prepared[0])
    with other_load() as load:
        times = _times(base, prepared, methods, budget)
    table = _table(base, budget, prepared, rows, times, reference, load)
    save_table(store, scene.digest, table)
    if known is None or "network" not in known:
        network = prepared[0].network
        assert network is not None  # the base always has one
        publish(base, _network_ref(base, network), rows[0]["psnr"])
    return table


def _base_run(run: RunState, budget: TradeoffBudget) -> RunState:
    """The run as it was trained, or with training that the budget affords."""
    return run if trained(run) is not None else derived_run(run, affordable(run.settings, budget))


# ------------------------------------------------ preparation ------------------------------------------------


def _prepare_all(base: RunState, budget: TradeoffBudget) -> list[_Prepared]:
    parts, prepared = PointParts(base), list[_Prepared]()
    variants = sweep_variants(base.settings, budget)
    with base.progress.track("sweep", len(variants)) as advance:
        for variant in variants:
            made = _prepare(base, parts, variant, prepared[0] if prepared else None, budget)
            if made is not None:
                prepared.append(made)
            advance(note=variant.name)
    return prepared


def _prepare(
    base: RunState, parts: PointParts, variant: SweepVariant, first: _Prepared | None, budget: TradeoffBudget
) -> _Prepared | None:
    """None where the variant cannot be had: bf16 that strays from fp32."""
    settings = base.settings.override(variant.overrides)
    run = derived_run(base, settings)
    bake_variant(run)
    program = parts.program(variant.overrides)
    network = first.network if first and variant.network == "base" else None
    if variant.network == "own":
        if first is not None:
            run = derived_run(base, affordable(settings, budget))
        network = train_variant(run, program).key
    precision, exposure = "fp32", first.exposure if first else 0.0
    if network is not None:
        precision = _resolved(base, program, network, variant)
        if variant.precision == "bf16" and precision != "bf16":
            base.progress.message("bf16 strays from fp32 on this network: no operating point uses it")
            return None
    reconstruct = parts.reconstruct(network, precision, variant.scale)
    if first is None:
        exposure = _encoding_exposure(base, network)
    return _Prepared(variant, network, precision, program, reconstruct, _costs(run, network), exposure)


def _encoding_exposure(base: RunState, network: str | None) -> float:
    if network is None:
        frames = base.settings.frames
        return training_exposure(base, run_render(base, base.paths.train, frames.train_spp, "render training frames"))
    return load_network(base, _network_ref(base, network))[1].exposure


def _network_ref(run: RunState, key: str) -> UnitRef:
    return UnitRef(run.scene.digest, "train", key)


def _resolved(base: RunState, program: QueryProgram, network: str, variant: SweepVariant) -> str:
    """The precision that is measured fastest at the run's size, where the variant leaves it open."""
    if variant.precision == "fp32":
        return "fp32"
    loaded, encoding = load_network(base, _network_ref(base, network))
    chooser = Reconstructor(loaded, encoding, precision=variant.precision)
    camera = base.paths.test[0]
    chooser(program.run(camera))
    return chooser.choices[f"{camera.width}x{camera.height}"]


def _costs(run: RunState, network: str | None) -> dict[str, Any]:
    """Bake seconds and paths, bytes at rest, and seconds of training, from the store's records."""
    baked = bake_cost(run, run_elements(run))
    costs = {"bake_seconds": baked["bake_seconds"], "bake_paths": baked["bake_paths"],
             "nbytes": int(baked["cache_nbytes"]), "train_seconds": None}  # fmt: skip
    if network is not None:
        ref = _network_ref(run, network)
        costs["nbytes"] += len(run.store.read(ref, WEIGHTS_FILE))
        costs["train_seconds"] = float((run.store.committed(ref) or {}).get("seconds", 0.0))
    return costs


# ------------------------------------------------ measurement ------------------------------------------------


def _methods(base: RunState, prepared: list[_Prepared], budget: TradeoffBudget) -> dict[str, Method]:
    """Every row's function from camera and frame index to radiance."""
    compared = derived_run(base, base.settings.override({"evaluation.spp": budget.spp}))
    network, encoding = load_network(base, _network_ref(base, str(prepared[0].network)))
    renderer = FrameRenderer(prepared[0].program, Reconstructor(network, encoding))
    others = compared_methods(compared, renderer)
    methods: dict[str, Method] = {one.variant.name: one.render for one in prepared}
    return methods | {name: method for name, method in others.items() if name not in ("ours", "ir")}


def _score(base: RunState, methods: dict[str, Method], reference: Reference, first: _Prepared) -> list[dict[str, Any]]:
    cameras, perceptual = base.paths.test, find_perceptual()
    network, encoding = load_network(base, _network_ref(base, str(first.network)))
    renderer = FrameRenderer(first.program, Reconstructor(network, encoding))
    positions = [positions_of(renderer, camera) for camera in cameras]
    rows = []
    with base.progress.track("score", len(methods)) as advance:
        for name, method in methods.items():
            frames = [method(camera, index) for index, camera in enumerate(cameras)]
            rows.append(score_row(name, frames, reference.frames, first.exposure, perceptual, cameras, positions, 0.0))
            advance(note=name)
    return rows


Times = dict[str, dict[tuple[int, int], float]]


def _times(base: RunState, prepared: list[_Prepared], methods: dict[str, Method], budget: TradeoffBudget) -> Times:
    """Median milliseconds by row and size: all rows at the run's own size, ours at the others too."""
    own = (base.settings.width, base.settings.height)
    times: Times = {name: {} for name in methods}
    for size in dict.fromkeys((own, *budget.sizes)):
        timed = methods if size == own else {one.variant.name: one.render for one in prepared}
        cameras = [camera.resized(*size) for camera in base.paths.test]

        def bound(method: Method, cameras: list[Camera] = cameras) -> Callable[[int], object]:
            return lambda index: method(cameras[index % len(cameras)], index)

        calls = {name: bound(method) for name, method in timed.items()}
        description = f"time {size[0]}x{size[1]}"
        for name, seconds in interleaved_medians(calls, budget.repeats, base.progress, description).items():
            times[name][size] = 1e3 * seconds
    return times


# -------------------------------------------------- the table --------------------------------------------------


def _table(
    base: RunState, budget: TradeoffBudget, prepared: list[_Prepared], rows: list[dict[str, Any]], times: Times,
    reference: Reference, load: dict[str, float],
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
    points = [_point(made[row["name"]], row) for row in rows if row["kind"] == "ours" and row["psnr"] is not None]
    refused = [row["name"] for row in rows if row["kind"] == "ours" and row["psnr"] is None]
    settings = base.settings
    result = {
        "scene": base.scene.name, "digest": base.scene.digest, "width": own[0], "height": own[1], "rows": rows,
        "preset": settings.preset, "exposure": prepared[0].exposure, "reference_error_db": reference.error_db,
        "reference_denoised": reference.denoised, "num_frames": len(base.paths.test), "repeats": budget.repeats,
        "network_seconds": budget.network_seconds, "machine": machine(), "commit": commit(), "load": load,
        "notes": _notes(budget, refused, reference),
    }  # fmt: skip
    return OperatingTable(base=settings.to_json(), points=tuple(points), result=result)


def _point(one: _Prepared, row: dict[str, Any]) -> OperatingPoint:
    times = tuple(FrameTime(**time) for time in row["times"])
    return OperatingPoint(
        name=row["name"], overrides=_listed(one.variant.overrides), network=one.network, precision=one.precision,
        scale=one.variant.scale, psnr=row["psnr"], flip=row["flip"], temporal=row["temporal"], times=times,
        bake_seconds=row["bake_seconds"], nbytes=row["nbytes"],
    )  # fmt: skip


def _listed(overrides: dict[str, Any]) -> dict[str, Any]:
    """Tuples as lists, as they come back from JSON: a point equals itself at rest."""
    return {key: list(value) if isinstance(value, tuple) else value for key, value in overrides.items()}


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
