"""A scene as every stage sees it: Mitsuba's scene, its own camera, what determines it and what was noted
about it.

load_scene("scene.xml") | load_scene("scene.yaml") | load_scene("chair.glb") | load_scene("tabletop")

A source may end in a variation, "tabletop#seed=3,materials=0.5" (`workers/variation.py`).
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from workers.backend import mi
from workers.camera import Camera
from workers.errors import SceneError
from workers.scene_check import bounds, check_scene
from workers.scene_draft import SceneDraft
from workers.scene_nodes import (
    audit_nodes,
    first_sensor,
    horizontal_fov_deg,
    instantiate,
    name_shapes,
    path_max_depth,
    sensor_pose,
    set_film_size,
)
from workers.scene_source import read_source
from workers.scene_variation import content_of, vary_scene
from workers.variation import Variation, split_source
from workers.world_frame import OWN, WorldFrame, dim_lights, move_nodes, suitable_frame

DIGEST_VERSION = 1
MAX_MOVES = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A loaded, checked scene.

    Attributes:
        name: slug for folders and reports.
        digest: sha256 hex over everything that determines the light in it (files, textures, meshes, a
            `max_depth` that was asked for); neither image size nor camera keyframes of a YAML file count.
        mi_scene: the `mi.Scene`; every shape has an id that is the same in every process, none are merged.
        camera: the scene's own view.
        keyframes: views that a camera path should pass through; may be empty.
        test_keyframes: views that the test path should pass through; may be empty.
        max_depth: longest path in edges, -1 for unlimited.
        near_clip: closest distance along the view that is seen, scene units.
        far_clip: farthest distance along the view that is seen, scene units.
        notes: what was added, changed or ignored, one line each.
        settings: overrides of the run's settings that the scene file asks for.
        source: what `load_scene` was given.
        frame: where `mi_scene` lies; cameras, bounds and clip distances here are in the file's own frame.
        variation: parameters and changes of a varied scene; empty otherwise.
    """

    name: str
    digest: str
    mi_scene: Any
    camera: Camera
    keyframes: tuple[Camera, ...] = ()
    test_keyframes: tuple[Camera, ...] = ()
    max_depth: int
    near_clip: float
    far_clip: float
    notes: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    source: str
    frame: WorldFrame = OWN
    variation: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def address(self) -> str:
        """The source as it is found from any folder: a file's path is absolute. What a store keeps."""
        base, _ = split_source(self.source)
        return f"{Path(base).resolve()}{self.source[len(base) :]}" if Path(base).is_file() else self.source

    @property
    def bounds_centre(self) -> np.ndarray:
        """[3] centre of the bounding box, scene units."""
        return self.frame.file_points(bounds(self.mi_scene)[0])

    @property
    def bounds_diagonal(self) -> float:
        """Diagonal of the bounding box, scene units."""
        return bounds(self.mi_scene)[1] / self.frame.scale

    def make_sensor(self, camera: Camera, spp: int = 1) -> Any:
        """`mi.Sensor` for a camera: float32 RGB film, box filter, independent sampler.

        The box filter keeps a repeated seed bit-identical; a sensor belongs to no scene and may be used with
        any.
        """
        return mi.load_dict(
            {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f(self.frame.local_camera(camera).to_world.tolist()),
                "fov": camera.fov_deg,
                "fov_axis": "x",
                "near_clip": self.near_clip * self.frame.scale,
                "far_clip": self.far_clip * self.frame.scale,
                "sampler": {"type": "independent", "sample_count": int(spp)},
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width,
                    "height": camera.height,
                    "pixel_format": "rgb",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
            }
        )


