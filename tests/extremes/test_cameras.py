"""Cameras where none should stand, and images of one pixel or 8192 in a row.

Bound: every channel but position is finite (position is NaN where nothing is hit, by definition), caches of 1 come
back as albedo to 1e-5, and paths around such a view are finite poses.
"""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.network import FusionNet, NetworkConfig
from models.transfer import Transfer
from workers.camera import Camera
from workers.camera_path import camera_paths, domain_poses
from workers.elements import build_elements
from workers.errors import CameraError
from workers.lattice import MAX_LEVEL, MAX_PATCHES, patch_counts, patch_levels
from workers.progress import Progress
from workers.query import CHANNELS, NUM_CHANNELS, CacheArrays, QueryProgram
from workers.reconstruct import GBUFFER_CHANNELS, Encoding, Reconstructor
from workers.settings import QuerySettings
from workers.visibility import domain_hits

SIZE = 16
UP = (0, 1, 0)
VIEWS: dict[str, Camera] = {
    "empty": Camera.look_at([0, 5, 20], [0, 5, 30], UP, 50, SIZE, SIZE),
    "inside the box": Camera.look_at([0.3, 0.4, 0], [0.3, 0.4, 1], UP, 50, SIZE, SIZE),
    "inside the ball": Camera.look_at([-0.5, 0.3, 0], [0, 0.5, -1], UP, 50, SIZE, SIZE),
    "at a vertex": Camera.look_at([0.7, 0.8, 0.4], [0, 0.5, 0], UP, 50, SIZE, SIZE),
    "on the wall": Camera.look_at([0, 1, -1], [0, 1, 3], UP, 50, SIZE, SIZE),
    "in the plane of the wall": Camera.look_at([0, 2, -1], [0, 0.1, -1], (0, 0, 1), 50, SIZE, SIZE),
    "along an edge": Camera.look_at([0.7, 0.8, 2], [0.7, 0.8, 0], UP, 50, SIZE, SIZE),
    "on an edge, along it": Camera.look_at([0.7, 0.8, 0.4], [0.7, 0.8, -1], UP, 50, SIZE, SIZE),
    "a thousandth of a degree": Camera.look_at([0, 1.5, 3], [0, 0.5, 0], UP, 0.001, SIZE, SIZE),
    "179.99 degrees": Camera.look_at([0, 1.5, 3], [0, 0.5, 0], UP, 179.99, SIZE, SIZE),
    "a billion units away": Camera.look_at([0, 1.5, 1e9], [0, 0.5, 0], UP, 50, SIZE, SIZE),
    "one pixel": Camera.look_at([0, 1.5, 3], [0, 0.5, 0], UP, 50, 1, 1),
}
views = pytest.mark.parametrize("name", list(VIEWS))


def check(features: np.ndarray) -> None:
    rest = features[..., : CHANNELS["position"][0]]
    assert np.isfinite(rest).all()
    layer = {name: features[..., slice(*where)] for name, where in CHANNELS.items()}
    lamp = layer["ir"].max(-1) > 1.0  # it shines by itself
    np.testing.assert_allclose(layer["ir"][~lamp], layer["albedo"][~lamp], atol=1e-5)
    assert layer["coverage"].min() >= 0.0 and layer["coverage"].max() <= 1.0 + 1e-6
    assert np.linalg.norm(layer["normal"], axis=-1).max() <= 1.0 + 1e-5


@views
def test_query_of_a_scene_baked_elsewhere_is_finite(prepare: Any, name: str) -> None:
    check(prepare().program().run(VIEWS[name]))


