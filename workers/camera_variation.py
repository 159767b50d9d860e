"""Moves all views of a scene by one random offset, as far as surfaces allow."""

import dataclasses

import numpy as np

from workers.camera import Camera
from workers.camera_clearance import clearance, median_hit_distance, reachable
from workers.scene import Scene
from workers.variation import Variation

_REACH = np.array([1.0, 0.5, 0.5])  # along the view's left, up and forward
_NEAREST = 0.025  # closest surface that a view may have, of the median hit distance
_SHRINK, _MAX_SHRINKS = 0.75, 16


def vary_cameras(scene: Scene, variation: Variation) -> Scene:
    """The scene with its view and its keyframes moved; each still looks at the same point ahead of it.

    Offsets are drawn in the scene's own view and shrink until every view stands clear of surfaces and can be reached
    from where it stood; where none does, the views stay and a note says so.
    """
    if variation.camera == 0:
        return scene
    distance, _ = median_hit_distance(scene, scene.camera)
    views = [scene.camera, *scene.keyframes, *scene.test_keyframes]
    rng = variation.random("camera")
    for shrinks in range(_MAX_SHRINKS):
        direction = rng.normal(size=3)
        local = direction / np.linalg.norm(direction) * _REACH * variation.camera * distance * _SHRINK**shrinks
        offset = local @ scene.camera.to_world[:3, :3].T
        moved = [_moved(view, offset, distance) for view in views]
        if _clear(scene, views, moved, distance):
            count = len(scene.keyframes)
            return dataclasses.replace(
                scene, camera=moved[0], keyframes=tuple(moved[1 : 1 + count]), test_keyframes=tuple(moved[1 + count :])
            )
    return dataclasses.replace(scene, notes=(*scene.notes, "the views could not be moved: surfaces are too close"))


def _moved(view: Camera, offset: np.ndarray, distance: float) -> Camera:
    target = view.origin + distance * view.forward
    turned = Camera.look_at(view.origin + offset, target, view.up, view.fov_deg, view.width, view.height)
    mirror = np.diag([np.sign(np.linalg.det(view.to_world[:3, :3])), 1.0, 1.0, 1.0])
    return Camera(turned.to_world @ mirror, view.fov_deg, view.width, view.height)


def _clear(scene: Scene, views: list[Camera], moved: list[Camera], distance: float) -> bool:
    origins = np.array([view.origin for view in moved])
    # A view that stood close to a surface already may stay as close.
    before = clearance(scene, np.array([view.origin for view in views]))
    needed = np.minimum(_NEAREST * distance, 0.5 * before)
    if not (clearance(scene, origins) >= needed).all():
        return False
    pairs = zip(views, origins, strict=True)
    return all(bool(reachable(scene, view.origin, origin[None]).all()) for view, origin in pairs)
