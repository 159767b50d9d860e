"""The measured trade as a picture: error against milliseconds a frame, bake seconds and bytes."""

import io
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

from service.errors import OptionError
from service.tradeoff import Row, tradeoff_title

SUFFIXES = (".png", ".svg", ".pdf")
DPI = 110
_COSTS = (("ms", "milliseconds a frame"), ("bake_seconds", "bake, seconds"), ("nbytes", "caches and network, bytes"))
_ERRORS = (("psnr", "PSNR, dB (higher is better)"), ("flip", "FLIP (lower is better)"),
           ("temporal", "temporal error (lower is better)"))  # fmt: skip
_KINDS = (("path tracing", "#7d828a", "x"), ("caches + OIDN", "#6a51a3", "s"), ("paper", "#2b6cb0", "D"),
          ("ours", "#c2570c", "o"))  # fmt: skip
LABELLED = ("ours", "paper", "caches + OIDN")


def plot_suffix(path: PurePath) -> str:
    """The kind of file that a plot's name asks for.

    Raises:
        OptionError: none of `SUFFIXES`.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise OptionError(f"--plot must name one of {', '.join(SUFFIXES)}, got {str(path)!r}")
    return suffix


def tradeoff_plot(result: Mapping[str, Any], suffix: str = ".png") -> bytes:
    """The plot as the bytes of a file.

    Rows on the front of a panel are filled and joined by a line; a row without the cost (path tracing bakes
    nothing) or without the error is left out of that panel.

    Args:
        result: of an operating table (`workers/tradeoff.py`).
        suffix: one of `SUFFIXES`.
    """
    # Not pyplot: it keeps figures alive and is no place for a server's threads.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 12), dpi=DPI, layout="constrained")
    panels = figure.subplots(len(_ERRORS), len(_COSTS))
    for line, (error, error_title) in enumerate(_ERRORS):
        for column, (cost, cost_title) in enumerate(_COSTS):
            axes = panels[line][column]
            _draw(axes, result["rows"], cost, error)
            axes.set_xlabel(cost_title)
            if column == 0:
                axes.set_ylabel(error_title)
    handles, labels = panels[0][0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    figure.suptitle(f"{result['scene']}, {result['width']}x{result['height']}, {result['preset']}: {result['machine']}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=suffix.removeprefix("."))
    return buffer.getvalue()


def _draw(axes: Any, rows: Sequence[Row], cost: str, error: str) -> None:
    """One panel."""
    having = [row for row in rows if row[cost] and row[error] is not None]
    front = sorted((row for row in having if error in row["pareto"][cost]), key=lambda row: row[cost])
    if having:
        axes.set_xscale("log")
    axes.plot([row[cost] for row in front], [row[error] for row in front], color="#444", linewidth=0.8, zorder=1)
    for kind, colour, marker in _KINDS:
        shown = [row for row in having if row["kind"] == kind]
        if not shown:
            continue
        points = [row[cost] for row in shown], [row[error] for row in shown]
        axes.scatter(*points, color=colour, marker=marker, s=26, label=kind, zorder=2)
        for row in shown:
            if kind in LABELLED or row in front:
                label = axes.annotate(tradeoff_title(row).removeprefix("ours, "), (row[cost], row[error]), fontsize=6,
                              xytext=(3, 3), textcoords="offset points", color=colour)  # fmt: skip
                label.set_in_layout(False)  # else panels shrink until every label fits beside them
    axes.margins(x=0.2)
    axes.grid(True, which="major", linewidth=0.3)
