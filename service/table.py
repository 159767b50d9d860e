"""What the commands print: the plan and the scores as terminal tables."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from service import scores
from service.scores import human_bytes, human_seconds


def score_table(result: Mapping[str, Any]) -> RenderableType:
    """The evaluation's rows, best value of each column bold, with the remarks that make them honest below.

    Args:
        result: an evaluation's result JSON.
    """
    rows = result["rows"]
    table = Table(title=f"{escape(result['scene'])}, {result['width']}x{result['height']}", title_style="bold")
    table.add_column("frame", no_wrap=True)
    for column in scores.COLUMNS:
        table.add_column(f"{column.title} {column.arrow}", justify="right", no_wrap=True)
    table.add_column("non-finite", justify="right")
    for row in rows:
        cells = [_cell(row, column, result) for column in scores.COLUMNS]
        name = Text(row["name"], style="bold cyan" if row["name"] == "ours" else "")
        table.add_row(name, *cells, Text(str(row.get("non_finite", scores.ABSENT))))
    return Group(table, *(Text(line, style="dim") for line in remarks(result)))


def _cell(row: scores.Row, column: scores.Column, result: Mapping[str, Any]) -> Text:
    text = scores.text(row, column, result.get("reference_error_db"))
    if text == scores.REFUSED:
        return Text(text, style="red")
    return Text(text, style="bold green" if scores.is_best(row, column, result["rows"]) else "")


def remarks(result: Mapping[str, Any]) -> list[str]:
    """One line each: sizes, time of all stages, the reference's own error, then the evaluation's notes."""
    lines = []
    stages_s = sum(stage["seconds"] for stage in result.get("stages", ()))
    sizes = [
        f"{name} {human_bytes(result[key])}"
        for name, key in (("caches", "cache_nbytes"), ("network", "network_nbytes"))
        if result.get(key) is not None
    ]
    lines.append("; ".join([*sizes, f"all stages {human_seconds(stages_s)}"]))
    if result.get("reference_error_db") is not None:
        lines.append(
            f"the reference's own noise: {result['reference_error_db']:.2f} dB; a PSNR above it is marked "
            f"{scores.BELOW_REFERENCE_MARK}, such rows cannot be told apart"
        )
    return lines + [f"note: {note}" for note in result.get("notes", ())]


def plan_table(plan: Mapping[str, Any]) -> RenderableType:
    """A plan's choices with their reasons, and what they cost.

    Args:
        plan: {"rows": [{"item", "choice", "reason"}], "cost": {"paths", "seconds", "nbytes"}}; where the plan
            is one of several, also "planned_cost" and "preset_cost" likewise.
    """
    table = Table("item", "choice", "reason")
    for row in plan["rows"]:
        style = "cyan" if row.get("by") == "you" else ""
        table.add_row(*(Text(str(row[key]), style=style) for key in ("item", "choice", "reason")))
    lines = [Text(f"cost: {_cost(plan['cost'])}", style="bold")]
    if "planned_cost" in plan and plan["planned_cost"] != plan["preset_cost"]:
        lines = [
            Text(f"cost as planned (run --planned): {_cost(plan['planned_cost'])}", style="bold"),
            Text(f"cost with the settings as given: {_cost(plan['preset_cost'])}"),
        ]
    return Group(table, *lines)


def _cost(cost: Mapping[str, Any]) -> str:
    return f"{cost['paths']:.3g} paths, about {human_seconds(cost['seconds'])}, {human_bytes(cost['nbytes'])}"


def show(renderable: RenderableType, console: Console | None = None) -> None:
    """Print on standard output. Where that is no terminal, lines are as wide as the table needs."""
    console = console or Console()
    if not console.is_terminal:
        console = Console(file=console.file, width=160)
    console.print(renderable)
