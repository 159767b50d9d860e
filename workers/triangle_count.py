"""A scene with another number of triangles: more without a change of its surfaces, fewer by coarser ones.

More: every triangle is cut into k x k equal ones, k = ceil(longest edge / L), with the L that comes nearest to the
number that was asked for. Positions, normals (left unnormalised) and texture coordinates are interpolated linearly, as
Mitsuba does between the old vertices: surfaces and shading stay as they were, to rounding. Neighbours of different k
leave vertices on each other's edges.

Fewer: the vertices of a shape that fall into one cell of a grid, and face the same of six ways, become the one of
them that is nearest to their mean; triangles that collapse or repeat go. This changes geometry and is no careful
decimation: a shape of which nothing would be left keeps its triangles. It is meant to measure costs by.

Lights and analytic shapes stay as they are.
"""

import dataclasses
import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.backend import mi
from workers.errors import WorkerError
from workers.mesh_table import Faces, Floats, MeshTable, build_mesh, read_mesh
from workers.scene import Scene
from workers.scene_check import bounds

VERSION = 1
CLOSE_ENOUGH = 0.02  # of the count that was asked for: the scene is taken as it is
MAX_DIVISIONS = 256
STEPS = 40  # of a bisection
AS_FILED, TESSELLATED, CLUSTERED = "as in the file", "tessellated", "vertices clustered"


def num_triangles(mi_scene: Any) -> int:
    """Triangles of all meshes."""
    return sum(int(shape.primitive_count()) for shape in mi_scene.shapes() if shape.is_mesh())


def with_triangles(scene: Scene, target: int) -> tuple[Scene, int, str]:
    """The scene with about `target` triangles.

    Args:
        scene: not changed; the new one shares its materials and lights.
        target: triangles of all meshes together, at least 1.

    Returns:
        The scene, how many triangles it really has, and by which rule.

    Raises:
        WorkerError: the target is below 1.
    """
    if target < 1:
        raise WorkerError(f"number of triangles must be at least 1, got {target}")
    count = num_triangles(scene.mi_scene)
    if abs(count - target) <= CLOSE_ENOUGH * target:
        return scene, count, AS_FILED
    shapes = [shape for shape in scene.mi_scene.shapes() if shape.is_mesh() and not shape.is_emitter()]
    meshes = [read_mesh(shape) for shape in shapes]
    fixed = count - sum(len(mesh.faces) for mesh in meshes)
    change, rule = (tessellated, TESSELLATED) if target > count else (clustered, CLUSTERED)
    changed = change(meshes, max(target - fixed, 1), bounds(scene.mi_scene)[1])
    mi_scene = _rebuilt(scene.mi_scene, {mesh.shape.id(): mesh for mesh in changed})
    count = num_triangles(mi_scene)
    identity = f"{scene.digest} {rule} {count} version {VERSION}"
    digest = hashlib.sha256(identity.encode()).hexdigest()
    note = f"{rule}: {count:,} triangles"
    renamed = dataclasses.replace(
        scene, mi_scene=mi_scene, digest=digest, name=f"{scene.name}-{count}", notes=(*scene.notes, note)
    )
    return renamed, count, rule


# ------------------------------------------------------- more -------------------------------------------------------


def tessellated(meshes: list[MeshTable], target: int, diagonal: float) -> list[MeshTable]:
    """Meshes with about `target` triangles, by cutting the longest ones.

    Args:
        meshes: with fewer triangles than that.
        target: triangles of all of them.
        diagonal: of the scene's bounds, in the meshes' units.
    """
    edges = [_longest_edges(mesh) for mesh in meshes]
    every = np.concatenate([np.zeros(0), *edges])

    def total(length: float) -> int:
        return int((_divisions(every, length) ** 2).sum())

    length = _nearest(total, target, 1e-7 * diagonal, diagonal)
    return [_cut(mesh, _divisions(edge, length)) for mesh, edge in zip(meshes, edges, strict=True)]


def _longest_edges(mesh: MeshTable) -> Floats:
    corners = mesh.columns[:, :3][mesh.faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)


def _divisions(edges: Floats, length: float) -> NDArray[np.int64]:
    return np.clip(np.ceil(edges / length), 1, MAX_DIVISIONS).astype(np.int64)


def _cut(mesh: MeshTable, divisions: NDArray[np.int64]) -> MeshTable:
    if (divisions == 1).all():
        return mesh
    points, faces, parents, offset = [], [], [], 0
    for k in np.unique(divisions):
        chosen = np.flatnonzero(divisions == k)
        weights, local = _lattice(int(k))
        made = _interpolated(mesh, mesh.faces[chosen], weights, int(k))
        starts = offset + len(weights) * np.arange(len(chosen))
        points.append(made)
        faces.append((starts[:, None, None] + local).reshape(-1, 3))
        parents.append(np.repeat(mesh.parents[chosen], len(local)))
        offset += len(made)
    # Corners and edges are shared again: a vertex costs as much memory as in the file.
    rows = np.concatenate(points).astype(np.float32) + np.float32(0)  # -0 and 0 are one place
    whole_rows = rows.view(np.dtype((np.void, rows.strides[0]))).reshape(-1)  # compared as bytes: many times faster
    _, first, place = np.unique(whole_rows, return_index=True, return_inverse=True)
    columns = rows[first].astype(np.float64)
    return MeshTable(
        mesh.shape, columns, mesh.widths, place.reshape(-1)[np.concatenate(faces)], np.concatenate(parents)
    )


