"""Operating points: measured ways to make a scene's frame, and the choice among them.

A point is what it changes of one base run, the network it uses, and what it was measured to cost and to be
worth. `workers/operating_table.py` keeps the points of a scene.

The time of a frame of p pixels is predicted as

    ms(p) = (a + b p) (1 + m) max(1 + s, d)

with a, b >= 0 fitted to the measured medians in relative least squares, and the margin m the largest relative
amount by which a median exceeds the fit. Frames smaller than the smallest measured size are taken to need its time:
an intercept is the least certain part of a fit. The spread s is how far a single frame lies above the median in 95 %
of the sweep's rounds. Another machine, or one that does other work meanwhile, is slower by a factor that the sweep
cannot know: d, learned from the frames that a server makes (`service/pace.py`), 1 where nothing is known.

It says nothing of a size's first frame, whose program is compiled: `workers/point_renderer.py` makes that
frame twice, and calls the first one preparation. PSNR is that of the run's own resolution.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from scipy.optimize import nnls

from workers.errors import NoOperatingPointsError, OperatingPointError, UnreachableTargetError

BALANCED_DB = 1.0  # "balanced" is the fastest point that loses at most this much to the best
Quality = Literal["draft", "balanced", "best"]
QUALITIES: tuple[str, ...] = get_args(Quality)


@dataclass(frozen=True, kw_only=True)
class FrameTime:
    """Median milliseconds from pose to frame in memory at one size."""

    width: int
    height: int
    ms: float


@dataclass(frozen=True, kw_only=True)
class OperatingPoint:
    """One way to make a frame.

    Attributes:
        name: unique in its scene.
        overrides: settings changed from the table's base run (`Settings.override`).
        network: key of the network's unit, None where the caches' own radiance is the frame.
        precision: of inference, "fp32" or "bf16"; fixed here, so that a new frame size measures nothing.
        scale: 1, or 2 where the network works at half the resolution and its frame is upsampled.
        psnr: dB, mean of the test frames.
        flip, temporal: as psnr; None where there is none (a single test frame has no temporal score).
        times: at least one size.
        bake_seconds: of the caches alone, from their units' records.
        nbytes: caches and network at rest.
        spread: relative excess of a single frame over the median that 95 % of them keep within; tables of before
            it was measured have 0.
    """

    name: str
    overrides: dict[str, Any] = field(hash=False)
    network: str | None
    precision: str
    scale: int
    psnr: float
    flip: float | None
    temporal: float | None
    times: tuple[FrameTime, ...]
    bake_seconds: float
    nbytes: int
    spread: float = 0.0

    def typical_ms(self, width: int, height: int) -> float:
        """Milliseconds of a median frame: (a + b p) (1 + m)."""
        fixed, per_pixel, margin = time_model(self.times)
        pixels = max(width * height, min(time.width * time.height for time in self.times))
        return (fixed + per_pixel * pixels) * (1.0 + margin)

    def predicted_ms(self, width: int, height: int, slowdown: float = 1.0) -> float:
        """Milliseconds that nearly every frame keeps, by the model in this module's first lines.

        Args:
            width, height: of the frame, pixels.
            slowdown: d, how much longer than typical frames take here and now.
        """
        return self.typical_ms(width, height) * max(1.0 + self.spread, slowdown)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> "OperatingPoint":
        return cls(**{**value, "times": tuple(FrameTime(**time) for time in value["times"])})


def time_model(times: Sequence[FrameTime]) -> tuple[float, float, float]:
    """(a in ms, b in ms per pixel, margin m) of ms(p) = (a + b p) (1 + m).

    One measured size gives a line through the origin.
    """
    ms = np.array([time.ms for time in times])
    pixels = np.array([float(time.width * time.height) for time in times])
    if len(times) == 1:
        return 0.0, float(ms[0] / pixels[0]), 0.0
    unit = pixels.max()  # keeps both columns at one magnitude
    system = np.column_stack([np.ones_like(ms), pixels / unit]) / ms[:, None]
    (fixed, slope), _ = nnls(system, np.ones_like(ms))
    margin = max(0.0, float(np.max(ms / (fixed + slope * pixels / unit))) - 1.0)
    return float(fixed), float(slope / unit), margin


# ------------------------------------------------- the choice -------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class FrameDemand:
    """What a frame must be; at least one of the three.

    Attributes:
        quality: "draft" is the fastest point, "best" that of the highest PSNR, "balanced" the fastest within
            `BALANCED_DB` of it; among the points that the other two admit.
        max_ms: at most so many milliseconds from pose to frame, > 0.
        min_psnr: at least so many dB.

    Raises:
        OperatingPointError: nothing is demanded, or a value is outside its range.
    """

    quality: Quality | None = None
    max_ms: float | None = None
    min_psnr: float | None = None

    def __post_init__(self) -> None:
        if self.quality is None and self.max_ms is None and self.min_psnr is None:
            raise OperatingPointError("a demand must have a quality, max_ms or min_psnr, got none of them")
        if self.quality is not None and self.quality not in QUALITIES:
            raise OperatingPointError(f"quality must be one of {', '.join(QUALITIES)}, got {self.quality!r}")
        if self.max_ms is not None and not 0 < self.max_ms < np.inf:
            raise OperatingPointError(f"max_ms must be above 0 and finite, got {self.max_ms}")
        if self.min_psnr is not None and not np.isfinite(self.min_psnr):
            raise OperatingPointError(f"min_psnr must be finite, got {self.min_psnr}")

    @property
    def text(self) -> str:
        """ "within 20 ms with at least 30 dB"."""
        parts = [f"within {self.max_ms:g} ms"] if self.max_ms is not None else []
        parts += [f"with at least {self.min_psnr:g} dB"] if self.min_psnr is not None else []
        return " ".join(parts) or f"of {self.quality} quality"


@dataclass(frozen=True)
class Choice:
    """The point, and the milliseconds predicted for the demanded size."""

    point: OperatingPoint
    ms: float


def choose(
    points: Sequence[OperatingPoint], demand: FrameDemand, width: int, height: int, slowdown: float = 1.0
) -> Choice:
    """Picks the measured point for a frame.

    Without a quality, `max_ms` takes the highest PSNR that it allows, and `min_psnr` alone the fastest point.

    Args:
        points: of the scene.
        demand: what the frame must be.
        width, height: of the frame, pixels.
        slowdown: as `OperatingPoint.predicted_ms`.

    Raises:
        NoOperatingPointsError: there are no points.
        UnreachableTargetError: none meets the demand.
    """
    if not points:
        raise NoOperatingPointsError("a scene must have a measured point to choose, got none; run: lightwell tradeoff")
    every = [Choice(point, point.predicted_ms(width, height, slowdown)) for point in points]
    max_ms = np.inf if demand.max_ms is None else demand.max_ms
    min_psnr = -np.inf if demand.min_psnr is None else demand.min_psnr
    admitted = [choice for choice in every if choice.ms <= max_ms and choice.point.psnr >= min_psnr]
    if not admitted:
        raise _unreachable(every, demand, width, height)
    quality = demand.quality or ("best" if demand.max_ms is not None else "draft")
    top = max(choice.point.psnr for choice in admitted)
    lowest = {"draft": -np.inf, "balanced": top - BALANCED_DB, "best": top}[quality]
    return min((choice for choice in admitted if choice.point.psnr >= lowest), key=lambda choice: choice.ms)


def _unreachable(every: list[Choice], demand: FrameDemand, width: int, height: int) -> UnreachableTargetError:
    fast_enough = [c for c in every if demand.max_ms is None or c.ms <= demand.max_ms]
    good_enough = [c for c in every if demand.min_psnr is None or c.point.psnr >= demand.min_psnr]
    best = max(fast_enough or [min(every, key=lambda c: c.ms)], key=lambda c: c.point.psnr)
    fastest = min(good_enough or [max(every, key=lambda c: c.point.psnr)], key=lambda c: c.ms)
    nearest = {"fastest": fastest, "best": best}
    texts = {
        name: f"{choice.point.name!r} with {choice.point.psnr:.2f} dB in {choice.ms:.1f} ms"
        for name, choice in nearest.items()
    }
    nearby = texts["best"] if best is fastest else f"{texts['best']}, or {texts['fastest']}"
    reachable = {
        name: {"point": choice.point.name, "ms": choice.ms, "psnr": choice.point.psnr}
        for name, choice in nearest.items()
    }
    return UnreachableTargetError(
        f"a frame of {width}x{height} must be asked for as some measured point can make it, got {demand.text}; "
        f"nearest: {nearby}",
        reachable,
    )
