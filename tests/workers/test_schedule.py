"""Learning-rate schedules."""

import pytest

from workers.schedule import FINAL_SHARE, PAPER_DECAY, learning_rate
from workers.settings import Settings

COSINE = Settings.preset_named("draft").train
PAPER = Settings.preset_named("draft").override({"train.schedule": "paper"}).train


def test_paper_schedule_decays_once_an_epoch() -> None:
    rates = [learning_rate(PAPER, step, 1000, 10) for step in (0, 9, 10, 25)]
    assert rates[0] == rates[1] == PAPER.learning_rate
    assert rates[2] == pytest.approx(PAPER.learning_rate * PAPER_DECAY)
    assert rates[3] == pytest.approx(PAPER.learning_rate * PAPER_DECAY**2)


def test_cosine_schedule_warms_up_peaks_and_ends_low() -> None:
    rates = [learning_rate(COSINE, step, 200, 10) for step in range(200)]
    assert rates[0] < 0.2 * COSINE.learning_rate
    assert max(rates) == pytest.approx(COSINE.learning_rate)
    assert rates[-1] < 1.5 * FINAL_SHARE * COSINE.learning_rate
    peak = rates.index(max(rates))
    assert all(a >= b for a, b in zip(rates[peak:], rates[peak + 1 :], strict=False))


def test_cosine_schedule_of_one_step_is_positive() -> None:
    assert learning_rate(COSINE, 0, 1, 1) > 0
