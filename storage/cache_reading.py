"""Reads a whole cache set and verifies every row of it against the units' markers."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from storage import layout, markers
from storage.cache_arrays import ArraySpec

if TYPE_CHECKING:
    from storage.caches import CacheSet


def read_arrays(caches: "CacheSet") -> dict[str, np.ndarray]:
    """All arrays of a set whose units are committed.

    Raises:
        MissingUnitError: a marker or a chunk is gone. Never zeros instead.
        DamagedUnitError: a chunk differs from its marker.
        StorageError: the file system refused.
    """
    listed = caches.store.files.sizes(layout.caches_folder(caches.ref.folder))
    records = _unit_records(caches)
    return {name: _read_array(caches, spec, records, listed) for name, spec in caches.specs.items()}


def _unit_records(caches: "CacheSet") -> list[dict[str, Any]]:
    """Markers of all units, many at once."""
    store, folder = caches.store, caches.ref.folder
    paths = [layout.bake_marker(folder, index) for index in range(caches.num_units)]
    records = []
    for index, (path, data) in enumerate(store.files.read_each(dict.fromkeys(paths, 0))):
        record = store.parse_marker(path, data, caches.ref)
        if record is None:
            raise caches.missing([index])
        if record["rows_sha256"].keys() != caches.specs.keys():
            raise caches.damaged(index, layout.caches_folder(folder), f"lacks {sorted(record['rows_sha256'])}")
        records.append(record)
    return records


def _read_array(
    caches: "CacheSet", spec: ArraySpec, records: Sequence[Mapping[str, Any]], listed: Mapping[str, int]
) -> np.ndarray:
    """Reads an array at once; where that fails, unit by unit to name the one that is damaged."""
    for index in range(caches.num_units):
        chunk = _chunk(caches, spec, index)
        if chunk not in listed:
            raise caches.missing([index], f" (no {caches.store.files.path(chunk)})")
    try:
        values = np.ascontiguousarray(caches.array(spec.name)[...])
    except Exception:  # told below, with the unit's name
        values = np.zeros(spec.shape, spec.dtype)
    for index, record in enumerate(records):
        rows, digest = spec.rows(index), record["rows_sha256"][spec.name]
        if markers.sha256_hex(values[rows].data) != digest:
            values[rows] = _read_unit(caches, spec, index, digest)
    return values


def _read_unit(caches: "CacheSet", spec: ArraySpec, index: int, digest: str) -> np.ndarray:
    path = _chunk(caches, spec, index)
    try:
        rows = np.ascontiguousarray(caches.array(spec.name)[spec.rows(index)])
    except Exception as error:  # a checksum, the decompressor or a size: each codec has its own error
        refused = caches.store.files.refusal(error, path, "readable")
        raise refused or caches.damaged(index, path, f"cannot be decoded: {error}") from error
    if markers.sha256_hex(rows.data) != digest:
        raise caches.damaged(index, path, "differs from its SHA-256")
    return rows


def _chunk(caches: "CacheSet", spec: ArraySpec, index: int) -> str:
    return f"{caches.ref.folder}/{layout.chunk_file(spec.name, index, len(spec.shape))}"
