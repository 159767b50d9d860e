"""What the parts of a frame and of a bake cost on this machine, as plain JSON values.

Whatever is compared is timed interleaved in one run (`workers/timing.py`).
"""

import dataclasses
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
import torch

from models.network import network_flops
from storage.store import Store, UnitRef
from workers.backend import dr, mi
from workers.bake import LANES_PER_LAUNCH, load_caches
from workers.bake_kernels import Batch
from workers.bake_lobes import lobes_of
from workers.camera import Camera
from workers.denoise import QUALITIES, denoise
from workers.element_stage import run_elements
from workers.elements import ElementSet
from workers.errors import WorkerError
from workers.network_record import load_network
from workers.pathtrace import trace
from workers.primary import DeviceCamera
from workers.progress import Progress
from workers.query import QueryProgram
from workers.reconstruct import Reconstructor
from workers.renderer import FrameRenderer
from workers.run_state import RunState
from workers.scene import Scene
from workers.settings import Settings
from workers.timing import interleaved_medians, matmul_gflop_per_s, other_load

PATH_TRACER = "mi.render path"
_SEED = 1


def measure_scene(
    scene: Scene, store: Store, size: tuple[int, int], repeats: int, progress: Progress
) -> dict[str, Any]:
    """Frame times at `size` (width, height) and the bake's throughput, for the run a scene is served from.

    Returns:
        {"frame_times": as `frame_times`, "bake": as `bake_throughput`, "load": as `other_load`}.

    Raises:
        WorkerError: the scene was never run to its end in this store.
    """
    entry = store.find_scene(scene.digest)
    if "network" not in entry:
        raise WorkerError(
            f"scene {scene.name!r} must be run before its frames are timed; "
            f"run: lightwell run {scene.source} --store {store.url}"
        )
    torch.set_num_threads(dr.thread_count())
    run = RunState(scene, store, Settings.from_json(entry["settings"]), progress)
    renderer, single = _renderer(run, UnitRef(scene.digest, "train", entry["network"]))
    with other_load() as load:
        times = frame_times(renderer, single, scene, *size, repeats, progress)
        throughput = bake_throughput(run, repeats)
    return {"frame_times": times, "bake": throughput, "load": load}


def _renderer(run: RunState, network_ref: UnitRef) -> tuple[FrameRenderer, QueryProgram]:
    """The run's renderer, and a query of the same caches with one ray a pixel."""
    network, encoding = load_network(run, network_ref)
    precision, compiled = run.settings.train.precision, run.settings.evaluation.compile
    reconstructor = Reconstructor(network, encoding, precision=precision, compile=compiled)
    program, single = query_programs(run)
    return FrameRenderer(program, reconstructor), single


def query_programs(run: RunState) -> tuple[QueryProgram, QueryProgram]:
    """Queries of a run's caches: with its own samples, and with 1x1."""
    elements = run_elements(run)
    caches, own = load_caches(run, elements), run.settings.query
    own_program, single = (
        QueryProgram(run.scene.mi_scene, run.table, elements, caches, settings)
        for settings in (own, dataclasses.replace(own, samples=1))
    )
    return own_program, single


# ------------------------------------------------ one frame ------------------------------------------------


