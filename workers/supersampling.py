"""Which pixels of a query need more than one sample, and where in the pixel those samples lie.

One sample is exact where a pixel and its neighbours see one smooth surface. The others (silhouettes, texture edges,
edges of shadows and reflections) get further samples, compacted into packets of their own. Measured against 4x4
samples everywhere (256x256 to 1920x1080, three scenes), the radiance is between 1.0 dB worse (`tabletop`, 640x360) and
1.4 dB better than with 2x2 everywhere, for 11 to 22 % of the pixels at 256x256 and 2 to 7 % at 1920x1080, where the
query takes half the time; at 256x256 it takes 0.8 to 1.1 of it.
"""

from dataclasses import dataclass

import numpy as np

from workers.backend import dr, mi

MAX_TURN = 0.5  # between neighbours' unit normals, as a distance: 29 degrees
MAX_ALBEDO_STEP = 0.2
MAX_RADIANCE_STEP = 0.3  # of the brighter neighbour's largest channel
MAX_BEND = 0.2  # second difference of 1 / distance, as a share of it: 0 on a plane, whatever its slope
# Around the centre, which is the first sample: no two of the four share a row or a column.
_CENTRE = (0.5, 0.5)
_AROUND_CENTRE = ((0.2, 0.2), (0.85, 0.3), (0.35, 0.85))


def grid_places(samples: int) -> np.ndarray:
    """[samples ** 2, 2] sample places of a regular grid, pixels."""
    steps = (np.arange(samples) + 0.5) / samples
    return np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)


def edge_places(samples: int) -> np.ndarray:
    """[k, 2] sample places of an edge pixel besides its centre, pixels; k is `samples` ** 2 - 1, or 16 for 4."""
    if samples == 2:
        return np.array(_AROUND_CENTRE)
    grid = grid_places(samples)
    return grid[np.any(np.abs(grid - _CENTRE) > 1e-9, axis=1)]


@dataclass
class PixelLook:
    """What decides about edges, of one pixel a lane."""

    radiance: "mi.Color3f"
    normal: "mi.Vector3f"
    albedo: "mi.Color3f"
    nearness: "mi.Float"

    @classmethod
    def read(cls, buffer: "mi.Float", pixel: "mi.UInt32", num_channels: int) -> "PixelLook":
        """From features with radiance, normal, albedo and distance as their first ten channels."""
        packets = num_channels // 4
        values = [value for k in range(3) for value in dr.gather(mi.Vector4f, buffer, pixel * packets + k)]
        distance = values[9]
        return cls(mi.Color3f(values[:3]), mi.Vector3f(values[3:6]), mi.Color3f(values[6:9]),
                   dr.select(distance > 0, dr.rcp(distance), 0.0))  # fmt: skip

    def differs(self, other: "PixelLook") -> "mi.Bool":
        """Whether an edge lies between two neighbours; False where either is NaN."""
        step = dr.max(dr.abs(self.radiance - other.radiance))
        brighter = dr.maximum(dr.max(self.radiance), dr.max(other.radiance))
        return (
            (dr.squared_norm(self.normal - other.normal) > MAX_TURN**2)
            | (dr.max(dr.abs(self.albedo - other.albedo)) > MAX_ALBEDO_STEP)
            | (step > MAX_RADIANCE_STEP * brighter)
        )


def edge_pixels(buffer: "mi.Float", width: int, height: int, num_channels: int) -> "mi.UInt32":
    """The edge pixels of an image first, in order; the lanes behind them hold width * height.

    Args:
        buffer: features of one sample a pixel, flat [height * width * num_channels].
    """
    pixel = dr.arange(mi.UInt32, width * height)
    x, y = pixel % width, pixel // width
    here = PixelLook.read(buffer, pixel, num_channels)
    edge = mi.Bool(False)
    for back, on in (
        (dr.select(x > 0, pixel - 1, pixel), dr.select(x < width - 1, pixel + 1, pixel)),
        (dr.select(y > 0, pixel - width, pixel), dr.select(y < height - 1, pixel + width, pixel)),
    ):
        before, after = (PixelLook.read(buffer, index, num_channels) for index in (back, on))
        bend = before.nearness + after.nearness - 2 * here.nearness
        edge |= here.differs(before) | here.differs(after) | (dr.abs(bend) > MAX_BEND * here.nearness)
    counted = dr.select(edge, mi.UInt32(1), mi.UInt32(0))
    # Evaluated by the sum: read from here on, or every later kernel would find the edges again.
    rank = dr.cumsum(counted) - counted
    packed = dr.full(mi.UInt32, width * height, width * height)
    dr.scatter(packed, pixel, rank, counted != 0)
    return packed
