"""The entries of a store's scenes: name, facts and the run that is served. Each carries a checksum of itself."""

import json
import logging
from collections.abc import Iterator, Mapping
from typing import Any

from storage import layout, markers
from storage.durable import FileTree
from storage.errors import DamagedUnitError, SceneNotFoundError
from storage.keys import plain

log = logging.getLogger("lightwell.storage")

_OLDEST_SEALED_LAYOUT = 2
_told: set[str] = set()  # damaged entries that the log has named


def register(files: FileTree, digest: str, info: Mapping[str, Any]) -> dict[str, Any]:
    """Writes a scene's entry, or replaces it."""
    entry = {"name": digest, **plain(dict(info), "info"), "digest": digest}
    files.write(layout.scene_file(digest), markers.seal(entry))
    return entry


def entries(files: FileTree, layout_version: int) -> list[dict[str, Any]]:
    """Entries of the registered scenes by name.

    One that cannot be read is left out and named in the log: it must take no other scene with it. `damaged` finds it.
    """
    found = [entry for entry, _ in _read(files, layout_version) if entry is not None]
    return sorted(found, key=lambda entry: (str(entry["name"]), entry["digest"]))


def damaged(files: FileTree, layout_version: int) -> list[DamagedUnitError]:
    """What is wrong with the entries that cannot be read."""
    return [error for _, error in _read(files, layout_version) if error is not None]


def _read(files: FileTree, layout_version: int) -> Iterator[tuple[dict[str, Any] | None, DamagedUnitError | None]]:
    paths = [layout.scene_file(digest) for digest in files.names(layout.SCENES) if layout.is_segment(digest)]
    for path, data in files.read_each(dict.fromkeys(paths, 0)):
        if data is None:
            continue
        try:
            yield parse(files, path, data, layout_version), None
        except DamagedUnitError as error:
            if str(error) not in _told:
                _told.add(str(error))
                log.warning("a scene is left out: %s", error)
            yield None, error


def find(scenes: list[dict[str, Any]], name_or_digest: str, url: str) -> dict[str, Any]:
    """The scene of that digest, name, or first six or more digits of a digest.

    Raises:
        SceneNotFoundError: none or several match.
    """
    matches = [scene for scene in scenes if scene["digest"] == name_or_digest]
    matches = matches or [scene for scene in scenes if scene["name"] == name_or_digest]
    if not matches and len(name_or_digest) >= 6:
        matches = [scene for scene in scenes if scene["digest"].startswith(name_or_digest)]
    if len(matches) == 1:
        return matches[0]
    known = ", ".join(f"{scene['name']} ({scene['digest']})" for scene in matches or scenes) or "none"
    raise SceneNotFoundError(
        f"scene must match one in {url}, got {name_or_digest!r} with {len(matches)} matches; "
        f"{'tell them apart by digest' if matches else 'known scenes'}: {known}"
    )


def parse(files: FileTree, path: str, data: bytes | None, layout_version: int) -> dict[str, Any]:
    """Reads an entry, or the store's own header.

    Args:
        files: where it lies, for the message.
        path: relative path, for the message.
        data: content, None where there is none.
        layout_version: of the store; before 2 these files had no checksum.

    Raises:
        DamagedUnitError: it is no JSON object, or not the one that was written.
    """
    try:
        content = json.loads(data or b"")
        if not isinstance(content, dict):
            raise ValueError(f"a {type(content).__name__}")
        if layout_version < _OLDEST_SEALED_LAYOUT and markers.CHECKSUM not in content:
            return content
        return markers.unseal(data or b"")
    except ValueError as error:
        raise DamagedUnitError(
            f"{files.path(path)} in store {files.url} must hold the JSON object that was written, got: {error}; "
            f"run: lightwell verify --store {files.url} --repair, then run the scene again"
        ) from error
