"""Triangle meshes made from arrays: bodies of revolution, tori, icospheres, and their way into Mitsuba."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workers.backend import mi

_ICOSAHEDRON_FACES = (
    (0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6),
    (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10),
    (8, 6, 7), (9, 8, 1),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class MeshArrays:
    """A smooth-shaded triangle mesh.

    Attributes:
        positions: [vertices, 3] float64, scene units.
        normals: [vertices, 3] float64, unit, outward.
        texcoords: [vertices, 2] float64, in [0, 1].
        faces: [triangles, 3] int64, counter-clockwise seen from outside.
    """

    positions: NDArray[np.float64]
    normals: NDArray[np.float64]
    texcoords: NDArray[np.float64]
    faces: NDArray[np.int64]

    def moved(self, offset: ArrayLike, *, tilt_deg: float = 0.0) -> "MeshArrays":
        """The mesh turned about the Z axis by `tilt_deg`, then moved by `offset` [3]."""
        angle = np.radians(tilt_deg)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        positions = self.positions @ turn.T + np.asarray(offset, dtype=np.float64)
        return MeshArrays(positions, self.normals @ turn.T, self.texcoords, self.faces)


def to_mitsuba(name: str, positions: ArrayLike, faces: ArrayLike, *, normals: ArrayLike | None = None,
               texcoords: ArrayLike | None = None, bsdf: Any = None, emitter: Any = None,
               attributes: Mapping[str, NDArray[Any]] | None = None) -> Any:  # fmt: skip
    """`mi.Mesh` from arrays; `name` becomes its id.

    Args:
        name: id of the shape, unique in its scene.
        positions: [vertices, 3], scene units.
        faces: [triangles, 3] vertex indices.
        normals: [vertices, 3]; without them the mesh is flat-shaded.
        texcoords: [vertices, 2].
        bsdf: a built `mi.BSDF`.
        emitter: a built area emitter.
        attributes: {"vertex_<name>": [vertices, channels]}.
    """
    positions, faces = np.asarray(positions, dtype=np.float32), np.asarray(faces, dtype=np.uint32)
    properties = mi.Properties()
    properties.set_id(name)
    if bsdf is not None:
        properties["bsdf"] = bsdf
    if emitter is not None:
        properties["emitter"] = emitter
    if normals is None:
        properties["face_normals"] = True
    mesh = mi.Mesh(name, len(positions), len(faces), props=properties, has_vertex_normals=normals is not None,
                   has_vertex_texcoords=texcoords is not None)  # fmt: skip
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = positions.ravel()
    parameters["faces"] = faces.ravel()
    if normals is not None:
        parameters["vertex_normals"] = np.asarray(normals, dtype=np.float32).ravel()
    if texcoords is not None:
        parameters["vertex_texcoords"] = np.asarray(texcoords, dtype=np.float32).ravel()
    parameters.update()
    for key, values in (attributes or {}).items():
        mesh.add_attribute(key, values.shape[1], np.asarray(values, dtype=np.float32).ravel().tolist())
    return mesh


def revolve(profile: ArrayLike, num_segments: int) -> MeshArrays:
    """Turn a profile about the Y axis.

    Args:
        profile: [points, 2] radius and height, ordered so that the outside lies to the right when walking
            along it from the bottom up (outwards); a radius of 0 makes a pole.
        num_segments: triangles pairs around the axis.
    """
    profile = np.asarray(profile, dtype=np.float64)
    tangent = np.gradient(profile, axis=0)
    radial, vertical = tangent[:, 1], -tangent[:, 0]
    length = np.hypot(radial, vertical)
    radial, vertical = radial / length, vertical / length
    poles = profile[:, 0] == 0
    radial, vertical = np.where(poles, 0.0, radial), np.where(poles, np.sign(vertical), vertical)
    angle = np.linspace(0.0, 2 * np.pi, num_segments + 1)
    cosine, sine = np.cos(angle), np.sin(angle)
    rows = len(profile)

    def ring(radius: NDArray[np.float64], height: NDArray[np.float64]) -> NDArray[np.float64]:
        grid = np.stack([np.outer(radius, cosine), np.broadcast_to(height[:, None], (rows, len(angle))),
                         np.outer(radius, sine)], axis=-1)  # fmt: skip
        return grid.reshape(-1, 3)

    u, v = np.meshgrid(angle / (2 * np.pi), np.linspace(0.0, 1.0, rows))
    faces = _grid_faces(rows, len(angle))
    positions = ring(profile[:, 0], profile[:, 1])
    return MeshArrays(positions, ring(radial, vertical), np.column_stack([u.ravel(), v.ravel()]),
                      _with_area(positions, faces))  # fmt: skip


def sphere(radius: float, num_segments: int, num_rings: int) -> MeshArrays:
    """Sphere about the origin with poles on the Y axis, scene units."""
    polar = np.linspace(0.0, np.pi, num_rings + 1)
    radii = radius * np.sin(polar)
    radii[[0, -1]] = 0.0
    return revolve(np.column_stack([radii, -radius * np.cos(polar)]), num_segments)


def torus(radius: float, tube: float, num_segments: int, num_rings: int) -> MeshArrays:
    """Torus about the Y axis; `radius` to the middle of the tube, `tube` the tube's own radius, scene
    units."""
    around = np.linspace(0.0, 2 * np.pi, num_rings + 1)
    profile = np.column_stack([radius + tube * np.cos(around), tube * np.sin(around)])
    mesh = revolve(profile, num_segments)
    centre = mesh.positions * [1, 0, 1]
    centre *= radius / np.linalg.norm(centre, axis=1, keepdims=True)
    return MeshArrays(mesh.positions, (mesh.positions - centre) / tube, mesh.texcoords, mesh.faces)


def icosphere(radius: float, num_subdivisions: int) -> MeshArrays:
    """Sphere of 20 * 4^n triangles about the origin."""
    golden = (1 + 5**0.5) / 2
    corners = [
        (-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0), (0, -1, golden), (0, 1, golden),
        (0, -1, -golden), (0, 1, -golden), (golden, 0, -1), (golden, 0, 1), (-golden, 0, -1), (-golden, 0, 1),
    ]  # fmt: skip
    points, faces = np.array(corners, dtype=np.float64), np.array(_ICOSAHEDRON_FACES)
    for _ in range(num_subdivisions):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)
        unique, inverse = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
        middle = inverse.reshape(-1, 3) + len(points)
        points = np.concatenate([points, points[unique].sum(axis=1) / 2])
        a, b, c = faces.T
        ab, bc, ca = middle.T
        faces = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    u = np.arctan2(normals[:, 2], normals[:, 0]) / (2 * np.pi) + 0.5
    v = np.arccos(np.clip(normals[:, 1], -1, 1)) / np.pi
    return MeshArrays(radius * normals, normals, np.column_stack([u, v]), faces)


def _grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    pairs = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2)
    return pairs.reshape(-1, 3)


def _with_area(positions: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    corners = positions[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return faces[area > 1e-12 * area.max()]
