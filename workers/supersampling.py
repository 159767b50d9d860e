"""Which pixels of a query need more than one sample, and where in the pixel those samples lie.

One sample is exact where a pixel and its neighbours see one smooth surface. The others (silhouettes, texture edges,
edges of shadows and reflections) get further samples, compacted into packets of their own. Measured against 4x4
samples everywhere (256x256 to 1920x1080, three scenes), the radiance is between 1.0 dB worse (`tabletop`, 640x360) and
1.4 dB better than with 2x2 everywhere, for 11 to 22 % of the pixels at 256x256 and 2 to 7 % at 1920x1080, where the
query takes half the time; at 256x256 it takes 0.57 to 0.68 of it.
"""

from dataclasses import dataclass

import numpy as np

from workers.backend import dr, mi

MAX_TURN = 0.5  # between neighbours' unit normals, as a distance: 29 degrees
MAX_ALBEDO_STEP = 0.2
MAX_RADIANCE_STEP = 0.3  # of the brighter neighbour's largest channel
MAX_BEND = 0.2  # second difference of 1 / distance, as a share of it: 0 on a plane, whatever its slope
TILE = 4  # pixels along an edge: one tile fills a packet of 16 lanes
RUN = 32  # edges that stay together, a multiple of every packet's width
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
    """The edge pixels of an image, tile by tile; the lanes between and behind them hold width * height.

    Lanes that work side by side see neighbouring edges. Runs of `RUN` edges are spread evenly over all lanes: a launch
    is cut into equal blocks, and edges that come first would all fall to one thread.

    Args:
        buffer: features of one sample a pixel, flat [height * width * num_channels].
    """
    pixel, inside = _tiles(width, height)
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
    counted = dr.select(edge & inside, mi.UInt32(1), mi.UInt32(0))
    # Evaluated by the sum: read from here on, or every later kernel would find the edges again.
    up_to = dr.cumsum(counted)
    packed = dr.full(mi.UInt32, width * height, dr.width(pixel))
    dr.scatter(packed, pixel, _spread(up_to - counted, up_to), counted != 0)
    return packed


def _tiles(width: int, height: int) -> "tuple[mi.UInt32, mi.Bool]":
    """(pixel, whether it lies in the image) of lanes that go through tiles of `TILE` x `TILE` pixels."""
    across, down = -(-width // TILE), -(-height // TILE)
    lane = dr.arange(mi.UInt32, across * down * TILE**2)
    tile, place = lane // TILE**2, lane % TILE**2
    x = (tile % across) * TILE + place % TILE
    y = (tile // across) * TILE + place // TILE
    inside = (x < width) & (y < height)
    return dr.select(inside, y * width + x, 0), inside


def _spread(rank: "mi.UInt32", up_to: "mi.UInt32") -> "mi.UInt32":
    """Lanes for ranks from 0 on, in their order, with equal gaps between runs; `up_to` ends with their number."""
    num_lanes = dr.width(up_to)
    runs = mi.Float((dr.gather(mi.UInt32, up_to, num_lanes - 1) + RUN - 1) // RUN)
    gap = dr.maximum((num_lanes // RUN) / dr.maximum(runs, 1), 1)  # at least 1: no two runs meet
    return mi.UInt32(mi.Float(rank // RUN) * gap) * RUN + rank % RUN
