"""How a stage says how far it is: the base class is silent, the service shows bars."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Advance(Protocol):
    """Adds work done to one tracked step."""

    def __call__(self, amount: float = 1.0, note: str = "") -> None: ...


class Progress:
    """Silent progress; subclasses override both methods to show bars with an ETA."""

    @contextmanager
    def track(self, description: str, total: float) -> Iterator[Advance]:
        """Tracks one step of `total` units; the yielded callable adds to it."""

        def advance(amount: float = 1.0, note: str = "") -> None:
            del amount, note

        yield advance

    def message(self, text: str) -> None:
        """Says one line that is no progress."""
        del text
