"""Triangles that no scene should have and every scene has: degenerate, duplicate, flipped, needle, non-manifold.

Bounds: elements, caches and query are finite; caches of 1 come back as the albedo to 1e-5 whatever the triangulation;
under a sky of 1 a flat sheet caches an irradiance of 1 (4.9 sigma) on every triangle with area.
"""

from typing import Any

import numpy as np
import pytest

from tests.exr_files import write_exr
from workers.backend import mi
from workers.bake_kernels import Batch, bake_diffuse
from workers.camera import Camera
from workers.elements import build_elements
from workers.errors import SceneError
from workers.mesh_building import to_mitsuba
from workers.progress import Progress
from workers.query import CHANNELS, CacheArrays, QueryProgram
from workers.scene import load_scene
from workers.scene_check import check_scene
from workers.settings import CacheSettings, QuerySettings
from workers.surfaces import build_surface_table
from workers.visibility import domain_hits

ALBEDO = (0.6, 0.4, 0.2)
MAX_Z = 4.9
CORNERS = [(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)]
NEEDLE = [(-1.0, 0.0, 1e-3), (1.0, 0.0, 1e-3), (1.0, 1e-6, 1e-3)]
SHEETS: dict[str, tuple[list[Any], list[Any]]] = {  # vertices, faces
    "plain": (CORNERS, [(0, 1, 2), (0, 2, 3)]),
    "degenerate": ([*CORNERS, (0.0, 0.0, 0.0)], [(0, 1, 2), (0, 2, 3), (0, 0, 1), (0, 2, 4), (4, 4, 4)]),
    "duplicate": (CORNERS * 2, [(0, 1, 2), (0, 2, 3), (0, 1, 2), (4, 5, 6)]),
    "flipped": (CORNERS, [(0, 1, 2), (0, 3, 2)]),
    "needle": ([*CORNERS, *NEEDLE], [(0, 1, 2), (0, 2, 3), (4, 5, 6)]),
    "sliver": ([*CORNERS, (1.0, 1.0 - 1e-7, 0.0)], [(0, 1, 4), (0, 4, 2), (0, 2, 3)]),
    "fan of 64": ([(0.0, 0.0, 0.0), *[(np.cos(a), np.sin(a), 0.0) for a in np.linspace(0, 2 * np.pi, 65)]],
                  [(0, i, i + 1) for i in range(1, 65)]),
    "non-manifold": ([*CORNERS, (0.0, 0.0, -1.0), (0.5, 0.2, -0.5)], [(0, 1, 2), (0, 2, 3), (0, 2, 4), (0, 2, 5)]),
}  # fmt: skip
sheets = pytest.mark.parametrize("name", list(SHEETS))


def built(name: str, normals: np.ndarray | None = None) -> "mi.Scene":
    vertices, faces = SHEETS[name]
    bsdf = mi.load_dict({"type": "twosided", "b": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}})
    mesh = to_mitsuba("sheet", vertices, faces, normals=normals, bsdf=bsdf)
    return mi.load_dict({"type": "scene", "sky": {"type": "constant", "radiance": 1.0}, "sheet": mesh}, optimize=False)


def answer(scene: "mi.Scene") -> tuple[Any, Any, np.ndarray]:
    """(surfaces, elements, features of caches of 1) of a view from above."""
    camera = Camera.look_at([0.1, -0.4, 2.0], [0, 0, 0], [0, 1, 0], 50, 24, 24)
    table = build_surface_table(scene)
    hits = domain_hits(scene, table, [camera], 48, 2500, Progress())
    elements = build_elements(table, hits, CacheSettings(max_elements=200))
    caches = CacheArrays(np.ones((elements.num_elements, 3), np.float32), np.zeros((0, 2, 2, 3), np.float32))
    program = QueryProgram(scene, table, elements, caches, QuerySettings(samples=1))
    return table, elements, program.run(camera)


@sheets
def test_query_and_bake_of_any_triangulation(name: str, within: Any) -> None:
    scene = built(name)
    table, elements, features = answer(scene)
    assert np.isfinite(elements.position).all() and np.isfinite(elements.normal).all()
    assert np.isfinite(features[..., : CHANNELS["position"][0]]).all()
    sheet = np.isfinite(features[..., slice(*CHANNELS["position"])]).all(-1)
    assert sheet.sum() > 50
    within("radiance of caches of 1", float(np.abs(features[sheet][:, :3] - ALBEDO).max()), 1e-5)
    count = elements.num_elements
    batch = Batch(np.arange(count), np.full(count, 5, np.uint64), np.arange(count, dtype=np.uint64))
    mean, square = (part.astype(np.float64) for part in bake_diffuse(scene, table, elements, batch, 256, 0, -1))
    assert np.isfinite(mean).all() and mean.min() >= 0.0
    if name in ("plain", "degenerate", "flipped", "sliver", "fan of 64"):  # others shade themselves
        error = np.sqrt(np.maximum(square - mean**2, 0.0) / 255).mean() / np.sqrt(count)
        within("irradiance in sigma", abs(mean.mean() - 1.0) / np.hypot(error, 1e-5), MAX_Z)


def test_flipped_triangle_is_seen_from_its_other_side() -> None:
    """Two-sided material: the flipped half caches its own back side, as bright as its neighbour's front."""
    _, elements, features = answer(built("flipped"))
    assert set(np.unique(elements.side)) == {0, 1}
    normal = features[..., slice(*CHANNELS["normal"])]
    assert normal[np.isfinite(features[..., CHANNELS["position"][0]]), 2].min() > 0.999, "both face the viewer"


def test_vertex_normals_of_zero_do_not_reach_the_network() -> None:
    """A file may hold them: they shade NaN, unless they are mended when the scene is checked."""
    scene = built("plain", normals=np.zeros((4, 3)))
    assert check_scene(scene, "scene x") == ["mesh sheet: 4 vertex normals without length are taken from its faces"]
    _, elements, features = answer(scene)
    np.testing.assert_allclose(elements.normal, np.tile([0, 0, 1], (elements.num_elements, 1)), atol=1e-6)
    assert np.isfinite(features[..., : CHANNELS["position"][0]]).all()


def test_degenerate_triangles_are_counted_and_pure_ones_refused() -> None:
    assert check_scene(built("degenerate"), "scene x") == ["3 triangles have no area: nothing is cached on them"]
    mesh = to_mitsuba("flat", CORNERS, [(0, 0, 1), (2, 2, 2)])
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "flat": mesh}, optimize=False)
    with pytest.raises(SceneError, match="must have area"):
        check_scene(scene, "scene x")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["floor", "sky"])
def test_texture_that_is_not_finite_is_refused_by_name(make_scene: Any, tmp_path: Any, where: str, bad: float) -> None:
    texels = np.full((4, 4, 3), 0.5, np.float32)
    texels[1, 2] = bad
    file = tmp_path / "texture.exr"
    write_exr(file, texels)
    if where == "floor":
        texture = {"type": "bitmap", "filename": str(file), "raw": True}
        more = {"floor": {"type": "rectangle", "b": {"type": "diffuse", "reflectance": texture}}}
    else:
        more = {"sky": {"type": "envmap", "filename": str(file)}}
    with pytest.raises(SceneError, match=rf"{where}.*must be finite, got \d+ of \d+ values NaN or Inf"):
        make_scene(**more)


def test_empty_scene_file_is_refused(tmp_path: Any) -> None:
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(SceneError):
        load_scene(tmp_path / "empty.obj")
