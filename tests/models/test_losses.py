"""The training loss: terms by closed form, what is active when, and refusals."""

import math

import pytest
import torch
from torch import Tensor, nn

from models.errors import ConfigError, ShapeError
from models.losses import DEFAULT_GRADIENT_WEIGHT, LossConfig, ReconstructionLoss, multi_scale_gradient_l1
from models.transfer import Transfer


class MeanDifference(nn.Module):
    """Stands in for a perceptual network: B distances, and a record of what it was shown."""

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        self.seen = (x.detach(), y.detach())
        return (x - y).abs().mean(dim=(1, 2, 3))


def image(value: float) -> Tensor:
    return torch.full((2, 3, 16, 16), value)


def test_paper_loss_is_l1_plus_weighted_perceptual() -> None:
    transfer, perceptual = Transfer(), MeanDifference()
    terms = ReconstructionLoss(transfer=transfer, perceptual=perceptual)(image(0.5), image(0.3))
    expected = (transfer.display(image(0.5)) - transfer.display(image(0.3))).mean().item()
    assert set(terms) == {"l1", "perceptual", "total"}
    assert terms["l1"].item() == pytest.approx(0.2)
    assert terms["perceptual"].item() == pytest.approx(expected, rel=1e-5)
    assert terms["total"].item() == pytest.approx(0.2 + 0.03 * expected, rel=1e-5)


def test_perceptual_network_sees_display_values() -> None:
    perceptual = MeanDifference()
    ReconstructionLoss(perceptual=perceptual)(image(-3.0), image(9.0))
    assert (perceptual.seen[0] == 0.0).all()
    assert perceptual.seen[1].min().item() == pytest.approx(1.0)
    assert perceptual.seen[1].max() <= 1.0


def test_without_perceptual_network_gradients_stand_in() -> None:
    x, y = torch.rand(1, 3, 16, 16), torch.rand(1, 3, 16, 16)
    terms = ReconstructionLoss()(x, y)
    assert set(terms) == {"l1", "gradient", "total"}
    total = terms["l1"] + DEFAULT_GRADIENT_WEIGHT * multi_scale_gradient_l1(x, y)
    assert terms["total"].item() == pytest.approx(total.item())


@pytest.mark.parametrize(
    ("config", "perceptual", "active"),
    [
        (LossConfig(l1=0.0, perceptual=1.0), True, {"perceptual"}),
        (LossConfig(perceptual=0.0), True, {"l1"}),
        (LossConfig(perceptual=0.0), False, {"l1"}),
        (LossConfig(gradient=0.0), False, {"l1"}),
        (LossConfig(gradient=0.2), True, {"l1", "perceptual", "gradient"}),
        (LossConfig(l1=0.0, gradient=1.0), False, {"gradient"}),
    ],
)
def test_weights_choose_the_terms(config: LossConfig, perceptual: bool, active: set[str]) -> None:
    loss = ReconstructionLoss(config, perceptual=MeanDifference() if perceptual else None)
    assert set(loss(image(0.1), image(0.2))) == active | {"total"}


def test_gradient_term_of_a_ramp_is_its_slope() -> None:
    """A ramp of slope s along x only: |difference| is s, 2s and 4s at the three scales, and 0 along y."""
    ramp = 0.1 * torch.arange(16.0).expand(1, 3, 16, 16)
    assert multi_scale_gradient_l1(ramp, torch.zeros_like(ramp)).item() == pytest.approx(0.1 * (1 + 2 + 4) / 6)


def test_gradient_term_ignores_a_constant_offset() -> None:
    x = torch.rand(1, 3, 16, 16, dtype=torch.float64)
    assert multi_scale_gradient_l1(x, x + 0.7).item() == pytest.approx(0.0, abs=1e-12)


def test_loss_of_black_and_blown_out_frames_has_a_finite_gradient() -> None:
    prediction = torch.cat((image(0.0), image(1e4))).requires_grad_()
    target = torch.rand(4, 3, 16, 16)
    ReconstructionLoss(LossConfig(gradient=1.0), perceptual=MeanDifference())(prediction, target)["total"].backward()
    assert prediction.grad is not None
    assert prediction.grad.isfinite().all()


def test_a_nan_in_the_prediction_reaches_the_total() -> None:
    prediction = image(0.1)
    prediction[0, 0, 0, 0] = math.nan
    assert ReconstructionLoss(perceptual=MeanDifference())(prediction, image(0.1))["total"].isnan()


def test_loss_rejects_shapes_that_would_broadcast() -> None:
    with pytest.raises(ShapeError):
        ReconstructionLoss()(image(0.1), image(0.1)[:1])


@pytest.mark.parametrize("values", [{"l1": -1.0}, {"perceptual": math.inf}, {"gradient": math.nan}])
def test_config_rejects_values_outside_its_rules(values: dict) -> None:
    with pytest.raises(ConfigError):
        LossConfig(**values)


def test_loss_without_a_term_is_refused() -> None:
    with pytest.raises(ConfigError, match="perceptual network"):
        ReconstructionLoss(LossConfig(l1=0.0))
    with pytest.raises(ConfigError, match="term"):
        ReconstructionLoss(LossConfig(l1=0.0, perceptual=0.0, gradient=0.0), perceptual=MeanDifference())
