"""The ablation as people read it: its rows as cells, for the terminal and for the benchmarks' page."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from service.scores import ABSENT, REFUSED, human_bytes, human_seconds

if TYPE_CHECKING:
    from storage.store import Store
    from workers.progress import Progress
    from workers.scene import Scene
    from workers.settings import Settings

HEAD = ("variant", "IR PSNR dB", "final PSNR dB", "against ours dB", "SSIM", "FLIP", "bake paths", "bake",
        "caches", "seen or not: paths", "caches")  # fmt: skip
LEGEND = (
    "Every variant shares camera paths and references. A variant without a network is scored, and set "
    "against ours, by its IR (marked *). Only what the cameras see is baked; the last columns are what caches on every "
    "triangle would take."
)
OURS, UNIFORM = "ours", "uniform 64x16x32, our network"
PLANNED = {
    "ours, planned": "Planned caches",
    "ours, planned, a quarter of the elements": "with a quarter of the elements",
}

Row = Mapping[str, Any]


def measure_ablation(
    scene: "Scene", store: "Store", settings: "Settings", progress: "Progress", command: str,
    names: Sequence[str] = (),
) -> dict[str, Any]:  # fmt: skip
    """Runs the variants; what the store has of them is not computed again.

    Args:
        scene: the scene.
        store: shared by all variants.
        settings: ours; variants change parts of it.
        progress: told about it.
        command: the command line that asks for it.
        names: rows to run; every one where none is given.

    Raises:
        WorkerError: a name is no row's.

    Returns:
        JSON: scene, width, height, preset, rows, command, commit, machine, and
        whether rows were selected.
    """
    from workers.ablation import run_ablation
    from workers.evaluate import commit, machine

    if all(entry["digest"] != scene.digest for entry in store.scenes()):
        store.register_scene(scene.digest, {"name": scene.name, "source": scene.address})
    rows = run_ablation(scene, store, settings, progress, names)
    return {
        "scene": scene.name, "width": settings.width, "height": settings.height, "preset": settings.preset,
        "rows": rows, "selected": bool(names), "command": command, "commit": commit(), "machine": machine(),
    }  # fmt: skip


def requirement(rows: Sequence[Row]) -> str:
    """What planned caches take against uniform ones on every triangle, in a sentence; empty without both."""
    by_name = {row["name"]: row for row in rows if row["psnr"] is not None}
    uniform = by_name.get(UNIFORM)
    found = [(words, by_name[name]) for name, words in PLANNED.items() if name in by_name]
    if uniform is None or not found:
        return ""
    parts = [
        f"{words}: {_ratio(uniform, row, 'paths')} of the paths, {_ratio(uniform, row, 'nbytes')} of the bytes, final "
        f"PSNR {row['psnr'] - uniform['psnr']:+.2f} dB"
        for words, row in found
    ]
    return f"Against 64x16 directions x 32 paths on every triangle: {'; '.join(parts)}."


def _ratio(uniform: Row, planned: Row, cost: str) -> str:
    """ "1/12"."""
    taken = planned["bake_paths" if cost == "paths" else "cache_nbytes"]
    return f"1/{uniform[f'whole_{cost}'] / taken:.3g}" if taken else "none"


def ablation_cells(rows: Sequence[Row]) -> list[list[str]]:
    """A list of texts a row, in the order of `HEAD`."""
    ours = next((row for row in rows if row["name"] == OURS), None)
    return [_cells(row, ours) for row in rows]


def _cells(row: Row, ours: Row | None) -> list[str]:
    network = row["network"]
    mark = "" if network else "*"
    key = "psnr" if network else "ir_psnr"
    against = None
    if ours is not None and row[key] is not None and ours[key] is not None:
        against = row[key] - ours[key]
    return [
        row["name"],
        _number(row["ir_psnr"], "{:.2f}"),
        _number(row["psnr"], "{:.2f}") if network else "-",
        _number(against, "{:+.2f}", "-") + (mark if against is not None else ""),
        _number(row["ssim"], "{:.4f}") + mark,
        _number(row["flip"], "{:.4f}") + mark,
        f"{row['bake_paths'] / 1e6:.3g} M",
        human_seconds(row["bake_seconds"]),
        human_bytes(row["cache_nbytes"]),
        _number(_in_millions(row.get("whole_paths")), "{:.3g} M", ABSENT),
        human_bytes(row["whole_nbytes"]) if "whole_nbytes" in row else ABSENT,
    ]


def _in_millions(count: float | None) -> float | None:
    return None if count is None else count / 1e6


def _number(number: float | None, pattern: str, absent: str = REFUSED) -> str:
    return absent if number is None else pattern.format(number)


def ablation_table(ablation: Mapping[str, Any]) -> RenderableType:
    """The rows as a terminal table, ours bold.

    Args:
        ablation: as `measure_ablation` returns it.
    """
    table = Table(
        title=f"{escape(ablation['scene'])}, {ablation['width']}x{ablation['height']}, {ablation['preset']}",
        title_style="bold",
        caption=LEGEND,
    )
    for index, title in enumerate(HEAD):
        table.add_column(title, justify="right" if index else "left", no_wrap=True)
    for cells in ablation_cells(ablation["rows"]):
        style = "bold cyan" if cells[0] == OURS else ""
        table.add_row(*(Text(cell, style=style) for cell in cells))
    return table
