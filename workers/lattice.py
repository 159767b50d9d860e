"""Barycentric patch lattices: where the caches sit, without touching geometry.

Every primitive is cut into m x m triangular *patches* (m = 1 unless the primitive is large on screen) and every
patch carries a lattice of level n: n = 0 is its barycentre alone, n >= 1 has (n + 1)(n + 2) / 2 points. A hit is
answered by the three lattice points around it. An analytic shape is one primitive with parameters (u, v) in the
unit square, cut into 2 m^2 triangles.

The rule for m and n is stated here only (`patch_counts`, `patch_levels`): points are spaced by `spacing_px` times
the footprint of a pixel of the camera domain, no closer. Points that fall together (shared vertices, the corners
of triangles smaller than the spacing) are merged by shape, normal and voxel.
"""

from dataclasses import dataclass

import numpy as np

MAX_PATCHES = 64
MAX_LEVEL = 255
PATCH_FOOTPRINTS = 32.0


@dataclass(frozen=True)
class PatchTable:
    """Patches and lattice points of all primitives.

    Attributes:
        prim_patches: m of each primitive, uint32 [num_prims].
        prim_base: first patch of each primitive, uint32 [num_prims].
        patch_level: n of each patch, uint32 [num_patches].
        patch_base: first lattice point of each patch, int64 [num_patches + 1].
        prim_is_square: true for analytic shapes, bool [num_prims].
    """

    prim_patches: np.ndarray
    prim_base: np.ndarray
    patch_level: np.ndarray
    patch_base: np.ndarray
    prim_is_square: np.ndarray

    @property
    def num_patches(self) -> int:
        return len(self.patch_level)

    @property
    def num_points(self) -> int:
        return int(self.patch_base[-1])


def patch_counts(prim_edge: np.ndarray, prim_footprint: np.ndarray) -> np.ndarray:
    """m of each primitive: patches of about `PATCH_FOOTPRINTS` pixels; 1 where it is never seen (footprint inf)."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # a camera on a surface has a footprint of 0
        wanted = np.ceil(prim_edge / (PATCH_FOOTPRINTS * prim_footprint))
    return np.clip(np.nan_to_num(wanted, nan=1.0), 1, MAX_PATCHES).astype(np.uint32)


def tessellation_counts(prim_edge: np.ndarray, diagonal: float, max_edge_fraction: float) -> np.ndarray:
    """m of each primitive for the paper's caches: sub-triangles with edges of at most a share of the scene.

    The paper tessellates large triangles before it bakes. Splitting a flat triangle into m x m similar ones changes
    neither its geometry nor its interpolated attributes, so the patches are the tessellated triangles and mesh, BVH
    and ground truth stay as they are (and watertight where they were).

    Args:
        prim_edge: longest edge of each primitive, scene units.
        diagonal: of the scene's bounding box, scene units.
        max_edge_fraction: longest edge allowed as a share of `diagonal`; 0 keeps every triangle whole.
    """
    if max_edge_fraction <= 0:
        return np.ones(len(prim_edge), np.uint32)
    return np.clip(np.ceil(prim_edge / (max_edge_fraction * diagonal)), 1, MAX_PATCHES).astype(np.uint32)


def patch_levels(edge: np.ndarray, footprint: np.ndarray, spacing_px: float) -> np.ndarray:
    """n of each patch: points `spacing_px` footprints apart, at least the corners; 0 where it is never seen."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        wanted = np.ceil(edge / (spacing_px * footprint))
    seen = np.isfinite(footprint)
    return np.where(seen, np.clip(np.nan_to_num(wanted, nan=0.0), 1, MAX_LEVEL), 0).astype(np.uint32)


def patches_per_prim(prim_patches: np.ndarray, prim_is_square: np.ndarray) -> np.ndarray:
    """Number of triangular patches of each primitive: m^2, twice that for a square."""
    return prim_patches.astype(np.int64) ** 2 * np.where(prim_is_square, 2, 1)


