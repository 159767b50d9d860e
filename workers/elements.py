"""Cache elements: the lattice points that the camera domain sees, merged where they fall together.

`build_elements` turns visible hits and a budget into patches (`workers/lattice.py`), picks the points that at
least one hit interpolates, and lays down, for every lattice point and side, the slot of the element that
answers for it: its own, or the nearest baked one where it was not seen.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from workers.backend import dr
from workers.direction_grids import measure_spread
from workers.lattice import (
    PatchTable,
    build_patch_table,
    locate_patch,
    locate_points,
    patch_counts,
    patch_levels,
    patches_per_prim,
    point_parameters,
    tessellation_counts,
)
from workers.lobes import LobeClass
from workers.settings import CacheSettings
from workers.surfaces import SurfaceTable
from workers.visibility import Hits

NOT_BAKED = np.uint32(1 << 31)  # flag on a slot: answered by its nearest baked neighbour
NO_SLOT = np.uint32(0xFFFFFFFF)
# Part of the keys of what is made from element sets; raise it whenever the same settings give other elements.
ELEMENTS_VERSION = 3
INSET = 0.15  # of the spacing
MERGE_VOXEL = 0.45  # of the spacing
SPACING_STEPS = 10
NORMAL_BINS = 4
HASH_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)
LEAF_SIZE = 32  # of the search tree; larger than the default: queries in six dimensions visit many leaves


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
        spread: angular width of that lobe in radians, float32 [g] (`workers/direction_grids.py`; infinite where
            nothing is measured: all of the exitant radiance).
        diffuse_slot, glossy_slot: uint32 [2 * num_points], by lattice point * 2 + side; a slot into all
            elements or into `glossy`, `NOT_BAKED` set where it stands in for a neighbour (for any element
            where the material lacks the lobe), `NO_SLOT` where the lobe does not occur in the scene.
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
    spread: np.ndarray
    diffuse_slot: np.ndarray
    glossy_slot: np.ndarray
    spacing_px: float

    @property
    def num_elements(self) -> int:
        return len(self.shape)

    @property
    def diffuse(self) -> np.ndarray:
        """Indices of the elements with a diffuse lobe, int64 [d]: others need none of its paths."""
        own = self.diffuse_slot[(self.diffuse_slot & NOT_BAKED) == 0]  # NO_SLOT has the bit, too
        return np.unique(own).astype(np.int64)


@dataclass(frozen=True)
class _Lattice:
    """Patches, the lattice points that hits touch (point * 2 + side, sorted unique), and the spacing that was asked
    for in each patch, scene units: triangles may be smaller than that."""

    patches: PatchTable
    touched: np.ndarray
    asked_spacing: np.ndarray


def build_elements(table: SurfaceTable, hits: Hits, settings: CacheSettings) -> ElementSet:
    """Lays out elements for a scene, a camera domain and a budget."""
    lattice, spacing = _solve_spacing(table, hits, settings)
    points = _Points.of(table, lattice, settings)
    return _assemble(table, lattice, points, settings, spacing)


def _solve_spacing(table: SurfaceTable, hits: Hits, settings: CacheSettings) -> tuple[_Lattice, float]:
    """Smallest spacing of the lattice whose seen elements fit the budget, by bisection on a log scale."""
    if settings.elements != "lattice":
        level = 1 if settings.elements == "vertex" else 0
        return _plain_lattice(table, hits, level, settings.max_edge_fraction), 0.0
    prim_footprint = np.full(table.num_prims, np.inf, np.float32)
    np.minimum.at(prim_footprint, hits.prim, hits.footprint)
    located = _LocatedHits.of(table, hits, patch_counts(table.prim_edge, prim_footprint))
    low, high = settings.min_spacing_px, 256.0
    best = located.lattice(low)
    if _fits(table, best, settings):
        return best, low
    best = located.lattice(high)
    for _ in range(SPACING_STEPS):
        middle = float(np.sqrt(low * high))
        lattice = located.lattice(middle)
        if _fits(table, lattice, settings):
            high, best = middle, lattice
        else:
            low = middle
        if high / low < 1.05:
            break
    return best, high


def _fits(table: SurfaceTable, lattice: _Lattice, settings: CacheSettings) -> bool:
    """Whether the merged elements are within the budget."""
    if len(lattice.touched) <= settings.max_elements:
        return True
    return _count_distinct(_Points.of(table, lattice, settings).merge_key) <= settings.max_elements


def _distinct(values: np.ndarray) -> np.ndarray:
    """`np.unique` of a vector by sorting, which beats its hash table several times over."""
    ordered = np.sort(values)
    return ordered[np.append(True, ordered[1:] != ordered[:-1])] if len(ordered) else ordered


def _count_distinct(rows: np.ndarray) -> int:
    """Number of distinct rows of an int64 matrix, by a 64-bit hash: many times faster than sorting rows."""
    digest = np.zeros(len(rows), np.uint64)
    for column in rows.T:
        digest = (digest ^ column.astype(np.uint64)) * HASH_MULTIPLIER
        digest ^= digest >> np.uint64(29)
    return len(_distinct(digest))


@dataclass(frozen=True)
class _LocatedHits:
    """Hits in their patches, and what the levels of patches depend on besides the spacing."""

    square: np.ndarray
    m: np.ndarray
    patch: np.ndarray
    b1: np.ndarray
    b2: np.ndarray
    side: np.ndarray
    patch_footprint: np.ndarray
    patch_edge: np.ndarray

    @classmethod
    def of(cls, table: SurfaceTable, hits: Hits, m: np.ndarray) -> "_LocatedHits":
        square = _prim_is_square(table)
        counts = patches_per_prim(m, square)
        base = np.concatenate([[0], np.cumsum(counts)])
        cell, b1, b2 = locate_patch(hits.uv[:, 0], hits.uv[:, 1], m[hits.prim], square[hits.prim])
        patch = base[hits.prim] + cell
        footprint = np.full(int(base[-1]), np.inf, np.float32)
        np.minimum.at(footprint, patch, hits.footprint)
        edge = np.repeat(table.prim_edge / m, counts)
        return cls(square, m, patch, b1, b2, hits.side, footprint, edge)

    def lattice(self, spacing_px: float) -> _Lattice:
        """The lattice with points `spacing_px` apart where patches are seen."""
        asked = np.where(np.isfinite(self.patch_footprint), spacing_px * self.patch_footprint, 0.0)
        return self.with_levels(patch_levels(self.patch_edge, self.patch_footprint, spacing_px), asked)

    def with_levels(self, level: np.ndarray, asked_spacing: np.ndarray) -> _Lattice:
        """The lattice with given levels of all patches."""
        patches = build_patch_table(self.m, level, self.square)
        return _Lattice(patches, _touched(patches, self.patch, self.b1, self.b2, self.side), asked_spacing)


def _plain_lattice(table: SurfaceTable, hits: Hits, level: int, max_edge_fraction: float) -> _Lattice:
    """Paper's caches: one element a (tessellated) triangle or vertex."""
    located = _LocatedHits.of(table, hits, tessellation_counts(table.prim_edge, table.diagonal, max_edge_fraction))
    num_patches = len(located.patch_edge)
    return located.with_levels(np.full(num_patches, level, np.uint32), np.zeros(num_patches))


