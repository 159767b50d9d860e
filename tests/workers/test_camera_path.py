"""Camera paths: counts, disjointness, smoothness, clear of surfaces, and the stated domain."""

from pathlib import Path

import numpy as np
import pytest

from workers.camera import Camera
from workers.camera_clearance import clearance, median_hit_distance, reachable
from workers.camera_path import CLEARANCE, CameraPaths, camera_paths, domain_poses
from workers.camera_spline import positions, spline
from workers.errors import CameraError
from workers.scene import Scene, load_scene

BOX = """<scene version="3.0.0"><sensor type="perspective"><float name="fov" value="50"/>
<transform name="to_world">
<lookat origin="{origin}" target="0,0,0" up="0,1,0"/></transform></sensor><emitter type="point"/>
<shape type="cube"><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape></scene>"""


def box_room(folder: Path, origin: str = "0,0,0.5") -> Scene:
    """A camera inside the cube [-1, 1]^3 that looks along -Z."""
    (folder / "box.xml").write_text(BOX.format(origin=origin))
    return load_scene(folder / "box.xml", width=32, height=32)


def make(scene: Scene, seed: int = 0, num_train: int = 36, num_validation: int = 4, num_test: int = 25) -> CameraPaths:
    return camera_paths(
        scene,
        num_train=num_train,
        num_validation=num_validation,
        num_test=num_test,
        width=48,
        height=24,
        seed=seed,
    )


@pytest.fixture(scope="module", params=["generated", "keyframes", "strayed"])
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, CameraPaths]:
    if request.param == "generated":
        scene = box_room(tmp_path_factory.mktemp("box"))
    else:
        scene = load_scene("tiny", width=32, height=32)
    if request.param == "strayed":
        object.__setattr__(scene, "test_keyframes", ())
    return scene, make(scene)


def test_counts_and_size_are_as_asked(case: tuple[Scene, CameraPaths]) -> None:
    _, paths = case
    assert (len(paths.train), len(paths.validation), len(paths.test)) == (36, 4, 25)
    assert {(camera.width, camera.height) for camera in paths.train + paths.test} == {(48, 24)}
    assert paths.free_radius.shape == (40,)


def test_no_pose_is_shared(case: tuple[Scene, CameraPaths]) -> None:
    _, paths = case
    place = positions(paths.train + paths.validation + paths.test)
    gaps = np.linalg.norm(place[:40, None] - place[None, 40:], axis=-1)
    assert gaps.min() > 1e-3
    assert not set(paths.train) & set(paths.validation)


def test_path_is_smooth(case: tuple[Scene, CameraPaths]) -> None:
    _, paths = case
    place = positions(paths.test)
    steps = np.linalg.norm(np.diff(place, axis=0), axis=1)
    turns = np.linalg.norm(np.diff(place, n=2, axis=0), axis=1)
    assert turns.max() < 1.0 * steps.max()


def test_own_view_is_on_path_a(case: tuple[Scene, CameraPaths]) -> None:
    scene, paths = case
    place = positions(paths.train + paths.validation)
    distance, _ = median_hit_distance(scene, scene.camera)
    assert np.linalg.norm(place - scene.camera.origin, axis=1).min() <= CLEARANCE * distance


def test_poses_are_clear_of_surfaces(case: tuple[Scene, CameraPaths]) -> None:
    scene, paths = case
    place = positions(paths.train + paths.validation + paths.test)
    distance, _ = median_hit_distance(scene, scene.camera)
    assert clearance(scene, place).min() >= CLEARANCE * distance
    assert reachable(scene, scene.camera.origin, place).all()


def test_test_path_and_domain_poses_lie_in_the_domain(case: tuple[Scene, CameraPaths]) -> None:
    scene, paths = case
    known = paths.train + paths.validation
    poses = domain_poses(paths, 60, seed=3)
    assert len(poses) == 60
    for camera in paths.test + poses:
        gaps = np.linalg.norm(positions(known) - camera.origin, axis=1)
        assert gaps.min() <= paths.domain_radius * 1.0001
    np.testing.assert_array_less(0, clearance(scene, positions(poses)))
    assert domain_poses(paths, 60, seed=3) == poses
    assert domain_poses(paths, 60, seed=4) != poses


def test_generated_path_starts_at_the_own_view_and_depends_on_the_seed(tmp_path: Path) -> None:
    scene = box_room(tmp_path)
    paths = make(scene)
    np.testing.assert_allclose(paths.train[0].to_world, scene.camera.to_world, atol=1e-9)
    assert make(scene).train == paths.train
    assert make(scene, seed=1).test != paths.test


def test_path_beside_a_wall_keeps_its_free_side(tmp_path: Path) -> None:
    scene = box_room(tmp_path, origin="0.99,0,0.5")
    paths = make(scene)
    place = positions(paths.train + paths.test)
    assert np.abs(place).max() < 1, "no pose crosses the wall"
    extent = np.ptp(positions(make(box_room(tmp_path)).train)[:, 0])
    assert 0.4 * extent < np.ptp(place[:, 0]) < 0.6 * extent


def test_mirrored_view_stays_mirrored(tmp_path: Path) -> None:
    scene = box_room(tmp_path)
    flipped = Camera(scene.camera.to_world @ np.diag([-1.0, 1, 1, 1]), 50, 32, 32)
    object.__setattr__(scene, "camera", flipped)
    paths = make(scene)
    np.testing.assert_allclose(paths.train[0].to_world, flipped.to_world, atol=1e-9)
    assert all(np.linalg.det(camera.to_world) < 0 for camera in paths.train + paths.test)


def test_spline_passes_through_its_keyframes() -> None:
    keyframes = [Camera.look_at([x, 0, 3], [0, 0, 0], [0, 1, 0], 40 + x, 8, 8) for x in (-1.0, 0.0, 1.0)]
    ends = spline(keyframes, np.array([0.0, 0.5, 1.0]))
    for camera, keyframe in zip(ends, keyframes, strict=True):
        np.testing.assert_allclose(camera.to_world, keyframe.to_world, atol=1e-9)
        assert camera.fov_deg == pytest.approx(keyframe.fov_deg)


def test_clearance_in_a_cube_is_known(tmp_path: Path) -> None:
    scene = box_room(tmp_path)
    found = clearance(scene, np.array([[0.0, 0, 0], [0.9, 0, 0]]))
    assert 1.0 <= found[0] < 1.05 and 0.1 <= found[1] < 0.11
    assert reachable(scene, np.zeros(3), np.array([[0.9, 0, 0], [1.1, 0, 0]])).tolist() == [True, False]


@pytest.mark.parametrize("counts", [(0, 1, 1), (1, -1, 1), (1, 0, -1)])
def test_paths_refuse_bad_counts(tmp_path: Path, counts: tuple[int, int, int]) -> None:
    with pytest.raises(CameraError, match="at least 1 training"):
        make(box_room(tmp_path), 0, *counts)


def test_smallest_paths_work() -> None:
    scene = load_scene("tiny", width=8, height=8)
    paths = make(scene, 0, 1, 0, 0)
    assert len(paths.train) == 1 and paths.test == []
    assert len(domain_poses(paths, 3, 0)) == 3
    with pytest.raises(CameraError):
        domain_poses(paths, 0, 0)
