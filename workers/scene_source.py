"""From the source of a scene, a file or the name of a built-in one, to its reader."""

import re
from pathlib import Path

from workers.builtin_scenes import BUILTIN_SCENES, read_builtin
from workers.errors import SceneError
from workers.scene_draft import SceneDraft
from workers.scene_mesh import MESH_SUFFIXES, read_mesh
from workers.scene_xml import read_xml
from workers.scene_yaml import YAML_SUFFIXES, read_yaml


def read_source(source: str | Path) -> tuple[str, SceneDraft]:
    """Chooses the reader; returns the scene's slug and its draft, which is not checked yet.

    Raises:
        SceneError: there is no such scene, or its reader cannot use it.
    """
    builtin = str(source).removeprefix("builtin:")
    if builtin in BUILTIN_SCENES and not Path(str(source)).is_file():
        return builtin, read_builtin(builtin)
    if str(source).startswith("builtin:"):
        raise SceneError(f"built-in scene must be one of {', '.join(sorted(BUILTIN_SCENES))}, got {builtin!r}")
    path = Path(source)
    if path.is_dir():
        path = path / "scene.xml"
    suffix = path.suffix.lower()
    readers = {
        ".xml": read_xml,
        **dict.fromkeys(YAML_SUFFIXES, read_yaml),
        **dict.fromkeys(MESH_SUFFIXES, read_mesh),
    }
    if suffix not in readers:
        raise SceneError(
            f"scene must be a {', '.join(sorted(readers))} file or one of "
            f"{', '.join(sorted(BUILTIN_SCENES))}, got {str(source)!r}"
        )
    if not path.is_file():
        raise SceneError(f"scene file must exist, got {str(source)!r}; check the path")
    stem = path.resolve().parent.name if path.stem == "scene" else path.stem
    return _slug(stem), readers[suffix](path)


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "scene"
