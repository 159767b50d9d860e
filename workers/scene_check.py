"""Checks of a built scene that Mitsuba does not make: finite vertices, area, content, light."""

from typing import Any

import numpy as np

from workers.backend import dr, mi
from workers.errors import SceneError


def check_scene(scene: Any, what: str) -> list[str]:
    """Look at every shape and the lights, mend vertex normals without length; returns notes.

    Raises:
        SceneError: no shape, no light, an empty mesh, vertices, textures or other parameters that are not finite, or a
            mesh without area.
    """
    shapes = scene.shapes()
    if not shapes:
        raise SceneError(f"{what} must hold at least one shape, got none; add geometry")
    _check_parameters(scene, what)
    degenerate = sum(_check_mesh(shape, what) for shape in shapes if shape.is_mesh())
    if not scene.emitters():
        raise SceneError(f"{what} must hold a light, got none; add an emitter (area, constant, envmap, point, ...)")
    notes = [note for shape in shapes if shape.is_mesh() for note in _mend_normals(shape)]
    if degenerate:
        notes.append(f"{degenerate} triangles have no area: nothing is cached on them")
    return notes


def _check_parameters(scene: Any, what: str) -> None:
    """A NaN in one texel becomes a black or burning pixel somewhere else, much later: it is refused here."""
    parameters = mi.traverse(scene)
    for name in parameters.keys():  # noqa: SIM118  # iterating it yields pairs, and reads every value
        try:
            value = parameters[name]
        except TypeError:  # Mitsuba shows a parameter that is not set, such as a hair's absorption
            continue
        if name.endswith("vertex_positions") or not (dr.is_array_v(value) and dr.is_float_v(value)):
            continue
        values = np.asarray(np.array(value))
        bad = int(values.size - np.count_nonzero(np.isfinite(values)))
        if bad:
            raise SceneError(f"{what}: {name} must be finite, got {bad} of {values.size} values NaN or Inf; repair it")


def _check_mesh(mesh: Any, what: str) -> int:
    """Check one mesh; returns its number of triangles without area."""
    name = mesh.id() or mesh.class_name()
    if mesh.face_count() == 0 or mesh.vertex_count() == 0:
        raise SceneError(f"{what}: mesh {name} must have triangles, got none; remove it")
    positions = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
    if not np.isfinite(positions).all():
        bad = int((~np.isfinite(positions).all(axis=1)).sum())
        raise SceneError(f"{what}: mesh {name} must have finite vertices, got {bad} with NaN or Inf; repair it")
    if int(faces.max()) >= len(positions):
        raise SceneError(f"{what}: mesh {name} must index its {len(positions)} vertices, got {int(faces.max())}")
    corners = positions[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    degenerate = int((np.linalg.norm(normals, axis=1) <= 0).sum())
    if degenerate == len(faces):
        raise SceneError(f"{what}: mesh {name} must have area, got {degenerate} triangles without; remove it")
    return degenerate


def _mend_normals(mesh: Any) -> list[str]:
    """Vertex normals of zero shade NaN where a triangle has three: they become the mean normal of their faces."""
    parameters = mi.traverse(mesh)
    if "vertex_normals" not in parameters:  # none, or a rectangle, which makes its own
        return []
    normals = np.array(parameters["vertex_normals"], dtype=np.float64).reshape(-1, 3)
    missing = np.linalg.norm(normals, axis=1) <= 0
    if not missing.any():
        return []
    positions = np.array(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    faces = np.array(parameters["faces"]).reshape(-1, 3)
    corners = positions[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    mean = np.zeros_like(normals)
    np.add.at(mean, faces.ravel(), np.repeat(face_normals, 3, axis=0))
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    mean = np.where(length > 0, mean / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])
    normals[missing] = mean[missing]
    parameters["vertex_normals"] = normals.astype(np.float32).ravel()
    parameters.update()
    return [f"mesh {mesh.id()}: {int(missing.sum())} vertex normals without length are taken from its faces"]


def bounds(scene: Any) -> tuple[np.ndarray, float]:
    """Centre [3] and diagonal of the scene's bounding box, scene units."""
    box = scene.bbox()
    low, high = np.array(box.min, dtype=np.float64).ravel(), np.array(box.max, dtype=np.float64).ravel()
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return np.zeros(3), 1.0
    return (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
