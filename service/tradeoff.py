"""The measured trade as people read it: the sweep's rows as a terminal table."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from service.options import write_file
from service.outcome import json_values
from service.page_records import PageRecords
from service.scores import ABSENT, REFUSED, human_bytes, human_seconds, method_title

HEAD = ("frame", "PSNR dB ↑", "FLIP ↓", "temporal ↓", "ms ↓", "bake", "bytes", "training", "front", "beaten by")
LEGEND = (
    "front: no other row is better in both PSNR and what it costs (t time a frame, b bake seconds, s bytes). "
    "beaten by: one of ours that takes no more time and is no worse in PSNR and FLIP."
)
TRADES = PageRecords("tradeoffs", "tradeoffs")
MAX_SPP = 8
"""Path-traced rows up to here are what a front has to beat (`dominance`)."""
_MARKS = {"ms": "t", "bake_seconds": "b", "nbytes": "s"}

Row = Mapping[str, Any]


def tradeoff_title(row: Row) -> str:
    """A row's name as a reader sees it; those of ours that have their own say so."""
    if row["kind"] == "ours" and row["name"] != "ours":
        return f"ours, {row['name']}"
    return method_title(row["name"])


def by_time(rows: Sequence[Row]) -> list[Row]:
    """The rows, fastest first."""
    return sorted(rows, key=lambda row: row["ms"])


def tradeoff_table(result: Mapping[str, Any]) -> RenderableType:
    """All rows, ours bold, with what makes them honest below.

    Args:
        result: of an operating table (`workers/tradeoff.py`).
    """
    title = f"{escape(result['scene'])}, {result['width']}x{result['height']}, {result['preset']}"
    table = Table(title=title, title_style="bold", caption=LEGEND)
    for index, name in enumerate(HEAD):
        table.add_column(name, justify="right" if 0 < index < len(HEAD) - 2 else "left", no_wrap=True)
    for row in by_time(result["rows"]):
        style = "bold cyan" if row["kind"] == "ours" else ""
        table.add_row(*(Text(cell, style=style) for cell in tradeoff_cells(row)))
    return Group(table, *(Text(line, style="dim") for line in remarks(result)))


def tradeoff_cells(row: Row) -> list[str]:
    """A row's texts, in the order of `HEAD`."""
    scores = [
        REFUSED if row.get("non_finite") else ABSENT if row[key] is None else pattern.format(row[key])
        for key, pattern in (("psnr", "{:.2f}"), ("flip", "{:.4f}"), ("temporal", "{:.4f}"))
    ]
    costs = [
        ABSENT if row[key] is None else shown(row[key])
        for key, shown in (("bake_seconds", human_seconds), ("nbytes", human_bytes), ("train_seconds", human_seconds))
    ]
    front = "".join(mark for cost, mark in _MARKS.items() if "psnr" in row["pareto"][cost])
    return [tradeoff_title(row), *scores, f"{row['ms']:.1f}", *costs, front, row.get("beaten_by") or ""]


def dominance(result: Mapping[str, Any]) -> str:
    """Whether ours beat path tracing with Open Image Denoise of few samples, in a sentence."""
    rows = [row for row in result["rows"] if row["kind"] == "path tracing" and "+oidn" in row["name"]
            and int(row["name"].split("+")[0].removeprefix("pt-")) <= MAX_SPP]  # fmt: skip
    unbeaten = [row["name"] for row in rows if not row["beaten_by"]]
    what = f"the {len(rows)} denoised path-traced rows up to {MAX_SPP} spp"
    if not rows:
        return ""
    beaten = "one of ours that takes no more time and is no worse in PSNR and FLIP"
    return f"Of {what}, {len(rows) - len(unbeaten)} are beaten by {beaten}" + (
        f"; not beaten: {', '.join(unbeaten)}." if unbeaten else "."
    )


def remarks(result: Mapping[str, Any]) -> list[str]:
    """One line each: machine and rounds, the reference's own error, what else ran, then the sweep's notes."""
    load = result["load"]
    return [
        f"{result['machine']}; median of {result['repeats']} interleaved rounds; mean of {result['num_frames']} test "
        f"frames; other processes kept {load['other_cpus']:.1f} of {load['cpus']:.0f} CPUs busy",
        f"the reference's own noise: {result['reference_error_db']:.2f} dB; rows above it cannot be told apart",
        *_spread(result),
        *(f"note: {note}" for note in result["notes"]),
    ]


def _spread(result: Mapping[str, Any]) -> list[str]:
    if "spread" not in result:  # of an older table
        return []
    percent = 100 * result["spread"]
    return [f"95 % of single frames take at most {percent:.0f} % more than their median; max_ms counts on that"]


def write_tradeoff(table: Mapping[str, Any], json_file: Path | None, plot_file: Path | None) -> None:
    """Writes the files that were asked for.

    Args:
        table: an operating table as JSON.
        json_file: the whole table.
        plot_file: the plot of its result, by suffix (`service/tradeoff_plot.py`).
    """
    if json_file is not None:
        text = json.dumps(json_values(table), indent=2, allow_nan=False)
        write_file(json_file, f"{text}\n".encode())
    if plot_file is not None:
        from service.tradeoff_plot import plot_suffix, tradeoff_plot

        write_file(plot_file, tradeoff_plot(table["result"], plot_suffix(plot_file)))
