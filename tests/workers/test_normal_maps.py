"""Normal maps in the G-buffers: the normal is the one that the material itself shades with."""

from typing import Any

import numpy as np
import pytest

from workers.backend import dr, mi
from workers.camera import Camera
from workers.elements import build_elements
from workers.normal_maps import NormalMaps
from workers.progress import Progress
from workers.query import CHANNELS, CacheArrays, QueryProgram
from workers.query_reference import query_reference
from workers.settings import CacheSettings, QuerySettings
from workers.surfaces import build_surface_table
from workers.visibility import domain_hits

ALBEDO = 0.5
COUNT = 64


def turned(size: int, seed: int) -> np.ndarray:
    """A map of random normals, at most 50 degrees off; float32 [size, size, 3] in [0, 1]."""
    slope = np.random.default_rng(seed).uniform(-0.8, 0.8, (size, size, 2))
    normal = np.concatenate([slope, np.ones((size, size, 1))], -1)
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True) / 2 + 0.5).astype(np.float32)


def material(wrap: str, **more: Any) -> dict[str, Any]:
    bitmap = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(turned(8, 1)), **more}
    mapped = {"type": "normalmap", "normalmap": bitmap, "b": {"type": "diffuse", "reflectance": ALBEDO}}
    return mapped if wrap == "" else {"type": wrap, "b": mapped}


def sheet(bsdf: dict[str, Any]) -> "mi.Scene":
    turn = mi.ScalarTransform4f().rotate([0, 0, 1], 30).scale([2, 1, 1])
    shapes = {
        "sheet": {"type": "rectangle", "to_world": turn, "bsdf": bsdf},
        "plain": {"type": "sphere", "center": [9, 0, 0]},
    }
    return mi.load_dict({"type": "scene", "sky": {"type": "constant"}, **shapes}, optimize=False)


def shaded_normal(si: "mi.SurfaceInteraction3f") -> np.ndarray:
    """From the material: f cos is linear in the light's direction as long as all of them are in front."""
    side = np.sign(np.array(si.wi)[2])
    lights = np.array([[0.05, 0.02, 1.0], [-0.03, 0.05, 1.0], [0.02, -0.05, 1.0]])
    values = []
    for light in lights / np.linalg.norm(lights, axis=1, keepdims=True):
        wo = mi.Vector3f(float(light[0]), float(light[1]), mi.Float(light[2] * side))
        values.append(np.array(si.bsdf().eval(mi.BSDFContext(), si, wo))[0] * np.pi / ALBEDO)
    flat = lights / np.linalg.norm(lights, axis=1, keepdims=True)
    local = np.linalg.solve(flat, np.array(values))
    local[2] *= side
    return np.array(si.to_world(mi.Vector3f(local.astype(np.float32)))).T


@pytest.mark.parametrize(("wrap", "side"), [("", 1), ("mask", 1), ("twosided", 1), ("twosided", -1)])
@pytest.mark.parametrize("more", [{}, {"to_uv": mi.ScalarTransform4f().translate([0.1, 0.3, 0]).scale([3, 2, 1])}])
def test_normal_is_that_of_the_material(wrap: str, side: int, more: dict[str, Any]) -> None:
    scene = sheet(material(wrap, **more))
    xy = np.random.default_rng(2).uniform(-0.6, 0.6, (2, COUNT)).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(xy[0], xy[1], 2.0 * side), mi.Vector3f(0, 0, -side))
    si = scene.ray_intersect(ray)
    shapes = scene.shapes()
    index = next(i for i, shape in enumerate(shapes) if shape.id() == "sheet")
    found = NormalMaps(shapes).normal(si, dr.full(mi.UInt32, index, COUNT), mi.Bool(True))
    share = 1.0 if wrap != "mask" else 0.5
    expected = shaded_normal(si) / share
    np.testing.assert_allclose(
        np.array(found).T * side, expected / np.linalg.norm(expected, axis=1)[:, None], atol=5e-3
    )


def test_surfaces_without_a_map_keep_their_normal() -> None:
    scene = sheet(material(""))
    shapes = scene.shapes()
    index = next(i for i, shape in enumerate(shapes) if shape.id() == "plain")
    ray = mi.Ray3f(mi.Point3f([9.0, 9.3], [0.0, 0.2], 4.0), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(ray)
    maps = NormalMaps(shapes)
    assert len(maps.textures) == 1
    found = maps.normal(si, dr.full(mi.UInt32, index, 2), mi.Bool(True))
    np.testing.assert_allclose(np.array(found), np.array(si.sh_frame.n), atol=1e-6)


def test_query_gives_the_mapped_normal_as_its_reference_does() -> None:
    scene = sheet(material("twosided"))
    table = build_surface_table(scene)
    camera = Camera.look_at([0, 0, 2.5], [0, 0, 0], [0, 1, 0], fov_deg=45, width=24, height=16)
    cache = CacheSettings(max_elements=200)
    elements = build_elements(table, domain_hits(scene, table, [camera], 24, 2000, Progress()), cache)
    caches = CacheArrays(np.ones((elements.num_elements, 3), np.float32), np.zeros((0, 2, 2, 3), np.float32))
    settings = QuerySettings(samples=1)
    program = QueryProgram(scene, table, elements, caches, settings)
    first, second = program.run(camera), program.run(camera)
    assert program.num_recordings == 1
    np.testing.assert_array_equal(first, second)
    a, b = CHANNELS["normal"]
    expected = query_reference(scene, table, elements, caches, settings, camera)
    np.testing.assert_allclose(first[..., a:b], expected["normal"], atol=1e-4)
    assert first[..., a:b][first[..., 9] > 0].std(axis=0).max() > 0.1
