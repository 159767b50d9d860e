"""Surface table: places on every kind of shape are where Mitsuba's own rays hit; the order is stable."""

from typing import Any

import numpy as np
import pytest

from workers.backend import dr, mi
from workers.errors import SceneError
from workers.mesh_building import icosphere, to_mitsuba
from workers.surfaces import SurfaceTable, build_surface_table, parametric_point

TURNED = mi.ScalarTransform4f().translate([0.3, -0.2, 0.5]) @ mi.ScalarTransform4f().rotate([0, 0, 1], 40)
SHAPES: dict[str, dict[str, Any]] = {
    "disk": {"type": "disk", "to_world": TURNED @ mi.ScalarTransform4f().scale([1.5, 1.5, 1.0])},
    "ellipse": {"type": "disk", "to_world": TURNED @ mi.ScalarTransform4f().scale([1.5, 0.5, 1.0])},
    "sphere": {"type": "sphere", "to_world": TURNED @ mi.ScalarTransform4f().scale(0.7)},
    "placed_sphere": {"type": "sphere", "center": [1.0, 2.0, 3.0], "radius": 0.4, "flip_normals": True},
    "cylinder": {"type": "cylinder", "p0": [0.1, 0.2, -0.4], "p1": [0.5, 0.4, 0.9], "radius": 0.3},
    "cylinder_turned": {
        "type": "cylinder",
        "to_world": TURNED @ mi.ScalarTransform4f().scale([0.5, 0.5, 2.0]),
    },
    "rectangle": {"type": "rectangle", "to_world": TURNED},
    "ball": {"type": "mesh_ball"},
}
LIGHT = {"type": "constant"}


def load(shapes: dict[str, dict[str, Any]]) -> "mi.Scene":
    def mesh(name: str) -> Any:
        ball, bsdf = icosphere(0.6, 2), mi.load_dict({"type": "diffuse"})
        return to_mitsuba(name, ball.positions, ball.faces, normals=ball.normals, texcoords=ball.texcoords, bsdf=bsdf)

    built: dict[str, Any] = {
        name: mesh(name) if shape["type"] == "mesh_ball" else dict(shape) for name, shape in shapes.items()
    }
    return mi.load_dict({"type": "scene", "light": LIGHT, **built}, optimize=False)


def rows(value: Any) -> np.ndarray:
    dr.eval(value)
    return np.array(value, dtype=np.float64).T


def random_hits(scene: "mi.Scene", count: int) -> "tuple[mi.PreliminaryIntersection3f, mi.SurfaceInteraction3f]":
    """Hits of rays between random points around the scene's box."""
    box = scene.bbox()
    low, high = np.array(box.min) - 0.5, np.array(box.max) + 0.5
    rng = np.random.default_rng(4)
    a, b = (rng.uniform(low, high, (count, 3)).T for _ in range(2))
    ray = mi.Ray3f(mi.Point3f(a), dr.normalize(mi.Vector3f(b) - mi.Point3f(a)))
    pi = scene.ray_intersect_preliminary(ray)
    return pi, pi.compute_surface_interaction(ray)


@pytest.mark.parametrize("name", SHAPES)
def test_interaction_is_where_mitsuba_hits(name: str) -> None:
    scene = load({name: SHAPES[name]})
    table = build_surface_table(scene)
    pi, hit = random_hits(scene, 3000)
    valid = np.array(hit.is_valid()).astype(bool)
    assert valid.sum() > 100
    mesh = not table.is_parametric[0]
    uv = rows(pi.prim_uv if mesh else hit.uv)[valid]
    prim = np.array(pi.prim_index).astype(np.int64)[valid] if mesh else np.zeros(len(uv), np.int64)
    placed = table.interaction(np.zeros(len(uv), np.int64), prim, uv.astype(np.float32))
    np.testing.assert_allclose(rows(placed.p), rows(hit.p)[valid], atol=1e-5)
    np.testing.assert_allclose(rows(placed.n), rows(hit.n)[valid], atol=1e-4)
    np.testing.assert_allclose(rows(placed.sh_frame.n), rows(hit.sh_frame.n)[valid], atol=1e-4)
    # The azimuth is not defined at a pole or centre, and 0 and 1 are one place.
    difference = np.abs(rows(placed.uv) - rows(hit.uv)[valid])
    assert np.quantile(np.minimum(difference, 1 - difference), 0.995) < 1e-4
    assert np.all(table.shape_index(placed, mi.Bool(True)).numpy() == 0)


