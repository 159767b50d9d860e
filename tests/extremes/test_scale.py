"""Scene scale 1e-6 to 1e6 and offsets to 1e6: the same image when camera and scene scale or move together.

Bound: mean absolute difference of 1e-3 of the mean, with the same random numbers. What is left are paths that pass an
edge on its other side after rounding (6e-8 a coordinate), and Mitsuba's ray offset, which is up to 1.8e-4 of the scene.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from workers.bake_kernels import Batch, bake_diffuse
from workers.camera_path import camera_paths
from workers.pathtrace import trace
from workers.query import CHANNELS
from workers.scene import load_scene
from workers.world_frame import OWN, WorldFrame

SAME = 1e-3
FAR = (1e6, -1e6, 0.0)
PLACES = [
    pytest.param(scale, offset, id=f"{scale:g} at {offset[0]:g}")
    for scale, offset in [
        (1e-6, (0.0,) * 3), (1e-3, (0.0,) * 3), (1e3, (0.0,) * 3), (1e6, (0.0,) * 3),
        (1.0, (1e3, 0.0, 0.0)), (1.0, FAR), (1e-6, FAR),
    ]
]  # fmt: skip


def difference(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean absolute difference as a share of the mean."""
    return float(np.abs(image.astype(np.float64) - reference).mean() / np.abs(reference).mean())


@pytest.mark.parametrize(("scale", "offset"), PLACES)
def test_path_tracing_is_the_same_at_every_scale_and_place(
    make_scene: Any, within: Any, scale: float, offset: Any
) -> None:
    at_home, there = make_scene(), make_scene(scale=scale, offset=offset)
    images = [trace(scene, scene.camera, 64, 1).radiance for scene in (at_home, there)]
    within("path tracing", difference(images[1], images[0]), SAME)


@pytest.mark.parametrize(("scale", "offset"), PLACES)
def test_query_is_the_same_at_every_scale_and_place(prepare: Any, within: Any, scale: float, offset: Any) -> None:
    at_home, there = prepare(), prepare(scale=scale, offset=offset)
    # Voxels are powers of two, so that neighbours agree: up to twice as coarse at a scale that is none.
    counts = [p.elements.num_elements for p in (at_home, there)]
    within("number of elements", abs(counts[1] / counts[0] - 1), 0.1)
    images = [p.program().run(p.scene.camera) for p in (at_home, there)]
    for name in ("ir", "normal", "albedo", "coverage"):
        low, high = CHANNELS[name]
        within(name, difference(images[1][..., low:high], images[0][..., low:high]), SAME)
    distances = [image[..., CHANNELS["distance"][0]] for image in images]
    within("distance", difference(distances[1] / scale, distances[0]), SAME)
    low, high = CHANNELS["position"]
    seen = np.isfinite(images[0][..., low:high]).all(-1) & np.isfinite(images[1][..., low:high]).all(-1)
    home = images[0][..., low:high][seen]
    position = (images[1][..., low:high][seen] + there.scene.frame.origin - np.array(offset)) / scale
    # An offset of 1e6 leaves 1e-10 of a unit in double precision: 1e-4 of this scene at 1e-6.
    within("position", difference(position, home), SAME)


@pytest.mark.parametrize(("scale", "offset"), PLACES)
def test_bake_is_the_same_at_every_scale_and_place(prepare: Any, within: Any, scale: float, offset: Any) -> None:
    """A place on the floor, the wall and the ball, 4096 paths each with the same random numbers."""
    values = []
    for prepared in (prepare(), prepare(scale=scale, offset=offset)):
        ids = [shape.id() for shape in prepared.table.shapes]
        elements = _on_shapes(prepared, [ids.index("floor"), ids.index("wall"), ids.index("ball")])
        batch = Batch(np.arange(3), np.full(3, 7, np.uint64), np.arange(3, dtype=np.uint64))
        values.append(bake_diffuse(prepared.scene.mi_scene, prepared.table, elements, batch, 4096, 0, 6)[0])
    within("diffuse cache", difference(values[1], values[0]), SAME)


