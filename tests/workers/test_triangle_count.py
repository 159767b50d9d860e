"""Scenes with more and with fewer triangles: counts, areas, unchanged light, materials and attributes."""

import numpy as np
import pytest

from workers.backend import mi
from workers.errors import WorkerError
from workers.mesh_building import to_mitsuba
from workers.mesh_table import MeshTable, read_mesh
from workers.scene import Scene, load_scene
from workers.triangle_count import (
    AS_FILED,
    CLUSTERED,
    TESSELLATED,
    clustered,
    num_triangles,
    tessellated,
    with_triangles,
)


@pytest.fixture(scope="module")
def tiny() -> Scene:
    return load_scene("tiny", width=32, height=32)


def areas(mesh: MeshTable) -> np.ndarray:
    corners = mesh.columns[:, :3][mesh.faces]
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def render(scene: Scene) -> np.ndarray:
    integrator = mi.load_dict({"type": "path", "max_depth": 3})
    sensor = scene.make_sensor(scene.camera, 4)
    return np.array(mi.render(scene.mi_scene, integrator=integrator, sensor=sensor, spp=4, seed=1))


def square(**attributes: np.ndarray) -> MeshTable:
    """Two triangles of a unit square."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    shape = to_mitsuba("square", corners, [[0, 1, 2], [0, 2, 3]], attributes=attributes)
    return read_mesh(shape)


@pytest.mark.parametrize("target", [1000, 5000])
def test_tessellation_meets_the_count_and_keeps_every_pixel(tiny: Scene, target: int) -> None:
    scene, count, rule = with_triangles(tiny, target)
    assert rule == TESSELLATED and count == num_triangles(scene.mi_scene)
    assert count == pytest.approx(target, rel=0.25)
    assert np.abs(render(scene) - render(tiny)).max() < 1e-3
    assert scene.digest != tiny.digest and str(count) in scene.name


def test_tessellation_keeps_area_and_shares_vertices() -> None:
    (mesh,) = tessellated([square()], 32, 1.0)
    assert len(mesh.faces) == 32 and len(mesh.columns) == 25  # 4 x 4 cells have 5 x 5 vertices
    assert areas(mesh).sum() == pytest.approx(1.0, rel=1e-6)
    assert areas(mesh) == pytest.approx(np.full(32, 1 / 32), rel=1e-5)
    assert (mesh.columns[:, 2] == 0).all()
    edges = mesh.columns[:, :3][mesh.faces]
    assert (np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])[:, 2] > 0).all()  # none is flipped
    assert np.bincount(mesh.parents).tolist() == [16, 16]


def test_tessellation_interpolates_what_vertices_carry() -> None:
    colours = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    (mesh,) = tessellated([square(vertex_color=colours)], 32, 1.0)
    assert mesh.widths == {"vertex_positions": 3, "vertex_color": 3}
    assert mesh.columns[:, 3:5] == pytest.approx(mesh.columns[:, :2])  # the colour is the place


def test_tessellation_cuts_the_long_ones_first() -> None:
    small = square()
    small = MeshTable(small.shape, small.columns * 0.1, small.widths, small.faces, small.parents)
    large, untouched = tessellated([square(), small], 34, 1.0)
    assert len(large.faces) == 32 and len(untouched.faces) == 2


def test_clustering_comes_near_the_count_and_keeps_the_bounds(tiny: Scene) -> None:
    scene, count, rule = with_triangles(tiny, 150)
    assert rule == CLUSTERED and num_triangles(tiny.mi_scene) > count > 75
    ball = next(shape for shape in scene.mi_scene.shapes() if shape.id() == "ball")
    old = next(shape for shape in tiny.mi_scene.shapes() if shape.id() == "ball")
    assert 4 <= ball.primitive_count() < old.primitive_count()
    extent, old_extent = (np.array(shape.bbox().extents()) for shape in (ball, old))
    assert extent == pytest.approx(old_extent, rel=0.4)
    assert np.isfinite(render(scene)).all()


def test_clustering_leaves_no_shape_without_triangles(tiny: Scene) -> None:
    scene, _, _ = with_triangles(tiny, 1)
    assert min(shape.primitive_count() for shape in scene.mi_scene.shapes()) >= 2
    assert len(scene.mi_scene.shapes()) == len(tiny.mi_scene.shapes())


def test_clustering_drops_what_repeats() -> None:
    mesh = square()
    twice = MeshTable(mesh.shape, mesh.columns, mesh.widths, np.concatenate([mesh.faces] * 2), np.arange(4))
    (merged,) = clustered([twice], 2, 1.0)
    assert len(merged.faces) == 2


def test_count_that_the_scene_has_changes_nothing(tiny: Scene) -> None:
    count = num_triangles(tiny.mi_scene)
    assert with_triangles(tiny, count) == (tiny, count, AS_FILED)


def test_lights_and_materials_stay(tiny: Scene) -> None:
    scene, _, _ = with_triangles(tiny, 2000)
    old = {shape.id(): shape for shape in tiny.mi_scene.shapes()}
    new = {shape.id(): shape for shape in scene.mi_scene.shapes()}
    assert old.keys() == new.keys()
    assert all(new[name].bsdf().ptr == old[name].bsdf().ptr for name in old)
    assert len(scene.mi_scene.emitters()) == len(tiny.mi_scene.emitters())


def test_a_count_below_one_is_refused(tiny: Scene) -> None:
    with pytest.raises(WorkerError, match="at least 1, got 0"):
        with_triangles(tiny, 0)
