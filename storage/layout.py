"""The one place that knows where things lie in a store. Paths are relative to the store's root, with "/"
everywhere.

store.json                                      layout version; a folder without it is no store
quarantine/<digest>/<stage>/<key>/unit.json     why a unit was set aside; a bake unit: 000042.json
scenes/<digest>/scene.json                      name and facts of a scene
scenes/<digest>/tradeoff.json                   its measured operating points, replaced as a whole
scenes/<digest>/<stage>/<key>/<files>           one unit
scenes/<digest>/<stage>/<key>/commit.json       its marker, written last
scenes/<digest>/bake/<key>/caches.zarr/         a cache set: zarr v3 arrays, one chunk per bake unit
scenes/<digest>/bake/<key>/units/000042.json    marker of one bake unit
.../.<name>.<random>.partial                    being written, or left by a crash: never read

In a remote store a unit's files are <sha256>.<name>: writers of different bytes never meet, and the one marker
that is put decides. The marker's file entry says so in "at"; a reader needs nothing else, so a store may be
copied between a folder and a bucket.
"""

import re
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from storage.errors import PathNameError

LAYOUT_VERSION = 2  # 2: store.json and scene.json carry a checksum
READABLE_LAYOUTS = (1, 2)
STORE_FILE = "store.json"
SCENES = "scenes"
SCENE_FILE = "scene.json"
TRADEOFF_FILE = "tradeoff.json"
MARKER = "commit.json"
CACHES = "caches.zarr"
UNIT_MARKERS = "units"
QUARANTINE = "quarantine"
ZARR_METADATA = "zarr.json"

_SEGMENT = re.compile(r"[0-9A-Za-z][0-9A-Za-z_.-]{0,127}")
_UNIT_MARKER = re.compile(r"(\d{6,})\.json")
_MAX_NAME_NBYTES = 200  # file systems allow 255; the temporary name needs the rest
_PARTIAL = ".partial"
_OBJECT_DIGITS = 16  # of the SHA-256: tells the few files of one name and unit apart


@dataclass(frozen=True)
class UnitRef:
    """Address of a unit: a frame, a training run, a cache set."""

    scene_digest: str
    stage: str
    key: str

    @property
    def folder(self) -> str:
        """Path of the unit's folder, relative to the store."""
        return unit_folder(self.scene_digest, self.stage, self.key)

    def __str__(self) -> str:
        return f"{self.stage}/{self.key} of scene {self.scene_digest}"


def scene_folder(digest: str) -> str:
    return f"{SCENES}/{_segment('scene digest', digest)}"


def scene_file(digest: str) -> str:
    return f"{scene_folder(digest)}/{SCENE_FILE}"


def tradeoff_file(digest: str) -> str:
    return f"{scene_folder(digest)}/{TRADEOFF_FILE}"


def stage_folder(digest: str, stage: str) -> str:
    return f"{scene_folder(digest)}/{_segment('stage', stage)}"


def unit_folder(digest: str, stage: str, key: str) -> str:
    return f"{stage_folder(digest, stage)}/{_segment('key', key)}"


def unit_marker(folder: str) -> str:
    return f"{folder}/{MARKER}"


def array_name(name: str) -> str:
    """Checks the name of a cache array."""
    return _segment("array name", name)


def caches_folder(folder: str) -> str:
    return f"{folder}/{CACHES}"


def chunk_file(array: str, index: int, num_axes: int) -> str:
    """Path of a bake unit's chunk inside the unit folder, by zarr's default chunk keys."""
    return "/".join([CACHES, array, "c", str(index), *["0"] * (num_axes - 1)])


def object_name(name: str, sha256: str) -> str:
    """Name of a unit's file in a remote store."""
    return f"{sha256[:_OBJECT_DIGITS]}.{file_name(name)}"


def stored_file(folder: str, name: str, entry: Mapping[str, Any]) -> str:
    """Path of a file that a marker speaks of.

    Raises:
        PathNameError: the marker names a place outside its unit.
    """
    at = str(entry.get("at", name))
    if any(part in ("", ".", "..") for part in at.split("/")):
        raise PathNameError(f"file of {folder} must lie in its unit, got {at!r}; the marker is not ours")
    return f"{folder}/{at}"


def quarantine_folder(digest: str = "") -> str:
    return f"{QUARANTINE}/{_segment('scene digest', digest)}" if digest else QUARANTINE


def quarantine_file(ref: UnitRef, unit: int | None) -> str:
    """Path of the record that says why a unit, or one bake unit of a cache set, was set aside."""
    name = "unit.json" if unit is None else f"{unit:06d}.json"
    return f"{QUARANTINE}/{ref.folder.removeprefix(SCENES + '/')}/{name}"


def bake_markers_folder(folder: str) -> str:
    return f"{folder}/{UNIT_MARKERS}"


def bake_marker(folder: str, index: int) -> str:
    return f"{bake_markers_folder(folder)}/{index:06d}.json"


def bake_marker_index(name: str) -> int | None:
    """Index of the bake unit whose marker has this file name; None for any other file."""
    match = _UNIT_MARKER.fullmatch(name)
    return int(match.group(1)) if match else None


def partial_name(path: str) -> str:
    """A fresh name beside `path` (same folder, so a rename stays on one file system)."""
    folder, _, name = path.rpartition("/")
    return f"{folder}/.{name}.{uuid.uuid4().hex[:12]}{_PARTIAL}"


def is_segment(name: str) -> bool:
    """Whether a name could be a scene's, a stage's or a unit's; others (.DS_Store) are not ours."""
    return _SEGMENT.fullmatch(name) is not None


def is_partial(name: str) -> bool:
    """Whether a file is being written, or was when a process died; zarr's own end like ours."""
    return name.endswith(_PARTIAL)


def file_name(name: str) -> str:
    """Checks the name of a file in a unit: any letters, one path segment, not hidden, not the marker's.

    Raises:
        PathNameError: the name breaks one of these rules.
    """
    printable = isinstance(name, str) and name.isprintable() and not set(name) & set('/\\:*?"<>|')
    fits = printable and 0 < len(name.encode("utf-8", "surrogatepass")) <= _MAX_NAME_NBYTES
    if not fits or name.startswith(".") or is_partial(name) or name in (MARKER, UNIT_MARKERS, CACHES):
        raise PathNameError(
            f"file name must be one visible path segment of at most {_MAX_NAME_NBYTES} bytes other than "
            f"{MARKER}, {UNIT_MARKERS}, {CACHES} and *{_PARTIAL}, got {name!r}; rename it"
        )
    return name


def _segment(what: str, text: str) -> str:
    if not isinstance(text, str) or not is_segment(text):
        raise PathNameError(
            f"{what} must be 1 to 128 letters, digits, '_', '-' or '.', starting with a letter or digit, "
            f"got {text!r}; "
            "use a digest or a plain name"
        )
    return text
