"""Cache sets: zarr v3 arrays of baked elements, one chunk along axis 0 for each bake unit.

Each unit has one writer. Its chunks are written and flushed first, its marker last. A missing chunk is an
error: zarr would fill it with zeros, which look like darkness.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import zarr

from storage import cache_arrays, layout, markers
from storage.cache_arrays import ArraySpec
from storage.cache_reading import read_arrays
from storage.errors import CacheMismatchError, DamagedUnitError, MissingUnitError, StorageError
from storage.keys import plain, seed_from_key
from storage.layout import UnitRef
from storage.store import Store
from storage.verification import difference

__all__ = ["ArraySpec", "CacheSet", "marked_units"]

_SHOWN = 8  # indices named in an error


class CacheSet:
    """Arrays that a bake fills unit by unit. Make one with `CacheSet.create_or_open`."""

    def __init__(self, store: Store, ref: UnitRef, group: zarr.Group, specs: Sequence[ArraySpec]) -> None:
        self.store = store
        self.ref = ref
        self.specs = {spec.name: spec for spec in specs}
        self._group = group
        self._arrays = {spec.name: cache_arrays.open_array(group, spec.name) for spec in specs}

    @classmethod
    def create_or_open(
        cls, store: Store, ref: UnitRef, arrays: Sequence[ArraySpec], attributes: Mapping[str, Any]
    ) -> "CacheSet":
        """Opens the cache set of a key, creating what is not there yet. Several processes may do so at once.

        Args:
            store: where it lies.
            ref: its address; everything that shapes the arrays must be part of the key.
            arrays: all arrays, each with the same number of units.
            attributes: JSON-like facts that a reader needs (directions, units, demodulation).

        Raises:
            CacheMismatchError: arrays disagree with each other or with what is stored.
            DamagedUnitError: zarr's own metadata cannot be read.
        """
        names = {spec.name for spec in arrays}
        if len({spec.num_units for spec in arrays}) != 1 or len(names) != len(arrays):
            raise CacheMismatchError(
                "arrays must have distinct names and one common number of units, "
                f"got {[(spec.name, spec.num_units) for spec in arrays]}; choose rows_per_unit to match"
            )
        files, folder = store.files, layout.caches_folder(ref.folder)
        with _opening(store, ref), files.writing(folder):
            group = cache_arrays.create_group(files, folder, plain(dict(attributes), "attributes"))
            for spec in arrays:
                cache_arrays.create_array(files, folder, group, spec)
            return cls(store, ref, group, arrays)

    @classmethod
    def open(cls, store: Store, ref: UnitRef) -> "CacheSet":
        """Opens a cache set as it was made, to read it.

        Raises:
            MissingUnitError: there is none.
            DamagedUnitError: zarr's own metadata cannot be read, or differs from the commit marker.
        """
        folder = layout.caches_folder(ref.folder)
        committed = store.committed(ref)
        if committed is None and not store.files.names(folder):
            raise MissingUnitError(
                f"cache set {ref} must be in store {store.url}, got no {store.files.path(folder)}; run the bake first"
            )
        for name, entry in (committed or {"files": {}})["files"].items():
            if problem := difference(store.files.read(f"{ref.folder}/{name}"), entry):
                raise store.damage(ref, f"{ref.folder}/{name}", problem)
        with _opening(store, ref):
            group = cache_arrays.open_group(store.files, folder)
            specs = [cache_arrays.spec_of(array) for array in cache_arrays.arrays_of(store.files, folder, group)]
        if not specs:  # a bake died between making the group and its first array
            raise MissingUnitError(
                f"cache set {ref} must hold arrays in store {store.url}, got none in {store.files.path(folder)}; "
                "run the bake again"
            )
        return cls(store, ref, group, specs)

    @property
    def num_units(self) -> int:
        return next(iter(self.specs.values())).num_units

    @property
    def attributes(self) -> dict[str, Any]:
        return dict(self._group.attrs)

    @property
    def nbytes(self) -> int:
        """Bytes at rest: compressed chunks, metadata and markers."""
        return self.store.nbytes(self.ref)

    def write_unit(self, index: int, rows: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> dict[str, Any]:
        """Stores one bake unit, marker last. A unit that is already committed is left as it is.

        Args:
            index: unit, in [0, num_units).
            rows: for every array its (rows, ...) of this unit, of the array's own dtype.
            record: facts for the marker (seconds, health); `seed` defaults to `unit_seed(index)`.

        Returns:
            The marker's fields.

        Raises:
            CacheMismatchError: index, names, shapes or dtypes do not fit.
            StoreWriteError: the file system refused; the unit is not committed.
        """
        self._check_rows(index, rows)
        existing = self.unit_record(index)
        if existing is not None:
            return existing
        digests = {name: markers.sha256_hex(np.ascontiguousarray(array).data) for name, array in rows.items()}
        own = {"unit": index, "seed": self.unit_seed(index), "rows_sha256": digests}
        markers.compose(own, record)  # a record that cannot be stored must fail before any byte is written
        files = {}
        for name, array in rows.items():
            chunk = layout.chunk_file(name, index, array.ndim)
            files[chunk] = markers.file_entry(self._write_chunk(index, name, array, chunk))
        fields = markers.compose({**self.store.own_fields(self.ref, files), **own}, record)
        if self.store.files.write_new(layout.bake_marker(self.ref.folder, index), markers.seal(fields)):
            return fields
        return self.unit_record(index) or fields

    def unit_seed(self, index: int) -> int:
        """The seed of a bake unit, from the set's key."""
        return seed_from_key(self.ref.key, f"unit {index}")

    def committed_units(self) -> set[int]:
        """Indices of the units whose marker is there. Resume = range(num_units) minus these."""
        return {index for index in marked_units(self.store, self.ref) if index < self.num_units}

    def unit_record(self, index: int) -> dict[str, Any] | None:
        """Fields of a unit's marker; None where it is not committed.

        Raises:
            DamagedUnitError: the marker is there but unreadable.
        """
        return self.store.read_marker(layout.bake_marker(self.ref.folder, index), self.ref)

    def discard_unit(self, index: int) -> None:
        """Takes one unit's marker away, and the set's own, so that the unit is baked again."""
        self.store.files.remove_file(layout.unit_marker(self.ref.folder))
        self.store.files.remove_file(layout.bake_marker(self.ref.folder, index))

    def quarantine_unit(self, index: int, reason: str, facts: Mapping[str, Any]) -> dict[str, Any]:
        """Records why a bake unit was set aside; see `Store.quarantine`."""
        return self.store.quarantine(self.ref, reason, unit=index, facts=facts)

    def commit(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Marks the whole set as done, so that `Store.units` and `Store.committed` know it.

        Args:
            record: facts for the marker (parameters, seconds, health).

        Returns:
            The marker's fields; its files are zarr's metadata, as the chunks are in the units' markers.

        Raises:
            MissingUnitError: a unit is not committed.
        """
        self._check_complete()
        existing = self.store.committed(self.ref)
        if existing is not None:
            return existing
        names = ["", *(f"{name}/" for name in self.specs)]
        paths = [f"{layout.CACHES}/{name}{cache_arrays.METADATA}" for name in names]
        contents = {path: self.store.files.read(f"{self.ref.folder}/{path}") or b"" for path in paths}
        files = {path: markers.file_entry(data) for path, data in contents.items()}
        own = {**self.store.own_fields(self.ref, files), "num_units": self.num_units}
        fields = markers.compose(own, record)
        if self.store.files.write_new(layout.unit_marker(self.ref.folder), markers.seal(fields)):
            return fields
        return self.store.committed(self.ref) or fields

    def load(self) -> dict[str, np.ndarray]:
        """Reads all arrays into memory and verifies every row.

        Raises:
            MissingUnitError: a unit is not committed, or a chunk is gone. Never zeros instead.
            DamagedUnitError: a chunk differs from its marker.
        """
        self._check_complete()
        return read_arrays(self)

    def array(self, name: str) -> zarr.Array:
        """An array as zarr sees it, unverified."""
        return self._arrays[name]

    def _check_complete(self) -> None:
        missing = sorted(set(range(self.num_units)) - self.committed_units())
        if missing:
            raise self.missing(missing)

    def _write_chunk(self, index: int, name: str, array: np.ndarray, chunk: str) -> bytes:
        """Writes a chunk, forces it to the disk and returns the bytes that lie there."""
        files = self.store.files
        path = f"{self.ref.folder}/{chunk}"
        with files.writing(path):
            self._arrays[name][self.specs[name].rows(index)] = array
            files.sync(path)
            return files.filesystem.cat_file(files.path(path))

    def _check_rows(self, index: int, rows: Mapping[str, np.ndarray]) -> None:
        if not 0 <= index < self.num_units:
            raise CacheMismatchError(f"unit must be in [0, {self.num_units}), got {index}; check the plan")
        if rows.keys() != self.specs.keys():
            raise CacheMismatchError(
                f"rows must be given for {sorted(self.specs)}, got {sorted(rows)}; give every array"
            )
        for name, array in rows.items():
            spec = self.specs[name]
            if array.shape != spec.unit_shape(index) or array.dtype.name != spec.dtype:
                raise CacheMismatchError(
                    f"rows of {name} in unit {index} must be {spec.dtype} {spec.unit_shape(index)}, "
                    f"got {array.dtype.name} {array.shape}; convert them"
                )

    def missing(self, indices: Sequence[int], reason: str = "") -> MissingUnitError:
        """The error for bake units that are not there."""
        more = ", ..." if len(indices) > _SHOWN else ""
        shown = ", ".join(str(index) for index in indices[:_SHOWN]) + more
        return MissingUnitError(
            f"cache set {self.ref} in store {self.store.url} must hold all of its {self.num_units} units, "
            f"got {len(indices)} without: {shown}{reason}; "
            f"run: lightwell verify --store {self.store.url} --repair, then run the scene again"
        )

    def damaged(self, index: int, path: str, problem: str) -> DamagedUnitError:
        """The error for a bake unit that is not what its marker promises."""
        return DamagedUnitError(
            f"bake unit {index} of {self.ref} in store {self.store.url} must hold what its marker promises, "
            f"but {self.store.files.path(path)} {problem}; "
            f"run: lightwell verify --store {self.store.url} --repair, then run the scene again"
        )


def marked_units(store: Store, ref: UnitRef) -> set[int]:
    """Indices of the bake units with a marker, of a cache set that need not exist yet: what a plan asks."""
    indices = (layout.bake_marker_index(name) for name in store.files.names(layout.bake_markers_folder(ref.folder)))
    return {index for index in indices if index is not None}


@contextlib.contextmanager
def _opening(store: Store, ref: UnitRef) -> Iterator[None]:
    try:
        yield
    except StorageError:
        raise
    except Exception as error:  # zarr answers bad metadata with JSON, key, type or its own errors
        path = layout.caches_folder(ref.folder)
        if refused := store.files.refusal(error, path, "readable"):
            raise refused from error
        raise store.damage(ref, path, f"cannot be opened: {type(error).__name__}: {error}") from error
