"""Scenes written as YAML: Mitsuba's dictionary form, a camera path and settings in one file.

    scene:                                   # what mi.load_dict takes, without "type: scene"
      sensor: {type: perspective, fov: 45, to_world: {look_at: {origin: [0, 1, 4], target: [0, 1, 0]}},
               film: {type: hdrfilm, width: 256, height: 256}}
      floor:
        type: rectangle
        to_world: [{rotate: {axis: [1, 0, 0], angle: -90}}, {scale: 4}, {translate: [0, 0, 0]}]  # in order
        bsdf: {type: diffuse, reflectance: {type: rgb, value: [0.5, 0.5, 0.5]}}
    camera:
      keyframes: [{origin: [0, 1, 4], target: [0, 1, 0], up: [0, 1, 0], fov: 45}]   # up and fov are optional
      test_keyframes: []
    settings: {}                             # overrides of the run's settings, handed on as they are

File names are relative to the YAML file's folder.
"""

import json
import math
import re
from collections.abc import Callable, Set
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from workers.backend import mi
from workers.camera import Camera
from workers.errors import CameraError, SceneError
from workers.scene_draft import SceneDraft, file_hash, text_hash
from workers.scene_nodes import parse_state, resolve_files

YAML_SUFFIXES = (".yaml", ".yml")
DEFAULT_FOV_DEG = 45.0
_TOP_KEYS = {"scene", "camera", "settings"}
_CAMERA_KEYS = {"keyframes", "test_keyframes"}
_KEYFRAME_KEYS = {"origin", "target", "up", "fov"}
_TRANSFORM_KEYS = {"to_world", "to_uv"}
_TEXT_KEYS = {"type", "id", "filename", "name"}
_EXPONENT = re.compile(r"[+-]?\d+[eE][+-]?\d+")  # YAML 1.1 reads 1e-3 as text


def read_yaml(path: Path) -> SceneDraft:
    """Parse a YAML scene.

    Raises:
        SceneError: broken YAML, an unknown or malformed key (named), a missing file.
    """
    what = f"scene {path.name}"
    document = _load(path, what)
    _check_keys(document, _TOP_KEYS, what, required={"scene"})
    if not isinstance(document["scene"], dict) or not document["scene"]:
        raise SceneError(f"{what}: key scene must be a mapping of named plugins, got {document['scene']!r}")
    camera = document.get("camera") or {}
    _check_keys(camera, _CAMERA_KEYS, f"{what}: key camera")
    settings = document.get("settings") or {}
    if not isinstance(settings, dict):
        raise SceneError(f"{what}: key settings must be a mapping, got {settings!r}")
    keyframes = {key: _keyframes(camera.get(key), f"{what}: key camera.{key}") for key in sorted(_CAMERA_KEYS)}
    plugins = {"type": "scene", **_convert(document["scene"], "scene", what)}
    state = parse_state(lambda config: mi.parser.parse_dict(config, plugins), what)
    files = resolve_files(state, [path.parent.resolve()], what)
    content = [("yaml", text_hash(json.dumps(document["scene"], sort_keys=True, default=str)))]
    content += [(written, file_hash(file)) for written, file in sorted(files.items())]
    draft = SceneDraft(what=what, state=state, content=content, settings=settings)
    if keyframes["keyframes"]:
        make = keyframes["keyframes"]
        draft.make_keyframes = make
        draft.make_camera = lambda width, height: make(Camera(np.eye(4), DEFAULT_FOV_DEG, width, height))[0]
    draft.make_test_keyframes = keyframes["test_keyframes"]
    return draft


