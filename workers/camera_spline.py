"""Smooth paths through given cameras."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from workers.camera import Camera

Floats = NDArray[np.float64]


def spline(keyframes: list[Camera], times: Floats) -> list[Camera]:
    """Smooth poses through keyframes: monotone cubic positions, C2 rotations; `times` in [0, 1]."""
    places = positions(keyframes)
    mirror = np.diag([np.sign(np.linalg.det(keyframes[0].to_world[:3, :3])), 1.0, 1.0])
    rotations = Rotation.from_matrix(np.stack([camera.to_world[:3, :3] @ mirror for camera in keyframes]))
    turned = (rotations[1:] * rotations[:-1].inv()).magnitude()
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1)
    length = moved / max(moved.max(), 1e-12) + turned + 1e-3
    knots = np.concatenate([[0.0], np.cumsum(length)]) / length.sum()
    place = PchipInterpolator(knots, places)(times)
    turn = RotationSpline(knots, rotations)(times).as_matrix() if len(times) else np.empty((0, 3, 3))
    fov_deg = np.interp(times, knots, [camera.fov_deg for camera in keyframes])
    cameras = []
    for index in range(len(times)):
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = turn[index] @ mirror, place[index]
        cameras.append(Camera(to_world, float(fov_deg[index]), keyframes[0].width, keyframes[0].height))
    return cameras


def positions(cameras: list[Camera]) -> Floats:
    """[cameras, 3] float64 origins, scene units."""
    return np.array([camera.origin for camera in cameras], dtype=np.float64).reshape(-1, 3)
