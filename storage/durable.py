"""A tree of files whose writes survive a crash: whole or not at all, on a local disk or elsewhere (fsspec).

A local disk gets a temporary name, flush, fsync and one rename. An object store shows an object only when
its upload has ended, so a plain put does the same there; it cannot rename folders, hence a marker is always
the last file put.
"""

import contextlib
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

from fsspec import AbstractFileSystem
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from storage import layout
from storage.errors import StorageError, StoreWriteError

_MAX_RENAMES = 16  # each failed turn means that another process moved the same folder in between


class FileTree:
    """Files below one root, addressed by relative paths with "/". It may be pickled to other processes."""

    def __init__(self, url: str | os.PathLike[str]) -> None:
        self.url = os.fspath(url)
        # Listings are not cached: other processes write too.
        filesystem, root = url_to_fs(self.url, use_listings_cache=False)
        self.filesystem: AbstractFileSystem = filesystem
        self.root: str = root.rstrip("/")

    @property
    def is_local(self) -> bool:
        return isinstance(self.filesystem, LocalFileSystem)

    def path(self, relative: str) -> str:
        """The path as the file system wants it."""
        return f"{self.root}/{relative}"

    def exists(self, relative: str) -> bool:
        return self.filesystem.exists(self.path(relative))

    def read(self, relative: str) -> bytes | None:
        """Content of a file; None where there is none."""
        try:
            return self.filesystem.cat_file(self.path(relative))
        except FileNotFoundError:
            return None

    def names(self, relative: str) -> list[str]:
        """Names in a folder, sorted; empty where it does not exist."""
        try:
            paths = self.filesystem.ls(self.path(relative), detail=False)
        except (FileNotFoundError, NotADirectoryError):
            return []
        return sorted(path.rstrip("/").rpartition("/")[2] for path in paths)

    def nbytes(self, relative: str) -> int:
        """Bytes of all files below a folder; 0 where it does not exist."""
        try:
            return sum(info["size"] for info in self.filesystem.find(self.path(relative), detail=True).values())
        except FileNotFoundError:
            return 0

    def remove(self, relative: str) -> None:
        """Removes a file or a whole folder; nothing happens where there is none."""
        with contextlib.suppress(FileNotFoundError):
            self.filesystem.rm(self.path(relative), recursive=True)

    def write(self, relative: str, data: bytes) -> None:
        """Puts one file in place, whole or not at all; an older file of that name is replaced.

        Raises:
            StoreWriteError: the file system refused; no temporary file is left.
        """
        with self.writing(relative):
            path = self.path(relative)
            self.filesystem.makedirs(path.rpartition("/")[0], exist_ok=True)
            if self.is_local:
                _replace_local_file(path, data)
            else:
                self.filesystem.pipe_file(path, data)

    def publish(self, relative: str, files: Mapping[str, bytes]) -> None:
        """Puts a folder of files in place. Its last file must be the marker: where it is, everything else is.

        Locally the folder appears by one rename, so a folder without a marker is debris and is replaced, and
        of two processes that publish the same folder the first wins and the second drops its copy. Elsewhere
        the files are put one by one; two processes may do so at once only because equal keys mean equal
        bytes.

        Raises:
            StoreWriteError: the file system refused; there is no marker and, locally, no temporary file.
        """
        with self.writing(relative):
            folder = self.path(relative)
            if self.is_local:
                _publish_local_folder(folder, files)
                return
            self.filesystem.makedirs(folder, exist_ok=True)
            for name, data in files.items():
                self.filesystem.pipe_file(f"{folder}/{name}", data)

    def sync(self, relative: str) -> None:
        """Forces a file that another library wrote down to the disk; does nothing in a remote tree."""
        if self.is_local:
            with self.writing(relative):
                _sync(self.path(relative), os.O_RDWR)
                _sync_folder(os.path.dirname(self.path(relative)))

    @contextlib.contextmanager
    def writing(self, relative: str) -> Iterator[None]:
        """Turns what the file system says of a failed write into a StoreWriteError with place and remedy."""
        try:
            yield
        except StorageError:
            raise
        except OSError as error:
            raise StoreWriteError(
                f"store {self.url} must be writable at {self.path(relative)}, got {type(error).__name__}: "
                f"{error}; "
                "free space or check permissions, then run again"
            ) from error


def _replace_local_file(path: str, data: bytes) -> None:
    partial = layout.partial_name(path)
    try:
        _write_and_sync(partial, data)
        os.replace(partial, path)
    finally:
        Path(partial).unlink(missing_ok=True)
    _sync_folder(os.path.dirname(path))


def _publish_local_folder(folder: str, files: Mapping[str, bytes]) -> None:
    partial = layout.partial_name(folder)
    try:
        os.makedirs(partial)
        for name, data in files.items():
            _write_and_sync(f"{partial}/{name}", data)
        _sync_folder(partial)
        _rename_folder(partial, folder, marker=list(files)[-1])
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    _sync_folder(os.path.dirname(folder))


def _rename_folder(partial: str, folder: str, marker: str) -> None:
    for _ in range(_MAX_RENAMES):
        try:
            os.rename(partial, folder)
            return
        except OSError:
            if not os.path.isdir(folder):
                raise
        if os.path.exists(f"{folder}/{marker}"):
            return  # another process was first
        debris = layout.partial_name(folder)
        with contextlib.suppress(FileNotFoundError):  # another process has just moved it
            os.rename(folder, debris)
        shutil.rmtree(debris, ignore_errors=True)
    raise OSError(f"{folder} moved {_MAX_RENAMES} times while it was replaced")


def _write_and_sync(path: str, data: bytes) -> None:
    with open(path, "xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(path: str) -> None:
    if os.name != "nt":  # Windows cannot open folders; its renames are journaled
        _sync(path, os.O_RDONLY)


def _sync(path: str, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
