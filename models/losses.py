"""The training loss: L1 in transfer space, and a term for what L1 blurs away.

Paper ("Imperfect caches", section 4.4.3, equation 8): L = L1 + 0.03 * perceptual. Ours uses ST-LPIPS on
display values for the perceptual term; where its weights are not installed, L1 on image gradients at several
scales stands in for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from models.errors import ConfigError, ShapeError
from models.transfer import Transfer

DEFAULT_GRADIENT_WEIGHT = 1.0
"""Weight of the gradient term when it stands in for the perceptual one: of L1's order for noisy frames."""

GRADIENT_SCALES = 3


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the loss terms, each >= 0; a term with weight 0 is not computed.

    Attributes:
        l1: Weight of the mean absolute difference in transfer space. 0 for the paper's "perceptual only"
            ablation.
        perceptual: Weight of ST-LPIPS; without effect when no perceptual network is given.
        gradient: Weight of the multi-scale gradient term. None: 0 beside a perceptual network,
            `DEFAULT_GRADIENT_WEIGHT` without.

    Raises:
        ConfigError: A weight is negative or not finite.
    """

    l1: float = 1.0
    perceptual: float = 0.03
    gradient: float | None = None

    def __post_init__(self) -> None:
        for name, weight in (("l1", self.l1), ("perceptual", self.perceptual), ("gradient", self.gradient)):
            if weight is not None and not (math.isfinite(weight) and weight >= 0.0):
                raise ConfigError(f"loss weight {name} must be finite and not negative, got {weight}")


class ReconstructionLoss(nn.Module):
    """Weighted sum of L1, perceptual and gradient terms.

    Args:
        config: The weights.
        transfer: The transfer function of the network's space, needed to map to the display for the
            perceptual term.
        perceptual: `models.perceptual.StLpips` or any module from two B,3,H,W display images in [0, 1] to B
            distances; None: fall back to image gradients.

    Raises:
        ConfigError: No term is left, or a perceptual-only loss without a perceptual network.
    """

    def __init__(
        self,
        config: LossConfig | None = None,
        *,
        transfer: Transfer | None = None,
        perceptual: nn.Module | None = None,
    ) -> None:
        super().__init__()
        config = config or LossConfig()
        self.transfer = transfer or Transfer()
        self.perceptual = perceptual
        if config.l1 == 0.0 and config.gradient is None and perceptual is None:
            raise ConfigError(
                "a perceptual-only loss must have a perceptual network, got None; install stlpips_pytorch"
            )
        gradient = config.gradient
        if gradient is None:
            stands_in = perceptual is None and config.perceptual > 0.0
            gradient = DEFAULT_GRADIENT_WEIGHT if stands_in else 0.0
        weights = {
            "l1": config.l1,
            "perceptual": config.perceptual if perceptual is not None else 0.0,
            "gradient": gradient,
        }
        self.weights = {name: weight for name, weight in weights.items() if weight > 0.0}
        if not self.weights:
            raise ConfigError("a loss must have a term with a weight above 0, got none")

    def forward(
        self,
        prediction: Float[Tensor, "batch 3 height width"],
        target: Float[Tensor, "batch 3 height width"],
    ) -> dict[str, Float[Tensor, ""]]:
        """The loss and its terms.

        Args:
            prediction: B,3,H,W in transfer space.
            target: As prediction; the reference.

        Returns:
            Scalars: every active term before its weight ("l1", "perceptual", "gradient"), and their weighted
                sum "total".

        Raises:
            ShapeError: The shapes differ (torch would broadcast them).
        """
        if prediction.shape != target.shape:
            shapes = f"{tuple(prediction.shape)} and {tuple(target.shape)}"
            raise ShapeError(f"prediction and target must have one shape, got {shapes}")
        terms: dict[str, Tensor] = {}
        if "l1" in self.weights:
            terms["l1"] = F.l1_loss(prediction, target)
        if "perceptual" in self.weights and self.perceptual is not None:
            display = self.transfer.display
            terms["perceptual"] = self.perceptual(display(prediction), display(target)).mean()
        if "gradient" in self.weights:
            terms["gradient"] = multi_scale_gradient_l1(prediction, target)
        total = torch.stack([self.weights[name] * term for name, term in terms.items()]).sum()
        return {**terms, "total": total}


def multi_scale_gradient_l1(
    prediction: Float[Tensor, "batch channels height width"],
    target: Float[Tensor, "batch channels height width"],
    num_scales: int = GRADIENT_SCALES,
) -> Float[Tensor, ""]:
    """Mean absolute difference of the images' forward differences, averaged over directions and scales.

    Each scale halves the one before by 2x2 means.

    Args:
        prediction: B,C,H,W; scales too small to have differences (below 2 pixels) are left out.
        target: As prediction.
        num_scales: Number of scales, the full one included.

    Returns:
        A scalar; 0 when the images differ by a constant only.
    """
    # Every step below is linear: one pass over the difference does for both images.
    difference = prediction - target
    total, num_terms = difference.new_zeros(()), 0
    for scale in range(num_scales):
        if scale > 0 and min(difference.shape[-2:]) < 2:
            break
        if scale > 0:
            difference = F.avg_pool2d(difference, 2)
        for axis in (-1, -2):
            if difference.shape[axis] > 1:  # the mean of no differences is NaN
                total, num_terms = total + difference.diff(dim=axis).abs().mean(), num_terms + 1
    return total / max(num_terms, 1)
