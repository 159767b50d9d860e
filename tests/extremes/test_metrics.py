"""Metrics and losses on equal, zero, infinite, NaN, huge and tiny images.

Bounds are those of the definitions: a metric is finite and within its range, or it refuses; a loss is finite with
finite gradients for finite images of any size, and NaN for NaN, so that a step is skipped and counted.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from models import metrics
from models.errors import MetricError
from models.losses import LossConfig, ReconstructionLoss, multi_scale_gradient_l1
from models.metrics import PSNR_LIMIT_DB, score_frame, tone_map
from models.transfer import Transfer

Metric = Callable[[np.ndarray, np.ndarray], float]
SIZE = (12, 13)
VALID = np.ones(SIZE, bool)
DISPLAY: dict[str, tuple[Metric, float, float, float]] = {  # metric, least, largest, value of equal images
    "psnr": (metrics.psnr, 0.0, PSNR_LIMIT_DB, PSNR_LIMIT_DB),
    "ssim": (metrics.ssim, -1.0, 1.0, 1.0),
    "flip": (lambda x, y: metrics.flip(x, y)[0], 0.0, 1.0, 0.0),
    "temporal": (lambda x, y: metrics.temporal_difference(x, x, y, y, VALID) or 0.0, 0.0, 2.0, 0.0),
}
LINEAR: dict[str, Metric] = {
    "relmse": metrics.relmse, "smape": metrics.smape,
    "reference_error": lambda x, y: metrics.reference_error_db(x, np.abs(y), 1.0),
}  # fmt: skip
ALL: dict[str, Metric] = {name: entry[0] for name, entry in DISPLAY.items()} | LINEAR
LEVELS = [0.0, 1e-8, 1.0, 1e4, 1e6, 1e8]


def image(value: float) -> np.ndarray:
    return np.full((*SIZE, 3), value, np.float32)


@pytest.mark.parametrize("name", list(DISPLAY))
@given(x=arrays(np.float32, (*SIZE, 3), elements=st.floats(0, 1, width=32)),
       y=arrays(np.float32, (*SIZE, 3), elements=st.floats(0, 1, width=32)))  # fmt: skip
def test_display_metrics_stay_in_their_range(name: str, x: np.ndarray, y: np.ndarray) -> None:
    metric, least, largest, equal = DISPLAY[name]
    assert least - 1e-6 <= metric(x, y) <= largest + 1e-6
    assert metric(x, x) == pytest.approx(equal, abs=1e-5)


@pytest.mark.parametrize("name", list(ALL))
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_metrics_refuse_what_is_not_finite(name: str, bad: float) -> None:
    """Each absorbed it in its own way: FLIP took NaN for black, PSNR gave NaN, SMAPE of Inf was NaN."""
    broken = image(0.5)
    broken[3, 4, 1] = bad
    for pair in ((broken, image(0.5)), (image(0.5), broken)):
        with pytest.raises(MetricError, match="must be finite"):
            ALL[name](*pair)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("other", LEVELS)
def test_scores_of_every_level_are_finite_json_numbers(level: float, other: float) -> None:
    scores = score_frame(image(level), image(other), 0.5)
    values = [value for name, value in scores.to_dict().items() if name != "st_lpips"]
    assert all(value is not None and np.isfinite(value) for value in values)
    if level == other:
        assert (scores.psnr, scores.relmse, scores.smape) == (PSNR_LIMIT_DB, 0.0, 0.0)
        assert scores.ssim == pytest.approx(1.0) and scores.flip == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (1, 64), (10, 64)])
def test_images_too_small_for_a_window_have_the_other_scores(shape: tuple[int, int]) -> None:
    scores = score_frame(np.full((*shape, 3), 0.3, np.float32), np.full((*shape, 3), 0.4, np.float32), 1.0)
    assert scores.ssim is None and scores.st_lpips is None
    assert scores.psnr is not None and scores.flip is not None and scores.relmse is not None


def test_tone_map_of_any_product_is_a_display_value() -> None:
    """Also where exposure times radiance overflows: white, without a warning."""
    radiance = np.array([0.0, -1.0, 1e-38, 1e-8, 1.0, 1e8, 3e38, np.inf], np.float32)
    for exposure in (1e-30, 1e-8, 1.0, 1e8, 1e30):
        display = tone_map(radiance, exposure)
        assert display.min() >= 0.0 and display.max() <= 1.0 and np.all(np.diff(display[1:]) >= 0)


# ------------------------------------------------- losses -------------------------------------------------


def loss() -> ReconstructionLoss:
    return ReconstructionLoss(LossConfig(gradient=0.5))


def encoded(value: float, size: tuple[int, int] = (16, 16)) -> torch.Tensor:
    return Transfer().forward(torch.full((1, 3, *size), value))


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("other", LEVELS)
def test_loss_and_its_gradient_are_finite_at_every_level(level: float, other: float) -> None:
    prediction = encoded(level).requires_grad_()
    total = loss()(prediction, encoded(other))["total"]
    total.backward()
    assert prediction.grad is not None and torch.isfinite(prediction.grad).all()
    assert torch.isfinite(total) and (total == 0) == (level == other)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (4, 4), (5, 3), (8, 8)])
def test_gradient_term_of_small_images_is_finite(size: tuple[int, int]) -> None:
    """4x4 crops were NaN: their third scale has one pixel and no difference to take the mean of."""
    x, y = torch.rand(2, 3, *size), torch.rand(2, 3, *size)
    assert torch.isfinite(multi_scale_gradient_l1(x, y))
    assert multi_scale_gradient_l1(x, x + 0.5) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_loss_does_not_hide_what_is_not_finite(bad: float) -> None:
    broken = encoded(0.5)
    broken[0, 1, 2, 3] = bad
    assert not torch.isfinite(loss()(broken, encoded(0.5))["total"])


levels = st.floats(0, 1e8, width=32)


@given(levels, st.sampled_from(["mu-law", "log1p"]))
def test_transfer_returns_every_level(level: float, curve: Any) -> None:
    """To 1e-4: the logarithm of 1e9 has 20.7, of which single precision keeps 1e-6, which the exponential raises."""
    transfer = Transfer(curve=curve)
    value = torch.tensor([level])
    assert transfer.inverse(transfer.forward(value)).item() == pytest.approx(level, rel=1e-4, abs=1e-7)
