"""Errors of the storage package: one root, each also a fitting builtin.

A message reads "<thing> must <rule>, got <value>; <remedy>" and names the store and the path it speaks of.
"""


class StorageError(Exception):
    """Root of everything this package raises on purpose."""


class StoreNotFoundError(StorageError, FileNotFoundError):
    """The URL holds no Lightwell store and none was asked to be created."""


class StoreVersionError(StorageError, ValueError):
    """The store was written with another layout than this code reads."""


class StoreWriteError(StorageError, OSError):
    """The file system refused a write (disk full, quota, read-only)."""


class StoreReadError(StorageError, OSError):
    """The file system could not read what is there (a failing disk, a remote store that answers with an error)."""


class StoreAccessError(StorageError, PermissionError):
    """The file system or the remote store denied a read or a write."""


class StoreUnreachableError(StorageError, ConnectionError):
    """The remote store does not answer."""


class StoreUrlError(StorageError, ValueError):
    """The URL of a store names no bucket, no known protocol, or a package that is not installed."""


class SceneNotFoundError(StorageError, LookupError):
    """No scene, or more than one, answers to that name or digest."""


class MissingUnitError(StorageError, LookupError):
    """A unit, one of its files or one of its chunks is not in the store."""


class DamagedUnitError(StorageError, OSError):
    """Bytes in the store differ from what their commit marker promises."""


class PathNameError(StorageError, ValueError):
    """A digest, stage, key or file name cannot be one segment of a path."""


class CanonicalError(StorageError, ValueError):
    """A value has no canonical JSON form (NaN, infinity, a set, an object)."""


class CacheMismatchError(StorageError, ValueError):
    """Rows or specifications do not fit the cache arrays they are meant for."""


class FrameError(StorageError, ValueError):
    """Layers cannot be stored as a frame, or bytes are not a frame of ours."""


class WeightsError(StorageError, ValueError):
    """Weights or a checkpoint cannot be encoded, or bytes are not what they should be."""


class DatasetError(StorageError, ValueError):
    """A folder is no dataset of ours, or its files are not what its manifest says."""
