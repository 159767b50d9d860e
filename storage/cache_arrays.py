"""The zarr v3 arrays of a cache set: their specification, and how they are created and opened.

Chunks are compressed and carry a CRC32C. One chunk is one bake unit, so a unit has one writer and no locks.
"""

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.errors import ContainsArrayError, ContainsGroupError
from zarr.storage import FsspecStore, LocalStore

from storage import layout
from storage.durable import FileTree
from storage.errors import CacheMismatchError

METADATA = layout.ZARR_METADATA
_ZSTD_LEVEL = 1  # noisy floats hardly shrink; a higher level only costs time


@dataclass(frozen=True)
class ArraySpec:
    """One array of a cache set.

    Attributes:
        name: a plain name, such as `diffuse_radiance`.
        shape: (elements, ...).
        dtype: numpy name, such as "float32".
        rows_per_unit: elements in each bake unit; the last unit may hold fewer.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    rows_per_unit: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", tuple(int(length) for length in self.shape))
        object.__setattr__(self, "dtype", np.dtype(self.dtype).name)
        layout.array_name(self.name)
        if not self.shape or min(self.shape) < 1 or self.rows_per_unit < 1:
            raise CacheMismatchError(
                f"array {self.name} must have at least one row, column and row per unit, "
                f"got shape {self.shape} and rows_per_unit {self.rows_per_unit}; leave empty arrays out"
            )

    @property
    def num_units(self) -> int:
        return math.ceil(self.shape[0] / self.rows_per_unit)

    def rows(self, index: int) -> slice:
        """Rows of a unit."""
        return slice(index * self.rows_per_unit, min((index + 1) * self.rows_per_unit, self.shape[0]))

    def unit_shape(self, index: int) -> tuple[int, ...]:
        rows = self.rows(index)
        return (rows.stop - rows.start, *self.shape[1:])


def create_group(files: FileTree, folder: str, attributes: Mapping[str, Any]) -> zarr.Group:
    """Creates the group of a cache set, or opens the one that is there.

    Raises:
        CacheMismatchError: it was made with other attributes.
    """
    try:
        group = zarr.create_group(_zarr_store(files, folder), zarr_format=3, attributes=dict(attributes))
        files.sync(f"{folder}/{METADATA}")
    except ContainsGroupError:
        group = open_group(files, folder)
    if dict(group.attrs) != attributes:
        raise CacheMismatchError(
            f"attributes of {files.path(folder)} must be those it was made with, {dict(group.attrs)}, "
            f"got {dict(attributes)}; make what differs part of the key"
        )
    return group


def open_group(files: FileTree, folder: str) -> zarr.Group:
    return zarr.open_group(_zarr_store(files, folder), mode="r+", zarr_format=3)


def create_array(files: FileTree, folder: str, group: zarr.Group, spec: ArraySpec) -> None:
    """Creates one array of a cache set where it is not there yet.

    Raises:
        CacheMismatchError: it is there with another shape, chunk or dtype.
    """
    try:
        group.create_array(
            spec.name,
            shape=spec.shape,
            chunks=(spec.rows_per_unit, *spec.shape[1:]),
            dtype=spec.dtype,
            compressors=[ZstdCodec(level=_ZSTD_LEVEL), Crc32cCodec()],
        )
        files.sync(f"{folder}/{spec.name}/{METADATA}")
    except ContainsArrayError:
        stored = spec_of(open_array(group, spec.name))
        if stored != spec:
            raise CacheMismatchError(
                f"array of {files.path(folder)} must stay {stored}, got {spec}; make what differs part of the key"
            ) from None


def open_array(group: zarr.Group, name: str) -> zarr.Array:
    """Opens an array so that chunks of zeros are written too: zarr forgets this setting between sessions."""
    array = group[name]
    if not isinstance(array, zarr.Array):
        raise CacheMismatchError(f"{name} must be an array, got a group; use another array name")
    return array.with_config({"write_empty_chunks": True})


def arrays_of(files: FileTree, folder: str, group: zarr.Group) -> list[zarr.Array]:
    """Arrays of a group by name; folders without metadata, which a killed bake leaves, and groups are passed over."""
    names = [name for name in files.names(folder) if name != METADATA and not layout.is_partial(name)]
    found = []
    for name in names:
        with contextlib.suppress(KeyError):
            found.append(group[name])
    return [array for array in found if isinstance(array, zarr.Array)]


def spec_of(array: zarr.Array) -> ArraySpec:
    """The specification that an array was made with."""
    return ArraySpec(array.basename, array.shape, array.dtype.name, array.chunks[0])


def _zarr_store(files: FileTree, folder: str) -> LocalStore | FsspecStore:
    if files.is_local:
        return LocalStore(files.path(folder))
    url = files.filesystem.unstrip_protocol(files.path(folder))
    return FsspecStore.from_url(url, storage_options=dict(files.filesystem.storage_options))
