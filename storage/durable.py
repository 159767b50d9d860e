"""A tree of files whose writes survive a crash: whole or not at all, on a local disk or elsewhere (fsspec).

A local disk gets a temporary name, flush, fsync and one rename. An object store shows an object only when
its upload has ended, so a plain put does the same there; it cannot rename folders, hence a marker is always
the last file put, and only where there is none yet. Whatever the file system refuses is raised as a StorageError
that names store, path and remedy.
"""

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence

from storage import layout, local_files, object_store, refusals
from storage.errors import StorageError

_BATCH_NBYTES = 64 << 20  # read at once by `read_each`: enough to hide the latency of a remote store
_BATCH_FILES = 64


class FileTree:
    """Files below one root, addressed by relative paths with "/". It may be pickled to other processes."""

    def __init__(self, url: str | os.PathLike[str]) -> None:
        self.url = os.fspath(url)
        self.filesystem, self.root = object_store.open_filesystem(self.url)

    @property
    def is_local(self) -> bool:
        return object_store.is_local(self.filesystem)

    def path(self, relative: str) -> str:
        """The path as the file system wants it."""
        return f"{self.root}/{relative}"

    # --------------------------------------------------------------- reading

    def read(self, relative: str) -> bytes | None:
        """Content of a file; None where there is none. One request in an object store."""
        with self.reading(relative):
            try:
                return self.filesystem.cat_file(self.path(relative))
            except FileNotFoundError as error:
                if refusals.error_code(error) == "NoSuchBucket":
                    raise
                return None

    def read_each(self, sizes: Mapping[str, int]) -> Iterator[tuple[str, bytes | None]]:
        """Content of many files, in their order; a remote store is asked for a batch of them at once.

        Args:
            sizes: relative path to the expected bytes, which only bound how much is held at once.
        """
        batch: list[str] = []
        nbytes = 0
        for relative, size in sizes.items():
            if batch and (nbytes + size > _BATCH_NBYTES or len(batch) == _BATCH_FILES):
                yield from zip(batch, self._read_batch(batch), strict=True)
                batch, nbytes = [], 0
            batch.append(relative)
            nbytes += size
        yield from zip(batch, self._read_batch(batch), strict=True)

    def _read_batch(self, relatives: Sequence[str]) -> list[bytes | None]:
        if not getattr(self.filesystem, "async_impl", False):
            return [self.read(relative) for relative in relatives]
        answers = self.filesystem.cat_ranges([self.path(relative) for relative in relatives], None, None)
        contents: list[bytes | None] = []
        for relative, answer in zip(relatives, answers, strict=True):
            missing = isinstance(answer, FileNotFoundError) and refusals.error_code(answer) != "NoSuchBucket"
            if isinstance(answer, BaseException) and not missing:
                with self.reading(relative):
                    raise answer
            contents.append(None if missing else answer)
        return contents

    def names(self, relative: str) -> list[str]:
        """Names in a folder, sorted; empty where it does not exist."""
        folder = self.path(relative)
        with self.reading(relative):
            try:
                paths = self.filesystem.ls(folder, detail=False)
            except (FileNotFoundError, NotADirectoryError) as error:
                if refusals.error_code(error) == "NoSuchBucket":
                    raise
                return []
        names = (path.rstrip("/") for path in paths)
        return sorted(name.rpartition("/")[2] for name in names if name != folder)  # consoles put "folder/" objects

    def sizes(self, relative: str) -> dict[str, int]:
        """Bytes of every file below a folder by relative path, sorted. One request a thousand files."""
        with self.reading(relative):
            try:
                found = self.filesystem.find(self.path(relative), detail=True)
            except FileNotFoundError as error:
                if refusals.error_code(error) == "NoSuchBucket":
                    raise
                return {}
        start = len(self.path(""))
        listed = {path[start:]: int(info["size"]) for path, info in found.items() if not path.endswith("/")}
        return dict(sorted(listed.items()))

    def folders_with(self, relative: str, name: str) -> list[str]:
        """Names of the folders in a folder that hold a file of this name, sorted."""
        if self.is_local:
            return [
                folder for folder in self.names(relative) if os.path.exists(self.path(f"{relative}/{folder}/{name}"))
            ]
        inside = (path[len(relative) + 1 :].split("/") for path in self.sizes(relative))
        return [parts[0] for parts in inside if len(parts) == 2 and parts[1] == name]

    def nbytes(self, relative: str) -> int:
        """Bytes of all files below a folder; 0 where it does not exist."""
        return sum(self.sizes(relative).values())

    def partials(self, relative: str) -> list[str]:
        """Files and folders below a folder that an interrupted write left, sorted; a remote store has none."""
        if not self.is_local:
            return []
        found = []
        for folder, folders, files in os.walk(self.path(relative)):
            inside = os.path.relpath(folder, self.root).replace(os.sep, "/")
            found += [f"{inside}/{name}" for name in (*folders, *files) if layout.is_partial(name)]
            folders[:] = [name for name in folders if not layout.is_partial(name)]
        return sorted(path.removeprefix("./") for path in found)

    # --------------------------------------------------------------- writing

    def remove_file(self, relative: str) -> None:
        """Removes one file; nothing happens where there is none. One request in an object store."""
        with self.writing(relative), contextlib.suppress(FileNotFoundError):
            self.filesystem.rm_file(self.path(relative))

    def remove(self, relative: str) -> None:
        """Removes a file or a whole folder; nothing happens where there is none."""
        path = self.path(relative)
        with self.writing(relative), contextlib.suppress(FileNotFoundError):
            if object_store.has_folders(self.filesystem):
                self.filesystem.rm(path, recursive=True)
                return
            found = self.filesystem.find(path)
            if len(found) > 1 and not set(path) & set("*?["):  # fsspec would expand [1] and *
                self.filesystem.rm(found)
                found = self.filesystem.find(path)  # a request for many is not told which ones were denied
            for file in found:
                self.filesystem.rm_file(file)

    def write(self, relative: str, data: bytes) -> None:
        """Puts one file in place, whole or not at all; an older file of that name is replaced.

        Raises:
            StorageError: the file system refused; no temporary file is left.
        """
        with self.writing(relative):
            path = self.path(relative)
            self._make_folder(path.rpartition("/")[0])
            if self.is_local:
                local_files.replace_local_file(path, data)
            else:
                self.filesystem.pipe_file(path, data)

    def write_new(self, relative: str, data: bytes) -> bool:
        """Puts one file in place where there is none; returns whether it did. Locally an older one is replaced,
        which is the same where equal keys mean equal bytes.

        Raises:
            StorageError: the file system refused.
        """
        if self.is_local:
            self.write(relative, data)
            return True
        with self.writing(relative):
            self._make_folder(self.path(relative).rpartition("/")[0])
            return object_store.put_new(self.filesystem, self.path(relative), data)

    def publish(self, relative: str, files: Mapping[str, bytes]) -> bool:
        """Puts a folder of files in place. Its last file must be the marker: where it is, everything else is.

        Locally the folder appears by one rename, so a folder without a marker is debris and is replaced.
        Elsewhere the files are put first and the marker only where there is none, so the names of files whose
        content may differ between two writers must differ too (`layout.object_name`).

        Returns:
            Whether the marker in place is this one; False where another process was first.

        Raises:
            StorageError: the file system refused; there is no marker and, locally, no temporary file.
        """
        folder = self.path(relative)
        with self.writing(relative):
            if self.is_local:
                return local_files.publish_local_folder(folder, files)
            *names, marker = files
            self._make_folder(folder)
            if names:
                self.filesystem.pipe({f"{folder}/{name}": files[name] for name in names})
            return object_store.put_new(self.filesystem, f"{folder}/{marker}", files[marker])

    def sync(self, relative: str) -> None:
        """Forces a file that another library wrote down to the disk; does nothing in a remote tree."""
        if self.is_local:
            with self.writing(relative):
                local_files.sync_file(self.path(relative))
                local_files.sync_folder(os.path.dirname(self.path(relative)))

    def _make_folder(self, folder: str) -> None:
        if object_store.has_folders(self.filesystem):
            self.filesystem.makedirs(folder, exist_ok=True)

    # -------------------------------------------------------------- refusals

    def reading(self, relative: str) -> contextlib.AbstractContextManager[None]:
        """Turns what the file system says of a failed read into a StorageError with place and remedy."""
        return self._telling(relative, "readable")

    def writing(self, relative: str) -> contextlib.AbstractContextManager[None]:
        """Turns what the file system says of a failed write into a StorageError with place and remedy."""
        return self._telling(relative, "writable")

    def refusal(self, error: BaseException, relative: str, doing: refusals.Doing) -> StorageError | None:
        """The StorageError for what the file system refused; None where the error is another's, or says "not there"."""
        if isinstance(error, FileNotFoundError) and refusals.error_code(error) != "NoSuchBucket":
            return None
        return refusals.refusal(error, self.url, self.path(relative), doing)

    @contextlib.contextmanager
    def _telling(self, relative: str, doing: refusals.Doing) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            refused = refusals.refusal(error, self.url, self.path(relative), doing)
            if refused is None or refused is error:
                raise
            raise refused from error
