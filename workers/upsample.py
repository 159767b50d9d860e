"""Frames at full resolution from radiance at half of it: joint bilateral upsampling, guided by the G-buffers.

After "Joint bilateral upsampling" (Kopf et al. 2007, equation 3): a pixel p averages the four low-resolution
pixels q around it with

    w(p, q) = bilinear(p, q) * exp(-k_n (1 - n_p . n_q)) * exp(-|d_p - d_q| / (s_d max(d_p, d_q)))
                             * exp(-|a_p - a_q|^2 / (2 s_a^2)) + 1e-4 bilinear(p, q)

with normal n, distance d and albedo a. The last term answers a pixel that resembles none of the four. Radiance
is averaged per unit of reflectance, L / max(a, 0.05), and multiplied by the pixel's own, so that textures stay
as sharp as the albedo. What no guide tells (shadows, highlights, what a mirror shows beyond its albedo) is as
blurred as bilinear interpolation leaves it.
"""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from workers.query import CHANNELS
from workers.reconstruct import Reconstructor, pad_to_multiple

SCALE = 2
NORMAL_SHARPNESS = 16.0
DISTANCE_SIGMA = 0.04  # relative
ALBEDO_SIGMA = 0.1
FALLBACK = 1e-4
MIN_ALBEDO = 0.05
MAX_GAIN = 4.0  # of the pixel's reflectance over its neighbours': a dark neighbour must not become a firefly


def halve(image: Float[Tensor, "batch channels height width"]) -> Float[Tensor, "batch channels half_h half_w"]:
    """Means of 2x2 pixels; an odd last row or column is repeated first.

    One ray through the middle of each of the four pixels is the 2x2 query of the half-sized image: a frame's
    query serves both resolutions.
    """
    return F.avg_pool2d(pad_to_multiple(image, SCALE), SCALE)


def joint_bilateral_upsample(
    radiance: Float[Tensor, "1 3 half_h half_w"],
    guide: Float[Tensor, "1 7 height width"],
    low_guide: Float[Tensor, "1 7 half_h half_w"],
    *,
    demodulate: bool = True,
) -> Float[Tensor, "1 3 height width"]:
    """Radiance at the guide's resolution.

    Args:
        radiance: linear, at half the resolution (rounded up).
        guide: normal (3), albedo (3) and distance (1, scene units, 0 on a miss) at full resolution.
        low_guide: the same at half the resolution (`halve`).
        demodulate: average radiance per unit of reflectance.
    """
    full = pad_to_multiple(guide, SCALE)
    height, width = guide.shape[-2:]
    result = torch.empty((1, 3, *full.shape[-2:]), dtype=radiance.dtype, device=radiance.device)
    padded_guide, padded = (F.pad(x, (1, 1, 1, 1), mode="replicate") for x in (low_guide, radiance))
    # The four pixels of a block see different neighbours, but each of the four kinds sees shifts of one image.
    for y in range(SCALE):
        for x in range(SCALE):
            kind = (..., slice(y, None, SCALE), slice(x, None, SCALE))
            result[kind] = _pixels_of_kind(full[kind], padded_guide, padded, y, x, demodulate)
    return result[..., :height, :width]


def _pixels_of_kind(pixel: Tensor, padded_guide: Tensor, padded: Tensor, y: int, x: int, demodulate: bool) -> Tensor:
    """The pixels at (x, y) of every block: means over the block's own and the three nearest low-resolution pixels.

    Args:
        pixel: their guide, [1, 7, h, w].
        padded_guide, padded: guide and radiance at low resolution, one pixel wider on every side.
        y, x: 0 or 1.
        demodulate: average radiance per unit of reflectance.
    """
    height, width = pixel.shape[-2:]
    albedo = pixel[:, 3:6].clamp(min=MIN_ALBEDO)
    total, weights = torch.zeros_like(albedo), torch.zeros_like(albedo[:, :1])
    for dy, wy in ((0, 0.75), (2 * y - 1, 0.25)):
        for dx, wx in ((0, 0.75), (2 * x - 1, 0.25)):
            other, value = (
                image[..., 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] for image in (padded_guide, padded)
            )
            if demodulate:
                value = value * (albedo / other[:, 3:6].clamp(min=MIN_ALBEDO)).clamp_(max=MAX_GAIN)
            weight = _similarity(pixel, other).add_(FALLBACK).mul_(wy * wx)
            total.addcmul_(value, weight)
            weights += weight
    return total.div_(weights)


def _similarity(pixel: Tensor, other: Tensor) -> Tensor:
    """The three guided factors, [1, 1, h, w]; both [1, 7, h, w]."""
    # Normals of a mean of rays are shorter than 1, and 0 on a miss: their difference says the same without that.
    normal = (pixel[:, :3] - other[:, :3]).square_().sum(dim=1, keepdim=True).mul_(NORMAL_SHARPNESS / 2)
    albedo = (pixel[:, 3:6] - other[:, 3:6]).square_().sum(dim=1, keepdim=True).div_(2 * ALBEDO_SIGMA**2)
    a, b = pixel[:, 6:7], other[:, 6:7]
    distance = (a - b).abs_().div_(torch.maximum(a, b).clamp_(min=1e-12).mul_(DISTANCE_SIGMA))
    return normal.add_(albedo).add_(distance).neg_().exp_()


class HalfScaleReconstructor:
    """A network that works at half the resolution, and the upsampling behind it.

    Args:
        reconstructor: of the network.
    """

    def __init__(self, reconstructor: Reconstructor) -> None:
        self.reconstructor = reconstructor
        self.encoding = reconstructor.encoding
        self.device = reconstructor.device

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """float32 [height, width, NUM_CHANNELS] to linear radiance, float32 [height, width, 3]."""
        first, last = CHANNELS["normal"][0], CHANNELS["distance"][1]
        with torch.inference_mode():
            # What follows the distance (coverage, position) is no input of the network.
            image = torch.from_numpy(features[..., :last]).to(self.device).permute(2, 0, 1)[None]
            low = halve(image)
            padding = features.shape[2] - last
            low_features = F.pad(low[0].permute(1, 2, 0), (0, padding)).contiguous().cpu().numpy()
            radiance = torch.from_numpy(self.reconstructor(low_features)).to(self.device).permute(2, 0, 1)[None]
            frame = joint_bilateral_upsample(radiance, image[:, first:last], low[:, first:last])
            return frame[0].permute(1, 2, 0).contiguous().cpu().numpy()
