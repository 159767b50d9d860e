"""Progress bars on a terminal, lines elsewhere."""

import io
import re

import pytest
from rich.console import Console

from service.progress import RichProgress


def console(*, terminal: bool) -> Console:
    return Console(file=io.StringIO(), force_terminal=terminal, width=120, color_system=None)


def written(target: Console) -> str:
    return target.file.getvalue()  # type: ignore[attr-defined]


def test_without_a_terminal_a_step_is_two_lines() -> None:
    target = console(terminal=False)
    with RichProgress(target) as progress, progress.track("bake [1]", 3) as advance:
        advance()
        advance(2, note="x")
    first, second = written(target).splitlines()
    assert first == "bake [1] …"
    assert re.fullmatch(r"bake \[1\]: done in \d+\.\d s", second)


def test_on_a_terminal_a_finished_step_is_full_and_shows_its_note() -> None:
    target = console(terminal=True)
    with RichProgress(target) as progress, progress.track("bake", 4) as advance:
        advance(1, note="pass 1 of 4")
    last = written(target).splitlines()[-2]
    assert "bake" in last and "100%" in last and "pass 1 of 4" in last


def test_a_step_that_raises_is_not_shown_as_done() -> None:
    target = console(terminal=True)
    with pytest.raises(ValueError, match="broken"), RichProgress(target) as progress:  # noqa: SIM117
        with progress.track("train", 4) as advance:
            advance(1)
            raise ValueError("broken")
    assert "25%" in written(target) and "100%" not in written(target)


def test_messages_are_printed_as_they_are() -> None:
    target = console(terminal=False)
    with RichProgress(target) as progress:
        progress.message("note: [bold] stays")
    assert written(target) == "note: [bold] stays\n"
