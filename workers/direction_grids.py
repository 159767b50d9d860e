"""How many directions each glossy element is baked for: as many as its material asks for, from a ladder of grids.

What decides is the measured width of the lobe that the directional cache holds. Its directions are sampled at the
element, from two viewers, and give the solid angle that it effectively fills,

    Omega = (integral of f)^2 / integral of f^2,        f = BSDF times cosine,

which is 4 pi sigma^2 for a narrow Gaussian lobe, about 12 pi alpha^2 for GGX, and grows by 1 / share^2 where a narrow
lobe holds only a share of the energy: what hardly shows needs no fine grid. Nothing but the BSDF's own sampling is
asked, so any plugin and any texture will do.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from workers.backend import dr, mi
from workers.lobes import SMOOTH_MASK, LobeClass, context, directional_lobes, has
from workers.settings import CacheSettings
from workers.surfaces import SurfaceTable

if TYPE_CHECKING:
    from workers.elements import ElementSet

NUM_RUNGS = 5  # 8x2, 16x4, 32x8, 64x16 and 128x32
MIN_AZIMUTH, MIN_POLAR = 8, 2
CELL_PER_SPREAD = 1.25
"""A grid's cell (90 degrees over its polar rows) is at most this many times the lobe's spread.

Jitter in the bin and bilinear lookup blur by half a cell (standard deviation): at 1.25 the lobe widens by a fifth. On
`tabletop`, a grid finer than that gains at most 0.4 dB on plastics and gold, one twice as coarse loses 1 to 5 dB.
"""
SPREAD_SAMPLES = 64  # directions of each view: the spread to about 10 %
_VIEWS = ((0.4, 0.3), (1.05, 1.9))  # polar angle and azimuth of the two viewers, radians
_LANES_PER_LAUNCH = 1 << 21
_PLASTIC = 1.2207440846057596  # root of x^4 = x + 1: its powers spread points evenly over the unit cube


def grid_of(rung: int) -> tuple[int, int]:
    """(azimuth, polar) of a rung of the ladder."""
    return MIN_AZIMUTH << rung, MIN_POLAR << rung


def top_rung(cache: CacheSettings) -> int:
    """The finest rung that the settings allow; -1 where every element gets cache.azimuth x cache.polar."""
    if cache.grids == "uniform" or cache.lobes == "exitant":
        return -1
    allowed = [rung for rung in range(NUM_RUNGS) if _within(grid_of(rung), cache)]
    return max(allowed, default=-1)


def _within(grid: tuple[int, int], cache: CacheSettings) -> bool:
    return grid[0] <= cache.azimuth and grid[1] <= cache.polar


def choose_grids(spread: np.ndarray, cache: CacheSettings) -> np.ndarray | None:
    """Rung of each glossy element: the coarsest whose cell is below `CELL_PER_SPREAD` of the lobe's spread.

    Args:
        spread: `ElementSet.spread`, radians [g].
        cache: its azimuth and polar are the finest grid allowed.

    Returns:
        uint8 [g]; None where all elements share cache.azimuth x cache.polar.
    """
    finest = top_rung(cache)
    if finest < 0:
        return None
    coarsest_cell = np.pi / 2 / MIN_POLAR
    needed = np.ceil(np.log2(coarsest_cell / (CELL_PER_SPREAD * np.clip(spread, 1e-6, 1e6))))
    return np.clip(needed, 0, finest).astype(np.uint8)


def samples_per_direction(rung: int, cache: CacheSettings) -> int:
    """Paths of one direction: doubled with every rung below the finest, which halves the paths of an element.

    A coarse grid's texel answers for more views, so its noise is seen over a larger part of a frame.
    """
    return cache.directional_spp << (top_rung(cache) - rung)


@dataclass(frozen=True)
class GridShare:
    """The elements that share a grid.

    Attributes:
        name: of their cache set.
        rows: how many there are.
        grid: (azimuth, polar).
        spp: paths of one direction.
    """

    name: str
    rows: int
    grid: tuple[int, int]
    spp: int

    @property
    def texels(self) -> int:
        return self.rows * self.grid[0] * self.grid[1]


def grid_shares(elements: "ElementSet", cache: CacheSettings) -> list[GridShare]:
    """The directional cache sets of an element set, coarsest grid first."""
    rungs = choose_grids(elements.spread, cache)
    if rungs is None:
        whole = GridShare("directional", len(elements.glossy), (cache.azimuth, cache.polar), cache.directional_spp)
        return [whole] if whole.rows else []
    present, rows = np.unique(rungs, return_counts=True)
    return [
        GridShare(set_name(grid_of(rung)), count, grid_of(rung), samples_per_direction(rung, cache))
        for rung, count in zip(present.tolist(), rows.tolist(), strict=True)
    ]


def set_name(grid: tuple[int, int]) -> str:
    """Name of the cache set of a grid where grids differ."""
    return f"directional-{grid[0]}x{grid[1]}"


def directional_cost(elements: "ElementSet", cache: CacheSettings) -> dict[str, int]:
    """What the directional cache of an element set costs: "paths" and "texels"."""
    shares = grid_shares(elements, cache)
    return {"paths": sum(share.texels * share.spp for share in shares), "texels": sum(share.texels for share in shares)}


def measure_spread(
    table: SurfaceTable, shape: np.ndarray, prim_local: np.ndarray, uv: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """Angular spread of the directionally cached lobe at some places: sqrt(Omega / 4 pi), the sharper of two views.

    Args:
        table: surfaces of the scene.
        shape, prim_local, uv, normal: the places, as in `ElementSet`.

    Returns:
        float32 [n], radians; infinite where the lobe is black or gives no finite sample.
    """
    per_launch = max(1, _LANES_PER_LAUNCH // SPREAD_SAMPLES)
    parts = [np.zeros(0, np.float32)]
    for first in range(0, len(shape), per_launch):
        chosen = slice(first, first + per_launch)
        views = [_spread(table, shape[chosen], prim_local[chosen], uv[chosen], normal[chosen], view) for view in _VIEWS]
        parts.append(np.minimum(*views))
    return np.concatenate(parts)


def _spread(
    table: SurfaceTable, shape: np.ndarray, prim_local: np.ndarray, uv: np.ndarray, normal: np.ndarray,
    view: tuple[float, float],
) -> np.ndarray:  # fmt: skip
    """The spread seen by one viewer; every place draws the same points, so equal materials get equal answers."""
    places = table.interaction(shape, prim_local, uv)
    normals = mi.Vector3f(np.ascontiguousarray(normal.T))
    lobes = dr.gather(mi.UInt32, table.lobe_bits_dr, mi.UInt32(shape.astype(np.uint32)))
    dr.eval(places, normals, lobes)
    lane = dr.arange(mi.UInt32, len(shape) * SPREAD_SAMPLES)
    owner = lane // SPREAD_SAMPLES
    si, bits = dr.gather(mi.SurfaceInteraction3f, places, owner), dr.gather(mi.UInt32, lobes, owner)
    theta, phi = view
    viewer = mi.Vector3f(math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta))
    si.wi = si.to_local(mi.Frame3f(dr.gather(mi.Vector3f, normals, owner)).to_world(viewer))
    weight, pdf = _sample_lobe(table.lobe_union, si, bits, mi.Float(lane % SPREAD_SAMPLES) + 0.5)
    total, square = (_sums(value) for value in (weight, dr.square(weight) * pdf))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        solid_angle = total**2 / (SPREAD_SAMPLES * square)
    found = np.isfinite(solid_angle) & (square > 0) & (total > 0)
    return np.where(found, np.sqrt(solid_angle / (4 * np.pi), where=found, out=np.zeros_like(total)), np.inf).astype(
        np.float32
    )


def _sample_lobe(
    union: LobeClass, si: "mi.SurfaceInteraction3f", bits: "mi.UInt32", index: "mi.Float"
) -> "tuple[mi.Float, mi.Float]":
    """(f / pdf, pdf) of one direction of the lobe that the cache holds; 0 where there is none or it is not finite."""
    ctx, removed = directional_lobes(si, bits, union)
    points = [index * _PLASTIC**-power for power in (1, 2, 3)]
    one, two, three = (point - dr.floor(point) for point in points)
    bs, value = si.bsdf().sample(ctx, si, one, mi.Point2f(two, three))
    if union & LobeClass.WHOLE:
        whole = has(bits, LobeClass.WHOLE)
        smooth = context(SMOOTH_MASK)
        every = si.bsdf().sample(smooth, si, one, mi.Point2f(two, three), whole)
        bs, value = (dr.select(whole, a, b) for a, b in zip(every, (bs, value), strict=True))
    cosine = dr.maximum(bs.wo.z * dr.sign(si.wi.z), 0.0)
    value -= removed * cosine * dr.inv_pi / bs.pdf
    weight = dr.maximum(dr.mean(value), 0.0)
    usable = (bs.pdf > 0) & dr.isfinite(bs.pdf) & dr.isfinite(weight)
    usable &= ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    return dr.select(usable, weight, 0.0), dr.select(usable, bs.pdf, 0.0)


def _sums(value: "mi.Float") -> np.ndarray:
    """Sums over the samples of each place, float64."""
    dr.eval(value)
    return value.numpy().reshape(-1, SPREAD_SAMPLES).sum(axis=1, dtype=np.float64)
