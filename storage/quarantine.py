"""Records of units that were set aside: over a health limit, or damaged at rest. A record is a note and never says
that work is done or that it must not be done: a run computes the unit again, and once it is committed the record
is history.
"""

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from storage import layout, markers
from storage.layout import UnitRef

if TYPE_CHECKING:
    from storage.store import Store

Cause = Literal["health", "damage"]


def put(
    store: "Store", ref: UnitRef, reason: str, *, cause: Cause, unit: int | None, facts: Mapping[str, Any]
) -> dict[str, Any]:
    """Writes why a unit was set aside, and how often it was; an older record is replaced."""
    path = layout.quarantine_file(ref, unit)
    before = _parsed(store.files.read(path)) or {}
    record = {
        "scene_digest": ref.scene_digest, "stage": ref.stage, "key": ref.key, "unit": unit, "cause": cause,
        "reason": reason, "facts": dict(facts), "attempts": int(before.get("attempts", 0)) + 1,
        "created_unix_s": round(time.time(), 3),
    }  # fmt: skip
    store.files.write(path, markers.seal(record))
    return record


def standing(store: "Store", scene_digest: str = "") -> list[dict[str, Any]]:
    """Records of the units that are still not committed, by address; those of one scene where it is given."""
    contents = store.files.read_each(store.files.sizes(layout.quarantine_folder(scene_digest)))
    records = [record for _, data in contents if (record := _parsed(data)) is not None]
    return [record for record in records if not store.files.read(_marker(record))]


def unreadable(store: "Store") -> list[str]:
    """Paths of the records that are not what was written."""
    contents = store.files.read_each(store.files.sizes(layout.QUARANTINE))
    return [path for path, data in contents if _parsed(data) is None]


def _marker(record: Mapping[str, Any]) -> str:
    folder = UnitRef(record["scene_digest"], record["stage"], record["key"]).folder
    return layout.unit_marker(folder) if record["unit"] is None else layout.bake_marker(folder, record["unit"])


def _parsed(data: bytes | None) -> dict[str, Any] | None:
    try:
        return markers.unseal(data or b"")
    except ValueError:
        return None
