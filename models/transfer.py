"""Transfer functions between linear light, network space and display, as forward/inverse pairs.

Networks work on *exposed* radiance `x = e * L`, where `L` is linear scene radiance (Rec.709) and `e` the
scene's exposure (see `models.metrics`), so that a value of 1 is display white in every scene. All functions
are elementwise and differentiable, keep shape and dtype, clamp x < 0 to 0 (renderers and networks overshoot;
light cannot) and let NaN through: hiding it is not their job.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from models.errors import ConfigError

DEFAULT_MU = 16.0
"""Strength of the mu-law: half of the code values up to white lie below x = 0.2."""

SRGB_LINEAR_LIMIT = 0.0031308
SRGB_ENCODED_LIMIT = 0.04045
SRGB_SLOPE = 12.92
SRGB_OFFSET = 0.055
SRGB_EXPONENT = 2.4
"""Constants of the sRGB curve (IEC 61966-2-1:1999)."""


def log1p_forward(x: Tensor) -> Tensor:
    """y = log(1 + x), the paper's transform of HDR input (Imperfect caches, section 4.4.4).

    x >= 0 linear, y >= 0.
    """
    return torch.log1p(x.clamp(min=0.0))


def log1p_inverse(y: Tensor) -> Tensor:
    """x = exp(y) - 1, the inverse of `log1p_forward`; y < 0 gives 0."""
    return torch.expm1(y.clamp(min=0.0))


def mu_law_forward(x: Tensor, mu: float = DEFAULT_MU) -> Tensor:
    """y = log(1 + mu x) / log(1 + mu) (Kalantari and Ramamoorthi 2017): 0 to 0 and 1 to 1.

    x above 1 is compressed further, not clipped.
    """
    return torch.log1p(mu * x.clamp(min=0.0)) / math.log1p(mu)


def mu_law_inverse(y: Tensor, mu: float = DEFAULT_MU) -> Tensor:
    """x = ((1 + mu)^y - 1) / mu, the inverse of `mu_law_forward`; y < 0 gives 0."""
    return torch.expm1(y.clamp(min=0.0) * math.log1p(mu)) / mu


def srgb_forward(x: Tensor) -> Tensor:
    """The sRGB curve: linear light x in [0, 1], clipped to it, to display values in [0, 1]."""
    x = x.clamp(0.0, 1.0)
    # The power's slope is infinite at 0, and torch.where would pass it on as NaN: keep its argument on its
    # own side.
    above = x.clamp(min=SRGB_LINEAR_LIMIT)
    curve = (1.0 + SRGB_OFFSET) * above.pow(1.0 / SRGB_EXPONENT) - SRGB_OFFSET
    return torch.where(x <= SRGB_LINEAR_LIMIT, SRGB_SLOPE * x, curve)


def srgb_inverse(y: Tensor) -> Tensor:
    """Display values y in [0, 1], clipped to it, back to linear light in [0, 1]."""
    y = y.clamp(0.0, 1.0)
    curve = ((y + SRGB_OFFSET) / (1.0 + SRGB_OFFSET)).pow(SRGB_EXPONENT)
    return torch.where(y <= SRGB_ENCODED_LIMIT, y / SRGB_SLOPE, curve)


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """The curve between exposed radiance and what a network sees.

    Attributes:
        curve: "mu-law" (default) or "log1p" (the paper).
        mu: Strength of the mu-law, > 0; without effect on "log1p".

    Raises:
        ConfigError: Unknown curve, or mu not a positive finite number.
    """

    curve: Literal["mu-law", "log1p"] = "mu-law"
    mu: float = DEFAULT_MU

    def __post_init__(self) -> None:
        if self.curve not in ("mu-law", "log1p"):
            raise ConfigError(f'transfer curve must be "mu-law" or "log1p", got {self.curve!r}')
        if not (math.isfinite(self.mu) and self.mu > 0.0):
            raise ConfigError(f"transfer mu must be a positive finite number, got {self.mu}")

    def forward(self, exposed_radiance: Tensor) -> Tensor:
        """Exposed linear radiance (any shape) to network space (same shape)."""
        if self.curve == "log1p":
            return log1p_forward(exposed_radiance)
        return mu_law_forward(exposed_radiance, self.mu)

    def inverse(self, encoded: Tensor) -> Tensor:
        """Network space (any shape) to exposed linear radiance >= 0 (same shape)."""
        if self.curve == "log1p":
            return log1p_inverse(encoded)
        return mu_law_inverse(encoded, self.mu)

    def display(self, encoded: Tensor) -> Tensor:
        """Network space (any shape) to sRGB display values in [0, 1], as an LDR metric or a viewer sees them.

        Clips in network space first, so that an untrained network's wild output cannot overflow the
        exponential.
        """
        white = math.log(2.0) if self.curve == "log1p" else 1.0
        return srgb_forward(self.inverse(encoded.clamp(0.0, white)))
