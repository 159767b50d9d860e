"""Cache elements: the lattice points that the camera domain sees, merged where they fall together.

`build_elements` turns visible hits and a budget into patches (`workers/lattice.py`), picks the points that at
least one hit interpolates, and lays down, for every lattice point and side, the slot of the element that answers
for it: its own, or the nearest baked one where it was not seen.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from workers.backend import dr, mi
from workers.lattice import (
    PatchTable,
    build_patch_table,
    locate_patch,
    locate_points,
    patch_counts,
    patch_levels,
    patches_per_prim,
    point_parameters,
)
from workers.lobes import LobeClass
from workers.settings import CacheSettings
from workers.surfaces import SurfaceTable
from workers.visibility import Hits

NOT_BAKED = np.uint32(1 << 31)  # flag on a slot: answered by its nearest baked neighbour
NO_SLOT = np.uint32(0xFFFFFFFF)
MERGE_VOXEL = 0.45  # of the spacing
SPACING_STEPS = 10
NORMAL_BINS = 4


@dataclass(frozen=True)
class ElementSet:
    """Elements in bake order, and who answers for each lattice point.

    Attributes:
        patches: patches and levels of every primitive.
        shape: stable shape index, int64 [n].
        prim_local: primitive in its shape, int64 [n].
        uv: barycentrics or surface parameters, float32 [n, 2].
        side: 0 front, 1 back, uint8 [n].
        position: world position, float32 [n, 3].
        normal: unit shading normal towards `side`, float32 [n, 3].
        footprint: pixel edge at the element in scene units, float32 [n] (inf where never seen).
        glossy: indices (into the above) of the elements with a directional lobe, int64 [g].
        diffuse_slot, glossy_slot: uint32 [2 * num_points], by lattice point * 2 + side; a slot into all elements
            or into `glossy`, `NOT_BAKED` set where it stands in for a neighbour, `NO_SLOT` where the lobe does
            not occur in the scene.
        spacing_px: the spacing that met the budget.
    """

    patches: PatchTable
    shape: np.ndarray
    prim_local: np.ndarray
    uv: np.ndarray
    side: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    glossy: np.ndarray
    diffuse_slot: np.ndarray
    glossy_slot: np.ndarray
    spacing_px: float

    @property
    def num_elements(self) -> int:
        return len(self.shape)


@dataclass(frozen=True)
class _Lattice:
    """Patches and the lattice points that hits touch (point * 2 + side, sorted unique)."""

    patches: PatchTable
    touched: np.ndarray


def build_elements(table: SurfaceTable, hits: Hits, settings: CacheSettings) -> ElementSet:
    """Lays out elements for a scene, a camera domain and a budget."""
    lattice, spacing = _solve_spacing(table, hits, settings)
    points = _Points.of(table, lattice, settings)
    return _assemble(table, lattice, points, settings, spacing)


def _solve_spacing(table: SurfaceTable, hits: Hits, settings: CacheSettings) -> tuple[_Lattice, float]:
    """Smallest spacing of the lattice whose seen elements fit the budget, by bisection on a log scale."""
    if settings.elements != "lattice":
        return _plain_lattice(table, hits, 1 if settings.elements == "vertex" else 0), 0.0
    prim_footprint = np.full(table.num_prims, np.inf, np.float32)
    np.minimum.at(prim_footprint, hits.prim, hits.footprint)
    m = patch_counts(table.prim_edge, prim_footprint)
    located = _patches_of_hits(table, hits, m)
    low, high = settings.min_spacing_px, 256.0
    best = _lattice_at(table, hits, m, located, low)
    if len(_merged(table, best, settings)) <= settings.max_elements:
        return best, low
    for _ in range(SPACING_STEPS):
        middle = float(np.sqrt(low * high))
        lattice = _lattice_at(table, hits, m, located, middle)
        if len(_merged(table, lattice, settings)) <= settings.max_elements:
            high, best = middle, lattice
        else:
            low = middle
        if high / low < 1.05:
            break
    return best, high


def _patches_of_hits(table: SurfaceTable, hits: Hits, m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    square = _prim_is_square(table)
    base = np.concatenate([[0], np.cumsum(patches_per_prim(m, square))])[:-1]
    cell, b1, b2 = locate_patch(hits.uv[:, 0], hits.uv[:, 1], m[hits.prim], square[hits.prim])
    return base[hits.prim] + cell, b1, b2


def _lattice_at(table: SurfaceTable, hits: Hits, m: np.ndarray, located, spacing: float) -> _Lattice:  # type: ignore[no-untyped-def]
    patch, b1, b2 = located
    square = _prim_is_square(table)
    counts = patches_per_prim(m, square)
    footprint = np.full(int(counts.sum()), np.inf, np.float32)
    np.minimum.at(footprint, patch, hits.footprint)
    edge = np.repeat(table.prim_edge / m, counts)
    patches = build_patch_table(m, patch_levels(edge, footprint, spacing), square)
    return _Lattice(patches, _touched(patches, patch, b1, b2, hits.side))


def _plain_lattice(table: SurfaceTable, hits: Hits, level: int) -> _Lattice:
    m = np.ones(table.num_prims, np.uint32)
    square = _prim_is_square(table)
    count = int(patches_per_prim(m, square).sum())
    patches = build_patch_table(m, np.full(count, level, np.uint32), square)
    patch, b1, b2 = _patches_of_hits(table, hits, m)
    return _Lattice(patches, _touched(patches, patch, b1, b2, hits.side))


def _touched(
    patches: PatchTable, patch: np.ndarray, b1: np.ndarray, b2: np.ndarray, side: np.ndarray
) -> np.ndarray:
    index, weight = locate_points(b1, b2, patches.patch_level[patch])
    point = (patches.patch_base[patch][:, None] + index) * 2 + side[:, None]
    return np.unique(point[weight > 0])


def _prim_is_square(table: SurfaceTable) -> np.ndarray:
    counts = np.diff(table.prim_offset)
    return np.repeat(table.is_parametric, counts)


def _merged(table: SurfaceTable, lattice: _Lattice, settings: CacheSettings) -> np.ndarray:
    return np.unique(_Points.of(table, lattice, settings).merge_key, axis=0)


@dataclass(frozen=True)
class _Points:
    """Touched lattice points with their places and merge keys."""

    shape: np.ndarray
    prim_local: np.ndarray
    uv: np.ndarray
    side: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    merge_key: np.ndarray

    @classmethod
    def of(cls, table: SurfaceTable, lattice: _Lattice, settings: CacheSettings) -> "_Points":
        point, side = lattice.touched // 2, (lattice.touched % 2).astype(np.uint8)
        prim, uv_all = point_parameters(lattice.patches)
        prim, uv = prim[point], uv_all[point].astype(np.float32)
        shape = np.searchsorted(table.prim_offset, prim, side="right") - 1
        prim_local = prim - table.prim_offset[shape]
        position, normal, geometric = surface_frame(table, shape, prim_local, uv, side)
        spacing = _point_spacing(table, lattice, point, prim)
        key = _merge_key(shape, side, position, geometric, spacing, settings)
        return cls(shape, prim_local, uv, side, position, normal, key)


def surface_frame(
    table: SurfaceTable, shape: np.ndarray, prim_local: np.ndarray, uv: np.ndarray, side: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, shading normal and geometric normal (both towards `side`) of places; float32 [n, 3] each."""
    si = table.interaction(shape, prim_local, uv)
    sign = np.where(side == 1, -1.0, 1.0).astype(np.float32)[:, None]
    dr.eval(si.p, si.sh_frame.n, si.n)
    position = np.ascontiguousarray(np.array(si.p).T.astype(np.float32))
    normal = np.array(si.sh_frame.n).T.astype(np.float32) * sign
    return position, normal, np.array(si.n).T.astype(np.float32) * sign


