"""Mesh files (glTF, OBJ, PLY, STL) as scenes: geometry and materials from the file, light and camera added.

Such files hold no light that this reader could use: a constant environment and a soft area light above are
added, and a three-quarter view that frames the bounds. Up is Y for glTF and OBJ, Z for PLY and STL.
Animation, skinning, morphs, glTF cameras and lights are not read.
"""

import itertools
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from workers.backend import mi
from workers.camera import Camera
from workers.errors import SceneError
from workers.mesh_building import to_mitsuba
from workers.mesh_material import read_material
from workers.scene_draft import SceneDraft, file_hash
from workers.scene_nodes import first_line, parse_state
from workers.world_frame import WorldFrame

Floats = NDArray[np.float64]
Part = Callable[[WorldFrame], Any]
MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
FOV_DEG = 45.0
ENVIRONMENT_RADIANCE = 0.5
LIGHT_RADIANCE = 12.0
_FILL = 0.9  # of the half image that the box may reach
_Z_UP = (".ply", ".stl")
_IGNORED_EXTENSIONS_START = ("KHR_materials_", "KHR_lights", "KHR_texture_transform", "EXT_")


def read_mesh(path: Path) -> SceneDraft:
    """Read a mesh file into a lit scene.

    Raises:
        SceneError: the file is broken, holds no triangles, or vertices that are not finite.
    """
    what = f"scene {path.name}"
    files, notes = _referenced_files(path, what)
    content = [(path.suffix.lower(), file_hash(path))]
    content += [(name, file_hash(file)) for name, file in sorted(files.items())]
    parts, corners = _parts(path, what, notes)
    frame = WorldFrame.of_box(*corners)
    shapes = {name: part(frame) for name, part in parts.items()}
    low, high = corners = frame.local_points(corners)
    up = np.array([0.0, 0.0, 1.0] if path.suffix.lower() in _Z_UP else [0.0, 1.0, 0.0])
    front = np.array([0.0, -1.0, 0.0] if path.suffix.lower() in _Z_UP else [0.0, 0.0, 1.0])
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    plugins = {"type": "scene", **shapes, **_lights(centre, radius, up, front)}
    notes += [
        "no light is read from mesh files: added a constant environment and a soft area light above",
        f"no camera is read from mesh files: added a three-quarter view, fov {FOV_DEG:g} degrees",
    ]
    return SceneDraft(
        what=what,
        state=parse_state(lambda config: mi.parser.parse_dict(config, plugins), what),
        content=content,
        notes=notes,
        make_camera=lambda width, height: frame.file_camera(_framing(corners, up, front, width, height)),
        frame=frame,
    )


def _framing(corners: Floats, up: Floats, front: Floats, width: int, height: int) -> Camera:
    """Three-quarter view from which the box between `corners` [2, 3] just fits into the image."""
    centre = corners.mean(axis=0)
    direction = front + 0.6 * np.cross(up, front) + 0.45 * up
    view = Camera.look_at(centre + direction, centre, up, FOV_DEG, width, height)
    box = np.array(list(itertools.product(*corners.T))) - centre
    local = box @ view.to_world[:3, :3]
    half_tangent = np.tan(np.radians([view.fov_deg, view.fov_y_deg]) / 2)
    distance = (np.abs(local[:, :2]) / (_FILL * half_tangent) - local[:, 2:]).max()
    return Camera.look_at(centre - distance * view.forward, centre, up, FOV_DEG, width, height)


def _parts(path: Path, what: str, notes: list[str]) -> tuple[dict[str, Part], Floats]:
    """({name: what builds its mesh in a frame}, [2, 3] bounds); one shape for each node of the file."""
    try:
        loaded = trimesh.load_scene(path, process=False)
    except Exception as error:
        raise SceneError(f"{what} must be a readable {path.suffix} file, got: {first_line(error)}") from error
    shapes: dict[str, Part] = {}
    corners = np.array([[np.inf] * 3, [-np.inf] * 3])
    skipped = 0
    for node in sorted(loaded.graph.nodes_geometry):
        transform, geometry_name = loaded.graph[node]
        geometry = loaded.geometry[geometry_name]
        if not isinstance(geometry, trimesh.Trimesh) or len(geometry.faces) == 0:
            skipped += 1
            continue
        name = _unused_name(str(node), shapes)
        shapes[name], positions = _part(name, geometry, np.asarray(transform), path, what, notes)
        corners = np.stack([np.minimum(corners[0], positions.min(0)), np.maximum(corners[1], positions.max(0))])
    if not shapes:
        raise SceneError(f"{what} must hold triangles, got none; export a triangle mesh")
    if skipped:
        notes.append(f"{skipped} parts without triangles (points, lines, empty meshes) are left out")
    notes[:] = list(dict.fromkeys(notes))
    return shapes, corners


