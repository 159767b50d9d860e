"""Ray casts that tell whether a camera may stand somewhere: how far surfaces are, what is in the way."""

import numpy as np
from numpy.typing import NDArray

from workers.backend import mi
from workers.camera import Camera
from workers.scene import Scene

NUM_DIRECTIONS = 64
_VIEW_GRID = 32

Floats = NDArray[np.float64]


def hit_distances(scene: Scene, origins: Floats, directions: Floats) -> Floats:
    """[rays] distance to the first surface, scene units, inf where there is none; directions are unit
    vectors."""
    if len(origins) == 0:
        return np.empty(0)
    local = scene.frame.local_points(origins)
    ray = mi.Ray3f(mi.Point3f(local.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32)))
    distances = np.array(scene.mi_scene.ray_intersect_preliminary(ray).t, dtype=np.float64)
    return np.where(np.isfinite(distances) & (distances < 1e30), distances / scene.frame.scale, np.inf)


def clearance(scene: Scene, origins: Floats) -> Floats:
    """[poses] distance from each origin [poses, 3] to the nearest of `NUM_DIRECTIONS` hits (inf in the
    open)."""
    directions = _sphere_directions(NUM_DIRECTIONS)
    everywhere = np.tile(directions, (len(origins), 1))
    distances = hit_distances(scene, np.repeat(origins, NUM_DIRECTIONS, axis=0), everywhere)
    return distances.reshape(len(origins), NUM_DIRECTIONS).min(axis=1)


def reachable(scene: Scene, start: Floats, ends: Floats) -> NDArray[np.bool_]:
    """[poses] whether the straight segment from `start` [3] to each of `ends` [poses, 3] meets no surface."""
    offsets = np.asarray(ends) - start
    lengths = np.linalg.norm(offsets, axis=1)
    directions = offsets / np.maximum(lengths, 1e-30)[:, None]
    directions[lengths == 0] = [0, 0, 1]
    return hit_distances(scene, np.broadcast_to(start, directions.shape), directions) > lengths


def median_hit_distance(scene: Scene, camera: Camera) -> tuple[float, list[str]]:
    """Median distance of what the camera sees, scene units, with a note where it sees nothing."""
    half = np.tan(np.radians(camera.fov_deg) / 2)
    steps = (np.arange(_VIEW_GRID) + 0.5) / _VIEW_GRID * 2 - 1
    x, y = np.meshgrid(steps * half, steps * half * camera.height / camera.width)
    local = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    directions = (local / np.linalg.norm(local, axis=1, keepdims=True)) @ camera.to_world[:3, :3].T
    distances = hit_distances(scene, np.broadcast_to(camera.origin, directions.shape), directions)
    seen = distances[np.isfinite(distances)]
    if len(seen) == 0:
        fallback = 0.5 * scene.bounds_diagonal
        return fallback, [f"the scene's own view sees no surface: distances are taken to be {fallback:.3g}"]
    return float(np.median(seen)), []


def _sphere_directions(count: int) -> Floats:
    """[count, 3] unit vectors of a Fibonacci lattice."""
    index = np.arange(count)
    height = 1 - (2 * index + 1) / count
    around = np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(around), height, radius * np.sin(around)], axis=1)
