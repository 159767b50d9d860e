"""A scene's measured trade: its operating points and every row that they were compared to, kept beside the scene
(`storage/tradeoffs.py`)."""

from dataclasses import dataclass
from typing import Any

from storage import tradeoffs
from storage.errors import DamagedUnitError
from storage.layout import tradeoff_file
from storage.store import Store
from workers.errors import NoOperatingPointsError, OperatingPointError
from workers.operating_points import OperatingPoint

SCHEMA = 1


@dataclass(frozen=True, kw_only=True)
class OperatingTable:
    """A scene's measured trade.

    Attributes:
        base: settings (JSON) that the points' overrides change.
        points: what a frame can be asked for with.
        result: everything that was measured, JSON: "rows" of all methods and what they were measured on.
    """

    base: dict[str, Any]
    points: tuple[OperatingPoint, ...]
    result: dict[str, Any]

    def point(self, name: str) -> OperatingPoint:
        """The point of that name.

        Raises:
            OperatingPointError: there is none.
        """
        for point in self.points:
            if point.name == name:
                return point
        known = ", ".join(point.name for point in self.points) or "none"
        raise OperatingPointError(f"operating point must be one of {known}, got {name!r}")

    def to_json(self) -> dict[str, Any]:
        points = [point.to_json() for point in self.points]
        return {"schema": SCHEMA, "base": self.base, "points": points, "result": self.result}


def save_table(store: Store, digest: str, table: OperatingTable) -> None:
    """Keeps a scene's table in place of an older one."""
    tradeoffs.write(store.files, digest, table.to_json())


def load_table(store: Store, digest: str) -> OperatingTable:
    """A scene's table.

    Raises:
        NoOperatingPointsError: the scene's trade was never measured in this store.
        OperatingPointError: the file is not the one that was written, or of another version.
    """
    try:
        value = tradeoffs.read(store.files, digest)
    except DamagedUnitError as error:
        raise OperatingPointError(str(error)) from error
    if value is None:
        raise NoOperatingPointsError(
            f"scene {digest} must have measured operating points, got no {tradeoff_file(digest)}; "
            f"run: lightwell tradeoff SCENE --store {store.url}"
        )
    try:
        if value["schema"] != SCHEMA:
            raise ValueError(f"schema {value['schema']}")
        points = tuple(OperatingPoint.from_json(point) for point in value["points"])
        return OperatingTable(base=dict(value["base"]), points=points, result=dict(value["result"]))
    except (ValueError, KeyError, TypeError) as error:
        raise OperatingPointError(
            f"{store.files.path(tradeoff_file(digest))} must be a table of schema {SCHEMA}, got {error}; "
            "delete it and run lightwell tradeoff again"
        ) from error
