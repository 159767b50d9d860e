"""A unit that somebody wants, and the news that those who want it get."""

import queue
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from workers.job_spec import JobSpec
from workers.units import Unit

if TYPE_CHECKING:
    from distributed import Future


@dataclass(frozen=True)
class Outcome:
    """News of one unit.

    Attributes:
        identity: as it was asked for.
        kind: "done", "set_aside", "retry", "progress" or "message".
        answer: of a unit that is done, where its stage has one.
        reason, attempts: of a failure.
        done, total, note: of progress, in the unit's own steps.
    """

    identity: str
    kind: Literal["done", "set_aside", "retry", "progress", "message"]
    answer: Any = None
    reason: str = ""
    attempts: int = 0
    done: float = 0.0
    total: float = 0.0
    note: str = ""


class Listener:
    """One job's queue of outcomes."""

    def __init__(self) -> None:
        self.outcomes: queue.SimpleQueue[Outcome] = queue.SimpleQueue()


class UnitTotals:
    """Units that ended since the start, by stage; written by the board's thread, read by any.

    Attributes:
        units: computed.
        seconds: that their last attempts took.
        set_aside: given up.
    """

    def __init__(self) -> None:
        self.units: Counter[str] = Counter()
        self.seconds: dict[str, float] = {}
        self.set_aside: Counter[str] = Counter()

    def add(self, unit: Unit, seconds: float, *, done: bool) -> None:
        """Counts a unit that ended."""
        (self.units if done else self.set_aside)[unit.stage] += unit.count
        self.seconds[unit.stage] = self.seconds.get(unit.stage, 0.0) + seconds


@dataclass(eq=False)
class UnitRequest:
    """A unit that somebody wants."""

    identity: str
    unit: Unit
    spec: JobSpec
    listeners: set[Listener]
    failures: list[str] = field(default_factory=list)
    failed_on: set[str] = field(default_factory=set)
    deaths_nearby: int = 0
    key: str = ""
    future: "Future | None" = None
    worker: str | None = None
    address: str | None = None
    began_s: float = 0.0  # of this attempt, by time.monotonic

    def tell(self, outcome: Outcome) -> None:
        for listener in list(self.listeners):
            listener.outcomes.put(outcome)
