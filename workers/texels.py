"""Texels of the directional cache: three channels with a shared exponent in 32 bits (RGB9E5), and where they lie.

A packed texel is r | g << 9 | b << 18 | e << 27, its radiance `mantissa * 2**(top - 31 + e - bits)`. `top` moves the
32 octaves to where the values are: 2**top is above the largest of them. Values that can be negative (a principled
lobe of which the Lambertian part was taken away) have signed mantissas of 8 bits, others 9 bits without a sign.
An error is at most 2**-bits of the texel's largest channel, or 2**(top - 32 - bits) where that channel is below
2**(top - 32).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from workers.direction_grids import MIN_AZIMUTH, MIN_POLAR, grid_of
from workers.errors import WorkerError

FIELD_BITS = 9
FIELD_MASK = (1 << FIELD_BITS) - 1
EXPONENT_SHIFT = 3 * FIELD_BITS
MAX_EXPONENT = 31
LOWEST_TOP = -86  # lower ones would need factors below float32's normal range
TEXELS_PER_BLOCK = MIN_AZIMUTH * MIN_POLAR  # of the coarsest grid; every grid of the ladder is a multiple of it
MAX_TEXELS = 1 << 32  # their index is a uint32
_TEXELS_AT_ONCE = 1 << 20  # keeps temporaries small


@dataclass(frozen=True)
class Packing:
    """How texels of one buffer are packed.

    Attributes:
        top: 2**top is above every magnitude.
        signed: whether values can be negative; else what is below 0 becomes 0.
    """

    top: int
    signed: bool

    @property
    def bits(self) -> int:
        """Bits of a mantissa's magnitude."""
        return FIELD_BITS - int(self.signed)

    @property
    def error(self) -> float:
        """Largest error, as a share of a texel's largest channel."""
        return 2.0**-self.bits


def top_exponent(values: np.ndarray) -> int:
    """The `top` for some finite values."""
    largest = float(np.abs(values).max(initial=0.0))
    return max(int(np.frexp(largest)[1]), LOWEST_TOP)


def pack(values: np.ndarray, packing: Packing) -> np.ndarray:
    """Packs finite float32 [..., 3] below 2**top; uint32 [...]."""
    rows = np.ascontiguousarray(values, np.float32).reshape(-1, 3)
    packed = np.empty(len(rows), np.uint32)
    for first in range(0, len(rows), _TEXELS_AT_ONCE):
        part = slice(first, first + _TEXELS_AT_ONCE)
        packed[part] = _pack(rows[part], packing)
    return packed.reshape(values.shape[:-1])


def _pack(values: np.ndarray, packing: Packing) -> np.ndarray:
    if not packing.signed:
        values = np.maximum(values, 0.0)
    largest = np.abs(values).max(axis=1)
    lowest = packing.top - MAX_EXPONENT
    # The exponent bits of a float32 are those of `frexp`, plus 126.
    octave = np.clip((largest.view(np.uint32) >> 23).astype(np.int32) - 126, lowest, packing.top)
    scale = ((packing.bits - octave + 127) << 23).astype(np.uint32).view(np.float32)
    limit = (1 << packing.bits) - 1
    mantissa = np.clip(np.rint(values * scale[:, None]), -limit, limit).astype(np.int32)
    fields = (mantissa & FIELD_MASK).astype(np.uint32)
    exponent = (octave - lowest).astype(np.uint32)
    return fields[:, 0] | fields[:, 1] << 9 | fields[:, 2] << 18 | exponent << EXPONENT_SHIFT


def unpack(packed: np.ndarray, packing: Packing) -> np.ndarray:
    """Inverse of `pack`: float32 [..., 3]."""
    result = np.empty((packed.size, 3), np.float32)
    flat = packed.reshape(-1)
    for first in range(0, len(flat), _TEXELS_AT_ONCE):
        part = flat[first : first + _TEXELS_AT_ONCE]
        factor = (((part >> EXPONENT_SHIFT).astype(np.int32) + exponent_bias(packing)) << 23).view(np.float32)
        for channel in range(3):
            field = ((part >> np.uint32(FIELD_BITS * channel)) & np.uint32(FIELD_MASK)).astype(np.int32)
            if packing.signed:
                field = (field ^ 256) - 256
            np.multiply(field, factor, out=result[first : first + len(part), channel], casting="same_kind")
    return result.reshape(*packed.shape, 3)


def exponent_bias(packing: Packing) -> int:
    """What a texel's exponent lacks to a float32's exponent bits."""
    return packing.top - MAX_EXPONENT - packing.bits + 127


