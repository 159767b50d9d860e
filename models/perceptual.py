"""ST-LPIPS: a perceptual distance that forgives small shifts, from published weights.

Ghildyal and Liu, "Shift-tolerant Perceptual Similarity Metric", ECCV 2022; the calibration of features is
LPIPS's (Zhang et al., CVPR 2018, section 3). Call it ST-LPIPS in every report: its numbers are not those of
LPIPS. The weights come from outside (`storage` finds them); this module knows only their names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.errors import ShapeError, WeightsError

MIN_SIZE_PX = 32
"""Below this an image does not reach the deepest layer with more than a pixel or two of its own."""

NORM_FLOOR = 1e-10

_VGG_BLOCK_2 = ("conv", "relu", "conv", "relu")
_VGG_BLOCK_3 = (*_VGG_BLOCK_2, "conv", "relu")
_VGG_DOWN = ("pool", "blur")
TRUNKS: dict[str, tuple[tuple[str, ...], ...]] = {
    "vgg": (
        _VGG_BLOCK_2,
        (*_VGG_DOWN, *_VGG_BLOCK_2),
        (*_VGG_DOWN, *_VGG_BLOCK_3),
        (*_VGG_DOWN, *_VGG_BLOCK_3),
        (*_VGG_DOWN, *_VGG_BLOCK_3),
    ),
    "alex": (
        ("conv", "blur", "relu"),
        ("pool", "blur", "conv", "relu"),
        ("pool", "blur", "conv", "relu"),
        ("conv", "relu"),
        ("conv", "relu"),
    ),
}
"""Layers of the five slices whose outputs are compared.

Layers are numbered through: layer i of slice s is `net.slice{s}.{i}`.
"""

_POOL_SIZE = {"vgg": 2, "alex": 3}


class StLpips(nn.Module):
    """ST-LPIPS between two batches of display images: 0 for identical ones, larger for more different ones.

    The trunk is frozen: no parameter needs a gradient, but gradients flow to the images, and stay finite on
    flat black.

    Args:
        weights: Flat state dict of one trunk, names as in the published file: `net.slice{s}.{i}.weight`,
            `.bias` and `.filt`, `lin{s}.model.1.weight`, `scaling_layer.shift` and `.scale`. VGG16 and
            AlexNet are told apart by their first layer.

    Raises:
        WeightsError: A tensor is missing.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.trunk = "alex" if _tensor(weights, "net.slice1.0.weight").shape[-1] == 11 else "vgg"
        self.slices = nn.ModuleList(_slices(self.trunk, weights))
        self.calibration = nn.ParameterList(_tensor(weights, f"lin{s}.model.1.weight") for s in range(len(self.slices)))
        self.register_buffer("shift", _tensor(weights, "scaling_layer.shift"))
        self.register_buffer("scale", _tensor(weights, "scaling_layer.scale"))
        self.requires_grad_(False)

    def forward(
        self, x: Float[Tensor, "batch 3 height width"], y: Float[Tensor, "batch 3 height width"]
    ) -> Float[Tensor, " batch"]:
        """Distance of each pair.

        Args:
            x: B,3,H,W sRGB display values in [0, 1]; H, W at least 32.
            y: As x.

        Returns:
            B distances >= 0.

        Raises:
            ShapeError: Shapes differ, are not B,3,H,W, or are too small.
        """
        if x.shape != y.shape or x.ndim != 4 or x.shape[1] != 3 or min(x.shape[2:]) < MIN_SIZE_PX:
            shapes = f"{tuple(x.shape)} and {tuple(y.shape)}"
            raise ShapeError(f"images must both be B,3,H,W with H, W >= {MIN_SIZE_PX}, got {shapes}")
        distance = x.new_zeros(x.shape[0])
        for feature_x, feature_y, weight in zip(self._features(x), self._features(y), self.calibration, strict=True):
            difference = (feature_x - feature_y).square()
            distance = distance + (difference * weight).sum(dim=1).mean(dim=(1, 2))
        return distance

    def _features(self, image: Tensor) -> Iterator[Tensor]:
        """Yields each slice's output, scaled to unit length across channels at every pixel."""
        feature = (2.0 * image - 1.0 - self.shift) / self.scale
        for layers in self.slices:
            feature = layers(feature)
            yield unit_length(feature)


def unit_length(
    feature: Float[Tensor, "batch channels height width"],
) -> Float[Tensor, "batch channels height width"]:
    """Scales each pixel's feature vector to length 1; a zero vector stays zero and has a finite gradient."""
    # The floor inside the root is for the gradient alone: the root's slope at 0 is infinite.
    norm = (feature.square().sum(dim=1, keepdim=True) + NORM_FLOOR**2).sqrt()
    return feature / (norm + NORM_FLOOR)


def _tensor(weights: Mapping[str, Tensor], name: str) -> Tensor:
    if name not in weights:
        raise WeightsError(
            f"ST-LPIPS weights must hold {name}, got {len(weights)} others; give the state dict of one trunk"
        )
    return weights[name].detach().float()


def _slices(trunk: str, weights: Mapping[str, Tensor]) -> Iterator[nn.Sequential]:
    index = 0
    for number, kinds in enumerate(TRUNKS[trunk], start=1):
        layers: list[nn.Module] = []
        for kind in kinds:
            name = f"net.slice{number}.{index}"
            if kind == "conv":
                layers.append(_convolution(_tensor(weights, f"{name}.weight"), _tensor(weights, f"{name}.bias")))
            elif kind == "blur":
                layers.append(_blur(_tensor(weights, f"{name}.filt")))
            elif kind == "pool":
                layers.append(nn.MaxPool2d(_POOL_SIZE[trunk], stride=1))
            else:
                layers.append(nn.ReLU())
            index += 1
        yield nn.Sequential(*layers)


def _convolution(weight: Tensor, bias: Tensor) -> nn.Conv2d:
    """Stride 1; AlexNet's 11x11 is padded by 2 like its 5x5, everything else keeps its size."""
    out_channels, in_channels, size, _ = weight.shape
    layer = nn.Conv2d(in_channels, out_channels, size, padding=min(size // 2, 2))
    with torch.no_grad():
        layer.weight.copy_(weight)
        layer.bias.copy_(bias)  # type: ignore[union-attr]
    return layer


def _blur(filters: Tensor) -> nn.Sequential:
    """Low-pass filter and halving: the downsampling that makes the distance tolerant to shifts."""
    channels, _, size, _ = filters.shape
    layer = nn.Conv2d(channels, channels, size, stride=2, groups=channels, bias=False)
    with torch.no_grad():
        layer.weight.copy_(filters)
    return nn.Sequential(nn.ReflectionPad2d(size - 1), layer)
