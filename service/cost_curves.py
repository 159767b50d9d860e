"""Cost curves as people read them: a terminal table and the benchmarks page's section."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from service.page_records import PageRecords
from service.scores import ABSENT, human_bytes, human_seconds

CURVES = PageRecords("cost-curves", "cost curves")
KIND_TITLES = {"lattice": "ours, budget fixed", "triangle": "paper, an element a triangle"}
HEAD = ("triangles", "made by", "elements", "elements stage", "bake paths", "bake", "at rest", "in memory", "query, ms")
QUANTITY_TITLES = {
    "elements": "elements", "elements_seconds": "elements stage, s", "bake_paths": "bake, paths",
    "bake_seconds": "bake, s", "nbytes": "at rest, bytes", "memory_nbytes": "in memory, bytes", "query_ms": "query, ms",
}  # fmt: skip


def kind_title(kind: str) -> str:
    """A kind of caches as a reader sees it."""
    return KIND_TITLES.get(kind, kind)


def row_cells(row: Mapping[str, Any]) -> list[str]:
    """A row's texts, in the order of `HEAD`."""
    error = row["bake_seconds_error"]
    bake = human_seconds(row["bake_seconds"]) + (f" ± {human_seconds(error)}" if error else "")
    return [
        f"{row['triangles']:,}", row["rule"], f"{row['elements']:,}", human_seconds(row["elements_seconds"]),
        f"{row['bake_paths'] / 1e6:,.2f} M", bake, human_bytes(row["nbytes"]),
        ABSENT if row["memory_nbytes"] is None else human_bytes(row["memory_nbytes"]),
        ABSENT if row["query_ms"] is None else f"{row['query_ms']:.1f}",
    ]  # fmt: skip


def exponent_cells(fits: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """A quantity a row: its title, then the exponent of each kind with its standard error."""
    kinds = list(dict.fromkeys(fit["kind"] for fit in fits))
    found = {(fit["kind"], fit["quantity"]): fit for fit in fits}
    return [
        [title, *(_exponent(found.get((kind, quantity))) for kind in kinds)]
        for quantity, title in QUANTITY_TITLES.items()
    ]


def exponent_head(fits: Sequence[Mapping[str, Any]]) -> list[str]:
    """Titles above `exponent_cells`."""
    return ["cost ~ triangles^k, k of", *dict.fromkeys(kind_title(fit["kind"]) for fit in fits)]


def _exponent(fit: Mapping[str, Any] | None) -> str:
    if fit is None or fit["exponent"] is None:
        return ABSENT
    error = fit["standard_error"]
    return f"{fit['exponent']:.2f}" + (f" ± {error:.2f}" if error is not None else "")


def sentence(result: Mapping[str, Any]) -> str:
    """What the curves say of bake, bytes and query, computed from the fits."""
    found = {(fit["kind"], fit["quantity"]): fit["exponent"] for fit in result["exponents"]}
    parts = []
    for kind in dict.fromkeys(fit["kind"] for fit in result["exponents"]):
        powers = [(words, found[kind, quantity]) for words, quantity in
                  (("bake paths", "bake_paths"), ("bytes", "nbytes"), ("query time", "query_ms"))]  # fmt: skip
        told = ", ".join(f"{words} as n^{power:.2f}" for words, power in powers if power is not None)
        if told:
            parts.append(f"{kind_title(kind)}: {told}")
    counts = sorted({row["triangles"] for row in result["rows"]})
    return f"From {counts[0]:,} to {counts[-1]:,} triangles costs grow, {'; '.join(parts)}." if parts else ""


def cost_curves_table(result: Mapping[str, Any]) -> RenderableType:
    """All rows and exponents, with what makes them honest below."""
    title = f"{escape(result['scene'])}, {result['width']}x{result['height']}, {result['preset']}"
    rows = Table(title=title, title_style="bold")
    rows.add_column("caches", no_wrap=True)
    for name in HEAD:
        rows.add_column(name, justify="right", no_wrap=True)
    for row in result["rows"]:
        style = "bold cyan" if row["kind"] == "lattice" else ""
        rows.add_row(*(Text(cell, style=style) for cell in (kind_title(row["kind"]), *row_cells(row))))
    fits = Table()
    for name in exponent_head(result["exponents"]):
        fits.add_column(name, justify="right" if fits.columns else "left", no_wrap=True)
    for cells in exponent_cells(result["exponents"]):
        fits.add_row(*cells)
    return Group(rows, fits, *(Text(line, style="dim") for line in remarks(result)))


def remarks(result: Mapping[str, Any]) -> list[str]:
    """One line each: machine, frame and rounds, what else ran, then the measurement's notes."""
    load, frame = result["load"], result["frame"]
    return [
        f"{result['machine']}; query of {frame['width']}x{frame['height']}, median of {result['repeats']} interleaved "
        f"rounds; other processes kept {load['other_cpus']:.1f} of {load['cpus']:.0f} CPUs busy",
        *(f"note: {note}" for note in result["notes"]),
    ]
