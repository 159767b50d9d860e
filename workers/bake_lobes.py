"""What there is to bake: the cache sets of a run, one for the diffuse lobe and one for each grid of the directional.

A set is rectangular: elements of one grid, in units of `elements_per_unit` of them. Where paths end in diffuse caches
(`workers/gather.py`), the diffuse lobe is baked twice: with a quarter of the paths traced to their end, then with half
of them, which end in what the first ones found.
"""

import dataclasses
import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np

from storage.caches import ArraySpec
from storage.store import UnitRef
from workers.bake_kernels import Batch, bake_diffuse, bake_directional
from workers.direction_grids import choose_grids, grid_of, samples_per_direction, set_name
from workers.element_stage import elements_ref
from workers.elements import ElementSet
from workers.gather import diffuse_gather, gather_params, gathers
from workers.lobes import LobeClass
from workers.run_state import RunState
from workers.texels import Packing, pack_rows
from workers.transport import TRANSPORT_VERSION

Rows = dict[str, np.ndarray]
STAGE = "bake"
DIFFUSE = "diffuse"
TRACED = "diffuse-traced"  # the first of two: not queried
TRACED_SHARE, GATHERED_SHARE = 4, 2  # `cache.diffuse_spp` over the paths of each


@dataclasses.dataclass(frozen=True)
class Lobe:
    """One cache set to bake: its specification and its kernel.

    Attributes:
        name: "diffuse", "directional", or "directional-8x2" where grids differ.
        params: what its key is made of.
        arrays: shape of a row of what the kernel gives, by name.
        owners: element of each row, int64 [rows].
        lanes_per_element: paths of one element and pass.
        kernel: (elements of a launch, pass) to float32 rows.
        signed: whether values can be negative; None where rows are stored as float32, as they are.
        slots: place in `ElementSet.glossy` of each row; None for the diffuse lobe.
        after: the set that must be sealed before this one is baked, for its paths end there; "" for none.
    """

    name: str
    params: dict[str, Any]
    arrays: dict[str, tuple[int, ...]]
    owners: np.ndarray
    lanes_per_element: int
    kernel: Callable[[Batch, int], Rows]
    signed: bool | None = None
    slots: np.ndarray | None = None
    after: str = ""

    def array_specs(self, rows_per_unit: int) -> list[ArraySpec]:
        """Its arrays at rest."""
        rows = len(self.owners)
        if self.signed is None:
            return [ArraySpec(name, (rows, *shape), "float32", rows_per_unit) for name, shape in self.arrays.items()]
        grid = self.arrays["mean"][:-1]
        return [ArraySpec("texels", (rows, *grid), "uint32", rows_per_unit),
                ArraySpec("top", (rows,), "int16", rows_per_unit)]  # fmt: skip

    def at_rest(self, rows: Rows) -> Rows:
        """A unit's rows as they are stored."""
        return rows if self.signed is None else pack_rows(rows["mean"], signed=self.signed)

    def attributes(self) -> dict[str, Any]:
        """What a reader of its arrays needs to know."""
        facts = {"lobe": self.name, **self.params}
        if self.signed is None:
            return facts
        error = Packing(0, self.signed).error
        return facts | {"encoding": "rgb9e5", "signed": self.signed, "max_error_of_largest_channel": error}