def _touched(patches: PatchTable, patch: np.ndarray, b1: np.ndarray, b2: np.ndarray, side: np.ndarray) -> np.ndarray:
    index, weight = locate_points(b1, b2, patches.patch_level[patch])
    point = (patches.patch_base[patch][:, None] + index) * 2 + side[:, None]
    return _distinct(point[weight > 0])


def _prim_is_square(table: SurfaceTable) -> np.ndarray:
    counts = np.diff(table.prim_offset)
    return np.repeat(table.is_parametric, counts)


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
        prim, uv = _parameters_of(lattice.patches, point)
        shape = np.searchsorted(table.prim_offset, prim, side="right") - 1
        prim_local = prim - table.prim_offset[shape]
        position, normal, geometric = surface_frame(table, shape, prim_local, uv, side)
        spacing = _point_spacing(table, lattice, point, prim)
        key = _merge_key(shape, side, position, geometric, spacing, settings)
        return cls(shape, prim_local, uv, side, position, normal, key)


def _parameters_of(patches: PatchTable, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`lattice.point_parameters` of some points: primitive, int64 [n], and its (u, v), float32 [n, 2]."""
    prim, uv = point_parameters(patches)
    return prim[point], uv[point].astype(np.float32)


def surface_frame(
    table: SurfaceTable, shape: np.ndarray, prim_local: np.ndarray, uv: np.ndarray, side: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, shading normal and geometric normal (both towards `side`) of places; float32 [n, 3] each."""
    if len(shape) == 0:  # Dr.Jit cannot evaluate nothing
        return tuple(np.zeros((0, 3), np.float32) for _ in range(3))  # type: ignore[return-value]
    si = table.interaction(shape, prim_local, uv)
    sign = np.where(side == 1, -1.0, 1.0).astype(np.float32)[:, None]
    dr.eval(si.p, si.sh_frame.n, si.n)
    position = np.ascontiguousarray(np.array(si.p).T.astype(np.float32))
    normal = np.array(si.sh_frame.n).T.astype(np.float32) * sign
    return position, normal, np.array(si.n).T.astype(np.float32) * sign


def _point_spacing(table: SurfaceTable, lattice: _Lattice, point: np.ndarray, prim: np.ndarray) -> np.ndarray:
    patch = np.searchsorted(lattice.patches.patch_base, point, side="right") - 1
    level = np.maximum(lattice.patches.patch_level[patch], 1)
    laid = table.prim_edge[prim] / lattice.patches.prim_patches[prim] / level
    return np.maximum(laid, lattice.asked_spacing[patch])


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
    lobes = np.array([int(lobe) for lobe in table.lobes])
    exitant = settings.lobes == "exitant"
    glossy_shape = exitant | ((lobes & int(LobeClass.GLOSSY)) > 0)
    diffuse_shape = ~np.bool_(exitant) & ((lobes & int(LobeClass.DIFFUSE)) > 0)
    glossy = np.flatnonzero(glossy_shape[points.shape[chosen]])
    glossy_rank = np.full(len(chosen), -1, np.int64)
    glossy_rank[glossy] = np.arange(len(glossy))
    slots = _Slots(table, lattice, points, element, chosen)
    uv, position, normal = points.uv[chosen], points.position[chosen], points.normal[chosen]
    if settings.elements == "lattice":
        uv = _inset(table, lattice, points, chosen)
        place = (points.shape[chosen], points.prim_local[chosen], uv, points.side[chosen])
        position, normal, _ = surface_frame(table, *place)
    lobe_at = (points.shape[chosen][glossy], points.prim_local[chosen][glossy], uv[glossy], normal[glossy])
    return ElementSet(
        patches=lattice.patches,
        shape=points.shape[chosen],
        prim_local=points.prim_local[chosen],
        uv=uv,
        side=points.side[chosen],
        position=position,
        normal=normal,
        glossy=glossy,
        spread=np.full(len(glossy), np.inf, np.float32) if exitant else measure_spread(table, *lobe_at),
        diffuse_slot=slots.fill(
            np.where(diffuse_shape[points.shape[chosen]], np.arange(len(chosen)), -1), diffuse_shape
        ),
        glossy_slot=slots.fill(glossy_rank, glossy_shape),
        spacing_px=spacing,
    )


def _inset(table: SurfaceTable, lattice: _Lattice, points: _Points, chosen: np.ndarray) -> np.ndarray:
    """Where elements are baked: `INSET` of the lattice's spacing from their point towards the primitive's centre.

    A point on the edge between two walls lies in both: rays that leave it slip behind the other wall, and the corner
    would be cached black or leak light.
    """
    point = lattice.touched[chosen] // 2
    prim = table.prim_offset[points.shape[chosen]] + points.prim_local[chosen]
    patch = np.searchsorted(lattice.patches.patch_base, point, side="right") - 1
    divisions = lattice.patches.prim_patches[prim] * np.maximum(lattice.patches.patch_level[patch], 1)
    centre = np.where(lattice.patches.prim_is_square[prim], 1 / 2, 1 / 3)[:, None]
    uv = points.uv[chosen]
    return (uv + (centre - uv) * (INSET / divisions)[:, None]).astype(np.float32)


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

    def fill(self, slot_of_element: np.ndarray, has_lobe: np.ndarray) -> np.ndarray:
        """Slots of one lobe, from the slot of each element (-1: none) and whether each shape has the lobe."""
        num = self.lattice.patches.num_points * 2
        slots = np.full(num, NO_SLOT, np.uint32)
        own = slot_of_element[self.element]
        baked = own >= 0
        slots[self.lattice.touched[baked]] = own[baked]
        candidates = np.flatnonzero(slot_of_element >= 0)
        if len(candidates) == 0:
            return slots
        used = np.repeat(has_lobe[self._shape_of_patch()], np.diff(self.lattice.patches.patch_base))
        missing = slots == NO_SLOT
        slots[missing] = np.uint32(slot_of_element[candidates[0]]) | NOT_BAKED
        missing = np.flatnonzero(missing & np.repeat(used, 2))
        if len(missing) == 0:
            return slots
        asking, answer = self._askers(missing)
        nearest = self._nearest(candidates, asking)[answer]
        slots[missing] = slot_of_element[candidates[nearest]].astype(np.uint32) | NOT_BAKED
        return slots

    def _shape_of_patch(self) -> np.ndarray:
        per_prim = patches_per_prim(self.lattice.patches.prim_patches, self.lattice.patches.prim_is_square)
        prim = np.repeat(np.arange(len(per_prim)), per_prim)
        return np.searchsorted(self.table.prim_offset, prim, side="right") - 1

    def _askers(self, missing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(the points to look for, which of them answers for each of `missing`).

        The side of a patch that no hit touched is one question, asked at its middle point: most of all points
        are there (backs of walls), and their searches are the longest.
        """
        patches = self.lattice.patches
        seen = np.zeros(2 * patches.num_patches, bool)
        seen[_patch_side(patches, self.lattice.touched)] = True
        face = _patch_side(patches, missing)
        order = np.argsort(face, kind="stable")
        first = np.concatenate([[True], np.diff(face[order]) > 0]) | seen[face[order]]
        group = np.cumsum(first) - 1
        start = np.flatnonzero(first)
        middle = (start + np.append(start[1:], len(missing)) - 1) // 2
        answer = np.empty(len(missing), np.int64)
        answer[order] = group
        return missing[order[middle]], answer

    def _nearest(self, candidates: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Nearest candidate of each wanted (point, side): place and normal count."""
        prim, uv = _parameters_of(self.lattice.patches, wanted // 2)
        shape = np.searchsorted(self.table.prim_offset, prim, side="right") - 1
        side = (wanted % 2).astype(np.uint8)
        local = prim - self.table.prim_offset[shape]
        position, normal, _ = surface_frame(self.table, shape, local, uv, side)
        known = self.points.position[self.chosen][candidates]
        scale = max(float(np.ptp(known, axis=0).max()), 1e-30) * 0.1
        places = np.concatenate([known, self.points.normal[self.chosen][candidates] * scale], axis=1)
        asked = np.nan_to_num(np.concatenate([position, normal * scale], axis=1))
        return cKDTree(places, leafsize=LEAF_SIZE).query(asked, workers=-1)[1]


def _patch_side(patches: PatchTable, point_side: np.ndarray) -> np.ndarray:
    """patch * 2 + side of (point * 2 + side)."""
    patch = np.searchsorted(patches.patch_base, point_side // 2, side="right") - 1
    return patch * 2 + point_side % 2
