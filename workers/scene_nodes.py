"""What every kind of scene file goes through: Mitsuba's parsed node list, audited and adjusted before it is
built.

The parsed form (`mi.parser`) is where files, names, films and unsupported plugins can be seen, for XML and
dictionaries alike, before a plugin touches the disk or crashes on what it finds.
"""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.backend import VARIANT, mi
from workers.errors import SceneError
from workers.scene_instances import expand_instances

PINHOLE_SENSORS = ("perspective", "thinlens")
_PATH_INTEGRATORS = ("path", "volpath", "volpathmis", "prb", "prb_basic", "prbvolpath", "ptracer")
DEFAULT_MAX_DEPTH = 12
_CPP_PLACE = re.compile(r"\[[\w./-]+\.(?:cpp|h):\d+\]\s*")
_EMPTY_MESH = re.compile(r"jit_\w+\(.*operands have incompatible sizes.*")  # Dr.Jit on a mesh of no triangles


def first_line(error: BaseException) -> str:
    """The first line of Mitsuba's message that tells something, without C++ file names."""
    lines = [_CPP_PLACE.sub("", line.strip()) for line in str(error).splitlines()]
    told = [line for line in lines if line and not line.endswith(("exception:", "error:"))]
    if not told:
        return type(error).__name__
    line = " ".join(told[:2]) if told[0].endswith(":") else told[0]
    return _EMPTY_MESH.sub("a mesh must have triangles and vertices, got none", line).rstrip(".!")


def parse_state(parse: Callable[[Any], Any], what: str) -> Any:
    """Run one of `mi.parser`'s parsers and its transformations (upgrade, references; nothing is merged).

    Args:
        parse: called with the parser's configuration, returns a `ParserState`.
        what: names the scene in messages.

    Raises:
        SceneError: Mitsuba refuses the text, an unknown tag, parameter or reference.
    """
    try:
        state = parse(parser_config())
        mi.parser.transform_all(parser_config(), state)
    except Exception as error:
        raise SceneError(f"{what} must be a valid Mitsuba scene, got: {first_line(error)}") from error
    if not state.nodes or state.root.type != mi.ObjectType.Scene:
        raise SceneError(f"{what} must hold a <scene> at its root; wrap its content in one")
    return state


def parser_config() -> Any:
    """Configuration that keeps every shape apart: caches are keyed by shape and triangle."""
    config = mi.parser.ParserConfig(VARIANT)
    config.merge_equivalent = False
    config.merge_meshes = False
    return config


def resolve_files(state: Any, folders: list[Path], what: str) -> dict[str, Path]:
    """Make every `filename` property absolute; returns {name as written: path}.

    Raises:
        SceneError: a referenced file is missing.
    """
    found: dict[str, Path] = {}
    for node in state.nodes:
        if "filename" not in node.props:
            continue
        written = str(node.props["filename"])
        candidates = [Path(written)] if Path(written).is_absolute() else [folder / written for folder in folders]
        path = next((candidate.resolve() for candidate in candidates if candidate.is_file()), None)
        if path is None:
            raise SceneError(
                f"{what}: {node.props.plugin_name()} file must exist, got {written}; put it beside the scene "
                "or correct its filename"
            )
        node.props["filename"] = str(path)
        found[written] = path
    return found


def nodes_of(state: Any, kind: Any) -> Iterator[Any]:
    """Nodes of one `mi.ObjectType` that the scene uses, in the order of the file."""
    return (node for node in state.nodes if node.type == kind)


def name_shapes(state: Any) -> None:
    """Give every unnamed shape an id by its place in the file: the order of `scene.shapes()` is not
    stable."""
    taken = {node.props.id() for node in state.nodes}
    for index, node in enumerate(nodes_of(state, mi.ObjectType.Shape)):
        if not node.props.id():
            name = f"shape-{index:05d}"
            while name in taken:
                name += "-"
            taken.add(name)
            node.props.set_id(name)


def audit_nodes(state: Any, what: str) -> list[str]:
    """Write instances out; returns notes about that and about what is ignored.

    Raises:
        SceneError: instances that cannot be written out.
    """
    notes = expand_instances(state, what)
    if any(True for _ in nodes_of(state, mi.ObjectType.Medium)):
        notes.append("participating media are ignored: light crosses them as if they were empty")
    for node in nodes_of(state, mi.ObjectType.Integrator):
        if node.props.get("hide_emitters", False):
            notes.append("hide_emitters is ignored: visible lights stay visible")
    return notes


def path_max_depth(state: Any) -> int:
    """Longest path in edges as the file's path integrator has it (-1: unlimited), else
    `DEFAULT_MAX_DEPTH`."""
    for node in nodes_of(state, mi.ObjectType.Integrator):
        if node.props.plugin_name() in _PATH_INTEGRATORS:
            return int(node.props["max_depth"]) if "max_depth" in node.props else -1
    return DEFAULT_MAX_DEPTH


