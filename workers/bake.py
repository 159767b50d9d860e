"""Stage `bake`: the imperfect caches of a scene, unit by unit.

A unit is `elements_per_unit` elements of one lobe; its seed comes from the cache set's key. Units are grouped
into launches only for speed: a unit's bytes do not depend on its company.
"""

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from storage.caches import ArraySpec, CacheSet
from storage.store import UnitRef
from workers.bake_kernels import Batch, bake_diffuse, bake_directional
from workers.cache_filter import filter_diffuse, filter_directional
from workers.element_stage import elements_ref
from workers.elements import ElementSet
from workers.errors import QuarantinedError
from workers.lobes import reflectance_at
from workers.query import CacheArrays
from workers.run_state import RunState
from workers.transport import TRANSPORT_VERSION

STAGE = "bake"
LANES_PER_LAUNCH = 1 << 21
MAX_NON_FINITE_SHARE = 1e-4


@dataclasses.dataclass(frozen=True)
class _Lobe:
    """One lobe to bake: its cache set's specification and its kernel."""

    name: str
    params: dict
    arrays: dict[str, tuple[int, ...]]
    owners: np.ndarray  # element of each row
    lanes_per_element: int
    kernel: Callable[[Batch, int], dict[str, np.ndarray]]


def _lobes(run: RunState, elements: ElementSet) -> list[_Lobe]:
    """What there is to bake; a lobe without elements is left out."""
    cache = run.settings.cache
    scene, table, depth = run.scene.mi_scene, run.table, run.scene.max_depth
    common = {"elements": elements_ref(run).key, "max_depth": depth, "passes": cache.passes,
              "elements_per_unit": cache.elements_per_unit, "transport": TRANSPORT_VERSION}  # fmt: skip
    grid = (cache.azimuth, cache.polar)
    diffuse_spp = _per_pass(cache.diffuse_spp, cache.passes)
    directional_spp = _per_pass(cache.directional_spp, cache.passes)

    def diffuse(batch: Batch, index: int) -> dict[str, np.ndarray]:
        mean, square = bake_diffuse(scene, table, elements, batch, diffuse_spp, index, depth)
        return {"mean": mean, "square": square}

    def directional(batch: Batch, index: int) -> dict[str, np.ndarray]:
        exitant = cache.lobes == "exitant"
        return {"mean": bake_directional(scene, table, elements, batch, grid, directional_spp, index, depth, exitant)}

    lobes = []
    if cache.lobes == "split" and elements.num_elements:
        params = common | {"lobe": "diffuse", "spp": cache.diffuse_spp}
        owners = np.arange(elements.num_elements)
        arrays: dict[str, tuple[int, ...]] = {"mean": (3,), "square": (3,)}
        lobes.append(_Lobe("diffuse", params, arrays, owners, diffuse_spp, diffuse))
    if len(elements.glossy):
        params = common | {"lobe": cache.lobes, "grid": grid, "spp": cache.directional_spp}
        lanes = grid[0] * grid[1] * directional_spp
        arrays = {"mean": (grid[1], grid[0], 3)}
        lobes.append(_Lobe("directional", params, arrays, elements.glossy, lanes, directional))
    return lobes