@views
def test_elements_of_a_domain_of_that_view_answer_it(prepare: Any, name: str) -> None:
    """Also where nothing is seen: no element, a black query."""
    prepared, camera = prepare(), VIEWS[name]
    mi_scene, table = prepared.scene.mi_scene, prepared.table
    hits = domain_hits(mi_scene, table, [camera], 64, 2000, Progress())
    elements = build_elements(table, hits, prepared.settings)
    assert elements.num_elements <= prepared.settings.max_elements
    assert (elements.num_elements == 0) == (len(hits.prim) == 0)
    assert np.isfinite(elements.position).all() and np.isfinite(elements.normal).all()
    caches = CacheArrays(np.ones((elements.num_elements, 3), np.float32), np.zeros((0, 2, 2, 3), np.float32))
    features = QueryProgram(mi_scene, table, elements, caches, QuerySettings(samples=1)).run(camera)
    if elements.num_elements:
        check(features)
    else:
        assert np.isfinite(features[..., : CHANNELS["position"][0]]).all()


@views
def test_paths_around_that_view_are_finite(make_scene: Any, name: str) -> None:
    scene = dataclasses.replace(make_scene(), camera=VIEWS[name])
    paths = camera_paths(scene, num_train=3, num_validation=1, num_test=2, width=SIZE, height=SIZE, seed=1)
    assert np.isfinite(paths.domain_radius) and paths.domain_radius > 0
    for camera in [*paths.train, *paths.test, *domain_poses(paths, 6, 2)]:
        assert np.isfinite(camera.to_world).all()


@pytest.mark.parametrize("size", [(1, 1), (8192, 1), (1, 8192), (3, 7)])
def test_images_of_any_shape_are_queried_and_reconstructed(prepare: Any, size: tuple[int, int]) -> None:
    width, height = size
    features = prepare().program().run(prepare().scene.camera.resized(width, height))
    assert features.shape == (height, width, NUM_CHANNELS)
    check(features)
    config = NetworkConfig(gbuffer_channels=GBUFFER_CHANNELS, widths=(16, 16, 16))
    encoding = Encoding(1.0, 4.0, Transfer())
    frame = Reconstructor(FusionNet(config), encoding, precision="fp32")(features)
    assert frame.shape == (height, width, 3)
    np.testing.assert_allclose(frame, features[..., :3], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_8k_frame_is_its_small_frame_enlarged(prepare: Any) -> None:
    """8192x4608: the means of 32x32 blocks against one ray through their middle; edges differ, 1 % of the mean."""
    program, camera = prepare().program(), prepare().scene.camera
    large, small = (program.run(camera.resized(32 * n, 18 * n))[..., :3] for n in (256, 8))
    blocks = large.reshape(144, 32, 256, 32, 3).mean((1, 3))
    assert np.isfinite(large).all()
    assert abs(blocks.mean() - small.mean()) <= 0.01 * small.mean()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e39, 1e300])
def test_cameras_beyond_single_precision_are_refused(bad: float) -> None:
    with pytest.raises(CameraError, match="must"):
        Camera.look_at([bad, 0, 0], [0, 0, 0], UP, 50, 4, 4)


def test_surface_at_the_camera_has_the_finest_lattice_there_is() -> None:
    """Its footprint is 0: no division warns, and counts stay within their limits; a point has the coarsest."""
    edge, footprint = np.array([1.0, 1e6, 0.0, 1.0]), np.array([0.0, 1e-38, 0.0, np.inf])
    assert patch_counts(edge, footprint).tolist() == [MAX_PATCHES, MAX_PATCHES, 1, 1]
    assert patch_levels(edge, footprint, 1.5).tolist() == [MAX_LEVEL, MAX_LEVEL, 1, 0]


@given(st.floats(-6, 6), st.tuples(*[st.floats(-1, 1)] * 3), st.tuples(*[st.floats(-1, 1)] * 3))
def test_look_at_is_orthonormal_at_every_scale(exponent: float, origin: Any, towards: Any) -> None:
    """To 1e-9: the axes come from float64 directions, whose own length is no matter."""
    scale, direction = 10.0**exponent, np.array(towards)
    if np.linalg.norm(direction) < 1e-3 or np.linalg.norm(np.cross(direction, UP)) < 1e-3 * np.linalg.norm(direction):
        return
    start = scale * np.array(origin)
    camera = Camera.look_at(start, start + scale * direction, UP, 50, 4, 4)
    rotation = camera.to_world[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(camera.forward, direction / np.linalg.norm(direction), atol=1e-6)
