"""Denoising of the directional cache: elements next to each other see nearly the same reflection.

Three passes over ever wider neighbourhoods (an a-trous scheme, Dammertz et al. 2010): every texel is averaged with the
same texel of other elements of its surface. Place and normal decide who is a neighbour; what stands out of the noise is
no light to share: the range weight compares means over 3 x 3 texels with the noise that they have left (as in non-local
means with known variance, Rousselle et al. 2012). The noise is the one that neighbours show, pooled over directions: no
estimate of its own is baked, and where samples are stratified it would be too large.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from workers.backend import dr, mi
from workers.cache_filter import element_spacing, neighbours
from workers.elements import ElementSet

NEAR_SIGMA = 1.0  # of the first pass, in spacings
# Of each further pass: every so many elements, along the bake order's curve, are looked at; reach in spacings.
FAR_PASSES = ((4, 2.0), (16, 4.0))
NUM_FAR = 12
MAX_SIGMAS = 2.5
RANGE_STRENGTH = 8.0
WINDOW = 9  # texels of a comparison
HALO = 1 + len(FAR_PASSES)  # rows of directions beside a texel's own that its result depends on: one a pass
TEXELS_AT_ONCE = 1 << 26  # some 3 GB in device memory
TINY = 1e-30


@dataclass(frozen=True)
class _Pass:
    """Neighbours of each row (itself first) and their weights; uint32, float32 [n, k]."""

    index: np.ndarray
    weight: np.ndarray


def filter_directional(elements: ElementSet, values: np.ndarray, slots: np.ndarray | None = None) -> np.ndarray:
    """Denoised directional lobe.

    Args:
        elements: where the values sit.
        values: grids of one size, float32 [n, polar, azimuth, 3].
        slots: place of each row in `ElementSet.glossy`, int64 [n]; None for all of them.

    Returns:
        float32 [n, polar, azimuth, 3]. Only rows given average each other, but they are neighbours by the spacing of
        all glossy elements: one of few among other grids is left alone.
    """
    rows, polar, azimuth = values.shape[:3]
    if rows == 0:
        return values
    # Squares of radiance must neither overflow nor vanish: the largest value becomes about 1, exactly.
    exponent = int(np.frexp(float(np.abs(values).max(initial=0.0)))[1])
    passes = _passes(elements, slots, np.pi / 2 / polar)
    result = np.empty_like(values)
    whole = values[..., 0].size <= TEXELS_AT_ONCE
    band = polar if whole else max(TEXELS_AT_ONCE // (rows * azimuth) - 2 * HALO, 1)
    for start in range(0, polar, band):
        low, high = max(start - HALO, 0), min(start + band + HALO, polar)
        texels = _Texels(np.ldexp(values[:, low:high], -exponent))
        for one in passes:
            texels.average(one)
        result[:, start : start + band] = texels.numpy()[:, start - low : start - low + band]
    return np.ldexp(result, exponent, out=result)


def _passes(elements: ElementSet, slots: np.ndarray | None, cell: float) -> list[_Pass]:
    members = elements.glossy if slots is None else elements.glossy[slots]
    spacing = element_spacing(elements, elements.glossy)
    spacing = spacing if slots is None else spacing[slots]
    near = neighbours(elements, members, NEAR_SIGMA, spacing)
    found = [_Pass(near[0].astype(np.uint32), near[1].astype(np.float32))]
    for stride, sigma in FAR_PASSES:
        if len(members) > stride * NUM_FAR:
            found.append(_far(elements, members, spacing, stride, sigma, cell))
    return found


def _far(
    elements: ElementSet, members: np.ndarray, spacing: np.ndarray, stride: int, sigma: float, cell: float
) -> _Pass:
    """Neighbours among every `stride`th row; their normals must agree within half a cell of the grid."""
    position, normal = elements.position[members].astype(np.float64), elements.normal[members].astype(np.float64)
    shape, side = elements.shape[members], elements.side[members]
    some = np.arange(stride // 2, len(members), stride)
    reach = sigma * spacing[:, None]
    distance, index = cKDTree(position[some]).query(position, k=NUM_FAR, workers=2)
    index = some[index]
    weight = np.exp(-0.5 * (distance / reach) ** 2) * (distance <= MAX_SIGMAS * reach)
    sharpness = np.log(2.0) / (1.0 - np.cos(cell / 2))
    weight *= np.maximum(np.einsum("nkc,nc->nk", normal[index], normal), 0.0) ** sharpness
    weight *= (shape[index] == shape[:, None]) & (side[index] == side[:, None])
    own = np.arange(len(members))[:, None]
    weight *= index != own
    return _Pass(
        np.concatenate([own, index], 1).astype(np.uint32),
        np.concatenate([np.ones((len(members), 1)), weight], 1).astype(np.float32),
    )


class _Texels:
    """The texels of some rows in device memory, with the noise that is left in them."""

    def __init__(self, values: np.ndarray) -> None:
        polar, azimuth = values.shape[1:3]
        self._count = polar * azimuth
        self._polar, self._azimuth = dr.opaque(mi.UInt32, polar), dr.opaque(mi.UInt32, azimuth)
        self._lane = dr.arange(mi.UInt32, len(values) * self._count)
        self._shape = values.shape
        channels = np.ascontiguousarray(values.reshape(-1, 3).T)
        self._values = mi.Color3f(*(mi.Float(channel) for channel in channels))
        self._noise: mi.Float | None = None

    def numpy(self) -> np.ndarray:
        """float32 [n, polar, azimuth, 3]."""
        return np.stack([channel.numpy() for channel in self._values], -1).reshape(self._shape)

    def average(self, one: _Pass) -> None:
        """One pass."""
        index, weight = mi.UInt32(one.index.reshape(-1)), mi.Float(one.weight.reshape(-1))
        size = dr.opaque(mi.UInt32, one.index.shape[1])
        level = dr.mean(self._values)
        dr.eval(level)
        if self._noise is None:
            spread = self._spread(level, index, weight, size)
            dr.eval(spread)
            self._noise = self._window(spread)
        guide, noise = self._window(level), self._noise
        dr.eval(guide, noise)
        self._values, self._noise = self._mix(guide, noise, index, weight, size)
        dr.eval(self._values, self._noise)

    def _window(self, value: "mi.Float") -> "mi.Float":
        """Mean over 3 x 3 directions."""
        azimuth, polar, lane = self._azimuth, self._polar, self._lane
        column, row = lane % azimuth, lane // azimuth % polar
        first = lane - column - row * azimuth
        total = dr.zeros(mi.Float, dr.width(lane))
        columns = (column + azimuth - 1) % azimuth, column, (column + 1) % azimuth
        for r in (dr.maximum(row, 1) - 1, row, dr.minimum(row + 1, polar - 1)):
            for c in columns:
                total += dr.gather(mi.Float, value, first + r * azimuth + c)
        return total / WINDOW

    @dr.syntax
    def _spread(self, level, index, weight, size):
        """Variance of each texel among its row's neighbours."""
        row, texel = self._lane // self._count, self._lane % self._count
        own = dr.gather(mi.Float, level, self._lane)
        total, squares = dr.zeros(mi.Float, dr.width(self._lane)), dr.zeros(mi.Float, dr.width(self._lane))
        first, second = mi.Float(total), mi.Float(total)
        k = mi.UInt32(0)
        while k < size:
            w = dr.gather(mi.Float, weight, row * size + k)
            other = dr.gather(mi.UInt32, index, row * size + k)
            difference = dr.gather(mi.Float, level, other * self._count + texel) - own
            total += w
            squares += w * w
            first += w * difference
            second += w * difference * difference
            k += 1
        mean = first / total
        rest = dr.maximum(1 - squares / dr.square(total), 1e-3)  # of the degrees of freedom
        return dr.maximum(second / total - dr.square(mean), 0.0) / rest

    @dr.syntax
    def _mix(self, guide, noise, index, weight, size):
        """(averaged texels, noise that is left)."""
        row, texel = self._lane // self._count, self._lane % self._count
        own, own_noise = dr.gather(mi.Float, guide, self._lane), dr.gather(mi.Float, noise, self._lane)
        value, left = dr.zeros(mi.Color3f, dr.width(self._lane)), dr.zeros(mi.Float, dr.width(self._lane))
        total = mi.Float(left)
        k = mi.UInt32(0)
        while k < size:
            w = dr.gather(mi.Float, weight, row * size + k)
            lane = dr.gather(mi.UInt32, index, row * size + k) * self._count + texel
            other_noise = dr.gather(mi.Float, noise, lane)
            expected = (own_noise + other_noise) / WINDOW
            difference = dr.square(dr.gather(mi.Float, guide, lane) - own)
            w *= dr.exp(-dr.maximum(difference - expected, 0.0) / (RANGE_STRENGTH * expected + TINY))
            value += w * mi.Color3f(*(dr.gather(mi.Float, channel, lane) for channel in self._values))
            left += w * w * other_noise
            total += w
            k += 1
        return value / total, left / dr.square(total)