def _per_pass(spp: int, passes: int) -> int:
    return max(1, -(-spp // passes))


def bake_refs(run: RunState, elements: ElementSet) -> dict[str, UnitRef]:
    """Cache sets of a run by lobe."""
    return {lobe.name: run.ref(STAGE, lobe.params) for lobe in _lobes(run, elements)}


def run_bake(run: RunState, elements: ElementSet) -> dict[str, UnitRef]:
    """Bakes whatever units the store lacks.

    Returns:
        Cache set of each lobe ("diffuse", "directional").

    Raises:
        QuarantinedError: a unit holds more non-finite values than a few stray samples; it was set aside.
    """
    start = time.perf_counter()
    refs = {}
    for lobe in _lobes(run, elements):
        refs[lobe.name] = run.ref(STAGE, lobe.params)
        if run.store.committed(refs[lobe.name]) is None:
            caches = _cache_set(run, lobe)
            _bake_missing(run, lobe, caches, sorted(set(range(caches.num_units)) - caches.committed_units()))
            _seal(run, lobe, caches)
            run.seconds[STAGE] = time.perf_counter() - start
    return refs


@dataclasses.dataclass(frozen=True)
class BakeSet:
    """One lobe's cache set as a plan sees it.

    Attributes:
        ref: its address.
        num_units: bake units.
        lanes_per_unit: paths of one unit, all passes.
    """

    ref: UnitRef
    num_units: int
    lanes_per_unit: int


def bake_sets(run: RunState, elements: ElementSet) -> dict[str, BakeSet]:
    """What there is to bake, by lobe."""
    per_unit, passes = run.settings.cache.elements_per_unit, run.settings.cache.passes
    return {
        lobe.name: BakeSet(run.ref(STAGE, lobe.params), -(-len(lobe.owners) // per_unit),
                           lobe.lanes_per_element * per_unit * passes)
        for lobe in _lobes(run, elements)
    }  # fmt: skip


def bake_units(run: RunState, elements: ElementSet, lobe_name: str, units: range) -> UnitRef:
    """Bakes those of some units of one lobe that the store lacks.

    Raises:
        WorkerError: a unit holds more non-finite values than a few stray samples.
    """
    lobe = _lobe(run, elements, lobe_name)
    caches = _cache_set(run, lobe)
    _bake_missing(run, lobe, caches, [unit for unit in units if caches.unit_record(unit) is None])
    return caches.ref


def seal_bake(run: RunState, elements: ElementSet, lobe_name: str) -> UnitRef:
    """Marks a lobe's cache set as done.

    Raises:
        MissingUnitError: a unit is not committed.
    """
    lobe = _lobe(run, elements, lobe_name)
    caches = _cache_set(run, lobe)
    _seal(run, lobe, caches)
    return caches.ref


def _lobe(run: RunState, elements: ElementSet, name: str) -> _Lobe:
    return next(lobe for lobe in _lobes(run, elements) if lobe.name == name)


def _cache_set(run: RunState, lobe: _Lobe) -> CacheSet:
    per_unit, rows = run.settings.cache.elements_per_unit, len(lobe.owners)
    specs = [ArraySpec(name, (rows, *shape), "float32", per_unit) for name, shape in lobe.arrays.items()]
    ref = run.ref(STAGE, lobe.params)
    return CacheSet.create_or_open(run.store, ref, specs, {"lobe": lobe.name, **lobe.params})


def _bake_missing(run: RunState, lobe: _Lobe, caches: CacheSet, missing: list[int]) -> None:
    per_unit = run.settings.cache.elements_per_unit
    per_launch = max(1, LANES_PER_LAUNCH // (lobe.lanes_per_element * per_unit))
    with run.progress.track(f"bake {lobe.name}", len(missing)) as advance:
        for first in range(0, len(missing), per_launch):
            units = missing[first : first + per_launch]
            _bake_units(run, lobe, caches, units, per_unit)
            advance(len(units))


def _seal(run: RunState, lobe: _Lobe, caches: CacheSet) -> None:
    caches.commit({"params": lobe.params, "passes": run.settings.cache.passes})


def _bake_units(run: RunState, lobe: _Lobe, caches: CacheSet, units: list[int], per_unit: int) -> None:
    start = time.perf_counter()
    ranges = [np.arange(u * per_unit, min((u + 1) * per_unit, len(lobe.owners))) for u in units]
    seeds = [np.full(len(r), caches.unit_seed(u), np.uint64) for u, r in zip(units, ranges, strict=True)]
    places = [np.arange(len(r), dtype=np.uint64) for r in ranges]
    batch = Batch(lobe.owners[np.concatenate(ranges)], np.concatenate(seeds), np.concatenate(places))
    totals: dict[str, np.ndarray] = {}
    passes = run.settings.cache.passes
    for index in range(passes):
        for name, value in lobe.kernel(batch, index).items():
            totals[name] = totals.get(name, 0.0) + value.astype(np.float64)
        run.progress.between_passes()
    means = {name: (total / passes).astype(np.float32) for name, total in totals.items()}
    seconds = (time.perf_counter() - start) / len(units)
    offset = 0
    refused: list[QuarantinedError] = []
    for unit, members in zip(units, ranges, strict=True):
        rows = {name: value[offset : offset + len(members)] for name, value in means.items()}
        offset += len(members)
        try:
            health = _checked_health(lobe.name, unit, rows)
        except QuarantinedError as error:
            caches.quarantine_unit(unit, str(error), error.facts)
            refused.append(error)
        else:
            caches.write_unit(unit, rows, {"seconds": seconds, "health": health})
    if refused:  # once the others are kept
        raise QuarantinedError(f"{refused[0]} (units set aside: {len(refused)})", refused[0].facts)


def _checked_health(lobe: str, unit: int, rows: dict[str, np.ndarray]) -> dict[str, int]:
    """Counts NaN, Inf and negative values; stray non-finite elements are zeroed and counted, many are refused."""
    size = sum(value.size for value in rows.values())
    bad = {name: ~np.isfinite(value) for name, value in rows.items()}
    count = int(sum(mask.sum() for mask in bad.values()))
    if count > MAX_NON_FINITE_SHARE * size:
        raise QuarantinedError(
            f"bake unit {unit} of the {lobe} lobe must be finite, got {count} of {size} values NaN or Inf; "
            "look for NaN in the scene's textures and materials",
            {"non_finite": count, "values": size, "max_share": MAX_NON_FINITE_SHARE},
        )
    for name, mask in bad.items():
        rows[name][mask] = 0.0
    return {"non_finite": count, "negative": int((rows["mean"] < 0).sum())}


def load_caches(run: RunState, elements: ElementSet) -> CacheArrays:
    """Reads the caches of a run into memory.

    Raises:
        StorageError: a unit is missing or damaged.
    """
    cache = run.settings.cache
    refs = bake_refs(run, elements)
    loaded = {name: CacheSet.open(run.store, ref).load() for name, ref in refs.items()}
    diffuse = loaded["diffuse"]["mean"] if "diffuse" in loaded else np.zeros((0, 3), np.float32)
    empty = np.zeros((0, cache.polar, cache.azimuth, 3), np.float32)
    directional = loaded["directional"]["mean"] if "directional" in loaded else empty
    exitant = cache.lobes == "exitant"
    if cache.denoise and not exitant:
        directional = filter_directional(elements, directional)
        if "diffuse" in loaded:
            square = loaded["diffuse"]["square"].astype(np.float64)
            variance = np.maximum(square - diffuse.astype(np.float64) ** 2, 0.0) / max(cache.diffuse_spp - 1, 1)
            diffuse = filter_diffuse(elements, diffuse, np.sqrt(variance))
    if not cache.demodulate and not exitant:
        diffuse = diffuse * reflectance_at(run.table, elements)
    return CacheArrays(diffuse, directional, demodulated=cache.demodulate, exitant=exitant)


def cache_nbytes(run: RunState, elements: ElementSet) -> int:
    """Bytes of a run's caches at rest."""
    return sum(CacheSet.open(run.store, ref).nbytes for ref in bake_refs(run, elements).values())
