"""Cost curves as a picture: every cost against triangles, both axes logarithmic, with the fitted powers."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from service.cost_curves import QUANTITY_TITLES, kind_title

DPI = 110
MARGIN = 2.0
_PANELS = ("elements_seconds", "bake_paths", "bake_seconds", "nbytes", "memory_nbytes", "query_ms")
_STYLES = {"lattice": ("#c2570c", "o"), "triangle": ("#2b6cb0", "D")}
_OTHER = ("#7d828a", "x")


def cost_curves_plot(result: Mapping[str, Any], suffix: str = ".png") -> bytes:
    """The plot as the bytes of a file.

    A row without a cost (a query whose caches did not fit) is left out of that panel.

    Args:
        result: of `workers/cost_curves.py`.
        suffix: one of `service.tradeoff_plot.SUFFIXES`.
    """
    # Not pyplot: it keeps figures alive and is no place for a server's threads.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 8), dpi=DPI, layout="constrained")
    for axes, quantity in zip(figure.subplots(2, 3).flat, _PANELS, strict=True):
        _draw(axes, result["rows"], result["exponents"], quantity)
    figure.suptitle(f"{result['scene']}, {result['width']}x{result['height']}, {result['preset']}: {result['machine']}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=suffix.removeprefix("."))
    return buffer.getvalue()


def _draw(axes: Any, rows: Sequence[Mapping[str, Any]], fits: Sequence[Mapping[str, Any]], quantity: str) -> None:
    """One panel."""
    shown = [row[quantity] for row in rows if row[quantity]]
    if shown:
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(min(shown) / MARGIN, max(shown) * MARGIN)  # a cost that does not move has no range of its own
    for fit in fits:
        having = [row for row in rows if row["kind"] == fit["kind"] and row[quantity]]
        if fit["quantity"] != quantity or not having:
            continue
        colour, marker = _STYLES.get(fit["kind"], _OTHER)
        counts, costs = [row["triangles"] for row in having], [row[quantity] for row in having]
        label = kind_title(fit["kind"])
        if fit["exponent"] is not None:
            error = fit["standard_error"]
            label += f": n^{fit['exponent']:.2f}" + (f" ± {error:.2f}" if error is not None else "")
            level = np.exp(np.mean(np.log(costs)) - fit["exponent"] * np.mean(np.log(counts)))
            ends = np.array([min(counts), max(counts)], dtype=float)
            axes.plot(ends, level * ends ** fit["exponent"], color=colour, linewidth=0.8, zorder=1)
        bars = [row["bake_seconds_error"] for row in having] if quantity == "bake_seconds" else None
        axes.errorbar(counts, costs, yerr=bars, color=colour, marker=marker, linestyle="none", label=label, zorder=2)
    if shown:
        axes.legend(fontsize=8)
    axes.set_xlabel("triangles")
    axes.set_ylabel(QUANTITY_TITLES[quantity])
    axes.grid(True, which="major", linewidth=0.3)
