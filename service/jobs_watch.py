"""A job's events on the terminal: one bar a stage, a line for what is said."""

from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

from service.jobs_client import StreamEvent
from service.scores import human_seconds

TERMINAL_STATES = ("complete", "failed", "cancelled")


def watch(events: Iterable[StreamEvent], console: Console) -> dict[str, Any]:
    """Shows events until they end.

    Args:
        events: of one job, in order.
        console: where; without a terminal there are no bars but a line when a stage begins and ends.

    Returns:
        The data of the last change of state, empty where there was none.
    """
    state: dict[str, Any] = {}
    with _Bars(console) as bars:
        for event in events:
            if event.kind == "progress":
                bars.progress(event.data)
            elif event.kind == "state":
                state = event.data
                bars.state(state)
            else:
                bars.say(_sentence(event))
    return state


class _Bars:
    def __init__(self, console: Console) -> None:
        self._console = console
        self._tasks: dict[str, TaskID] = {}
        self._said: dict[str, str] = {}
        self._bars = Progress(
            SpinnerColumn(finished_text="[green]✓[/]"), TextColumn("{task.description}"), BarColumn(bar_width=24),
            TaskProgressColumn(), TimeElapsedColumn(), TextColumn("[dim]{task.fields[left]}[/]"),
            TextColumn("[dim]{task.fields[note]}[/]"), console=console, disable=not console.is_terminal,
        )  # fmt: skip

    def __enter__(self) -> "_Bars":
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def progress(self, data: dict[str, Any]) -> None:
        stage, done, total = str(data["stage"]), float(data["done"]), float(data["total"])
        eta_s, is_new = data.get("eta_s"), stage not in self._tasks
        left = f"{human_seconds(eta_s)} left" if eta_s and done < total else ""
        note = escape(str(data.get("note") or ""))
        if is_new:
            self._tasks[stage] = self._bars.add_task(escape(stage), total=total, left="", note="")
        self._bars.update(self._tasks[stage], completed=done, total=total, left=left, note=note)
        word = "done" if done >= total else "…"
        if not self._console.is_terminal and self._said.get(stage) != word:
            self._said[stage] = word
            self.say(f"{stage}: {word}")

    def state(self, data: dict[str, Any]) -> None:
        if data["state"] == "queued":  # the stages are told about anew
            self._tasks.clear()
            self._said.clear()
        details = [str(data[key]) for key in ("error", "note") if data.get(key)]
        self.say(": ".join([str(data["state"]), *details]))

    def say(self, text: str) -> None:
        self._console.print(escape(text), highlight=False, soft_wrap=True)


def _sentence(event: StreamEvent) -> str:
    data = event.data
    if event.kind == "message":
        return str(data.get("text", ""))
    if event.kind == "set_aside":
        return f"set aside after {data.get('attempts')} attempts: {data.get('unit')}: {data.get('reason')}"
    if event.kind in ("preview", "report"):
        return f"{event.kind}: {data.get('url')}"
    shown = {key: value for key, value in data.items() if key != "at"}
    return f"{event.kind}: " + ", ".join(f"{key} {value}" for key, value in shown.items())
