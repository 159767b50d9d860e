"""Camera: conventions against Mitsuba's own, round trips, refused values."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workers.backend import mi
from workers.camera import Camera
from workers.errors import CameraError

UP = [0.0, 1.0, 0.0]
coordinate = st.floats(-50, 50)


def view(width: int = 64, height: int = 32, fov_deg: float = 60.0) -> Camera:
    return Camera.look_at([1, 2, 3], [-2, 0.5, -4], UP, fov_deg, width, height)


def test_look_at_agrees_with_mitsuba() -> None:
    expected = mi.ScalarTransform4f().look_at([1, 2, 3], [-2, 0.5, -4], UP).matrix
    np.testing.assert_allclose(view().to_world, np.array(expected), atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.tuples(coordinate, coordinate, coordinate), st.tuples(coordinate, coordinate, coordinate))
def test_look_at_is_a_rotation_that_faces_its_target(origin: tuple, offset: tuple) -> None:
    offset = np.array(offset)
    if np.linalg.norm(offset) < 1e-3 or np.linalg.norm(np.cross(offset, UP)) < 1e-3 * np.linalg.norm(offset):
        return
    camera = Camera.look_at(origin, np.array(origin) + offset, UP, 40, 8, 8)
    rotation = camera.to_world[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(camera.forward, offset / np.linalg.norm(offset), atol=1e-6)


def test_json_round_trip_is_exact() -> None:
    camera = view()
    again = Camera.from_json(camera.to_json())
    assert again == camera and hash(again) == hash(camera)
    assert camera.resized(8, 8) != camera


def test_world_to_camera_puts_the_target_ahead() -> None:
    local = view().world_to_camera @ [-2, 0.5, -4, 1]
    np.testing.assert_allclose(local[:2], 0, atol=1e-12)
    assert local[2] == pytest.approx(np.linalg.norm([3, 1.5, 7]))


def test_resized_keeps_the_horizontal_field_of_view() -> None:
    camera = view(fov_deg=90.0).resized(200, 100)
    assert camera.fov_deg == 90.0
    assert camera.fov_y_deg == pytest.approx(np.degrees(2 * np.arctan(0.5)))


def test_pose_is_read_only() -> None:
    with pytest.raises(ValueError, match="read-only"):
        view().to_world[0, 0] = 5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fov_deg": 0.0}, "fov_deg"),
        ({"fov_deg": 180.0}, "fov_deg"),
        ({"fov_deg": float("nan")}, "fov_deg"),
        ({"fov_deg": "wide"}, "fov_deg"),
        ({"width": 0}, "width"),
        ({"height": 1.5}, "height"),
        ({"width": True}, "width"),
        ({"width": 2_000_000, "height": 2_000_000}, "memory"),
        ({"to_world": np.diag([2.0, 2, 2, 1])}, "orthonormal"),
        ({"to_world": np.full((4, 4), np.inf)}, "finite"),
        ({"to_world": np.eye(3)}, "4x4"),
        ({"to_world": np.ones((4, 4))}, "row 0 0 0 1"),
    ],
)
def test_camera_refuses(change: dict, message: str) -> None:
    with pytest.raises(CameraError, match=message):
        Camera(**{"to_world": np.eye(4), "fov_deg": 45.0, "width": 8, "height": 8, **change})


@pytest.mark.parametrize("pose", [([0, 0, 0], [0, 0, 0], UP), ([0, 0, 0], [0, 1, 0], UP), ([0, 0], [0, 0, 1], UP)])
def test_look_at_refuses_poses_without_a_direction(pose: tuple) -> None:
    with pytest.raises(CameraError):
        Camera.look_at(*pose, 45, 8, 8)


def test_from_json_names_the_keys() -> None:
    with pytest.raises(CameraError, match="fov_deg"):
        Camera.from_json({"to_world": np.eye(4).tolist()})
