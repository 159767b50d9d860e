"""Frame requests: which are valid, and which camera they mean."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from service.errors import FrameTooLargeError
from service.schemas import FrameRequest
from workers.camera import Camera
from workers.errors import CameraError

LOOK_AT = {"origin": [0.0, 1.0, 5.0], "target": [0.0, 1.0, 0.0], "up": [0.0, 1.0, 0.0]}


def request(camera: Any = None, **values: Any) -> FrameRequest:
    return FrameRequest.model_validate({"camera": {"look_at": LOOK_AT} if camera is None else camera, **values})


def test_look_at_and_its_matrix_mean_the_same_camera() -> None:
    camera = request(fov_deg=60, width=32, height=20).to_camera()
    matrix = [
        [-1, 0, 0, 0],
        [0, 1, 0, 1],
        [0, 0, -1, 5],
        [0, 0, 0, 1],
    ]  # looks along -Z: the image's left is -X
    np.testing.assert_allclose(camera.to_world, matrix, atol=1e-12)
    assert request({"to_world": matrix}, fov_deg=60, width=32, height=20).to_camera() == camera
    assert camera == Camera(np.array(matrix, float), 60.0, 32, 20)


def test_the_example_of_the_documentation_is_a_camera() -> None:
    (example,) = FrameRequest.model_json_schema()["examples"]
    assert FrameRequest.model_validate(example).to_camera().width == 640


def test_lens_and_size_have_defaults() -> None:
    camera = request().to_camera()
    assert (camera.fov_deg, camera.width, camera.height) == (45.0, 640, 360)


@pytest.mark.parametrize(
    "camera",
    [
        {},
        {"look_at": LOOK_AT, "to_world": np.eye(4).tolist()},
        {"look_at": LOOK_AT, "fov_deg": 45},
        {"look_at": {**LOOK_AT, "origin": [0, 1]}},
        {"look_at": {**LOOK_AT, "origin": [0, 1, float("nan")]}},
        {"look_at": {**LOOK_AT, "origin": [0, 1, 1e300]}},
        {"to_world": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, float("inf")], [0, 0, 0, 1]]},
    ],
)
def test_poses_that_are_none_are_refused(camera: dict) -> None:
    with pytest.raises(ValidationError):
        request(camera)


@pytest.mark.parametrize(
    "values",
    [{"fov_deg": 0}, {"fov_deg": 180}, {"fov_deg": float("nan")}, {"width": 0}, {"height": -5},
     {"width": 1.5}, {"width": "64"}, {"width": True}, {"height": 16385}, {"spp": 4}],
)  # fmt: skip
def test_values_outside_their_range_are_refused(values: dict) -> None:
    with pytest.raises(ValidationError):
        request(**values)


@pytest.mark.parametrize(
    "camera",
    [
        {"look_at": {**LOOK_AT, "target": LOOK_AT["origin"]}},
        {"look_at": {**LOOK_AT, "up": [0, 0, 1]}},
        {"look_at": {**LOOK_AT, "up": [0, 0, 0]}},
        {"to_world": (2 * np.eye(4)).tolist()},
        {"to_world": np.diag([2.0, 1, 1, 1]).tolist()},
    ],
)
def test_degenerate_poses_are_camera_errors(camera: dict) -> None:
    with pytest.raises(CameraError):
        request(camera).to_camera()


def test_pixels_are_limited_at_exactly_the_bound() -> None:
    assert request(width=10, height=10).to_camera(max_pixels=100).width == 10
    with pytest.raises(FrameTooLargeError, match="at most 99 pixels, got 10x10"):
        request(width=10, height=10).to_camera(max_pixels=99)
