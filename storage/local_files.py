"""Writes on a local disk that survive a crash: a temporary name, flush, fsync, one rename."""

import contextlib
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from storage import layout

_MAX_RENAMES = 16  # each failed turn means that another process moved the same folder in between


def replace_local_file(path: str, data: bytes) -> None:
    """Puts one file in place; an older one of that name stays until the new one is whole."""
    partial = layout.partial_name(path)
    try:
        _write_and_sync(partial, data)
        os.replace(partial, path)
    finally:
        Path(partial).unlink(missing_ok=True)
    sync_folder(os.path.dirname(path))


def publish_local_folder(folder: str, files: Mapping[str, bytes]) -> bool:
    """Puts a folder of files in place by one rename; its last file is the marker.

    A folder without a marker is debris and is replaced. Of two processes the first wins.

    Returns:
        Whether the folder in place is this one; False where another process was first.
    """
    partial = layout.partial_name(folder)
    try:
        os.makedirs(partial)
        for name, data in files.items():
            _write_and_sync(f"{partial}/{name}", data)
        sync_folder(partial)
        won = _rename_folder(partial, folder, marker=list(files)[-1])
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    sync_folder(os.path.dirname(folder))
    return won


def _rename_folder(partial: str, folder: str, marker: str) -> bool:
    for _ in range(_MAX_RENAMES):
        try:
            os.rename(partial, folder)
            return True
        except OSError:
            if not os.path.isdir(folder):
                raise
        if os.path.exists(f"{folder}/{marker}"):
            return False  # another process was first
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


def sync_folder(path: str) -> None:
    """Forces the names in a folder down to the disk."""
    if os.name != "nt":  # Windows cannot open folders; its renames are journaled
        sync_file(path, os.O_RDONLY)


def sync_file(path: str, flags: int = os.O_RDWR) -> None:
    """Forces a file that another library wrote down to the disk."""
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
