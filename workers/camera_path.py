"""Camera paths inside a scene: one to train and validate on, a disjoint one to test on.

Path A is a closed Lissajous curve around the scene's own view (or a spline through its keyframes); path B is
another curve in the same region that shares no pose with A. Generated curves keep looking at what the own
view looks at; a pose that ray casts find behind, inside or too close to a surface is drawn towards the own view.

The volume that caches are baked for is stated here, once: all poses within `CameraPaths.domain_radius` of a
pose of path A (nearer where a surface is nearer) and within `CameraPaths.domain_angle_deg` of its view
direction. Path B lies within it. A view from outside still renders, from caches that were never asked what it
sees.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from workers.camera import Camera
from workers.camera_clearance import clearance, median_hit_distance, reachable
from workers.camera_spline import positions, spline
from workers.errors import CameraError
from workers.scene import Scene

AMPLITUDE = (0.14, 0.07, 0.09)  # of the median hit distance, along the camera's left, up and forward
TARGET_AMPLITUDE = 0.03  # how far the point looked at wanders, of the median hit distance
CLEARANCE = 0.025  # closest surface, of the median hit distance
TEST_AMPLITUDE = 0.85  # of path A's: inside the region that A spans
KEYFRAME_TEST_AMPLITUDE = 0.04  # how far B strays from the spline of A, of the median hit distance
MIN_ROOM = 0.05  # of an axis' amplitude, however close a surface is
_SHRINK, _MAX_SHRINKS = 0.75, 16
_NUM_PHASES = 24
_MIN_DOMAIN_ANGLE_DEG = 2.0

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraPaths:
    """Views to train, validate and test on.

    Attributes:
        train: path A without its validation poses, in path order.
        validation: evenly spaced poses of path A.
        test: path B, in path order.
        domain_radius: radius about path A's poses that the caches answer for, scene units.
        domain_angle_deg: likewise for the view direction, degrees.
        free_radius: [train, then validation] float64, the distance from each pose of A to the nearest
            surface.
        notes: what had to be changed or was found, one line each.
    """

    train: list[Camera]
    validation: list[Camera]
    test: list[Camera]
    domain_radius: float
    domain_angle_deg: float
    free_radius: Floats
    notes: tuple[str, ...] = ()


def camera_paths(scene: Scene, *, num_train: int, num_validation: int, num_test: int, width: int, height: int,
                 seed: int) -> CameraPaths:  # fmt: skip
    """Two disjoint smooth paths through the scene.

    Args:
        scene: its camera and keyframes say where; at least two keyframes replace the generated path A.
        num_train: poses of path A to train on, at least 1. The scene's own view is on path A: it is the first
            training pose of a generated path.
        num_validation: poses of path A held out.
        num_test: poses of path B.
        width: image width in pixels.
        height: image height in pixels.
        seed: chooses the curves.

    Raises:
        CameraError: a negative count, or no training pose.
    """
    if num_train < 1 or num_validation < 0 or num_test < 0:
        raise CameraError(
            "camera paths must have at least 1 training pose and no negative count, got "
            f"{num_train} training, {num_validation} validation and {num_test} test poses"
        )
    base = scene.camera.resized(width, height)
    distance, notes = median_hit_distance(scene, base)
    num_path = num_train + num_validation
    rng = np.random.default_rng(seed)
    if len(scene.keyframes) >= 2:
        path, test, more = _keyframe_paths(scene, base, distance, num_path, num_test, rng)
    else:
        path, test, more = _generated_paths(scene, base, distance, num_path, num_test, rng)
    held_out = _interleaved(num_path, num_validation)
    train = [camera for index, camera in enumerate(path) if index not in held_out]
    validation = [path[index] for index in sorted(held_out)]
    radius, angle = _domain(train + validation, test, distance)
    return CameraPaths(
        train=train,
        validation=validation,
        test=test,
        domain_radius=radius,
        domain_angle_deg=angle,
        free_radius=clearance(scene, np.array([camera.origin for camera in train + validation])),
        notes=tuple([*notes, *more]),
    )


def domain_poses(paths: CameraPaths, count: int, seed: int) -> list[Camera]:
    """Poses that fill the volume the caches are baked for (see the module's text).

    Path A's own poses come first, evenly spaced, at most half of `count`; the rest are drawn uniformly from
    the balls about them, each ball cut at 0.9 of the distance to the nearest surface, with the view turned
    within the domain's angle.

    Raises:
        CameraError: `count` is below 1.
    """
    if count < 1:
        raise CameraError(f"number of domain poses must be at least 1, got {count}")
    rng = np.random.default_rng(seed)
    cameras = paths.train + paths.validation
    num_own = min((count + 1) // 2, len(cameras))
    own = [cameras[index] for index in np.linspace(0, len(cameras) - 1, num_own).round().astype(int)]
    return own + [_jittered(paths, cameras, rng) for _ in range(count - num_own)]


def _jittered(paths: CameraPaths, cameras: list[Camera], rng: np.random.Generator) -> Camera:
    index = int(rng.integers(len(cameras)))
    camera = cameras[index]
    direction = rng.normal(size=3)
    radius = min(paths.domain_radius, 0.9 * float(paths.free_radius[index])) * rng.random() ** (1 / 3)
    axis = rng.normal(size=3)
    angle = np.radians(paths.domain_angle_deg) * rng.random() ** 0.5
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    to_world = camera.to_world.copy()
    to_world[:3, :3] = turn @ to_world[:3, :3]
    to_world[:3, 3] += radius * direction / np.linalg.norm(direction)
    return Camera(to_world, camera.fov_deg, camera.width, camera.height)


def _interleaved(num_path: int, num_held_out: int) -> set[int]:
    """Evenly spaced indices of a path, never the first one."""
    step = num_path / max(num_held_out, 1)
    return {max(1, int((index + 0.5) * step)) for index in range(num_held_out)}


def _generated_paths(scene: Scene, base: Camera, distance: float, num_path: int, num_test: int,
                     rng: np.random.Generator) -> tuple[list[Camera], list[Camera], list[str]]:  # fmt: skip
    """Lissajous curves about the scene's own view, drawn towards it where surfaces are in the way."""
    margin = min(CLEARANCE * distance, 0.5 * float(clearance(scene, base.origin[None])[0]))
    room = _axis_room(scene, base, distance, margin)
    amplitude = np.array(AMPLITUDE) * distance
    signs, wobble = rng.choice([-1.0, 1.0], size=3), rng.uniform(0, 2 * np.pi, size=2)
    phases = rng.uniform(0, 2 * np.pi, size=(_NUM_PHASES, 3))
    around_path = np.linspace(0, 2 * np.pi, num_path, endpoint=False)
    curve = _fitted(_curve_a(around_path, signs), room) * amplitude
    path = _cleared(scene, base, distance, margin, curve, _target_curve(around_path, np.zeros(2)))
    test = _test_path(scene, base, distance, margin, amplitude, room, path, num_test, phases, wobble)
    reach = float(np.linalg.norm(positions(path) - base.origin, axis=1).max()) / distance
    notes: list[str] = []
    if reach < 0.5 * max(AMPLITUDE):
        notes.append(f"camera path shrunk to {reach:.1%} of the median distance: surfaces are close to the view")
    return path, test, notes


def _cleared(scene: Scene, base: Camera, distance: float, margin: float, offset: Floats,
             wander: Floats) -> list[Camera]:  # fmt: skip
    """`_aimed`, each pose drawn towards the own view until no surface is closer than `margin` or in between."""
    scale = np.ones((len(offset), 1))
    for shrinks in range(_MAX_SHRINKS + 1):
        cameras = _aimed(base, distance, offset * scale, wander)
        origins = positions(cameras)
        blocked = ~reachable(scene, base.origin, origins) | (clearance(scene, origins) < margin)
        if not blocked.any():
            break
        scale[blocked] *= _SHRINK if shrinks < _MAX_SHRINKS - 1 else 0.0
    return cameras


def _axis_room(scene: Scene, base: Camera, distance: float, margin: float) -> Floats:
    """[2, 3] factors in [0, 1]: how much of each axis' amplitude is free on its negative and positive side.

    The sides are measured apart: a camera with its back to a wall still moves away from it.
    """
    axes = base.to_world[:3, :3].T
    reach = np.array(AMPLITUDE) * distance + margin
    signs = np.array([-1.0, 1.0])[:, None]
    room = np.ones((2, 3))
    for factor in np.linspace(1.0, 0.0, 9):
        ends = (signs * room * reach)[:, :, None] * axes[None]
        blocked = ~reachable(scene, base.origin, base.origin + ends.reshape(6, 3)).reshape(2, 3)
        if not blocked.any():
            break
        room[blocked] = factor
    return np.maximum(room, MIN_ROOM)


def _fitted(curve: Floats, room: Floats) -> Floats:
    """A curve in units of the amplitude, each side of each axis scaled to its room [2, 3]; 0 stays where it is."""
    return curve * np.where(curve < 0, room[0], room[1])


def _curve_a(angle: Floats, signs: Floats) -> Floats:
    """[poses, 3] in units of the amplitude; 0 (the own view) at angle 0."""
    return signs * np.stack([np.sin(angle), np.sin(2 * angle), np.sin(3 * angle)], axis=1)


def _curve_b(angle: Floats, phases: Floats) -> Floats:
    return TEST_AMPLITUDE * np.stack(
        [np.cos(angle + phases[0]), np.cos(3 * angle + phases[1]), np.cos(2 * angle + phases[2])], axis=1
    )


def _target_curve(angle: Floats, phases: Floats) -> Floats:
    """[poses, 3] where the point looked at wanders, in units of its amplitude: left and up only."""
    start = np.stack([np.sin(phases[0]), np.sin(phases[1]), 0.0])
    return np.stack([np.sin(2 * angle + phases[0]), np.sin(angle + phases[1]), 0 * angle], axis=1) - 0.5 * start


def _test_path(scene: Scene, base: Camera, distance: float, margin: float, amplitude: Floats, room: Floats,
               path: list[Camera], num_test: int, phases: Floats, wobble: Floats) -> list[Camera]:  # fmt: skip
    """Of some curves, the one that stays farthest from path A."""
    if num_test == 0:
        return []
    angle = np.linspace(0, 2 * np.pi, num_test, endpoint=False)
    curves = [_fitted(_curve_b(angle, phase), room) * amplitude for phase in phases]
    known = positions(path) - base.origin
    axes = base.to_world[:3, :3]
    gaps = [np.linalg.norm((curve @ axes.T)[:, None] - known[None], axis=-1).min() for curve in curves]
    return _cleared(scene, base, distance, margin, curves[int(np.argmax(gaps))], _target_curve(angle, wobble))


def _aimed(base: Camera, distance: float, offset: Floats, wander: Floats) -> list[Camera]:
    """Cameras moved by `offset` in the base's axes, looking at a point `distance` ahead of the base that
    wanders."""
    axes = base.to_world[:3, :3]
    origins = base.origin + offset @ axes.T
    targets = base.origin + distance * base.forward + (TARGET_AMPLITUDE * distance * wander) @ axes.T
    mirror = np.diag([np.sign(np.linalg.det(axes)), 1.0, 1.0, 1.0])
    cameras = []
    for origin, target in zip(origins, targets, strict=True):
        upright = Camera.look_at(origin, target, base.up, base.fov_deg, base.width, base.height)
        cameras.append(Camera(upright.to_world @ mirror, base.fov_deg, base.width, base.height))
    return cameras


def _keyframe_paths(scene: Scene, base: Camera, distance: float, num_path: int, num_test: int,
                    rng: np.random.Generator) -> tuple[list[Camera], list[Camera], list[str]]:  # fmt: skip
    """Splines through the keyframes; the scene's own view is path A's first pose."""
    keyframes = [camera.resized(base.width, base.height) for camera in scene.keyframes]
    path = spline(keyframes, np.linspace(0, 1, num_path) if num_path > 1 else np.array([0.5]))
    notes = []
    if np.linalg.norm(positions(path) - base.origin, axis=1).min() > CLEARANCE * distance:
        path[0] = base
        notes.append("the scene's own view is not on the keyframe path: it is the first training pose")
    if len(scene.test_keyframes) >= 2:
        given = [camera.resized(base.width, base.height) for camera in scene.test_keyframes]
        test = spline(given, np.linspace(0, 1, num_test))
    else:
        test = _strayed(scene, keyframes, distance, num_test, rng)
    margin = CLEARANCE * distance
    close = int((clearance(scene, positions(path + test)) < margin).sum())
    if close:
        notes.append(f"{close} of {num_path + num_test} poses are closer than {margin:.3g} to a surface")
    return path, test, notes


def _strayed(scene: Scene, keyframes: list[Camera], distance: float, num_test: int,
             rng: np.random.Generator) -> list[Camera]:  # fmt: skip
    """The keyframes' spline between A's samples, moved off it as far as surfaces allow."""
    times = (np.arange(num_test) + 0.5) / max(num_test, 1)
    along = spline(keyframes, times)
    stray = KEYFRAME_TEST_AMPLITUDE * distance * _curve_b(2 * np.pi * times, rng.uniform(0, 2 * np.pi, size=3))
    if not along:
        return along
    room = np.clip(clearance(scene, positions(along)) - CLEARANCE * distance, 0, None).min()
    stray *= min(1.0, 0.9 * float(room) / max(float(np.linalg.norm(stray, axis=1).max()), 1e-12))
    moved = []
    for camera, offset in zip(along, stray, strict=True):
        to_world = camera.to_world.copy()
        to_world[:3, 3] += to_world[:3, :3] @ offset
        moved.append(Camera(to_world, camera.fov_deg, camera.width, camera.height))
    return moved


def _domain(path: list[Camera], test: list[Camera], distance: float) -> tuple[float, float]:
    """Smallest ball and cone about path A's poses that hold path B, with a tenth to spare."""
    radius, angle = CLEARANCE * distance, _MIN_DOMAIN_ANGLE_DEG
    known, forward = positions(path), np.array([camera.forward for camera in path])
    for camera in test:
        gaps = np.linalg.norm(known - camera.origin, axis=1)
        nearest = int(np.argmin(gaps))
        radius = max(radius, 1.1 * float(gaps[nearest]))
        cosine = float(np.clip(forward[nearest] @ camera.forward, -1, 1))
        angle = max(angle, 1.1 * float(np.degrees(np.arccos(cosine))))
    return radius, angle