def _point_spacing(table: SurfaceTable, lattice: _Lattice, point: np.ndarray, prim: np.ndarray) -> np.ndarray:
    patch = np.searchsorted(lattice.patches.patch_base, point, side="right") - 1
    level = np.maximum(lattice.patches.patch_level[patch], 1)
    return table.prim_edge[prim] / lattice.patches.prim_patches[prim] / level


def _merge_key(
    shape: np.ndarray, side: np.ndarray, position: np.ndarray, normal: np.ndarray, spacing: np.ndarray,
    settings: CacheSettings,
) -> np.ndarray:  # fmt: skip
    """Points with one key share an element: same shape and side, near normals, one voxel.

    A voxel is `MERGE_VOXEL` of the spacing, rounded to a power of two so that neighbours with nearly the same
    spacing agree; vertex and triangle caches merge only points that coincide.
    """
    if settings.elements == "triangle":
        return np.arange(len(shape), dtype=np.int64)[:, None]
    extent = float(np.ptp(position, axis=0).max()) if len(position) else 1.0
    if settings.elements == "vertex":
        voxel = np.full(len(shape), max(extent, 1e-30) * 1e-6)
    else:
        voxel = np.exp2(np.round(np.log2(np.maximum(spacing, max(extent, 1e-30) * 1e-6) * MERGE_VOXEL)))
    cell = np.floor((position - position.min(axis=0, initial=0.0)) / voxel[:, None] + 0.25).astype(np.int64)
    facing = np.round(normal * NORMAL_BINS).astype(np.int64)
    return np.column_stack([shape, side, np.round(np.log2(voxel)).astype(np.int64), cell, facing])