def first_sensor(state: Any, what: str) -> tuple[Any | None, list[str]]:
    """The sensor node to use, or None, with notes about what is dropped.

    Raises:
        SceneError: the first sensor is no pinhole camera.
    """
    sensors = list(nodes_of(state, mi.ObjectType.Sensor))
    if not sensors:
        return None, []
    sensor, notes = sensors[0], []
    plugin = sensor.props.plugin_name()
    if plugin not in PINHOLE_SENSORS:
        raise SceneError(
            f"{what}: the first sensor must be one of {', '.join(PINHOLE_SENSORS)}, got {plugin}; "
            "put a perspective sensor first"
        )
    if len(sensors) > 1:
        notes.append(f"{len(sensors)} sensors in the file: the first one is used")
    if plugin == "thinlens":
        notes.append("the thin lens is treated as a pinhole: no depth of field")
    for axis in "xy":
        name = f"principal_point_offset_{axis}"
        if name in sensor.props and float(sensor.props[name]) != 0.0:
            notes.append(f"{name} {float(sensor.props[name]):g} is ignored: the view is centred")
    if "shutter_open" in sensor.props or "shutter_close" in sensor.props:
        notes.append("shutter times are ignored: the scene is rendered at one instant")
    return sensor, notes


def sensor_pose(sensor: Any, what: str) -> tuple[NDArray[np.float64], list[str]]:
    """Rigid [4, 4] float64 pose of a sensor node: scale is taken out and noted, and written back to the node.

    Raises:
        SceneError: the transform is singular, sheared or not finite.
    """
    if "to_world" not in sensor.props:
        return np.eye(4), []
    matrix = np.array(sensor.props["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if not np.isfinite(matrix).all() or lengths.min() <= 0:
        raise SceneError(f"{what}: the sensor's to_world must be finite and invertible, got {matrix.tolist()}")
    axes = matrix[:3, :3] / lengths
    left, _, right = np.linalg.svd(axes)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = left @ right, matrix[:3, 3]
    if not np.allclose(pose[:3, :3], axes, atol=1e-3):
        raise SceneError(f"{what}: the sensor's to_world must not be sheared, got {matrix.tolist()}")
    sensor.props["to_world"] = mi.ScalarTransform4f(pose.tolist())
    notes = [] if np.allclose(lengths, 1, atol=1e-3) else ["the scale in the sensor's transform is ignored"]
    return pose, notes


def horizontal_fov_deg(sensor: Any, width: int, height: int, what: str) -> float:
    """Field of view across `width`, degrees, of a sensor node whose `fov_axis` or focal length may say
    otherwise.

    Raises:
        SceneError: Mitsuba refuses the values.
    """
    given = {key: sensor.props[key] for key in ("fov", "fov_axis", "focal_length") if key in sensor.props}
    film = {"type": "hdrfilm", "width": width, "height": height}
    try:
        built = mi.load_dict({"type": "perspective", **given, "film": film})
    except Exception as error:
        raise SceneError(f"{what}: the sensor must have a valid fov, got: {first_line(error)}") from error
    return float(np.array(mi.traverse(built)["x_fov"]).ravel()[0])


def set_film_size(state: Any, width: int | None, height: int | None, what: str) -> tuple[int, int]:
    """Image size in pixels: as asked, the rest from the first film; written to every film node, crop
    removed."""
    films = list(nodes_of(state, mi.ObjectType.Film))
    film_size = [768, 576]
    if films:
        for index, name in enumerate(("width", "height")):
            if name in films[0].props:
                film_size[index] = int(films[0].props[name])
    if min(film_size) < 1:
        raise SceneError(f"{what}: the film must have at least one pixel, got {film_size[0]}x{film_size[1]}")
    if width is None and height is None:
        width, height = film_size
    elif width is None:
        assert height is not None
        width = max(1, round(height * film_size[0] / film_size[1]))
    elif height is None:
        height = max(1, round(width * film_size[1] / film_size[0]))
    for film in films:
        for name in ("crop_width", "crop_height", "crop_offset_x", "crop_offset_y"):
            if name in film.props:
                del film.props[name]
        film.props["width"], film.props["height"] = int(width), int(height)
    return int(width), int(height)


def instantiate(state: Any, what: str) -> Any:
    """Build the scene.

    Raises:
        SceneError: unknown plugin, unreadable file, unused or wrong parameter.
    """
    try:
        return mi.parser.instantiate(parser_config(), state)
    except Exception as error:
        raise SceneError(f"{what} must be a scene that Mitsuba can build, got: {first_line(error)}") from error