@pytest.mark.parametrize("name", ["disk", "ellipse", "sphere", "cylinder", "cylinder_turned"])
def test_parametric_points_lie_on_the_shape(name: str) -> None:
    shape = build_surface_table(load({name: SHAPES[name]})).shapes[0]
    uv = np.random.default_rng(0).random((500, 2))
    world = parametric_point(shape, uv)
    matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
    local = (world - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3]).T
    radius = np.linalg.norm(local[:, :2], axis=1)
    if name in ("disk", "ellipse"):
        np.testing.assert_allclose(radius, uv[:, 0], atol=1e-5)
        np.testing.assert_allclose(local[:, 2], 0, atol=1e-5)
    elif name == "sphere":
        np.testing.assert_allclose(np.linalg.norm(local, axis=1), 1, atol=1e-5)
    else:
        np.testing.assert_allclose(radius, 1, atol=1e-5)
        np.testing.assert_allclose(local[:, 2], uv[:, 1], atol=1e-5)


def describe(table: SurfaceTable) -> list[tuple[str, int]]:
    return [(shape.id(), int(lobe)) for shape, lobe in zip(table.shapes, table.lobes, strict=True)]


def test_order_does_not_depend_on_loading() -> None:
    shapes = {**SHAPES, "gold": {"type": "rectangle", "bsdf": {"type": "roughconductor"}}}
    names = list(shapes)
    tables = []
    for seed in range(3):
        np.random.default_rng(seed).shuffle(names)
        tables.append(build_surface_table(load({name: shapes[name] for name in names})))
    assert describe(tables[0]) == describe(tables[1]) == describe(tables[2])
    assert len({id_ for id_, _ in describe(tables[0])}) == len(shapes)
    for table in tables[1:]:
        np.testing.assert_array_equal(table.prim_offset, tables[0].prim_offset)
        np.testing.assert_array_equal(table.prim_edge, tables[0].prim_edge)


def test_shape_index_names_the_shape_that_was_hit() -> None:
    scene = load(SHAPES)
    table = build_surface_table(scene)
    _, si = random_hits(scene, 2000)
    valid = np.array(si.is_valid()).astype(bool)
    index = table.shape_index(si, si.is_valid()).numpy()[valid]
    registry = dr.reinterpret_array(mi.UInt32, si.shape).numpy()[valid]
    for position, shape in enumerate(table.shapes):
        own = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)).numpy()[0]
        assert np.array_equal(index == position, registry == own)
    assert len(np.unique(index)) > 4
    gathered = dr.reinterpret_array(mi.UInt32, table.shape_pointers).numpy()
    assert [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s)).numpy()[0]) for s in table.shapes] == list(gathered)


def test_primitives_and_edges_are_counted() -> None:
    table = build_surface_table(load({name: SHAPES[name] for name in ("rectangle", "sphere", "ball")}))
    counts = dict(zip([shape.id() for shape in table.shapes], np.diff(table.prim_offset), strict=True))
    assert counts == {"rectangle": 2, "sphere": 1, "ball": 320}
    first = {shape.id(): table.prim_offset[i] for i, shape in enumerate(table.shapes)}
    assert table.prim_edge[first["rectangle"]] == pytest.approx(2 * np.sqrt(2))
    assert table.prim_edge[first["sphere"]] == pytest.approx(np.pi * 0.7)
    assert table.num_prims == len(table.prim_edge) == 323


def test_unknown_shapes_are_refused_with_a_remedy() -> None:
    grid = {"type": "sdfgrid", "grid": mi.TensorXf(np.zeros((2, 2, 2, 1), np.float32))}
    scene = mi.load_dict({"type": "scene", "light": LIGHT, "grid": grid})
    with pytest.raises(SceneError, match="convert it to a mesh"):
        build_surface_table(scene)
