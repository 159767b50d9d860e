"""Metrics: closed forms, agreement of the reference error with simulated noise, and refusals."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import metrics
from models.errors import MetricError, ShapeError
from models.metrics import PSNR_LIMIT_DB, Scores, score_frame


def image(value: float = 0.5, size: tuple[int, int] = (24, 32)) -> np.ndarray:
    return np.full((*size, 3), value, dtype=np.float32)


def noisy(seed: int = 0, size: tuple[int, int] = (24, 32)) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.05, 0.95, (*size, 3)).astype(np.float32)


@given(offset=st.floats(0.001, 0.5))
def test_psnr_of_a_constant_offset_is_its_decibels(offset: float) -> None:
    assert metrics.psnr(image(0.2), image(0.2) + np.float32(offset)) == pytest.approx(
        -20.0 * math.log10(offset), abs=1e-3
    )


def test_identical_images_get_the_best_of_every_score() -> None:
    x = noisy()
    assert metrics.psnr(x, x) == PSNR_LIMIT_DB
    assert metrics.ssim(x, x) == pytest.approx(1.0)
    mean, error_map = metrics.flip(x, x)
    assert mean == pytest.approx(0.0, abs=1e-6)
    assert error_map.shape == (24, 32)
    assert metrics.relmse(x, x) == metrics.smape(x, x) == 0.0


def test_ssim_of_two_constants_is_its_luminance_term() -> None:
    x, y, c1 = 0.5, 0.25, 0.01**2
    expected = (2 * x * y + c1) / (x**2 + y**2 + c1)
    assert metrics.ssim(image(x), image(y)) == pytest.approx(expected, rel=1e-5)


def test_ssim_and_flip_get_worse_with_noise() -> None:
    clean = image()
    noise = np.random.default_rng(1).normal(size=clean.shape).astype(np.float32)
    frames = [np.clip(clean + s * noise, 0, 1) for s in (0.02, 0.08, 0.3)]
    ssims, flips = [metrics.ssim(f, clean) for f in frames], [metrics.flip(f, clean)[0] for f in frames]
    assert ssims == sorted(ssims, reverse=True)
    assert flips == sorted(flips)


def test_flip_map_shows_where_the_error_is() -> None:
    frame, reference = image(0.5, (64, 64)), image(0.5, (64, 64))
    frame[8:12, 50:54] = 1.0
    mean, error_map = metrics.flip(frame, reference)
    assert np.unravel_index(error_map.argmax(), error_map.shape) == pytest.approx((9.5, 51.5), abs=4)
    assert mean == pytest.approx(error_map.mean(), rel=1e-3)


def test_relmse_and_smape_have_their_closed_forms() -> None:
    x, y = image(3.0), image(1.0)
    assert metrics.relmse(x, y) == pytest.approx(4.0 / 1.01)
    assert metrics.smape(x, y) == pytest.approx(2.0 / 4.01)
    assert metrics.relmse(image(0.0), image(0.0)) == 0.0


def test_exposure_puts_the_80th_percentile_at_its_target() -> None:
    luminances = [np.arange(0, 50.0), np.arange(50.0, 101.0).reshape(3, 17)]
    assert metrics.exposure_from_luminance(luminances) == pytest.approx(0.6 / 80.0)


def test_exposure_of_dark_scenes_is_defined() -> None:
    assert metrics.exposure_from_luminance([np.zeros((4, 4))]) == 1.0
    mostly_black = np.zeros(100)
    mostly_black[:10] = 2.0
    assert metrics.exposure_from_luminance([mostly_black]) == pytest.approx(0.3)
    assert metrics.exposure_from_luminance([np.full(4, 1e-320)]) == 1.0


@pytest.mark.parametrize("luminances", [[], [np.array([1.0, np.nan])], [np.array([np.inf])]])
def test_exposure_refuses_what_it_cannot_use(luminances: list) -> None:
    with pytest.raises(MetricError):
        metrics.exposure_from_luminance(luminances)


def test_tone_map_exposes_clips_and_encodes() -> None:
    radiance = np.array([[[-1.0, 0.0, 0.09], [0.5, 3.0, np.inf]]])
    expected = [0.0, 0.0, 0.461356, 1.0, 1.0, 1.0]
    assert metrics.tone_map(radiance, 2.0).ravel().tolist() == pytest.approx(expected, abs=1e-5)
    assert np.isnan(metrics.tone_map(np.array([np.nan]), 1.0)).all()


def test_luminance_of_white_is_one() -> None:
    assert metrics.luminance(image(1.0)) == pytest.approx(1.0)
    assert metrics.luminance(np.array([0.0, 1.0, 0.0])) == pytest.approx(0.7152)


def test_temporal_difference_sees_flicker_but_not_the_references_own_motion() -> None:
    reference, warped_reference = image(0.6), image(0.4)
    valid = np.zeros((24, 32), dtype=bool)
    valid[:, :16] = True
    steady = metrics.temporal_difference(image(0.7), image(0.5), reference, warped_reference, valid)
    assert steady == pytest.approx(0.0, abs=1e-6)
    flickering = image(0.7)
    flickering[:, :8] += 0.1
    flickering[:, 16:] = 0.0  # invalid pixels do not count
    score = metrics.temporal_difference(flickering, image(0.5), reference, warped_reference, valid)
    assert score == pytest.approx(0.05, abs=1e-6)
    assert metrics.temporal_difference(flickering, image(), reference, image(), np.zeros_like(valid)) is None


def test_reference_error_is_what_a_perfect_frame_scores() -> None:
    """Truth against a simulated noisy reference of 6144 values: one sigma of the PSNR is about 0.08 dB."""
    rng = np.random.default_rng(4)
    truth = rng.uniform(0.2, 1.5, (32, 64, 3))
    standard_error = 0.02 * truth
    reference = truth + rng.normal(size=truth.shape) * standard_error
    exposure = 0.5
    scored = metrics.psnr(metrics.tone_map(truth, exposure), metrics.tone_map(reference, exposure))
    assert metrics.reference_error_db(reference, standard_error, exposure) == pytest.approx(scored, abs=0.3)


def test_reference_error_does_not_count_what_clipping_hides() -> None:
    assert metrics.reference_error_db(image(50.0), image(1.0), 1.0) == PSNR_LIMIT_DB
    assert metrics.reference_error_db(image(0.5), image(0.0), 1.0) == PSNR_LIMIT_DB


def test_score_frame_fills_every_score_and_is_json() -> None:
    def perceptual(x: object, y: object) -> float:
        return 0.25

    scores = score_frame(noisy(1, (32, 32)), noisy(2, (32, 32)), 0.7, perceptual)  # type: ignore[arg-type]
    assert scores.non_finite == 0
    assert scores.st_lpips == 0.25
    values = json.loads(json.dumps(scores.to_dict(), allow_nan=False))
    assert all(value is not None for value in values.values())
    assert score_frame(noisy(1), noisy(2), 0.7).st_lpips is None


def test_hdr_scores_do_not_depend_on_the_unit_of_radiance() -> None:
    scores = score_frame(noisy(1), noisy(2), 0.7)
    scaled = score_frame(noisy(1) * 1000.0, noisy(2) * 1000.0, 0.7e-3)
    assert scaled.relmse == pytest.approx(scores.relmse, rel=1e-5)
    assert scaled.psnr == pytest.approx(scores.psnr, rel=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_scores_are_refused_for_non_finite_frames(bad: float) -> None:
    frame = noisy(1)
    frame[3, 4] = bad
    frame[9, 9, 0] = bad
    assert score_frame(frame, noisy(2), 1.0) == Scores(non_finite=4)
    with pytest.raises(MetricError):
        score_frame(noisy(2), frame, 1.0)


@pytest.mark.parametrize("shape", [(24, 31, 3), (24, 32, 4), (24, 32)])
def test_scores_refuse_other_shapes(shape: tuple) -> None:
    with pytest.raises(ShapeError):
        score_frame(np.ones(shape, dtype=np.float32), image(), 1.0)
    with pytest.raises(ShapeError):
        metrics.ssim(image(0.5, (8, 8)), image(0.5, (8, 8)))