def frame_times(
    renderer: FrameRenderer, single: QueryProgram, scene: Scene, width: int, height: int, repeats: int,
    progress: Progress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Times every part of a frame from the scene's own view, beside its adversary's parts.

    Args:
        renderer: the scene, prepared.
        single: its query with 1x1 samples (`query_programs`).
        scene: the same scene.
        width, height: of the frame, pixels.
        repeats: timed rounds.
        progress: told round by round.

    Returns:
        "width", "height", "repeats", "samples" (of the run's query, along each axis), "supersample"; "ms" by part:
        "primary" (one ray a pixel, nothing but the intersection), "query-1x1", "query" (the run's own samples),
        "network", "frame" (query and network), "pt-1" (one path a pixel), "oidn-<quality>" (Open Image
        Denoise alone, with albedo and normal); "ratios" of them; "network" as `network_rate` returns it.
    """
    camera = scene.camera.resized(width, height)
    local = renderer.program.table.frame.local_camera(camera)
    primary = PrimaryRays(renderer.program.scene)
    features = renderer.program.run(camera)
    traced = trace(scene, camera, 1, _SEED, features=True)
    # Only its time counts here: a stray Inf must not stop a benchmark.
    noisy = np.where(np.isfinite(traced.radiance), traced.radiance, 0.0).astype(np.float32)
    methods: dict[str, Callable[[int], object]] = {
        "primary": lambda index: primary.cast(local),
        "query-1x1": lambda index: single.run(camera),
        "query": lambda index: renderer.program.run(camera),
        "network": lambda index: renderer.reconstructor(features, lambda: renderer.program.run(camera)),
        "frame": lambda index: renderer.render(camera),
        "pt-1": lambda index: trace(scene, camera, 1, index),
    }
    for quality in QUALITIES:
        methods[f"oidn-{quality}"] = lambda index, q=quality: denoise(  # type: ignore[misc]
            noisy, traced.albedo, traced.normal, quality=q
        )
    medians = interleaved_medians(methods, repeats, progress or Progress(), f"frames of {width}x{height}")
    milliseconds = {name: 1e3 * seconds for name, seconds in medians.items()}
    return {
        "width": width, "height": height, "repeats": repeats, "samples": renderer.program.settings.samples,
        "supersample": renderer.program.settings.supersample,
        "ms": milliseconds, "ratios": _ratios(milliseconds),
        "network": network_rate(renderer.reconstructor, width, height, medians["network"]),
    }  # fmt: skip


def _ratios(milliseconds: dict[str, float]) -> dict[str, float]:
    pairs = [("query-1x1", "primary"), ("query", "primary"), ("frame", "oidn-fast"), ("frame", "oidn-balanced")]
    ratios = {f"{a} / {b}": milliseconds[a] / milliseconds[b] for a, b in pairs}
    whole = milliseconds["pt-1"] + milliseconds["oidn-fast"]
    return ratios | {"frame / (pt-1 + oidn-fast)": milliseconds["frame"] / whole}


class PrimaryRays:
    """The least that a frame costs: a ray through the middle of every pixel, recorded once like the query."""

    def __init__(self, mi_scene: "mi.Scene") -> None:
        self.scene = mi_scene
        self._replay = dr.freeze(self._program, state_fn=lambda *_: self.scene)

    def _program(self, device: DeviceCamera, width: int, height: int) -> "tuple[mi.Float, mi.Point2f, mi.UInt32]":
        lane = dr.arange(mi.UInt32, width * height)
        ray = device.ray(mi.Float(lane % width) + 0.5, mi.Float(lane // width) + 0.5, width, height)
        hit = self.scene.ray_intersect_preliminary(ray, coherent=True)
        return hit.t, hit.prim_uv, hit.prim_index

    def cast(self, camera: Camera) -> "mi.Float":
        """Casts the rays and waits for the intersections.

        Returns:
            Distance of each pixel's hit, row by row; infinite on a miss.
        """
        hit = self._replay(DeviceCamera.upload(camera), camera.width, camera.height)
        dr.eval(hit)
        dr.sync_thread()
        return hit[0]


def network_rate(reconstructor: Reconstructor, width: int, height: int, seconds: float) -> dict[str, Any]:
    """What the network computes in a second, beside what the machine can.

    Returns:
        "choice" (precision and compilation, as measured), "gflop" of one frame (convolutions and linear
        layers), "gflop_per_s" of the whole network step (encoding and transfers included), "peak_gflop_per_s"
        by precision (a large matrix product), "share" of the peak of the precision in use, and "threads".
    """
    multiple = reconstructor.config.size_multiple
    padded = [-(-edge // multiple) * multiple for edge in (height, width)]
    gflop = 0.0 if reconstructor.hands_on else network_flops(reconstructor.config, *padded) / 1e9
    choice = reconstructor.choices[f"{width}x{height}"]
    peaks = {
        "fp32": matmul_gflop_per_s(torch.float32, reconstructor.device),
        "bf16": matmul_gflop_per_s(torch.bfloat16, reconstructor.device),
    }
    rate = gflop / seconds
    return {"choice": choice, "gflop": gflop, "gflop_per_s": rate, "peak_gflop_per_s": peaks,
            "share": rate / peaks[choice.split()[0]], "threads": torch.get_num_threads()}  # fmt: skip


# ------------------------------------------------- the bake ------------------------------------------------


def bake_throughput(run: RunState, repeats: int = 5, *, lanes_per_launch: int = LANES_PER_LAUNCH) -> dict[str, Any]:
    """Paths a second of each lobe's bake, and of Mitsuba's own `path` integrator at the same depth.

    Whole units, evenly spaced over the scene, as many as one launch of the bake holds; the path tracer
    renders the scene's own view with about as many paths. Both include the copy of the result to the host;
    nothing is stored.

    Args:
        run: its settings say what is baked.
        repeats: timed rounds.
        lanes_per_launch: paths of one launch, at most (a unit is never cut).

    Returns:
        "max_depth", "repeats", "paths" of one launch by method (the cache sets by name, such as "diffuse" and
        "directional-32x8", and `PATH_TRACER`; a lobe that the scene lacks is left out), "paths_per_s" by method,
        and "ratios" of each set to the path tracer.
    """
    methods, paths = _bake_methods(run, run_elements(run), lanes_per_launch)
    camera = run.scene.camera.resized(run.settings.width, run.settings.height)
    pixels = camera.width * camera.height
    spp = max(1, round(max(paths.values(), default=lanes_per_launch) / pixels))
    methods[PATH_TRACER] = lambda index: trace(run.scene, camera, spp, index * spp)
    paths[PATH_TRACER] = spp * pixels
    medians = interleaved_medians(methods, repeats, run.progress, "bake throughput")
    rates = {name: paths[name] / seconds for name, seconds in medians.items()}
    ratios = {name: rate / rates[PATH_TRACER] for name, rate in rates.items() if name != PATH_TRACER}
    return {"max_depth": run.scene.max_depth, "repeats": repeats, "paths": paths, "paths_per_s": rates,
            "ratios": ratios}  # fmt: skip


def _bake_methods(
    run: RunState, elements: ElementSet, lanes_per_launch: int
) -> tuple[dict[str, Callable[[int], object]], dict[str, int]]:
    """The bake's kernels on a launch each, and the paths of those launches."""
    methods: dict[str, Callable[[int], object]] = {}
    paths: dict[str, int] = {}
    for lobe in lobes_of(run, elements):
        per_unit, lanes = run.settings.cache.elements_per_unit, lobe.lanes_per_element
        batch = spread_batch(lobe.owners, per_unit, lanes, lanes_per_launch)
        paths[lobe.name] = len(batch.element) * lanes
        methods[lobe.name] = partial(lobe.kernel, batch)
    return methods, paths


def spread_batch(owners: np.ndarray, elements_per_unit: int, lanes_per_element: int, lanes_per_launch: int) -> Batch:
    """Whole units, evenly spaced, as many as fit one launch (at least one).

    Args:
        owners: element of each row of the lobe, int64 [rows].
        elements_per_unit: rows of a unit.
        lanes_per_element: paths of an element.
        lanes_per_launch: paths of the launch.
    """
    num_units = -(-len(owners) // elements_per_unit)
    count = min(num_units, max(1, lanes_per_launch // (lanes_per_element * elements_per_unit)))
    units: Iterable[int] = np.linspace(0, num_units - 1, count).round().astype(int).tolist()
    rows = [owners[u * elements_per_unit : (u + 1) * elements_per_unit] for u in units]
    seeds = [np.full(len(r), u, np.uint64) for u, r in zip(units, rows, strict=True)]
    places = [np.arange(len(r), dtype=np.uint64) for r in rows]
    return Batch(np.concatenate(rows), np.concatenate(seeds), np.concatenate(places))