def lobes_of(run: RunState, elements: ElementSet) -> list[Lobe]:
    """What there is to bake; a lobe or grid without elements is left out."""
    cache = run.settings.cache
    common = {"elements": elements_ref(run).key, "max_depth": run.scene.max_depth, "passes": cache.passes,
              "elements_per_unit": cache.elements_per_unit, "transport": TRANSPORT_VERSION}  # fmt: skip
    found, gathered = list[Lobe](), None
    if gathers(cache, run.scene.max_depth, run.table, elements):
        found.append(_diffuse(run, elements, common, TRACED, -(-cache.diffuse_spp // TRACED_SHARE), None))
        traced = run.ref(STAGE, found[0].params)
        params = common | gather_params(traced, cache)
        found.append(_diffuse(run, elements, params, DIFFUSE, -(-cache.diffuse_spp // GATHERED_SHARE), traced))
        gathered = run.ref(STAGE, found[1].params)
        common |= gather_params(gathered, cache)
    elif cache.lobes == "split" and len(elements.diffuse):
        found.append(_diffuse(run, elements, common, DIFFUSE, cache.diffuse_spp, None))
    if len(elements.glossy) == 0:
        return found
    rungs = choose_grids(elements.spread, cache)
    if rungs is None:
        every = np.arange(len(elements.glossy))
        grid = (cache.azimuth, cache.polar)
        spp = cache.directional_spp
        return [*found, _directional(run, elements, common, "directional", every, grid, spp, gathered)]
    for rung in np.unique(rungs).tolist():
        azimuth, polar = grid_of(rung)
        # Who is chosen rather than why: settings that choose alike share what they bake.
        params = common | {"chosen": hashlib.sha256(np.packbits(rungs == rung).tobytes()).hexdigest()[:32]}
        name, spp = set_name((azimuth, polar)), samples_per_direction(rung, cache)
        slots = np.flatnonzero(rungs == rung)
        found.append(_directional(run, elements, params, name, slots, (azimuth, polar), spp, gathered))
    return found


def _diffuse(
    run: RunState, elements: ElementSet, common: dict[str, Any], name: str, spp_of_all_passes: int,
    gathered: UnitRef | None,
) -> Lobe:  # fmt: skip
    spp = _per_pass(spp_of_all_passes, run.settings.cache.passes)

    def kernel(batch: Batch, index: int) -> Rows:
        scene, depth = run.scene.mi_scene, run.scene.max_depth
        gather = None if gathered is None else diffuse_gather(run, elements, gathered)
        mean, square = bake_diffuse(scene, run.table, elements, batch, spp, index, depth, gather)
        return {"mean": mean, "square": square}

    params, after = common | {"lobe": "diffuse", "spp": spp_of_all_passes}, "" if gathered is None else TRACED
    shapes: dict[str, tuple[int, ...]] = {"mean": (3,), "square": (3,)}
    return Lobe(name, params, shapes, elements.diffuse, spp, kernel, after=after)


def _directional(
    run: RunState, elements: ElementSet, common: dict[str, Any], name: str, slots: np.ndarray, grid: tuple[int, int],
    spp_of_all_passes: int, gathered: UnitRef | None,
) -> Lobe:  # fmt: skip
    cache, table = run.settings.cache, run.table
    exitant = cache.lobes == "exitant"
    spp, owners = _per_pass(spp_of_all_passes, cache.passes), elements.glossy[slots]

    def kernel(batch: Batch, index: int) -> Rows:
        scene, depth = run.scene.mi_scene, run.scene.max_depth
        gather = None if gathered is None else diffuse_gather(run, elements, gathered)
        return {"mean": bake_directional(scene, table, elements, batch, grid, spp, index, depth, exitant, gather)}

    params = common | {"lobe": cache.lobes, "grid": grid, "spp": spp_of_all_passes}
    packed = cache.texels == "rgb9e5" and not exitant
    signed = has_signed_lobe(run, elements, owners) if packed else None
    if packed:
        params |= {"texels": "rgb9e5", "signed": signed}
    lanes, shape = grid[0] * grid[1] * spp, (grid[1], grid[0], 3)
    after = "" if gathered is None else DIFFUSE
    return Lobe(name, params, {"mean": shape}, owners, lanes, kernel, signed, slots, after)


def has_signed_lobe(run: RunState, elements: ElementSet, owners: np.ndarray) -> bool:
    """Whether a directional lobe of these elements can be negative: a principled one, from which the Lambertian part
    was taken away."""
    principled = np.array([bool(lobe & LobeClass.PRINCIPLED) for lobe in run.table.lobes])
    return bool(principled[np.unique(elements.shape[owners])].any())


def _per_pass(spp: int, passes: int) -> int:
    return max(1, -(-spp // passes))
