"""Memory that an open scene holds: the sum of its arrays, and an estimate of what Mitsuba keeps out of sight.

Counted, not measured: the process' resident memory also moves with frames in progress, with Dr.Jit's own cache
of freed blocks and with what other threads do, and would charge the first scene for the libraries.
"""

import gc
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from models.network import FusionNet, num_parameters
from workers.backend import dr, mi

if TYPE_CHECKING:
    from workers.query import QueryProgram
    from workers.reconstruct import Reconstructor
    from workers.surfaces import SurfaceTable

BVH_NBYTES_A_PRIMITIVE = 100
"""Embree's tree: resident memory grew by 103 and 68 bytes a triangle on meshes of 0.26 and 1.05 M triangles."""
PROGRAM_NBYTES = 8 * 2**20
"""Recorded query programs and their machine code, roughly, of a few image sizes."""
_GEOMETRY = ("faces", "vertex_positions", "vertex_normals", "vertex_texcoords")


def scene_nbytes(program: "QueryProgram", reconstructor: "Reconstructor") -> int:
    """Bytes of caches and lattice tables, geometry, textures, acceleration structure, network and programs."""
    geometry = geometry_nbytes(program.table) + _parameter_nbytes(program.scene)
    return program_nbytes(program) + geometry + network_nbytes(reconstructor)


def program_nbytes(program: "QueryProgram") -> int:
    """Caches, lattice tables and recorded programs, without the scene that they belong to."""
    return _array_nbytes(program.shading.state()[0]) + PROGRAM_NBYTES


def geometry_nbytes(table: "SurfaceTable") -> int:
    """Vertices, faces, acceleration structure and the table itself."""
    primitives = sum(int(shape.primitive_count()) for shape in table.shapes)
    meshes = [shape for shape in table.shapes if shape.is_mesh()]
    vertices = sum(_vertex_nbytes(mesh) * int(mesh.vertex_count()) for mesh in meshes)
    faces = sum(12 * int(mesh.face_count()) for mesh in meshes)
    tables = table.prim_edge.nbytes + table.prim_offset.nbytes
    return vertices + faces + tables + BVH_NBYTES_A_PRIMITIVE * primitives


def _vertex_nbytes(mesh: Any) -> int:
    return 12 + 12 * int(mesh.has_vertex_normals()) + 8 * int(mesh.has_vertex_texcoords())


def _parameter_nbytes(mi_scene: "mi.Scene") -> int:
    """Textures, environment maps and other parameters; geometry is counted by `geometry_nbytes`."""
    parameters = mi.traverse(mi_scene)
    values = [parameters[key] for key in parameters.keys() if key.rpartition(".")[2] not in _GEOMETRY]  # noqa: SIM118
    return sum(_nbytes(value) for value in values)


def network_nbytes(reconstructor: "Reconstructor") -> int:
    """Twice the fp32 weights: at most one copy in another precision stands beside them."""
    with torch.device("meta"):
        network = FusionNet(reconstructor.config)
    return 2 * 4 * num_parameters(network)


def _array_nbytes(arrays: Any) -> int:
    return sum(_nbytes(array) for array in arrays)


def _nbytes(value: Any) -> int:
    """Bytes of a Dr.Jit array, vector or tensor; 0 for plain values."""
    if dr.is_tensor_v(value):
        value = value.array
    if not dr.is_jit_v(value):
        return np.asarray(value).nbytes if isinstance(value, np.ndarray) else 0
    return int(dr.width(value)) * int(np.prod(dr.shape(value)[:-1], dtype=np.int64)) * int(dr.itemsize_v(value))


def release_freed() -> None:
    """Gives what closed scenes held back to the system; call it on the thread that rendered them."""
    gc.collect()  # frozen programs and their owners refer to each other
    dr.flush_malloc_cache()
