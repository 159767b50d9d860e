"""What one kind of caches costs at one number of triangles, measured in a process of its own.

The process loads the scene, gives it its triangles, lays out elements, bakes a sample of units, opens the query, says
what that took, and then renders a frame whenever it is asked to: so several of them can be timed in turns, and no
scene's materials are compiled into another's programs.
"""

import dataclasses
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from storage.caches import CacheSet
from storage.keys import seed_from_key
from storage.store import Store
from workers.bake import LANES_PER_LAUNCH, BakeSet, bake_refs, bake_sets, bake_units
from workers.camera_path import domain_poses
from workers.element_stage import RAYS_PER_POSE, elements_ref, run_elements
from workers.elements import ElementSet
from workers.errors import WorkerError
from workers.footprint import geometry_nbytes, program_nbytes
from workers.gather import DiffuseGather
from workers.query import CacheArrays, QueryProgram
from workers.run_state import PATH_SEED, RunState
from workers.scene import load_scene
from workers.settings import Settings
from workers.triangle_count import with_triangles
from workers.visibility import domain_hits

NUM_BLOCKS = 3
"""Launches of each lobe that are timed, at least: their scatter is the error of the seconds."""
END_S = 10.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class CostRequest:
    """What to measure.

    Attributes:
        source: what `load_scene` takes.
        settings: of the run, JSON; its width and height are the cameras'.
        target: triangles.
        frame_size: (width, height) of the queried frame.
        sample_paths: of each lobe, at least so many paths are baked where there are so many.
        memory_nbytes: caches that are larger are not opened: the query is not timed.
    """

    source: str
    settings: dict[str, Any]
    target: int
    frame_size: tuple[int, int]
    sample_paths: int
    memory_nbytes: int


class CostSample:
    """A measured scene, ready to render frames; `figures` says what it cost. Lives until `close`.

    Args:
        request: what to measure.
        told: called with what the process is at.

    Raises:
        WorkerError: the process refused, or died.
    """

    def __init__(self, request: CostRequest, told: Callable[[str], None] = lambda step: None) -> None:
        self._told = told
        context = multiprocessing.get_context("spawn")  # Dr.Jit's threads do not survive a fork
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, request), daemon=True)
        self._process.start()
        theirs.close()
        try:
            self.figures: dict[str, Any] = self._answer()
        except WorkerError:
            self.close()
            raise

    def frame(self, index: int = 0) -> None:
        """Queries one frame."""
        del index
        self._connection.send("frame")
        self._answer()

    def close(self) -> None:
        """Ends the process."""
        self._connection.close()  # it reads the end of its orders
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _answer(self) -> dict[str, Any]:
        try:
            kind, value = self._connection.recv()
            while kind == "step":
                self._told(value)
                kind, value = self._connection.recv()
        except (EOFError, ConnectionError) as error:
            self._process.join(END_S)
            raise WorkerError(
                f"process that measures costs must live, it ended with code {self._process.exitcode}; "
                "ask for fewer triangles or free memory"
            ) from error
        if kind == "refused":
            raise WorkerError(value)
        answer: dict[str, Any] = value
        return answer


def _serve(connection: Connection, request: CostRequest) -> None:
    with tempfile.TemporaryDirectory(prefix="lightwell-cost-") as folder:
        try:
            store = Store.open(folder, create=True)
            program, camera, figures = measure(request, store, lambda step: connection.send(("step", step)))
        except Exception as error:  # whatever it is, the asking process must not wait for ever
            connection.send(("refused", f"costs at {request.target:,} triangles: {type(error).__name__}: {error}"))
            return
    connection.send(("figures", figures))
    while True:
        try:
            connection.recv()
        except EOFError:
            return
        assert program is not None  # frames of samples without a query are not asked for
        program.run(camera)
        connection.send(("done", {}))


