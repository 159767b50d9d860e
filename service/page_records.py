"""Records of measurements beside those of `lightwell benchmark`: one JSON a scene, in a store and beside the page.

<store>/<folder>/<scene>.json, and docs/<folder>/<scene>.json beside the page
"""

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.errors import ServiceError
from service.outcome import json_values

if TYPE_CHECKING:
    from storage.durable import FileTree

SCHEMA = 1

Record = dict[str, Any]


class RecordError(ServiceError, ValueError):
    """A record cannot be read."""


@dataclass(frozen=True)
class PageRecords:
    """Records of one kind.

    Attributes:
        folder: where they lie.
        noun: what they are, for messages.
    """

    folder: str
    noun: str

    def keep(self, files: "FileTree", result: Mapping[str, Any], command: str) -> Record:
        """Keeps a scene's result in place of an older one; returns the record."""
        record = {"schema": SCHEMA, "scene": result["scene"], "command": command, "result": json_values(dict(result)),
                  "measured_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}  # fmt: skip
        self._write(files, record)
        return record

    def load(self, files: "FileTree") -> list[Record]:
        """Every record, by scene name.

        Raises:
            RecordError: one cannot be read.
        """
        names = [name for name in files.names(self.folder) if name.endswith(".json") and not name.startswith(".")]
        records = [self._read(files, f"{self.folder}/{name}") for name in names]
        return sorted(records, key=lambda record: str(record["scene"]))

    def copy(self, source: "FileTree", target: "FileTree") -> list[Record]:
        """Copies the records that `target` lacks or has from an earlier time; returns them."""
        known = {record["scene"]: record["measured_at"] for record in self.load(target)}
        newer = [record for record in self.load(source) if record["measured_at"] > known.get(record["scene"], "")]
        for record in newer:
            self._write(target, record)
        return newer

    def _write(self, files: "FileTree", record: Record) -> None:
        text = json.dumps(record, indent=2, allow_nan=False)
        files.write(f"{self.folder}/{record['scene']}.json", f"{text}\n".encode())

    def _read(self, files: "FileTree", file: str) -> Record:
        try:
            record = json.loads(files.read(file) or b"")
            if record["schema"] != SCHEMA:
                raise ValueError(f"schema {record['schema']}")
        except (ValueError, KeyError, TypeError) as error:
            raise RecordError(
                f"{self.noun} must be JSON of schema {SCHEMA}, got {error} in {files.path(file)}; "
                "delete it and measure the scene again"
            ) from error
        found: Record = record
        return found
