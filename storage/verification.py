"""Reads a whole store and tells what is wrong with it."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from storage import layout, markers
from storage.errors import StorageError
from storage.layout import UnitRef

if TYPE_CHECKING:
    from storage.store import Store


def difference(data: bytes | None, entry: Mapping[str, Any]) -> str:
    """Tells how a file differs from what its marker says; "" when it does not.

    Args:
        data: content of the file, None where it is missing.
        entry: `sha256` and `nbytes` of the marker.
    """
    if data is None:
        return "is missing"
    if len(data) != entry["nbytes"]:
        return f"has {len(data)} bytes instead of {entry['nbytes']}"
    if markers.sha256_hex(data) != entry["sha256"]:
        return "differs from its SHA-256"
    return ""


def verify_store(store: "Store") -> list[str]:
    """Checks every file that a marker speaks for, and names what no marker speaks for.

    Returns:
        One sentence a problem, with path and remedy; empty when all is well.
    """
    problems = []
    for digest in filter(layout.is_segment, store.files.names(layout.SCENES)):
        names = store.files.names(layout.scene_folder(digest))
        if layout.SCENE_FILE not in names:
            path = store.files.path(layout.scene_folder(digest))
            problems.append(f"{path} is no registered scene; submit the scene again")
        for stage in names:
            if stage not in (layout.SCENE_FILE, layout.TRADEOFF_FILE) and layout.is_segment(stage):
                problems += _stage_problems(store, digest, stage)
    return problems


def _stage_problems(store: "Store", digest: str, stage: str) -> Iterator[str]:
    folder = layout.stage_folder(digest, stage)
    for key in store.files.names(folder):
        if layout.is_partial(key):
            path = store.files.path(f"{folder}/{key}")
            yield f"{path} is left from an interrupted write; delete it when nothing is running"
        elif layout.is_segment(key):
            yield from _unit_problems(store, UnitRef(digest, stage, key))


def _unit_problems(store: "Store", ref: UnitRef) -> Iterator[str]:
    indices = map(layout.bake_marker_index, store.files.names(layout.bake_markers_folder(ref.folder)))
    paths = [layout.bake_marker(ref.folder, index) for index in indices if index is not None]
    is_cache_set = store.files.exists(layout.caches_folder(ref.folder))
    if not is_cache_set and not store.files.exists(layout.unit_marker(ref.folder)):
        yield f"{store.files.path(ref.folder)} has no commit marker; discard the unit and run its stage again"
        return
    for path in [layout.unit_marker(ref.folder), *paths]:
        try:
            fields = store.read_marker(path, ref)
        except StorageError as error:
            yield str(error)
            continue
        for name, entry in (fields or {"files": {}})["files"].items():
            data = store.files.read(f"{ref.folder}/{name}")
            if problem := difference(data, entry):
                yield str(store.damage(ref, f"{ref.folder}/{name}", problem))
