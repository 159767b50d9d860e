"""What a scene's file asks for, read without building the scene: enough to check a job before it is queued."""

from dataclasses import dataclass, field
from typing import Any

from workers.errors import SceneError
from workers.scene_nodes import audit_nodes, first_sensor, set_film_size
from workers.scene_source import read_source


@dataclass(frozen=True, kw_only=True)
class SceneRequest:
    """The size of the pictures and the settings that a scene's file asks for.

    Attributes:
        name: the scene's slug.
        width, height: of its film, pixels.
        settings: overrides of the run's settings, by dotted key.
    """

    name: str
    width: int
    height: int
    settings: dict[str, Any] = field(default_factory=dict)


def read_scene_request(source: str) -> SceneRequest:
    """Reads a scene's file; meshes and textures are not loaded.

    Args:
        source: what `workers.scene.load_scene` takes.

    Raises:
        SceneError: the file is missing or broken, or holds what caches cannot represent.
    """
    name, draft = read_source(source)
    audit_nodes(draft.state, draft.what)
    sensor, _ = first_sensor(draft.state, draft.what)
    if sensor is None and draft.make_camera is None:
        raise SceneError(f'{draft.what} must hold a sensor, got none; add a <sensor type="perspective">')
    width, height = set_film_size(draft.state, None, None, draft.what)
    return SceneRequest(name=name, width=width, height=height, settings=dict(draft.settings))