def _load(path: Path, what: str) -> Any:
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(f"{what} must be readable, got: {error.strerror}; check its permissions") from error
    except UnicodeDecodeError as error:
        raise SceneError(f"{what} must be UTF-8 text, got: {error.reason} at byte {error.start}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise SceneError(f"{what} must be valid YAML, got: {getattr(error, 'problem', error)}{place}") from error


def _check_keys(value: Any, known: Set[str], what: str, required: Set[str] = frozenset()) -> None:
    if not isinstance(value, dict):
        raise SceneError(f"{what} must be a mapping with the keys {', '.join(sorted(known))}, got {value!r}")
    unknown, missing = sorted(map(str, set(value) - known)), sorted(required - set(value))
    if unknown:
        raise SceneError(f"{what} must only have the keys {', '.join(sorted(known))}, got {', '.join(unknown)}")
    if missing:
        raise SceneError(f"{what} must have the key {', '.join(missing)}; add it")


def _convert(value: Any, key: str, what: str) -> Any:
    """YAML values to those of `mi.load_dict`; `key` is the dotted path for messages."""
    name = key.rsplit(".", 1)[-1]
    if name in _TRANSFORM_KEYS:
        return _transform(value, f"{what}: key {key}")
    if isinstance(value, dict):
        for child in value:
            if not isinstance(child, str):
                raise SceneError(f"{what}: key {key}.{child} must be text, got {child!r}; put it in quotes")
        if "type" not in value and key != "scene":
            raise SceneError(f"{what}: key {key} must have a type, got the keys {', '.join(sorted(value)) or 'none'}")
        return {child: _convert(inner, f"{key}.{child}", what) for child, inner in value.items()}
    if isinstance(value, str):
        return float(value) if name not in _TEXT_KEYS and _EXPONENT.fullmatch(value) else value
    if isinstance(value, list):
        return _numbers(value, None, f"{what}: key {key}")
    if isinstance(value, bool | int | float):
        return value
    raise SceneError(f"{what}: key {key} must be a number, text, list of numbers or mapping, got {value!r}")


def _numbers(value: Any, count: int | None, what: str) -> list[float]:
    rule = f"{count} finite numbers" if count else "finite numbers"
    try:
        if isinstance(value, str) or any(isinstance(item, bool) for item in value):
            raise TypeError
        numbers = [float(item) for item in value]
    except (TypeError, ValueError):
        raise SceneError(f"{what} must be {rule}, got {value!r}") from None
    if (count and len(numbers) != count) or not all(map(math.isfinite, numbers)):
        raise SceneError(f"{what} must be {rule}, got {value!r}")
    return numbers


def _transform(value: Any, what: str) -> Any:
    """One step or a list of steps, applied to the shape in the order of the list."""
    steps = value if isinstance(value, list) else [value]
    result = mi.ScalarTransform4d()
    for step in steps:
        if not isinstance(step, dict) or len(step) != 1 or next(iter(step)) not in _STEPS:
            raise SceneError(f"{what} must be one of {', '.join(sorted(_STEPS))} or a list of them, got {step!r}")
        kind, argument = next(iter(step.items()))
        result = _STEPS[kind](argument, f"{what}.{kind}") @ result
    return result


def _look_at(value: Any, what: str) -> Any:
    pose = _keyframe({"fov": DEFAULT_FOV_DEG, **value} if isinstance(value, dict) else value, what)
    camera = _build(pose, Camera(np.eye(4), DEFAULT_FOV_DEG, 1, 1), what)
    return mi.ScalarTransform4d(camera.to_world.tolist())


def _scale(value: Any, what: str) -> Any:
    factors = [value] * 3 if isinstance(value, int | float) else value
    return mi.ScalarTransform4d().scale(_numbers(factors, 3, what))


def _rotate(value: Any, what: str) -> Any:
    _check_keys(value, {"axis", "angle"}, what, required={"axis", "angle"})
    (angle,) = _numbers([value["angle"]], 1, f"{what}.angle")
    return mi.ScalarTransform4d().rotate(_numbers(value["axis"], 3, f"{what}.axis"), angle)


def _matrix(value: Any, what: str) -> Any:
    flat = [item for row in value for item in row] if isinstance(value, list) and len(value) == 4 else value
    try:
        return mi.ScalarTransform4d(np.array(_numbers(flat, 16, what)).reshape(4, 4).tolist())
    except TypeError:
        raise SceneError(f"{what} must be 4 rows of 4 numbers, got {value!r}") from None


_STEPS: dict[str, Callable[[Any, str], Any]] = {
    "look_at": _look_at,
    "translate": lambda value, what: mi.ScalarTransform4d().translate(_numbers(value, 3, what)),
    "scale": _scale,
    "rotate": _rotate,
    "matrix": _matrix,
}


def _keyframe(value: Any, what: str) -> dict[str, Any]:
    _check_keys(value, _KEYFRAME_KEYS, what, required={"origin", "target"})
    pose: dict[str, Any] = {key: _numbers(value[key], 3, f"{what}.{key}") for key in ("origin", "target")}
    pose["up"] = _numbers(value.get("up", [0, 1, 0]), 3, f"{what}.up")
    if "fov" in value:
        (pose["fov"],) = _numbers([value["fov"]], 1, f"{what}.fov")
    return pose


def _build(pose: dict[str, Any], view: Camera, what: str) -> Camera:
    fov_deg = pose.get("fov", view.fov_deg)
    try:
        return Camera.look_at(pose["origin"], pose["target"], pose["up"], fov_deg, view.width, view.height)
    except CameraError as error:
        raise SceneError(f"{what}: {error}") from error


def _keyframes(value: Any, what: str) -> Callable[[Camera], tuple[Camera, ...]] | None:
    """Checked keyframes as a function of the default camera (its size, and its field of view where none is
    given)."""
    if not value:
        return None
    if not isinstance(value, list):
        raise SceneError(f"{what} must be a list, got {value!r}")
    poses = [(_keyframe(item, f"{what}[{index}]"), f"{what}[{index}]") for index, item in enumerate(value)]
    for pose, name in poses:
        _build(pose, Camera(np.eye(4), DEFAULT_FOV_DEG, 1, 1), name)
    return lambda view: tuple(_build(pose, view, name) for pose, name in poses)
