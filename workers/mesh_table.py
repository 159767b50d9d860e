"""A Mitsuba mesh as one table of whatever its vertices carry, and back."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.backend import mi
from workers.mesh_building import to_mitsuba

Floats = NDArray[np.float64]
Faces = NDArray[np.int64]
_STANDARD = ("vertex_positions", "vertex_normals", "vertex_texcoords")


@dataclass(frozen=True, eq=False)
class MeshTable:
    """A mesh as one table.

    Attributes:
        shape: the Mitsuba mesh that it comes from.
        columns: everything that vertices carry, positions first, float64 [vertices, columns].
        widths: names of what the columns hold and how many each takes.
        faces: vertex indices, int64 [triangles, 3].
        parents: triangle of the original mesh that each one is part of, int64 [triangles].
    """

    shape: Any
    columns: Floats
    widths: dict[str, int]
    faces: Faces
    parents: NDArray[np.int64]


def read_mesh(shape: Any) -> MeshTable:
    """The arrays of a Mitsuba mesh."""
    num_vertices = int(shape.vertex_count())
    parts = {"vertex_positions": shape.vertex_positions_buffer()}
    if shape.has_vertex_normals():
        parts["vertex_normals"] = shape.vertex_normals_buffer()
    if shape.has_vertex_texcoords():
        parts["vertex_texcoords"] = shape.vertex_texcoords_buffer()
    parameters = mi.traverse(shape)
    for key in sorted(parameters.keys()):
        if key.startswith("vertex_") and key not in _STANDARD:
            parts[key] = parameters[key]
    tables = {name: np.array(part, dtype=np.float64).reshape(num_vertices, -1) for name, part in parts.items()}
    faces = np.array(shape.faces_buffer(), dtype=np.int64).reshape(-1, 3)
    columns = np.column_stack(list(tables.values()))
    widths = {name: table.shape[1] for name, table in tables.items()}
    return MeshTable(shape, columns, widths, faces, np.arange(len(faces)))


def build_mesh(mesh: MeshTable) -> Any:
    """The mesh with its original's name and material."""
    ends = np.cumsum(list(mesh.widths.values()))
    tables = dict(zip(mesh.widths, np.split(mesh.columns, ends[:-1], axis=1), strict=True))
    attributes = {name: table for name, table in tables.items() if name not in _STANDARD}
    parameters, num_faces = mi.traverse(mesh.shape), int(mesh.shape.face_count())
    for key in sorted(parameters.keys()):
        if key.startswith("face_"):
            attributes[key] = np.array(parameters[key]).reshape(num_faces, -1)[mesh.parents]
    return to_mitsuba(
        mesh.shape.id(), tables["vertex_positions"], mesh.faces, normals=tables.get("vertex_normals"),
        texcoords=tables.get("vertex_texcoords"), bsdf=mesh.shape.bsdf(), attributes=attributes,
    )  # fmt: skip