def _lattice(k: int) -> tuple[NDArray[np.int64], Faces]:
    """Integer barycentric weights (sum k) of the points of a triangle cut k times, and its k x k faces."""
    places = [(i, j) for i in range(k + 1) for j in range(k + 1 - i)]
    index = {place: number for number, place in enumerate(places)}
    weights = np.array([(k - i - j, i, j) for i, j in places], np.int64)
    faces = [(index[i, j], index[i + 1, j], index[i, j + 1]) for i, j in places if i + j < k]
    faces += [(index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]) for i, j in places if i + j < k - 1]
    return weights, np.array(faces, np.int64)


def _interpolated(mesh: MeshTable, faces: Faces, weights: NDArray[np.int64], k: int) -> Floats:
    """[triangles * points, columns]; corners are added in the order of their index, so that two triangles give the
    points of their common edge bit by bit."""
    order = np.argsort(faces, axis=1)
    corners = mesh.columns[np.take_along_axis(faces, order, axis=1)]
    shares = weights.T[order].transpose(0, 2, 1)[..., None]  # [triangles, points, corner, 1]
    total = shares[:, :, 0] * corners[:, None, 0] + shares[:, :, 1] * corners[:, None, 1]
    total += shares[:, :, 2] * corners[:, None, 2]
    return (total / k).reshape(-1, mesh.columns.shape[1])


# ------------------------------------------------------ fewer ------------------------------------------------------


def clustered(meshes: list[MeshTable], target: int, diagonal: float) -> list[MeshTable]:
    """Meshes with about `target` triangles, or as few as clustering gives; arguments as `tessellated`."""

    def total(cell: float) -> int:
        return sum(len(_merged_faces(mesh, cell)[0]) for mesh in meshes)

    cell = _nearest(total, target, 1e-6 * diagonal, diagonal)
    return [_merged(mesh, cell) for mesh in meshes]


def _merged(mesh: MeshTable, cell: float) -> MeshTable:
    faces, chosen = _merged_faces(mesh, cell)
    used, place = np.unique(faces, return_inverse=True)
    return MeshTable(mesh.shape, mesh.columns[used], mesh.widths, place.reshape(-1, 3), mesh.parents[chosen])


def _merged_faces(mesh: MeshTable, cell: float) -> tuple[Faces, NDArray[np.int64]]:
    """Triangles between the vertices that stand for their clusters, and which of the mesh's they are."""
    faces = _stand_ins(mesh, cell)[mesh.faces]
    a, b, c = faces.T
    whole = np.flatnonzero((a != b) & (b != c) & (c != a))
    if len(whole) == 0:
        return mesh.faces, np.arange(len(mesh.faces))
    _, first = np.unique(np.sort(faces[whole], axis=1), axis=0, return_index=True)
    chosen = whole[np.sort(first)]
    return faces[chosen], chosen


def _stand_ins(mesh: MeshTable, cell: float) -> NDArray[np.int64]:
    """For each vertex the one that stands for its cluster."""
    positions = mesh.columns[:, :3]
    keys = np.floor((positions - positions.min(axis=0)) / cell).astype(np.int64)
    if "vertex_normals" in mesh.widths:
        normals = mesh.columns[:, 3:6]
        axis = np.abs(normals).argmax(axis=1)
        side = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0
        keys = np.column_stack([keys, 2 * axis + side])
    _, cluster, sizes = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    cluster = cluster.reshape(-1)
    means = np.stack([np.bincount(cluster, weights=x) for x in positions.T], axis=1) / sizes[:, None]
    distance = np.linalg.norm(positions - means[cluster], axis=1)
    order = np.lexsort((distance, cluster))
    first = order[np.concatenate([[True], np.diff(cluster[order]) > 0])]
    return first[cluster]


def _nearest(total: Callable[[float], int], target: int, low: float, high: float) -> float:
    """The length between `low` and `high` whose total, which falls with it, comes nearest to the target."""
    best, best_gap = low, np.inf
    for _ in range(STEPS):
        middle = float(np.sqrt(low * high))
        count = total(middle)
        if abs(count - target) < best_gap:
            best, best_gap = middle, abs(count - target)
        low, high = (middle, high) if count > target else (low, middle)
        if high / low < 1 + 1e-6 or best_gap == 0:
            break
    return best


def _rebuilt(mi_scene: Any, meshes: dict[str, MeshTable]) -> Any:
    """A scene of the same materials, lights and analytic shapes around other meshes."""
    parts: dict[str, Any] = {"type": "scene"}
    for shape in mi_scene.shapes():
        parts[shape.id()] = build_mesh(meshes[shape.id()]) if shape.id() in meshes else shape
    for index, emitter in enumerate(mi_scene.emitters()):
        if emitter.get_shape() is None:
            parts[f"light {index}"] = emitter
    return mi.load_dict(parts)
