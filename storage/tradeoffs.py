"""A scene's measured trade at rest: one JSON object beside the scene's entry, with a checksum of itself."""

import json
from collections.abc import Mapping
from typing import Any

from storage import layout, markers
from storage.durable import FileTree
from storage.errors import DamagedUnitError


def write(files: FileTree, digest: str, trade: Mapping[str, Any]) -> None:
    """Keeps a scene's trade in place of an older one.

    Raises:
        CanonicalError: it has no JSON form (NaN, say).
    """
    files.write(layout.tradeoff_file(digest), markers.seal(trade))


def read(files: FileTree, digest: str) -> dict[str, Any] | None:
    """A scene's trade; None where it was never measured.

    Raises:
        DamagedUnitError: the file is not the one that was written.
    """
    path = layout.tradeoff_file(digest)
    data = files.read(path)
    return None if data is None else parse(files, path, data)


def parse(files: FileTree, path: str, data: bytes | None) -> dict[str, Any]:
    """Reads a trade back; `files` and `path` are for the message.

    Raises:
        DamagedUnitError: it is not what was written.
    """
    try:
        trade = json.loads(data or b"")
        if isinstance(trade, dict) and markers.CHECKSUM not in trade and "schema" in trade:
            return trade  # of a version that wrote no checksum
        return markers.unseal(data or b"")
    except ValueError as error:
        raise DamagedUnitError(
            f"{files.path(path)} in store {files.url} must hold the table that was written, got: {error}; "
            "delete it and run lightwell tradeoff again"
        ) from error