def _on_shapes(prepared: Any, shapes: list[int]) -> Any:
    from types import SimpleNamespace

    from workers.elements import surface_frame

    shape, prim = np.array(shapes), np.zeros(len(shapes), np.int64)
    uv = np.full((len(shapes), 2), 0.3, np.float32)
    position, normal, _ = surface_frame(prepared.table, shape, prim, uv, np.zeros(len(shapes), np.uint8))
    return SimpleNamespace(shape=shape, prim_local=prim, uv=uv, normal=normal, position=position)


@pytest.mark.parametrize(("scale", "offset"), PLACES)
def test_camera_paths_scale_with_the_scene(make_scene: Any, scale: float, offset: Any) -> None:
    counts = {"num_train": 3, "num_validation": 1, "num_test": 2, "width": 16, "height": 16, "seed": 1}
    at_home, there = (camera_paths(scene, **counts) for scene in (make_scene(), make_scene(scale=scale, offset=offset)))
    assert there.domain_radius / scale == pytest.approx(at_home.domain_radius, rel=SAME)
    for ours, theirs in zip(at_home.train + at_home.test, there.train + there.test, strict=True):
        np.testing.assert_allclose((theirs.origin - offset) / scale, ours.origin, atol=1e-3)


def test_mesh_file_in_map_coordinates_keeps_its_vertices(tmp_path: Path) -> None:
    """A triangle of 0.3 m at 4e6 m, as surveys write them: single precision would place it on a grid of 0.25 m."""
    corners = np.array([[4e6, 5e5, 0.0], [4e6 + 0.3, 5e5, 0.0], [4e6, 5e5 + 0.2, 0.1]])
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
    (tmp_path / "survey.obj").write_text("\n".join([*lines, "f 1 2 3"]))
    scene = load_scene(tmp_path / "survey.obj", width=8, height=8)
    mesh = next(shape for shape in scene.mi_scene.shapes() if not shape.is_emitter())
    local = np.array(mesh.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    np.testing.assert_allclose(scene.frame.file_points(local), corners, atol=1e-7)
    assert np.linalg.norm(scene.camera.origin - corners.mean(0)) < 2.0, "the camera stays in the file's frame"


def test_notes_tell_what_was_moved(make_scene: Any) -> None:
    assert not any("single precision" in note for note in make_scene().notes)
    assert any("single precision" in note for note in make_scene(scale=1e-6).notes)
    assert make_scene().digest != make_scene(scale=1e-6).digest


coordinates = st.floats(-1e6, 1e6, allow_nan=False, width=32)


@given(st.tuples(*[coordinates] * 3), st.floats(-20, 20), st.tuples(*[st.floats(-1, 1)] * 3))
def test_frame_returns_every_point(centre: Any, exponent: float, inside: Any) -> None:
    """To 1e-9 of the box and the last bits of a double at the box's own place (2.2e-16 of it, twice)."""
    centre, half = np.array(centre), 2.0**exponent
    frame = WorldFrame.of_box(centre - half, centre + half)
    point = centre + half * np.array(inside)
    error = np.abs(frame.file_points(frame.local_points(point)) - point).max()
    assert error <= 1e-9 * half + 1e-15 * np.abs(centre).max()
    assert np.log2(frame.scale) == np.round(np.log2(frame.scale)) and frame.scale >= 1.0
    extent = np.linalg.norm(frame.local_points(centre + half) - frame.local_points(centre - half))
    assert extent >= 0.5 * (1 - 1e-6), "nothing stays smaller than the ray offset allows"
    assert np.abs(frame.local_points(centre)).max() <= 4.0 * extent * (1 + 1e-6)


def test_frame_of_an_ordinary_scene_is_its_own() -> None:
    assert WorldFrame.of_box([-3, 0, -3], [3, 2.5, 3]) is not None
    assert WorldFrame.of_box([-3, 0, -3], [3, 2.5, 3]) == OWN
    assert WorldFrame.of_box([-1e6] * 3, [1e6] * 3) == OWN
    assert WorldFrame.of_box([np.inf] * 3, [-np.inf] * 3) == OWN, "an empty scene is refused elsewhere"