def _part(name: str, geometry: trimesh.Trimesh, transform: Floats, path: Path, what: str,
          notes: list[str]) -> tuple[Part, Floats]:  # fmt: skip
    """What builds the mesh in a frame, and its positions [vertices, 3] in the file's."""
    if path.suffix.lower() == ".stl":
        geometry.merge_vertices()
    vertices, faces = np.asarray(geometry.vertices, dtype=np.float64), np.asarray(geometry.faces)
    if not np.isfinite(vertices).all() or not np.isfinite(transform).all():
        bad = int((~np.isfinite(vertices).all(axis=1)).sum())
        raise SceneError(f"{what}: mesh {name} must have finite vertices, got {bad} with NaN or Inf; repair it")
    linear = transform[:3, :3]
    positions = vertices @ linear.T + transform[:3, 3]
    normals = _file_normals(geometry, linear)
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]
    texcoords = getattr(geometry.visual, "uv", None)
    if texcoords is not None:
        texcoords = np.asarray(texcoords, dtype=np.float64)[:, :2] * [1, -1] + [0, 1]  # trimesh has v upwards
    material = read_material(geometry, texcoords is not None)
    notes += material.notes

    def build(frame: WorldFrame) -> Any:
        return to_mitsuba(
            name,
            frame.local_points(positions),
            faces,
            normals=normals,
            texcoords=texcoords,
            attributes=material.attributes,
            bsdf=mi.load_dict(material.bsdf),
            emitter=mi.load_dict(material.emitter) if material.emitter else None,
        )

    return build, positions


def _file_normals(geometry: trimesh.Trimesh, linear: Floats) -> Floats | None:
    """Unit vertex normals in world space where the file had them, else None: trimesh would make some up."""
    if "vertex_normals" not in geometry._cache.cache:
        return None
    normals = np.asarray(geometry.vertex_normals, dtype=np.float64)
    if normals.shape != geometry.vertices.shape or not np.isfinite(normals).all():
        return None
    cofactor = np.linalg.det(linear) * np.linalg.pinv(linear).T
    turned = normals @ cofactor.T * np.sign(np.linalg.det(linear) or 1.0)
    lengths = np.linalg.norm(turned, axis=1, keepdims=True)
    return None if lengths.min() == 0 else turned / lengths


def _unused_name(name: str, taken: dict[str, Any]) -> str:
    """`name` as an id that Mitsuba accepts and that is not taken."""
    clean = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in name) or "mesh"
    index, unique = 1, clean
    while unique in taken or unique.startswith("added_"):
        unique, index = f"{clean}_{index}", index + 1
    return unique


def _lights(centre: Floats, radius: float, up: Floats,
            front: Floats) -> dict[str, Any]:  # fmt: skip
    """A grey sky and a square light above, in front and to the left."""
    place = centre + radius * (2.6 * up + 0.9 * front - 0.9 * np.cross(up, front))
    to = mi.ScalarTransform4f
    pose = to().look_at(place.tolist(), centre.tolist(), front.tolist()) @ to().scale([radius, radius, 1])
    return {
        "added_environment": {"type": "constant", "radiance": {"type": "rgb", "value": ENVIRONMENT_RADIANCE}},
        "added_light": {
            "type": "rectangle",
            "to_world": pose,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": LIGHT_RADIANCE}},
        },
    }


def _referenced_files(path: Path, what: str) -> tuple[dict[str, Path], list[str]]:
    """Files beside the mesh that its look depends on, by their name in the file, and notes."""
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return _gltf_files(path, what)
    if suffix == ".obj":
        return _obj_files(path)
    return {}, []


def _gltf_files(path: Path, what: str) -> tuple[dict[str, Path], list[str]]:
    document = _gltf_json(path, what)
    names = [entry.get("uri", "") for key in ("buffers", "images") for entry in document.get(key, [])]
    files = {name: path.parent / name for name in names if name and not name.startswith("data:")}
    missing = [name for name, file in files.items() if not file.is_file()]
    if missing:
        raise SceneError(f"{what}: file {missing[0]} must exist; put it beside the scene")
    notes = []
    ignored = [name for name in document.get("extensionsUsed", []) if name.startswith(_IGNORED_EXTENSIONS_START)]
    if ignored:
        notes.append(f"glTF extensions that are not read: {', '.join(sorted(ignored))}")
    if document.get("animations") or document.get("skins"):
        notes.append("glTF animation and skinning are ignored: the rest pose is used")
    return files, notes


def _gltf_json(path: Path, what: str) -> dict[str, Any]:
    data = path.read_bytes()
    try:
        if path.suffix.lower() == ".glb":
            (length,) = struct.unpack_from("<I", data, 12)
            data = data[20 : 20 + length]
        document = json.loads(data)
    except (struct.error, ValueError) as error:
        raise SceneError(f"{what} must be a readable glTF file, got: {first_line(error)}") from error
    if not isinstance(document, dict):
        raise SceneError(f"{what} must be a readable glTF file, got no JSON object at its root")
    return document


def _obj_files(path: Path) -> tuple[dict[str, Path], list[str]]:
    files: dict[str, Path] = {}
    notes = []
    pending = _statements(path, ("mtllib",))
    for name in pending:
        file = path.parent / name
        if not file.is_file():
            notes.append(f"material file {name} is missing: its materials are grey")
            continue
        files[name] = file
        for texture in _statements(file, ("map_Kd",)):
            if (file.parent / texture).is_file():
                files[texture] = file.parent / texture
            else:
                notes.append(f"texture {texture} is missing: its material has none")
    return files, notes


def _statements(path: Path, keywords: tuple[str, ...]) -> list[str]:
    """The last word (or the rest) of each line of an OBJ or MTL file that starts with one of the keywords."""
    found = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            keyword, _, rest = line.strip().partition(" ")
            if keyword in keywords and rest.strip():
                whole = rest.strip()
                found.append(whole if (path.parent / whole).is_file() else whole.split()[-1])
    return found
