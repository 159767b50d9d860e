"""The frame that a scene is computed in: the file's own, unless its size or its place defeats single precision.

Mitsuba starts secondary rays at an offset of (1 + max |p|) * 8.9e-5 from a surface, whatever the size of the scene.
That is nothing in a room of a few metres near the origin. A scene a micrometre across is jumped over by it, and one
that lies a thousand rooms away loses its contacts. Measured on one box, path tracing against the same scene at unit
size near the origin: mean error 1.2 % at a scale of 1e-3 and at an offset of 1e3, 14 % at 1e-6 and at 1e6.

Such a scene is built as `scale * (p - origin)` and everything outside of Mitsuba stays in the file's units: cameras
go in by `local_camera`, distances come back divided by `scale`. Scenes that are large need nothing: the offset grows
with them. The scale is a power of two, so it rounds nothing.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from workers.backend import mi
from workers.camera import Camera
from workers.scene_nodes import nodes_of

SMALLEST_DIAGONAL = 0.5  # scene units; below, the scene is enlarged to a diagonal between 1 and 2
FARTHEST_DIAGONALS = 4.0  # of the box's centre from the origin, in diagonals; beyond, the scene is moved there
_POSITIONAL_EMITTERS = ("point", "spot", "projector")

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class WorldFrame:
    """local = scale * (file - origin).

    Attributes:
        origin: the file's point that is the local origin, scene units.
        scale: local units in one scene unit, a power of two, at least 1.
    """

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    @classmethod
    def of_box(cls, low: ArrayLike, high: ArrayLike) -> "WorldFrame":
        """The frame that suits a bounding box: the file's own wherever that is precise enough."""
        low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            return OWN
        diagonal, centre = float(np.linalg.norm(high - low)), (low + high) / 2
        scale = 2.0 ** np.ceil(-np.log2(diagonal)) if 0.0 < diagonal < SMALLEST_DIAGONAL else 1.0
        is_far = np.abs(centre).max() > FARTHEST_DIAGONALS * max(diagonal, SMALLEST_DIAGONAL / scale)
        x, y, z = (float(value) for value in (centre if is_far else np.zeros(3)))
        return cls((x, y, z), float(scale))

    def then(self, further: "WorldFrame") -> "WorldFrame":
        """This frame, then another that is stated in this one's local units."""
        x, y, z = (float(value) for value in self.file_points(further.origin))
        return WorldFrame((x, y, z), self.scale * further.scale)

    @property
    def is_own(self) -> bool:
        """Whether it is the file's own frame."""
        return self == OWN

    @property
    def matrix(self) -> Floats:
        """[4, 4] from the file's frame to the local one."""
        matrix = np.diag([self.scale, self.scale, self.scale, 1.0])
        matrix[:3, 3] = -self.scale * np.array(self.origin)
        return matrix

    def local_points(self, points: ArrayLike) -> Floats:
        """[..., 3] points of the file's frame in the local one."""
        return (np.asarray(points, dtype=np.float64) - self.origin) * self.scale

    def file_points(self, points: ArrayLike) -> Floats:
        """[..., 3] inverse of `local_points`."""
        return np.asarray(points, dtype=np.float64) / self.scale + self.origin

    def local_camera(self, camera: Camera) -> Camera:
        """A camera of the file's frame in the local one."""
        return self._placed(camera, self.local_points(camera.origin))

    def file_camera(self, camera: Camera) -> Camera:
        """Inverse of `local_camera`."""
        return self._placed(camera, self.file_points(camera.origin))

    def near_camera(self, camera: Camera) -> Camera:
        """A camera of the file's frame, in scene units from `origin`: what the query's positions refer to."""
        return self._placed(camera, camera.origin - self.origin)

    def _placed(self, camera: Camera, origin: Floats) -> Camera:
        if self.is_own:
            return camera
        to_world = camera.to_world.copy()
        to_world[:3, 3] = origin
        return Camera(to_world, camera.fov_deg, camera.width, camera.height)

    def describe(self) -> str:
        """One line for the scene's notes."""
        place = ", ".join(f"{value:.6g}" for value in self.origin)
        return f"computed about ({place}) at {self.scale:g} times its size: single precision needs it"


OWN = WorldFrame()


def suitable_frame(mi_scene: Any) -> WorldFrame:
    """The frame that suits a built scene."""
    box = mi_scene.bbox()
    return WorldFrame.of_box(np.array(box.min).ravel(), np.array(box.max).ravel())


def move_nodes(state: Any, frame: WorldFrame) -> None:
    """Writes a frame into the shapes and lights of a parsed scene, in double precision."""
    for node in nodes_of(state, mi.ObjectType.Shape):
        _move_shape(node.props, frame)
    for node in nodes_of(state, mi.ObjectType.Emitter):
        if node.props.plugin_name() in _POSITIONAL_EMITTERS:
            _move_emitter(node.props, frame)
    for node in nodes_of(state, mi.ObjectType.BSDF):
        if node.props.plugin_name() == "bumpmap":  # displaces by scene units
            node.props["scale"] = float(node.props.get("scale", 1.0)) * frame.scale


def dim_lights(mi_scene: Any, frame: WorldFrame) -> None:
    """Gives point-like lights of a built scene the intensity that their distances have been scaled for.

    Radiant intensity is power a solid angle: irradiance is I / d^2, and d has grown by the scale.
    """
    if frame.scale == 1.0:
        return
    for emitter in mi_scene.emitters():
        if type(emitter).__name__ == "Emitter" and emitter.class_name() in ("PointLight", "SpotLight", "Projector"):
            parameters = mi.traverse(emitter)
            for name in ("intensity.value", "scale"):
                if name in parameters:
                    parameters[name] = parameters[name] * frame.scale**2
            parameters.update()


def _move_shape(props: Any, frame: WorldFrame) -> None:
    to_world = _matrix(props)
    if props.plugin_name() == "sphere":  # its centre would be read in single precision before the move
        centre, radius = (props.get(name, default) for name, default in (("center", [0, 0, 0]), ("radius", 1.0)))
        ball = np.diag([radius, radius, radius, 1.0])
        ball[:3, 3] = np.array(centre, dtype=np.float64)
        to_world = to_world @ ball
        for name in ("center", "radius"):
            if name in props:
                del props[name]
    props["to_world"] = mi.ScalarTransform4d((frame.matrix @ to_world).tolist())


def _move_emitter(props: Any, frame: WorldFrame) -> None:
    if "position" in props:
        place = frame.local_points(np.array(props["position"], dtype=np.float64))
        props["position"] = mi.ScalarPoint3d(place.tolist())
        return
    to_world = _matrix(props)
    to_world[:3, 3] = frame.local_points(to_world[:3, 3])
    props["to_world"] = mi.ScalarTransform4d(to_world.tolist())


def _matrix(props: Any) -> Floats:
    if "to_world" not in props:
        return np.eye(4)
    return np.array(props["to_world"].matrix, dtype=np.float64).reshape(4, 4)
