"""A block of a job's units in progress: what was found, computed and set aside, and how long the rest will take."""

import time
from collections.abc import Collection, Iterator

from service.job_runner import Event
from workers.units import Block, Unit


class BlockRun:
    """A block of units in progress.

    Attributes:
        block: what is to be done.
        found: members that the store had when the block was opened.
        computed: members that were done since.
        lost: members that were set aside.
        flying: units that were asked for, with the share of each that is done.
    """

    def __init__(self, block: Block) -> None:
        self.block = block
        self.pending: Iterator[Unit] | None = None
        self.exhausted = False
        self.found = self.computed = 0
        self.lost: list[int] = []
        self.flying: dict[str, tuple[Unit, float]] = {}
        self.opened_s = self.told_s = 0.0
        self.note = ""

    def open(self, done: Collection[int]) -> None:
        """Starts handing out the units that are not `done`."""
        self.found = len(done)
        self.pending = self.block.pending(done)
        self.opened_s = time.monotonic()

    def next_unit(self) -> Unit | None:
        """The next unit to ask for; None where there is none left."""
        unit = next(self.pending, None) if self.pending is not None else None
        self.exhausted = self.pending is not None and unit is None
        return unit

    @property
    def ended(self) -> bool:
        return self.exhausted and not self.flying

    def progress(self) -> Event:
        """How far the block is, with the seconds that are left at the pace so far."""
        partly = sum(share * unit.count for unit, share in self.flying.values())
        done = min(self.found + self.computed + len(self.lost) + partly, self.block.total)
        fresh, elapsed_s = self.computed + partly, time.monotonic() - self.opened_s
        left = self.block.total - done
        eta_s = elapsed_s / fresh * left if fresh > 0 else None
        return {"kind": "progress", "stage": self.block.name, "done": done, "total": float(self.block.total),
                "eta_s": 0.0 if left <= 0 else eta_s, "note": self.note}  # fmt: skip
