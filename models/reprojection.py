"""Exact motion of a static scene between two cameras: where a surface point was in the previous frame."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from models.errors import ShapeError

Array = NDArray[np.floating]

DEFAULT_TOLERANCE = 0.01
"""Seen before: the previous frame saw a point this close, relative to the distance to its camera."""


def reproject(
    previous_image: Array,
    position_world: Array,
    previous_position_world: Array,
    previous_to_world: Array,
    previous_fov_deg: float,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    surface: NDArray[np.bool_] | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Warps the previous frame into the current one by the world positions of the pixels.

    Bilinear. Disocclusions are found by comparing positions. It cannot follow moving objects, reflections or
    the background, and at the silhouettes of the previous frame it declares pixels invalid rather than blend
    two surfaces.

    Args:
        previous_image: HxWxC, any quantity of the previous frame.
        position_world: HxWx3 world positions of the current frame's pixel centres; non-finite where no
            surface is.
        previous_position_world: HxWx3, of the previous frame.
        previous_to_world: 4x4 row-major camera-to-world of the previous frame; the camera looks along +Z, +X
            is image left, +Y up.
        previous_fov_deg: Horizontal field of view of the previous camera in degrees.
        tolerance: Largest distance between a point and what the previous frame saw there, relative to the
            distance to its camera.
        surface: HxW, False where the current frame sees no surface; None: everywhere that the position is
            finite.

    Returns:
        The warped image HxWxC (0 where invalid, dtype of `previous_image`) and HxW validity.

    Raises:
        ShapeError: Images of different sizes or a matrix that is not 4x4.
    """
    _check(previous_image, position_world, previous_position_world, previous_to_world)
    x_px, y_px, depth = project(position_world, previous_to_world, previous_fov_deg)
    height, width = previous_image.shape[:2]
    valid = (depth > 0.0) & (x_px >= 0.0) & (x_px <= width - 1) & (y_px >= 0.0) & (y_px <= height - 1)
    if surface is not None:
        valid &= surface
    x_px, y_px = np.where(valid, x_px, 0.0), np.where(valid, y_px, 0.0)

    seen = sample_bilinear(previous_position_world.astype(np.float64), x_px, y_px)
    eye = np.asarray(previous_to_world, dtype=np.float64)[:3, 3]
    miss = np.linalg.norm(seen - position_world, axis=-1)
    valid &= miss <= tolerance * np.linalg.norm(position_world - eye, axis=-1)  # False for NaN: unseen or background

    warped = sample_bilinear(previous_image, x_px, y_px)
    return np.where(valid[..., None], warped, 0.0).astype(previous_image.dtype), valid


def project(position_world: Array, to_world: Array, fov_deg: float) -> tuple[Array, Array, Array]:
    """Pinhole projection of an image of world positions into a camera whose image has the same size.

    Args:
        position_world: HxWx3.
        to_world: 4x4 camera-to-world, as in `reproject`.
        fov_deg: Horizontal field of view in degrees.

    Returns:
        Column and row in pixels (0 at the centre of the first) and depth along the view axis, HxW float64
        each. NaN where the position is not finite or the depth not above 0.
    """
    height, width = position_world.shape[:2]
    to_local = np.linalg.inv(np.asarray(to_world, dtype=np.float64))
    position = np.where(np.isfinite(position_world).all(axis=-1, keepdims=True), position_world, np.nan)
    local = position.astype(np.float64) @ to_local[:3, :3].T + to_local[:3, 3]
    depth = np.where(local[..., 2] > 0.0, local[..., 2], np.nan)
    focal_px = 0.5 * width / math.tan(math.radians(fov_deg) / 2.0)
    x_px = 0.5 * width - focal_px * local[..., 0] / depth - 0.5
    y_px = 0.5 * height - focal_px * local[..., 1] / depth - 0.5
    return x_px, y_px, depth


def sample_bilinear(image: Array, x_px: Array, y_px: Array) -> Array:
    """Bilinear lookups in an image.

    Args:
        image: HxWxC.
        x_px: Columns in [0, W-1], any shape; 0 is the centre of the first.
        y_px: Rows in [0, H-1], as x_px.

    Returns:
        The shape of x_px, then C; a non-finite neighbour makes the result non-finite.
    """
    height, width = image.shape[:2]
    x0 = np.clip(np.floor(x_px).astype(np.intp), 0, max(width - 2, 0))
    y0 = np.clip(np.floor(y_px).astype(np.intp), 0, max(height - 2, 0))
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    right, down = (x_px - x0)[..., None], (y_px - y0)[..., None]
    top = image[y0, x0] * (1.0 - right) + image[y0, x1] * right
    bottom = image[y1, x0] * (1.0 - right) + image[y1, x1] * right
    return top * (1.0 - down) + bottom * down


def _check(previous_image: Array, position: Array, previous_position: Array, to_world: Array) -> None:
    size = previous_image.shape[:2]
    if previous_image.ndim != 3 or position.shape != (*size, 3) or previous_position.shape != (*size, 3):
        raise ShapeError(
            "image and positions must be HxWxC, HxWx3 and HxWx3 of one size, "
            f"got {previous_image.shape}, {position.shape} and {previous_position.shape}"
        )
    if np.shape(to_world) != (4, 4):
        raise ShapeError(f"previous_to_world must be a 4x4 matrix, got shape {np.shape(to_world)}")