def _assemble(
    table: SurfaceTable, lattice: _Lattice, points: _Points, settings: CacheSettings, spacing: float
) -> ElementSet:
    _, representative, element = np.unique(points.merge_key, axis=0, return_index=True, return_inverse=True)
    element = element.reshape(-1)
    order = _bake_order(points.shape[representative], points.position[representative])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    chosen = representative[order]
    element = rank[element]
    lobes = np.array([int(lobe) for lobe in table.lobes])[points.shape[chosen]]
    exitant = settings.lobes == "exitant"
    is_glossy = np.full(len(chosen), True) if exitant else (lobes & int(LobeClass.GLOSSY)) > 0
    is_diffuse = np.full(len(chosen), False) if exitant else (lobes & int(LobeClass.DIFFUSE)) > 0
    glossy = np.flatnonzero(is_glossy)
    glossy_rank = np.full(len(chosen), -1, np.int64)
    glossy_rank[glossy] = np.arange(len(glossy))
    slots = _Slots(table, lattice, points, element, chosen)
    return ElementSet(
        patches=lattice.patches,
        shape=points.shape[chosen],
        prim_local=points.prim_local[chosen],
        uv=points.uv[chosen],
        side=points.side[chosen],
        position=points.position[chosen],
        normal=points.normal[chosen],
        glossy=glossy,
        diffuse_slot=slots.fill(np.where(is_diffuse, np.arange(len(chosen)), -1)),
        glossy_slot=slots.fill(glossy_rank),
        spacing_px=spacing,
    )


def _bake_order(shape: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Shape by shape along a Morton curve: neighbours in memory are neighbours in space."""
    if len(position) == 0:
        return np.zeros(0, np.int64)
    low, extent = position.min(axis=0), max(float(np.ptp(position, axis=0).max()), 1e-30)
    cell = np.clip((position - low) / extent * 1023, 0, 1023).astype(np.uint64)
    code = np.zeros(len(position), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.lexsort((code, shape))


@dataclass(frozen=True)
class _Slots:
    """Fills the slot tables: own element where one is baked, else the nearest of the same lobe."""

    table: SurfaceTable
    lattice: _Lattice
    points: _Points
    element: np.ndarray
    chosen: np.ndarray

    def fill(self, slot_of_element: np.ndarray) -> np.ndarray:
        num = self.lattice.patches.num_points * 2
        slots = np.full(num, NO_SLOT, np.uint32)
        own = slot_of_element[self.element]
        baked = own >= 0
        slots[self.lattice.touched[baked]] = own[baked]
        candidates = np.flatnonzero(slot_of_element >= 0)
        if len(candidates) == 0:
            return slots
        missing = np.flatnonzero(slots == NO_SLOT)
        slots[missing] = slot_of_element[candidates[self._nearest(candidates, missing)]].astype(np.uint32) | NOT_BAKED
        return slots

    def _nearest(self, candidates: np.ndarray, missing: np.ndarray) -> np.ndarray:
        """Nearest candidate of each missing (point, side): place and normal count, then the shape."""
        prim, uv_all = point_parameters(self.lattice.patches)
        prim, uv = prim[missing // 2], uv_all[missing // 2].astype(np.float32)
        shape = np.searchsorted(self.table.prim_offset, prim, side="right") - 1
        side = (missing % 2).astype(np.uint8)
        local = prim - self.table.prim_offset[shape]
        position, normal, _ = surface_frame(self.table, shape, local, uv, side)
        known = self.points.position[self.chosen][candidates]
        scale = max(float(np.ptp(known, axis=0).max()), 1e-30) * 0.1
        tree = cKDTree(np.concatenate([known, self.points.normal[self.chosen][candidates] * scale], axis=1))
        _, nearest = tree.query(np.nan_to_num(np.concatenate([position, normal * scale], axis=1)), workers=2)
        return nearest