def load_scene(source: str | Path, *, width: int | None = None, height: int | None = None,
               max_depth: int | None = None) -> Scene:  # fmt: skip
    """Read, check and build a scene.

    Args:
        source: path of a Mitsuba XML, a YAML or a mesh file, or the name of a built-in scene
            ("tabletop", "tiny", also "builtin:tabletop"); with a variation after a "#".
        width: image width in pixels; default: the scene's film, or from `height` and the film's aspect.
        height: image height in pixels, likewise.
        max_depth: replaces the longest path of the file's integrator, in edges; -1 is unlimited.

    Raises:
        SceneError: the scene is missing, broken, or asks for what caches cannot represent.
        CameraError: the image size is not usable.
        VariationError: what follows a "#" is no variation.
    """
    for option, size in (("width", width), ("height", height)):
        if size is not None and size < 1:
            raise SceneError(f"image {option} must be at least 1 pixel, got {size}")
    base, variation = split_source(source)
    parsed = _parse(base, width, height)
    draft, pixels = parsed.draft, parsed.pixels
    file_depth = path_max_depth(draft.state)
    depth = _checked_depth(file_depth if max_depth is None else max_depth)
    mi_scene, frame = _built(draft, lambda: _parse(base, width, height).draft)
    varied = _vary(mi_scene, draft, variation)
    notes = [*draft.notes, *check_scene(mi_scene, draft.what)]
    if not frame.is_own:
        notes.append(frame.describe())
    if parsed.pose is not None:
        camera = Camera(parsed.pose, horizontal_fov_deg(parsed.sensor, *pixels, draft.what), *pixels)
    else:
        assert draft.make_camera is not None
        camera = draft.make_camera(*pixels)
    near, far = _clip_distances(mi_scene, frame, camera, parsed.sensor)
    scene = Scene(
        name=f"{parsed.name}-v{variation.tag}" if variation and variation.changes_something else parsed.name,
        digest=_digest(draft, frame, depth if depth != file_depth else None),
        mi_scene=mi_scene,
        camera=camera,
        keyframes=draft.make_keyframes(camera) if draft.make_keyframes else (),
        test_keyframes=draft.make_test_keyframes(camera) if draft.make_test_keyframes else (),
        max_depth=depth,
        near_clip=near,
        far_clip=far,
        notes=tuple(notes),
        settings=MappingProxyType(draft.settings),
        source=str(source),
        frame=frame,
        variation=MappingProxyType(varied),
    )
    return _with_varied_views(scene, variation) if variation else scene


def _vary(mi_scene: Any, draft: SceneDraft, variation: Variation | None) -> dict[str, Any]:
    """Applies a variation to the built scene and to what its digest is made from."""
    if variation is None:
        return {}
    changes = vary_scene(mi_scene, variation)
    draft.content += content_of(changes, variation)
    return {**variation.to_json(), "changes": changes}


def _with_varied_views(scene: Scene, variation: Variation) -> Scene:
    from workers.camera_variation import vary_cameras  # it casts rays into a Scene: this module comes first

    return vary_cameras(scene, variation)


@dataclass(frozen=True)
class _Parsed:
    """A scene that is ready to be built: its name, draft, sensor node (None: none), the sensor's pose and pixels."""

    name: str
    draft: SceneDraft
    sensor: Any
    pose: np.ndarray | None
    pixels: tuple[int, int]


def _parse(source: str | Path, width: int | None, height: int | None) -> _Parsed:
    name, draft = read_source(source)
    draft.notes += audit_nodes(draft.state, draft.what)
    name_shapes(draft.state)
    sensor, sensor_notes = first_sensor(draft.state, draft.what)
    draft.notes += sensor_notes
    if sensor is None and draft.make_camera is None:
        raise SceneError(f'{draft.what} must hold a sensor, got none; add a <sensor type="perspective">')
    pixels = set_film_size(draft.state, width, height, draft.what)
    pose = None
    if sensor is not None:
        pose, pose_notes = sensor_pose(sensor, draft.what)
        draft.notes += pose_notes
    return _Parsed(name, draft, sensor, pose, pixels)


def _built(draft: SceneDraft, parse_again: Callable[[], SceneDraft]) -> tuple[Any, WorldFrame]:
    """Mitsuba's scene and the frame that it lies in.

    A parsed scene can be built only once, so one that its own frame does not suit is parsed again; one both tiny and
    far away shows its size only when it has been moved.
    """
    mi_scene = instantiate(draft.state, draft.what)
    if draft.frame is not None:
        return mi_scene, draft.frame
    frame = OWN
    for _ in range(MAX_MOVES):
        further = suitable_frame(mi_scene)
        if further.is_own:
            break
        frame = frame.then(further)
        moved = parse_again()
        move_nodes(moved.state, frame)
        mi_scene = instantiate(moved.state, draft.what)
        dim_lights(mi_scene, frame)
    return mi_scene, frame


def _digest(draft: SceneDraft, frame: WorldFrame, asked_depth: int | None) -> str:
    content: dict[str, Any] = {"version": DIGEST_VERSION, "content": draft.content, "max_depth": asked_depth}
    if not frame.is_own:
        content["frame"] = [*frame.origin, frame.scale]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _checked_depth(depth: int) -> int:
    if depth < 1 and depth != -1:
        raise SceneError(f"max_depth must be at least 1, or -1 for unlimited, got {depth}")
    return depth


def _float_property(node: Any, key: str) -> float | None:
    return float(node.props[key]) if key in node.props else None


def _clip_distances(mi_scene: Any, frame: WorldFrame, camera: Camera, sensor: Any) -> tuple[float, float]:
    """The file's own clip distances, else ones that cut nothing that can be seen."""
    near, far = (None if sensor is None else _float_property(sensor, key) for key in ("near_clip", "far_clip"))
    centre, diagonal = bounds(mi_scene)
    reach = diagonal / frame.scale + float(np.linalg.norm(camera.origin - frame.file_points(centre)))
    return (1e-4 * reach if near is None else near), (100.0 * reach if far is None else far)
