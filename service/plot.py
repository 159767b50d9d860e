"""The trade as a picture: quality against time a frame, as inline SVG that follows the page's colours."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from service import scores

WIDTH, HEIGHT = 760, 380
LEFT, RIGHT, TOP, BOTTOM = 64, 150, 18, 46
LABEL_HEIGHT = 15
_PSNR, _MS = scores.COLUMNS[0], scores.COLUMNS[-1]


@dataclass(frozen=True)
class Point:
    """One method: its place in the drawing (SVG units, y down), and where its label goes."""

    name: str
    title: str
    x: float
    y: float
    label_y: float
    is_best_trade: bool


@dataclass(frozen=True)
class Tick:
    """A labelled line across the drawing at `at` (SVG units)."""

    at: float
    label: str


@dataclass(frozen=True)
class TradePlot:
    """Everything that the template draws."""

    points: tuple[Point, ...]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    frontier: str
    reference_y: float | None


def best_trades(measured: Mapping[str, tuple[float, float]]) -> set[str]:
    """Names of the methods that no other method beats in both time and quality.

    Args:
        measured: name -> (milliseconds, PSNR in dB).
    """

    def is_beaten(ms: float, psnr: float) -> bool:
        return any(m <= ms and p >= psnr and (m < ms or p > psnr) for m, p in measured.values())

    return {name for name, (ms, psnr) in measured.items() if not is_beaten(ms, psnr)}


def _time_ticks(low: float, high: float) -> list[float]:
    """Powers of ten times 1, 2 and 5 within [low, high]."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [step * 10.0**decade for decade in decades for step in (1, 2, 5) if low <= step * 10.0**decade <= high]


def _psnr_ticks(low: float, high: float) -> list[float]:
    step = next((s for s in (1, 2, 5, 10, 20, 50) if (high - low) / s <= 7), 100)
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _spread(heights: list[float]) -> list[float]:
    """Moves labels down until none of a sorted column covers the one above it."""
    spread: list[float] = []
    for y in heights:
        spread.append(max(y, spread[-1] + LABEL_HEIGHT) if spread else y)
    overflow = (spread[-1] - (HEIGHT - BOTTOM)) if spread else 0.0
    if overflow > 0:  # push the whole column up from below instead
        limit: float = HEIGHT - BOTTOM
        for k in reversed(range(len(spread))):
            spread[k] = min(spread[k], limit)
            limit = spread[k] - LABEL_HEIGHT
    return spread


def trade_plot(result: Mapping[str, Any]) -> TradePlot | None:
    """Lays out PSNR against milliseconds (logarithmic). None where fewer than two rows have both.

    Args:
        result: an evaluation's result JSON.
    """
    measured: dict[str, tuple[float, float]] = {}
    for row in result["rows"]:
        ms, psnr = scores.value(row, _MS), scores.value(row, _PSNR)
        if ms is not None and ms > 0 and psnr is not None:
            measured[row["name"]] = (ms, psnr)
    if len(measured) < 2:
        return None
    times, psnrs = zip(*measured.values(), strict=True)
    low_ms, high_ms = min(times) / 1.25, max(times) * 1.25
    low_db, high_db = min(psnrs) - 1.0, max(psnrs) + 1.0

    def x_of(ms: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * math.log(ms / low_ms) / math.log(high_ms / low_ms)

    def y_of(psnr: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (high_db - psnr) / (high_db - low_db)

    trades = best_trades(measured)
    places = sorted(((y_of(psnr), x_of(ms), name) for name, (ms, psnr) in measured.items()))
    labels = _spread([y for y, _, _ in places])
    points = tuple(
        Point(name, scores.method_title(name), x, y, label_y, name in trades)
        for (y, x, name), label_y in zip(places, labels, strict=True)
    )
    reference_db = result.get("reference_error_db")
    return TradePlot(
        points=points,
        x_ticks=tuple(Tick(x_of(ms), f"{ms:g}") for ms in _time_ticks(low_ms, high_ms)),
        y_ticks=tuple(Tick(y_of(psnr), f"{psnr:g}") for psnr in _psnr_ticks(low_db, high_db)),
        frontier=" ".join(f"{p.x:.1f},{p.y:.1f}" for p in sorted(points, key=lambda p: p.x) if p.is_best_trade),
        reference_y=y_of(reference_db) if reference_db is not None and low_db < reference_db < high_db else None,
    )
