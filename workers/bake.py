"""Stage `bake`: the imperfect caches of a scene, unit by unit.

A unit is `elements_per_unit` elements of one lobe; its seed comes from the cache set's key. Units are grouped
into launches only for speed: a unit's bytes do not depend on its company.
"""

import dataclasses
import time

import numpy as np

from storage.caches import CacheSet
from storage.store import UnitRef
from workers.bake_kernels import Batch
from workers.bake_lobes import DIFFUSE, STAGE, TRACED, Lobe, lobes_of
from workers.direction_grids import choose_grids
from workers.directional_filter import filter_directional
from workers.elements import ElementSet
from workers.errors import QuarantinedError
from workers.gather import load_diffuse
from workers.lobes import reflectance_at
from workers.query import CacheArrays
from workers.run_state import RunState
from workers.texels import DirectionalTexels, Packing, unpack_rows

LANES_PER_LAUNCH = 1 << 21
MAX_NON_FINITE_SHARE = 1e-4


def bake_refs(run: RunState, elements: ElementSet) -> dict[str, UnitRef]:
    """Cache sets of a run by lobe."""
    return {lobe.name: run.ref(STAGE, lobe.params) for lobe in lobes_of(run, elements)}


def run_bake(run: RunState, elements: ElementSet) -> dict[str, UnitRef]:
    """Bakes whatever units the store lacks.

    Returns:
        Cache set of each lobe, by its name.

    Raises:
        QuarantinedError: a unit holds more non-finite values than a few stray samples; it was set aside.
    """
    start = time.perf_counter()
    refs = {}
    for lobe in lobes_of(run, elements):
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
        after: the set that must be sealed before; "" for none.
    """

    ref: UnitRef
    num_units: int
    lanes_per_unit: int
    after: str = ""


def bake_sets(run: RunState, elements: ElementSet) -> dict[str, BakeSet]:
    """What there is to bake, by lobe."""
    per_unit, passes = run.settings.cache.elements_per_unit, run.settings.cache.passes
    return {
        lobe.name: BakeSet(run.ref(STAGE, lobe.params), -(-len(lobe.owners) // per_unit),
                           lobe.lanes_per_element * per_unit * passes, lobe.after)
        for lobe in lobes_of(run, elements)
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


def _lobe(run: RunState, elements: ElementSet, name: str) -> Lobe:
    return next(lobe for lobe in lobes_of(run, elements) if lobe.name == name)


def _cache_set(run: RunState, lobe: Lobe) -> CacheSet:
    specs = lobe.array_specs(run.settings.cache.elements_per_unit)
    return CacheSet.create_or_open(run.store, run.ref(STAGE, lobe.params), specs, lobe.attributes())


def _bake_missing(run: RunState, lobe: Lobe, caches: CacheSet, missing: list[int]) -> None:
    per_unit = run.settings.cache.elements_per_unit
    per_launch = max(1, LANES_PER_LAUNCH // (lobe.lanes_per_element * per_unit))
    with run.progress.track(f"bake {lobe.name}", len(missing)) as advance:
        for first in range(0, len(missing), per_launch):
            units = missing[first : first + per_launch]
            _bake_units(run, lobe, caches, units, per_unit)
            advance(len(units))


def _seal(run: RunState, lobe: Lobe, caches: CacheSet) -> None:
    caches.commit({"params": lobe.params, "passes": run.settings.cache.passes})


def _bake_units(run: RunState, lobe: Lobe, caches: CacheSet, units: list[int], per_unit: int) -> None:
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
            caches.write_unit(unit, lobe.at_rest(rows), {"seconds": seconds, "health": health})
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
    lobes = {lobe.name: lobe for lobe in lobes_of(run, elements) if lobe.name != TRACED}
    diffuse = np.zeros((0, 3), np.float32)
    if DIFFUSE in lobes:
        diffuse = load_diffuse(run, elements, run.ref(STAGE, lobes.pop(DIFFUSE).params))
        if not cache.demodulate:
            diffuse = diffuse * reflectance_at(run.table, elements)
    directional = _load_directional(run, elements, list(lobes.values()))
    return CacheArrays(diffuse, directional, demodulated=cache.demodulate, exitant=cache.lobes == "exitant")


def _stored(run: RunState, lobe: Lobe) -> CacheSet:
    return CacheSet.open(run.store, run.ref(STAGE, lobe.params))


def _load_directional(run: RunState, elements: ElementSet, lobes: list[Lobe]) -> DirectionalTexels:
    """All grids in one buffer. Packed ones are read, filtered and packed again grid by grid: the floats of one grid
    are the most that is held beside the buffer."""
    cache = run.settings.cache
    if not lobes:
        return DirectionalTexels.uniform(np.zeros((0, cache.polar, cache.azimuth, 3), np.float32))
    at_rest = [_stored(run, lobe).load() for lobe in lobes]
    packing = None
    if lobes[0].signed is not None:
        top = max(int(arrays["top"].max()) for arrays in at_rest)  # a filtered value is never above what it averages
        packing = Packing(top, any(lobe.signed for lobe in lobes))

    def load(index: int) -> np.ndarray:
        lobe, arrays = lobes[index], at_rest[index]
        at_rest[index] = {}
        grids = arrays["mean"] if lobe.signed is None else unpack_rows(**arrays, signed=lobe.signed)
        if not cache.denoise or cache.lobes == "exitant":
            return grids
        return filter_directional(elements, grids, lobe.slots)

    rungs = choose_grids(elements.spread, cache)
    if rungs is None:
        return DirectionalTexels.uniform(load(0), packing)
    order = np.unique(rungs).tolist()  # as the lobes are
    return DirectionalTexels.ladder(rungs, lambda rung: load(order.index(rung)), packing)


def cache_nbytes(run: RunState, elements: ElementSet) -> int:
    """Bytes of a run's caches at rest."""
    return sum(CacheSet.open(run.store, ref).nbytes for ref in bake_refs(run, elements).values())
