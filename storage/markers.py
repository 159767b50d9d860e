"""Commit markers: the only record that says a unit is done. Pure functions from fields to bytes and back."""

import hashlib
import json
import platform
import time
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from typing import Any

from storage import layout
from storage.errors import CanonicalError
from storage.keys import canonical_json, plain
from storage.layout import LAYOUT_VERSION

CHECKSUM = "marker_sha256"
_LIBRARIES = ("numpy", "zarr", "OpenEXR", "safetensors")


def sha256_hex(data: bytes | memoryview) -> str:
    return hashlib.sha256(data).hexdigest()


def file_entry(data: bytes) -> dict[str, Any]:
    """What a marker says of a file: its SHA-256 and its size."""
    return {"sha256": sha256_hex(data), "nbytes": len(data)}


def stored_entries(files: Mapping[str, bytes], *, by_content: bool) -> dict[str, dict[str, Any]]:
    """What a marker says of a unit's files; `by_content` gives each a name of its own for its bytes ("at")."""
    entries = {layout.file_name(name): file_entry(data) for name, data in files.items()}
    if by_content:
        for name, entry in entries.items():
            entry["at"] = layout.object_name(name, entry["sha256"])
    return entries


def compose(own: Mapping[str, Any], record: Mapping[str, Any]) -> dict[str, Any]:
    """Joins the store's own fields with those of the stage (parameters, seconds, health counts, ...).

    Args:
        own: fields that belong to the store (key, stage, files, ...).
        record: what the stage adds. It may give `seed` and `versions`; versions are merged.

    Returns:
        All fields, with `versions` and `created_unix_s`.

    Raises:
        CanonicalError: the record contradicts one of the store's own fields, or has no JSON form.
    """
    fields = plain(dict(record), "record")
    own = plain({**own, "created_unix_s": round(time.time(), 3)}, "marker")
    for name in own.keys() & fields.keys() - {"seed", "created_unix_s"}:
        if fields[name] != own[name]:
            raise CanonicalError(f"record[{name!r}] must be left to the store, got {fields[name]!r}; rename the field")
    versions = {**_versions(), **fields.pop("versions", {})}
    if fields.get("seed") is None:  # None means "not given"; 0 is a real seed
        fields.pop("seed", None)
    return {**own, **fields, "created_unix_s": own["created_unix_s"], "versions": versions}


def seal(fields: Mapping[str, Any]) -> bytes:
    """Writes a marker as readable JSON that carries a checksum of itself."""
    body = {name: value for name, value in plain(fields, "marker").items() if name != CHECKSUM}
    body[CHECKSUM] = sha256_hex(canonical_json(body))
    return json.dumps(body, indent=1, sort_keys=True).encode()


def unseal(data: bytes) -> dict[str, Any]:
    """Reads a marker back.

    Raises:
        ValueError: these bytes are no marker, or not the ones that were written.
    """
    fields = json.loads(data)
    if not isinstance(fields, dict) or fields.pop(CHECKSUM, None) != sha256_hex(canonical_json(fields)):
        raise ValueError("its content does not match its own checksum")
    return fields


@cache
def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "store_layout": str(LAYOUT_VERSION)}
    for name in _LIBRARIES:
        found[name] = metadata.version(name)
    return found
