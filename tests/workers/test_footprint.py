"""Memory of an open scene, counted from what it holds."""

import numpy as np
import pytest

from workers.backend import mi
from workers.footprint import BVH_NBYTES_A_PRIMITIVE, _nbytes, _parameter_nbytes, geometry_nbytes
from workers.scene import load_scene
from workers.surfaces import build_surface_table


@pytest.mark.parametrize(
    ("value", "nbytes"),
    [
        (mi.Float([1, 2, 3]), 12),
        (mi.UInt32([1, 2]), 8),
        (mi.Point3f([1, 2], [3, 4], [5, 6]), 24),
        (mi.TensorXf(np.zeros((4, 5, 3), np.float32)), 240),
        (0.5, 0),
        ("text", 0),
    ],
)
def test_nbytes_of_dr_jit_values(value: object, nbytes: int) -> None:
    assert _nbytes(value) == nbytes


def test_geometry_is_counted_by_vertices_faces_and_tree() -> None:
    scene = mi.load_dict({"type": "scene", "cube": {"type": "cube", "id": "cube"}})
    table = build_surface_table(scene)  # 12 triangles, 24 vertices with normals and texture coordinates
    tables = table.prim_edge.nbytes + table.prim_offset.nbytes
    assert geometry_nbytes(table) == 24 * 32 + 12 * 12 + tables + 12 * BVH_NBYTES_A_PRIMITIVE


def test_textures_count_and_geometry_is_not_counted_twice() -> None:
    pixels = np.zeros((32, 16, 3), np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
    plain = mi.load_dict({"type": "scene", "a": {"type": "cube"}})
    textured = mi.load_dict(
        {"type": "scene", "a": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": texture}}}
    )
    assert _parameter_nbytes(plain) < 200
    assert pixels.nbytes <= _parameter_nbytes(textured) <= pixels.nbytes * 4 // 3 + 200


def test_tiny_is_small() -> None:
    scene = load_scene("tiny", width=16, height=16)
    assert 20_000 < geometry_nbytes(build_surface_table(scene.mi_scene)) < 200_000