def pack_rows(values: np.ndarray, *, signed: bool) -> dict[str, np.ndarray]:
    """Packs each element's own texels with a `top` of their own: what lies in the store.

    Args:
        values: finite float32 [n, polar, azimuth, 3].
        signed: see `Packing`.

    Returns:
        "texels", uint32 [n, polar, azimuth], and "top", int16 [n].
    """
    largest = np.abs(values).max(axis=(1, 2, 3), initial=0.0)
    top = np.maximum(np.frexp(largest)[1], LOWEST_TOP)
    scaled = np.ldexp(values, -top[:, None, None, None])  # by a power of two: exact
    return {"texels": pack(scaled, Packing(0, signed)), "top": top.astype(np.int16)}


def unpack_rows(texels: np.ndarray, top: np.ndarray, *, signed: bool) -> np.ndarray:
    """Inverse of `pack_rows`: float32 [n, polar, azimuth, 3]."""
    values = unpack(texels, Packing(0, signed))
    return np.ldexp(values, top.astype(np.int32)[:, None, None, None], out=values)


@dataclass(frozen=True)
class DirectionalTexels:
    """The directional cache as the query reads it: one flat buffer, the grids of a rung one behind another.

    Attributes:
        values: float32 [texels, 3], or packed uint32 [texels].
        grid: (azimuth, polar) of every slot where `rung` is None.
        rung: rung of the ladder of each slot, uint8 [g]; None where all share `grid`.
        packing: of packed values, else None.
    """

    values: np.ndarray
    grid: tuple[int, int]
    rung: np.ndarray | None = None
    packing: Packing | None = None

    @classmethod
    def uniform(cls, grids: np.ndarray, packing: Packing | None = None) -> "DirectionalTexels":
        """One grid for all: float32 [g, polar, azimuth, 3]."""
        polar, azimuth = grids.shape[1:3]
        values = grids.reshape(-1, 3) if packing is None else pack(grids, packing).reshape(-1)
        return cls(values, (azimuth, polar), None, packing)

    @classmethod
    def ladder(
        cls, rung: np.ndarray, load: Callable[[int], np.ndarray], packing: Packing | None = None
    ) -> "DirectionalTexels":
        """Grids of the ladder; only one rung's floats are held at once where they are packed.

        Args:
            rung: of each slot, uint8 [g].
            load: gives the grids of a rung's slots in order, float32 [n, polar, azimuth, 3].
            packing: how to pack them.
        """
        total = int(first_texels(rung)[1])
        values = np.empty((total, 3), np.float32) if packing is None else np.empty(total, np.uint32)
        start = 0
        for one in np.unique(rung).tolist():
            grids = load(one)
            stop = start + grids[..., 0].size
            values[start:stop] = grids.reshape(-1, 3) if packing is None else pack(grids, packing).reshape(-1)
            start = stop
        return cls(values, grid_of(0), rung, packing)

    def locators(self) -> np.ndarray:
        """Where a slot's grid lies: (first texel / `TEXELS_PER_BLOCK`) << 3 | rung, uint32 [g].

        Raises:
            WorkerError: more texels than 32 bits can tell.
        """
        assert self.rung is not None, "slots of one grid need no locator"
        first, total = first_texels(self.rung)
        if total > MAX_TEXELS:
            raise WorkerError(
                f"directional cache must have at most {MAX_TEXELS} texels, got {total}; "
                "lower cache.azimuth and cache.polar, or cache.max_elements"
            )
        return (first // TEXELS_PER_BLOCK << 3 | self.rung).astype(np.uint32)

    def grids(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """(slots, their grids unpacked, float32 [n, polar, azimuth, 3]) of every rung: for reference and tests."""
        values = self.values if self.packing is None else unpack(self.values, self.packing)
        if self.rung is None:
            azimuth, polar = self.grid
            grids = values.reshape(-1, polar, azimuth, 3)
            yield np.arange(len(grids)), grids
            return
        start = 0
        for one in np.unique(self.rung).tolist():
            slots = np.flatnonzero(self.rung == one)
            azimuth, polar = grid_of(one)
            stop = start + len(slots) * polar * azimuth
            yield slots, values[start:stop].reshape(-1, polar, azimuth, 3)
            start = stop


def first_texels(rung: np.ndarray) -> tuple[np.ndarray, int]:
    """First texel of each slot's grid, int64 [g], and the number of texels."""
    order = np.argsort(rung, kind="stable")
    size = np.int64(TEXELS_PER_BLOCK) << 2 * rung.astype(np.int64)
    end = np.cumsum(size[order])
    first = np.empty(len(rung), np.int64)
    first[order] = end - size[order]
    return first, int(end[-1]) if len(end) else 0
