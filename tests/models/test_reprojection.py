"""Reprojection: the projection by hand, and a textured plane with a card in front seen by two cameras."""

import math

import numpy as np
import pytest

from models.errors import ShapeError
from models.reprojection import project, reproject, sample_bilinear

HEIGHT, WIDTH, FOV_DEG = 40, 60, 60.0
FOCAL_PX = 0.5 * WIDTH / math.tan(math.radians(FOV_DEG) / 2.0)
PLANE_Z, CARD_Z = 5.0, 2.5


def camera(x: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Camera-to-world at (x, 0, 0), turned about Y."""
    to_world = np.eye(4)
    to_world[:3, :3] = [[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]]
    to_world[0, 3] = x
    return to_world


def trace(to_world: np.ndarray, *, card: bool = False) -> np.ndarray:
    """Positions seen through every pixel centre: the plane z = 5, and a card z = 2.5, |x| < 0.5 before it."""
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    local = np.stack(((0.5 * WIDTH - column) / FOCAL_PX, (0.5 * HEIGHT - row) / FOCAL_PX, np.ones_like(row)), -1)
    direction, eye = local @ to_world[:3, :3].T, to_world[:3, 3]
    plane = eye + direction * ((PLANE_Z - eye[2]) / direction[..., 2:])
    near = eye + direction * ((CARD_Z - eye[2]) / direction[..., 2:])
    return np.where(card & (np.abs(near[..., :1]) < 0.5), near, plane)


def shade(position: np.ndarray) -> np.ndarray:
    """A view-independent colour that is smooth over the plane and different on the card."""
    x, y, z = np.moveaxis(position, -1, 0)
    return np.stack((np.sin(x), np.cos(0.7 * y), z), axis=-1).astype(np.float32)


def test_projection_puts_x_left_y_up_and_spans_the_width() -> None:
    edge = math.tan(math.radians(FOV_DEG) / 2.0)
    position = np.tile([0.0, 0.0, 1.0], (HEIGHT, WIDTH, 1))
    position[0, :3] = [[edge, 0.0, 1.0], [0.0, edge * HEIGHT / WIDTH, 1.0], [0.0, 0.0, -1.0]]
    x_px, y_px, depth = project(position, np.eye(4), FOV_DEG)
    assert x_px[0, 0] == pytest.approx(-0.5)
    assert y_px[0, 1] == pytest.approx(-0.5)
    assert np.isnan(depth[0, 2])
    assert (x_px[5, 5], y_px[5, 5], depth[5, 5]) == pytest.approx((WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5, 1.0))


@pytest.mark.parametrize("to_world", [camera(), camera(1.3, 0.2), camera(-2.0, -0.4)])
def test_projection_of_traced_positions_is_their_own_pixel(to_world: np.ndarray) -> None:
    x_px, y_px, _ = project(trace(to_world), to_world, FOV_DEG)
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    assert np.allclose(x_px, column, atol=1e-9)
    assert np.allclose(y_px, row, atol=1e-9)


def test_a_still_camera_warps_to_the_same_image() -> None:
    position = trace(camera(), card=True)
    warped, valid = reproject(shade(position), position, position, camera(), FOV_DEG)
    assert valid[1:-1, 1:-1].all()  # rounding may put the outermost centres just outside
    assert np.allclose(warped[valid], shade(position)[valid], atol=1e-5)


def test_a_moving_camera_finds_the_same_surface_points() -> None:
    before, now = camera(0.2, 0.03), camera()
    position, previous = trace(now), trace(before)
    warped, valid = reproject(shade(previous), position, previous, before, FOV_DEG)
    assert valid.mean() > 0.8
    assert not valid.all()
    assert np.allclose(warped[valid], shade(position)[valid], atol=5e-3)
    assert (warped[~valid] == 0.0).all()


def test_disoccluded_pixels_are_invalid() -> None:
    before, now = camera(0.3), camera()
    position, previous = trace(now, card=True), trace(before, card=True)
    warped, valid = reproject(shade(previous), position, previous, before, FOV_DEG)
    # Of the plane, the previous camera missed what the card hid: x in [-1.3, 0.7] seen from x = 0.3.
    on_plane = position[..., 2] > 4.0
    hidden = on_plane & (np.abs(position[..., 0] + 0.3) < 0.95)
    assert hidden.sum() > 50
    assert not valid[hidden].any()
    assert valid[on_plane & (np.abs(position[..., 0] + 0.3) > 1.2) & (np.abs(position[..., 0]) < 2.4)].mean() > 0.9
    assert np.allclose(warped[valid][:, 2], position[valid][:, 2], atol=0.06)


def test_background_and_masked_pixels_are_invalid() -> None:
    position = trace(camera())
    position[3:6, 4:8] = np.nan
    position[10, 10] = np.inf
    surface = np.ones((HEIGHT, WIDTH), dtype=bool)
    surface[20:] = False
    warped, valid = reproject(shade(trace(camera())), position, trace(camera()), camera(), FOV_DEG, surface=surface)
    assert not valid[3:6, 4:8].any()
    assert not valid[10, 10]
    assert not valid[20:].any()
    assert valid[12:19, 12:-1].all()
    assert np.isfinite(warped).all()


def test_bilinear_is_exact_for_a_ramp_up_to_the_edges() -> None:
    row, column = np.mgrid[:5, :7].astype(float)
    ramp = (2.0 * column - 3.0 * row)[..., None]
    x, y = np.array([0.0, 2.25, 6.0]), np.array([4.0, 0.5, 0.0])
    assert sample_bilinear(ramp, x, y)[:, 0] == pytest.approx(2.0 * x - 3.0 * y)
    assert sample_bilinear(ramp[:1, :1], np.zeros(1), np.zeros(1)) == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("shapes", "matrix"),
    [
        (((4, 5, 3), (4, 6, 3), (4, 5, 3)), np.eye(4)),
        (((4, 5), (4, 5, 3), (4, 5, 3)), np.eye(4)),
        (((4, 5, 3), (4, 5, 3), (4, 5, 3)), np.eye(3)),
    ],
)
def test_reprojection_refuses_other_shapes(shapes: tuple, matrix: np.ndarray) -> None:
    with pytest.raises(ShapeError, match="must be"):
        reproject(*(np.ones(shape) for shape in shapes), matrix, FOV_DEG)
