"""How a stage says how far it is: the base class is silent, the service shows bars."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Advance(Protocol):
    """Adds work done to one tracked step."""

    def __call__(self, amount: float = 1.0, note: str = "") -> None: ...


class Progress:
    """Silent progress; subclasses override its methods to show bars with an ETA, and to stop a stage."""

    @contextmanager
    def track(self, description: str, total: float) -> Iterator[Advance]:
        """Tracks one step of `total` units; the yielded callable adds to it, and may raise as `between_passes`."""

        def advance(amount: float = 1.0, note: str = "") -> None:
            del amount, note

        yield advance

    def between_passes(self) -> None:
        """Called after every pass of a long unit.

        Raises:
            StoppedError: in a subclass, where somebody asked for a stop; what is committed is kept.
        """

    def message(self, text: str) -> None:
        """Says one line that is no progress."""
        del text
