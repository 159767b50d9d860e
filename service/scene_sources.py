"""From what a client calls a scene to what `load_scene` takes. A client never names a path of this machine."""

from pathlib import Path

from service.bundle_scenes import SCENE_SUFFIXES
from service.bundles import BundleStore
from service.errors import UnknownSceneError

BUILTIN_NAMES = ("tabletop", "tiny")
BUNDLE_SCHEME = "bundle:"


class SceneSources:
    """Built-in scenes, the scenes of one folder, and uploaded bundles.

    Args:
        bundles: uploaded ones; None where uploads are off.
        scenes_folder: whoever runs the service puts scenes there: files, or folders with a scene.xml. They are
            trusted, and not judged as bundles are.
    """

    def __init__(self, bundles: BundleStore | None = None, scenes_folder: Path | None = None) -> None:
        self._bundles, self._folder = bundles, scenes_folder

    def resolve_scene_source(self, name: str) -> str:
        """What `load_scene` takes for "tabletop", "hall", "hall/scene.yaml", "bundle:<id>" or "bundle:<id>/<file>".

        Raises:
            UnknownSceneError: there is no such scene; why (missing, outside the folder) is not told apart.
            UnknownBundleError: there is no such bundle, or it has no such scene.
        """
        if name.startswith(BUNDLE_SCHEME) and self._bundles is not None:
            bundle_id, _, scene = name.removeprefix(BUNDLE_SCHEME).partition("/")
            return str(self._bundles.scene_file(bundle_id, scene))
        if name.removeprefix("builtin:") in BUILTIN_NAMES:
            return name.removeprefix("builtin:")
        path = self._in_folder(name)
        if path is None:
            raise UnknownSceneError(
                f"scene must be one of {', '.join(self.names()[:50])} or bundle:<id>, got {name[:200]!r}; "
                "POST /v1/bundles adds a bundle"
            )
        return str(path)

    def names(self) -> list[str]:
        """Names of the built-in scenes and of those in the folder."""
        found: list[str] = []
        if self._folder is not None and self._folder.is_dir():
            found = sorted(path.name for path in self._folder.iterdir() if self._in_folder(path.name) is not None)
        return [*BUILTIN_NAMES, *found]

    def _in_folder(self, name: str) -> Path | None:
        """The scene file of this name, links resolved; None where it is missing or lies outside the folder."""
        if self._folder is None or not name or "\x00" in name or Path(name).is_absolute():
            return None
        if any(part.startswith(".") for part in Path(name).parts):
            return None
        try:
            folder = self._folder.resolve()
            path = (folder / name).resolve()
            if path.is_dir():
                path = (path / "scene.xml").resolve()
            inside = path.is_relative_to(folder) and path.is_file()
        except (OSError, RuntimeError, ValueError):  # too long, a circle of links, not encodable
            return None
        return path if inside and path.suffix.lower() in SCENE_SUFFIXES else None