def measure(
    request: CostRequest, store: Store, told: Callable[[str], None] = lambda step: None
) -> tuple[QueryProgram | None, Any, dict[str, Any]]:
    """Measures in this process.

    Args:
        request: what.
        store: where the sample is baked; of no use afterwards.
        told: called at the start of every step.

    Returns:
        The query (None where its caches are larger than allowed), a camera for it, and the figures: seconds, paths,
        bytes and counts, JSON-like.
    """
    told("scene")
    settings = Settings.from_json(request.settings)
    scene = load_scene(request.source, width=settings.width, height=settings.height)
    scene, triangles, rule = with_triangles(scene, request.target)
    store.register_scene(scene.digest, {"name": scene.name, "source": scene.address})
    run = RunState(scene, store, settings)
    told("elements")
    elements, elements_s = _timed_elements(run)
    figures: dict[str, Any] = {
        "target": request.target, "triangles": triangles, "rule": rule, "elements": elements.num_elements,
        "diffuse_elements": len(elements.diffuse), "directional_elements": len(elements.glossy),
        "spacing_px": elements.spacing_px,
        "elements_seconds": elements_s, "elements_nbytes": store.nbytes(elements_ref(run)),
    }  # fmt: skip
    lobes = {}
    for name, found in bake_sets(run, elements).items():
        told(f"bake {name}")
        lobes[name] = _sampled_bake(run, elements, name, found, request)
    for total in ("bake_paths", "bake_seconds", "cache_nbytes"):
        figures[total] = sum(lobe[total] for lobe in lobes.values())
    figures["bake_seconds_error"] = float(np.sqrt(sum(lobe["bake_seconds_error"] ** 2 for lobe in lobes.values())))
    figures["sampled_paths"] = sum(lobe["sampled_paths"] for lobe in lobes.values())
    figures["nbytes"] = figures["cache_nbytes"] + figures["elements_nbytes"]
    told("query")
    program, camera = None, scene.camera.resized(*request.frame_size)
    figures["memory_nbytes"] = None
    if _stand_in_nbytes(settings, elements) <= request.memory_nbytes:
        caches = stand_in_caches(settings, elements)
        program = QueryProgram(scene.mi_scene, run.table, elements, caches, settings.query)
        program.run(camera)
        figures["memory_nbytes"] = program_nbytes(program) + geometry_nbytes(run.table)
    figures["peak_resident_nbytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return program, camera, figures


def _timed_elements(run: RunState) -> tuple[ElementSet, float]:
    """The elements stage and its seconds, camera paths and the compilation of its ray casts aside."""
    poses = domain_poses(run.paths, run.settings.cache.domain_poses, PATH_SEED)
    domain_hits(run.scene.mi_scene, run.table, poses[:1], run.settings.width, RAYS_PER_POSE, run.progress)
    start = time.perf_counter()
    elements = run_elements(run)
    return elements, time.perf_counter() - start


def _sampled_bake(
    run: RunState, elements: ElementSet, lobe: str, found: BakeSet, request: CostRequest
) -> dict[str, float]:
    """Costs of a lobe, from launches chosen by a seed where there are more than are asked for.

    The first launch is baked twice: its first time compiles.
    """
    cache = run.settings.cache
    if found.after:
        # Sampled like this one: the caches that end its paths are not whole, and their values cost nothing.
        run.made[bake_refs(run, elements)[found.after].key] = DiffuseGather.of_nothing(
            run.scene.mi_scene, run.table, elements
        )
    group = max(1, LANES_PER_LAUNCH // max(found.lanes_per_unit // cache.passes, 1))
    blocks = [range(first, min(first + group, found.num_units)) for first in range(0, found.num_units, group)]
    wanted = max(NUM_BLOCKS, -(-request.sample_paths // (group * found.lanes_per_unit)))
    rng = np.random.default_rng(seed_from_key(found.ref.key, "cost sample"))
    chosen = sorted(rng.choice(len(blocks), min(wanted, len(blocks)), replace=False))
    caches = CacheSet.open(run.store, bake_units(run, elements, lobe, blocks[chosen[0]]))
    for unit in blocks[chosen[0]]:
        caches.discard_unit(unit)
    rates = []
    num_baked = 0
    for index in chosen:
        start = time.perf_counter()
        bake_units(run, elements, lobe, blocks[index])
        rates.append((time.perf_counter() - start) / len(blocks[index]))
        num_baked += len(blocks[index])
    rows = len(elements.glossy) if lobe == "directional" else len(elements.diffuse)
    lanes_per_row = found.lanes_per_unit // cache.elements_per_unit
    weights = np.array([len(blocks[index]) for index in chosen], np.float64)
    seconds = found.num_units * float(np.average(rates, weights=weights))
    # Of a finite population: launches that were all baked leave no error.
    left = np.sqrt(1 - len(chosen) / len(blocks))
    error = found.num_units * float(np.std(rates, ddof=1)) / np.sqrt(len(rates)) * left if len(rates) > 1 else 0.0
    return {
        "bake_paths": rows * lanes_per_row,
        "bake_seconds": seconds, "bake_seconds_error": float(error),
        "cache_nbytes": round(run.store.nbytes(found.ref) / num_baked * found.num_units),
        "sampled_paths": min(num_baked * cache.elements_per_unit, rows) * lanes_per_row,
    }  # fmt: skip


def stand_in_caches(settings: Settings, elements: ElementSet) -> CacheArrays:
    """Caches of a run's shape that hold random light: a query's time does not depend on what it reads."""
    rng, cache = np.random.default_rng(0), settings.cache
    exitant = cache.lobes == "exitant"
    diffuse = rng.random((0 if exitant else elements.num_elements, 3), dtype=np.float32)
    directional = rng.random((len(elements.glossy), cache.polar, cache.azimuth, 3), dtype=np.float32)
    return CacheArrays(diffuse, directional, demodulated=cache.demodulate, exitant=exitant)


def _stand_in_nbytes(settings: Settings, elements: ElementSet) -> int:
    """Twice the caches: as an array, and on the device."""
    cache = settings.cache
    return 2 * 4 * 3 * (elements.num_elements + len(elements.glossy) * cache.polar * cache.azimuth)
