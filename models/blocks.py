"""The parts of `models.network.FusionNet`: encoders, fusion block and decoder.

After "Imperfect caches", figures 4 and 5. Features are NCHW; lists of them go from the finest scale down.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CHANNEL_GRANULE = 16
"""bfloat16 kernels work on blocks of 16 channels; other counts are padded up to it at full cost."""


def _activation(negative_slope: float) -> nn.Module:
    """ReLU where the slope is 0."""
    return nn.LeakyReLU(negative_slope) if negative_slope else nn.ReLU()


def _conv(in_channels: int, out_channels: int, negative_slope: float, *, stride: int = 1) -> nn.Sequential:
    """3x3 convolution and activation."""
    return nn.Sequential(nn.Conv2d(in_channels, out_channels, 3, stride, 1), _activation(negative_slope))


def _round_channels(channels: float) -> int:
    return max(CHANNEL_GRANULE, round(channels / CHANNEL_GRANULE) * CHANNEL_GRANULE)


class SqueezeExcitation(nn.Module):
    """Scales every channel by a gate in (0, 1) computed from all channel means (Hu et al.

    2020, section 3).
    """

    def __init__(self, channels: int, *, reduction: int = 4) -> None:
        super().__init__()
        self.squeeze = nn.Linear(channels, channels // reduction)
        self.excite = nn.Linear(channels // reduction, channels)

    def forward(self, x: Tensor) -> Tensor:
        """B,C,H,W to B,C,H,W."""
        gate = torch.sigmoid(self.excite(F.relu(self.squeeze(x.mean(dim=(2, 3))))))
        return x * gate[:, :, None, None]


class FusionBlock(nn.Module):
    """Fuses the two branches at one scale (figure 5).

    A 1x1 convolution squeezes the G-buffer features, a 3x3 turns them into a residual that is added to the IR
    features; the sum and the G-buffer features are concatenated and recalibrated by squeeze-and-excitation.
    """

    def __init__(self, width: int, negative_slope: float) -> None:
        super().__init__()
        squeezed = max(CHANNEL_GRANULE, width // 2 // CHANNEL_GRANULE * CHANNEL_GRANULE)
        self.residual = nn.Sequential(
            nn.Conv2d(width, squeezed, 1), _activation(negative_slope), nn.Conv2d(squeezed, width, 3, padding=1)
        )
        self.recalibrate = SqueezeExcitation(2 * width)

    def forward(self, ir: Tensor, gbuffer: Tensor) -> tuple[Tensor, Tensor]:
        """Both B,C,H,W.

        Returns the guided IR features B,C,H,W, which go on down, and the skip features B,2C,H,W.
        """
        guided = ir + self.residual(gbuffer)
        return guided, self.recalibrate(torch.cat((guided, gbuffer), dim=1))


class FusionEncoder(nn.Module):
    """Two branches and a fusion block at every scale.

    The IR branch is two convolutions deep a scale, the clean G-buffers' one.
    """

    def __init__(self, ir_channels: int, gbuffer_channels: int, widths: tuple[int, ...], negative_slope: float) -> None:
        super().__init__()
        self.ir, self.gbuffer, self.fusion = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        for scale, width in enumerate(widths):
            stride = 1 if scale == 0 else 2
            first = _conv(ir_channels, width, negative_slope, stride=stride)
            self.ir.append(nn.Sequential(*first, *_conv(width, width, negative_slope)))
            self.gbuffer.append(_conv(gbuffer_channels, width, negative_slope, stride=stride))
            self.fusion.append(FusionBlock(width, negative_slope))
            ir_channels = gbuffer_channels = width
        self.skip_channels = tuple(2 * width for width in widths)

    def forward(self, ir: Tensor, gbuffer: Tensor) -> list[Tensor]:
        """B,C,H,W each. Returns the fused features of every scale, finest first."""
        skips = []
        for ir_stage, gbuffer_stage, fuse in zip(self.ir, self.gbuffer, self.fusion, strict=True):
            gbuffer = gbuffer_stage(gbuffer)
            ir, skip = fuse(ir_stage(ir), gbuffer)
            skips.append(skip)
        return skips


class ConcatenateEncoder(nn.Module):
    """The paper's ablation: G-buffers are further channels of the input to one encoder.

    It is sqrt(2) times wider than a branch of `FusionEncoder`, which costs about the same as the two.
    """

    def __init__(self, ir_channels: int, gbuffer_channels: int, widths: tuple[int, ...], negative_slope: float) -> None:
        super().__init__()
        self.stages = nn.ModuleList()
        in_channels = ir_channels + gbuffer_channels
        self.skip_channels = tuple(_round_channels(math.sqrt(2.0) * width) for width in widths)
        for scale, width in enumerate(self.skip_channels):
            stride = 1 if scale == 0 else 2
            first = _conv(in_channels, width, negative_slope, stride=stride)
            self.stages.append(nn.Sequential(*first, *_conv(width, width, negative_slope)))
            in_channels = width

    def forward(self, ir: Tensor, gbuffer: Tensor) -> list[Tensor]:
        """B,C,H,W each. Returns the features of every scale, finest first."""
        x, skips = torch.cat((ir, gbuffer), dim=1), []
        for stage in self.stages:
            x = stage(x)
            skips.append(x)
        return skips


class Decoder(nn.Module):
    """From the coarsest scale up: narrow by 1x1, double by repetition, concatenate the skip, merge by 3x3."""

    def __init__(self, skip_channels: tuple[int, ...], widths: tuple[int, ...], negative_slope: float) -> None:
        super().__init__()
        self.bottom = _conv(skip_channels[-1], widths[-1], negative_slope)
        # Coarse to fine. The 1x1 runs before the upsampling, at a quarter of the pixels.
        scales = range(len(widths) - 2, -1, -1)
        self.narrow = nn.ModuleList(nn.Conv2d(widths[s + 1], widths[s], 1) for s in scales)
        self.merge = nn.ModuleList(_conv(widths[s] + skip_channels[s], widths[s], negative_slope) for s in scales)

    def forward(self, skips: list[Tensor]) -> Tensor:
        """Skips B,C,H,W finest first. Returns B,widths[0],H,W at the finest scale."""
        x = self.bottom(skips[-1])
        for narrow, merge, skip in zip(self.narrow, self.merge, reversed(skips[:-1]), strict=True):
            x = F.interpolate(narrow(x), scale_factor=2.0, mode="nearest")
            x = merge(torch.cat((x, skip), dim=1))
        return x
