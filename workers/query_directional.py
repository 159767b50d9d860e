"""Lookups in the directional cache: one flat buffer of float32 or packed texels, with a grid of its own a slot.

Dr.Jit counterpart of `workers/texels.py` and of `bilinear` in `workers/query_reference.py`.
"""

import numpy as np

from workers.backend import dr, mi
from workers.direction_grids import MIN_AZIMUTH, MIN_POLAR
from workers.texels import (
    EXPONENT_SHIFT,
    FIELD_BITS,
    FIELD_MASK,
    TEXELS_PER_BLOCK,
    DirectionalTexels,
    exponent_bias,
)

GRAZING_COSINE = 0.02


def with_locators(packets: np.ndarray, cache: DirectionalTexels) -> np.ndarray:
    """Packets of four floats a slot, flat float32, whose fourth tells where the slot's grid lies: it is read anyway."""
    if cache.rung is not None and len(cache.rung):
        packets.reshape(-1, 4)[:, 3] = cache.locators().view(np.float32)
    return packets


class DirectionalLookup:
    """The directional cache of one scene in device memory.

    Attributes:
        texels: the buffer, four floats or one uint32 a texel.
    """

    def __init__(self, cache: DirectionalTexels) -> None:
        self.grid, self.packing, self.on_ladder = cache.grid, cache.packing, cache.rung is not None
        if cache.packing is None:
            self.texels = mi.Float(four_channels(cache.values))
        else:
            self.texels = mi.UInt32(cache.values if len(cache.values) else np.zeros(1, np.uint32))

    def _grid(self, slot, locator):
        """(first texel, azimuth, polar) of a slot's grid; see `DirectionalTexels.locators`."""
        if not self.on_ladder:
            azimuth, polar = self.grid
            return slot * (azimuth * polar), mi.UInt32(azimuth), mi.UInt32(polar)
        where = dr.reinterpret_array(mi.UInt32, locator)
        rung = where & 7
        return (where >> 3) * TEXELS_PER_BLOCK, mi.UInt32(MIN_AZIMUTH) << rung, mi.UInt32(MIN_POLAR) << rung

    def bilinear(self, slot, locator, local, active):
        """Lookup by polar angle and azimuth of a local direction in the grid of a slot; `locator` is its packet's
        fourth float."""
        first, azimuth, polar = self._grid(slot, locator)
        columns, rows = mi.Float(azimuth), mi.Float(polar)
        cos_theta = dr.maximum(local.z, GRAZING_COSINE)
        theta = dr.safe_acos(cos_theta) * (2 / dr.pi) * rows - 0.5
        phi = dr.atan2(local.y, local.x) * dr.inv_two_pi * columns - 0.5
        phi = dr.select(phi < 0, phi + columns, phi)
        row = dr.clip(dr.floor(theta), 0.0, dr.maximum(rows - 2, 0.0))
        column = dr.floor(phi)
        ft, fp = dr.clip(theta - row, 0.0, 1.0), phi - column
        r0 = mi.UInt32(row)
        r1 = dr.minimum(r0 + 1, polar - 1)
        c0 = self._wrapped(mi.UInt32(column), azimuth)
        c1 = self._wrapped(c0 + 1, azimuth)
        result = mi.Color3f(0)
        for r, c, w in ((r0, c0, (1 - ft) * (1 - fp)), (r0, c1, (1 - ft) * fp), (r1, c0, ft * (1 - fp)),
                        (r1, c1, ft * fp)):  # fmt: skip
            result += self._texel(first + r * azimuth + c, w, active)
        return result

    def _wrapped(self, column, azimuth):
        return column & (azimuth - 1) if self.on_ladder else column % azimuth

    def _texel(self, index, weight, active):
        """A texel of the directional cache times its weight; `texels.unpack` on the device."""
        if self.packing is None:
            return mi.Color3f(xyz(dr.gather(mi.Vector4f, self.texels, index, active))) * weight
        packed = dr.gather(mi.UInt32, self.texels, index, active)
        exponent = (packed >> EXPONENT_SHIFT) + exponent_bias(self.packing)
        factor = dr.reinterpret_array(mi.Float, exponent << 23) * weight
        fields = [packed, packed >> FIELD_BITS, packed >> 2 * FIELD_BITS]
        if self.packing.signed:
            above = 32 - FIELD_BITS
            signed = [dr.reinterpret_array(mi.Int32, field << above) >> above for field in fields]
            return mi.Color3f(*(mi.Float(value) for value in signed)) * factor
        return mi.Color3f(*(mi.Float(mi.Int32(field & FIELD_MASK)) for field in fields)) * factor


def four_channels(values: np.ndarray) -> np.ndarray:
    """[..., 3] as a flat array with four floats a row: one packet gather instead of three."""
    rows = values.reshape(-1, 3)
    padded = np.zeros((max(len(rows), 1), 4), np.float32)
    padded[: len(rows), :3] = rows
    return padded.reshape(-1)


def xyz(value: "mi.Vector4f") -> "mi.Vector3f":
    return mi.Vector3f(value.x, value.y, value.z)
