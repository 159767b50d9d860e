"""Progress bars with the time that is left, for the stages' `workers.progress.Progress` interface."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars

from workers.progress import Progress


class RichProgress(Progress):
    """Bars on standard error, so that what a command prints on standard output stays clean.

    Where standard error is no terminal, no bar is drawn: a line tells when a step begins and when it ends.
    Use as a context manager around the whole command.
    """

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._bars = Bars(
            SpinnerColumn(finished_text="[green]✓[/]"),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("[dim]left[/]"),
            TimeRemainingColumn(elapsed_when_finished=False),
            TextColumn("[dim]{task.fields[note]}[/]"),
            console=self._console,
            disable=not self._console.is_terminal,
        )

    def __enter__(self) -> "RichProgress":
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    @contextmanager
    def track(self, description: str, total: float) -> Iterator[Callable[..., None]]:
        """A bar of `total` steps, advanced by calling the value: `advance(amount=1.0, note="")`.

        The bar stays as it is when the step raises, and is filled when it ends well.
        """
        task = self._bars.add_task(escape(description), total=total, note="")
        self._line(f"{description} …")

        def advance(amount: float = 1.0, note: str = "") -> None:
            self._bars.update(task, advance=amount)
            if note:
                self._bars.update(task, note=escape(note))

        yield advance
        self._bars.update(task, completed=total)
        elapsed_s = self._bars.tasks[self._bars.task_ids.index(task)].elapsed or 0.0
        self._line(f"{description}: done in {elapsed_s:.1f} s")

    @contextmanager
    def busy(self, description: str) -> Iterator[None]:
        """A bar without steps, for work that cannot say how far it is; on a terminal alone."""
        task = self._bars.add_task(escape(description), total=None, note="")
        yield
        self._bars.update(task, total=1, completed=1)

    def message(self, text: str) -> None:
        """A line above the bars."""
        self._console.print(escape(text), highlight=False, soft_wrap=True)

    def _line(self, text: str) -> None:
        if not self._console.is_terminal:
            self._console.print(escape(text), highlight=False, soft_wrap=True)
            self._console.file.flush() if self._console.file is not sys.stderr else sys.stderr.flush()