def locate_patch(
    u: np.ndarray, v: np.ndarray, m: np.ndarray, is_square: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patch of its primitive and the barycentrics (b1, b2) in it.

    The upper triangle of cell (i, j) has its origin at corner (i + 1, j + 1), b1 towards (i, j + 1) and b2
    towards (i + 1, j).
    """
    m = m.astype(np.int64)
    su, sv = np.clip(u, 0, 1) * m, np.clip(v, 0, 1) * m
    i = np.minimum(su.astype(np.int64), m - 1)
    j = np.minimum(sv.astype(np.int64), m - 1)
    i = np.where(is_square, i, np.clip(i, 0, m - 1 - j))
    fu, fv = su - i, sv - j
    upper = (fu + fv > 1) & (is_square | (i + j < m - 1))
    in_row = np.where(is_square, j * 2 * m, j * (2 * m - j))
    patch = in_row + 2 * i + upper
    return patch, np.where(upper, 1 - fu, fu), np.where(upper, 1 - fv, fv)


def locate_points(b1: np.ndarray, b2: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The three lattice points around barycentrics (b1, b2) of a patch and their weights.

    Returns:
        (point index in the patch, int64 [n, 3]; weights that sum to 1, float [n, 3]).
    """
    n = level.astype(np.int64)
    safe = np.maximum(n, 1)
    su, sv = np.clip(b1, 0, 1) * safe, np.clip(b2, 0, 1) * safe
    i = np.minimum(su.astype(np.int64), safe - 1)
    j = np.minimum(sv.astype(np.int64), safe - 1)
    i = np.clip(i, 0, safe - 1 - j)
    fu, fv = np.clip(su - i, 0, 1), np.clip(sv - j, 0, 1)
    upper = (fu + fv > 1) & (i + j < safe - 1)
    over = np.maximum(fu + fv, 1.0)
    fu_low, fv_low = np.where(upper, fu, fu / over), np.where(upper, fv, fv / over)
    first = np.where(upper, point_index(i + 1, j + 1, safe), point_index(i, j, safe))
    second = np.where(upper, point_index(i, j + 1, safe), point_index(i + 1, j, safe))
    third = np.where(upper, point_index(i + 1, j, safe), point_index(i, j + 1, safe))
    w_second = np.where(upper, 1 - fu, fu_low)
    w_third = np.where(upper, 1 - fv, fv_low)
    index = np.stack([first, second, third], -1)
    weight = np.stack([1 - w_second - w_third, w_second, w_third], -1)
    single = n == 0
    index[single] = 0
    weight[single] = (1, 0, 0)
    return index, weight


def point_index(i: np.ndarray, j: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Linear index of lattice point (i, j) of a level-n patch; rows of constant j hold n + 1 - j points."""
    return j * (n + 1) - j * (j - 1) // 2 + i


def build_patch_table(prim_patches: np.ndarray, patch_level: np.ndarray, prim_is_square: np.ndarray) -> PatchTable:
    """Lays patches and points out one after the other."""
    per_prim = patches_per_prim(prim_patches, prim_is_square)
    prim_base = np.concatenate([[0], np.cumsum(per_prim)])[:-1].astype(np.uint32)
    level = patch_level.astype(np.int64)
    points = np.where(level == 0, 1, (level + 1) * (level + 2) // 2)
    patch_base = np.concatenate([[0], np.cumsum(points)]).astype(np.int64)
    return PatchTable(prim_patches, prim_base, patch_level.astype(np.uint32), patch_base, prim_is_square)


def point_parameters(table: PatchTable) -> tuple[np.ndarray, np.ndarray]:
    """Primitive and (u, v) in it of every lattice point; int64 [num_points], float64 [num_points, 2]."""
    per_prim = patches_per_prim(table.prim_patches, table.prim_is_square)
    patch_prim = np.repeat(np.arange(len(per_prim)), per_prim)
    counts = np.diff(table.patch_base)
    patch = np.repeat(np.arange(table.num_patches), counts)
    offset = np.arange(table.num_points) - table.patch_base[patch]
    b1, b2 = _lattice_barycentrics(offset, table.patch_level[patch].astype(np.int64))
    prim = patch_prim[patch]
    cell = patch - table.prim_base[prim]
    m = table.prim_patches[prim].astype(np.int64)
    i, j, upper = _cell_of_patch(cell, m, table.prim_is_square[prim])
    u = np.where(upper, i + 1 - b1, i + b1) / m
    v = np.where(upper, j + 1 - b2, j + b2) / m
    return prim, np.stack([u, v], -1)


def _lattice_barycentrics(offset: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of `point_index`, as barycentrics; the barycentre for level 0."""
    # Row j starts at j (n + 1) - j (j - 1) / 2: solve the quadratic, then mend the rounding.
    a = 2 * n + 3
    j = np.floor((a - np.sqrt(np.maximum(a * a - 8.0 * offset, 0.0))) / 2).astype(np.int64)
    j -= point_index(np.zeros_like(j), j, n) > offset
    j += point_index(np.zeros_like(j), j + 1, n) <= offset
    i = offset - point_index(np.zeros_like(j), j, n)
    safe = np.maximum(n, 1)
    return np.where(n == 0, 1 / 3, i / safe), np.where(n == 0, 1 / 3, j / safe)


def _cell_of_patch(cell: np.ndarray, m: np.ndarray, is_square: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    j_square = cell // (2 * m)
    # Row j of a triangle starts at j (2 m - j).
    j_triangle = np.floor(m - np.sqrt(np.maximum(m * m - cell.astype(np.float64), 0.0))).astype(np.int64)
    j_triangle -= j_triangle * (2 * m - j_triangle) > cell
    j_triangle += (j_triangle + 1) * (2 * m - j_triangle - 1) <= cell
    j = np.where(is_square, j_square, j_triangle)
    rest = cell - np.where(is_square, j * 2 * m, j * (2 * m - j))
    return rest // 2, j, rest % 2 == 1
