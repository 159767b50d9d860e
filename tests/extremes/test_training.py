"""Training on constant, black, single-frame and tiny data, beside a firefly, and on NaN.

Bound: the kept weights are never worse on the validation frame than the untrained network, which returns the caches'
own picture; curve and weights are finite; steps whose gradient is not finite are skipped, counted, and refused beyond
5 %.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from models.metrics import PSNR_LIMIT_DB
from storage.store import Store, UnitRef
from workers.errors import WorkerError
from workers.progress import Progress
from workers.query import CHANNELS, NUM_CHANNELS
from workers.settings import Settings
from workers.trainer import Trainer
from workers.training_data import Dataset

TRAIN = {
    "train.seconds": 0.0, "train.epochs": 12, "train.precision": "fp32", "train.perceptual_weight": 0.0,
    "train.crop": 16, "train.batch": 2, "train.widths": (16, 16, 16),
}  # fmt: skip


@pytest.fixture
def train(tmp_path: Any) -> Any:
    """Trains to the end on some data, validating on its first frame."""

    def run(features: np.ndarray, target: np.ndarray, **more: Any) -> Trainer:
        settings = Settings.preset_named("tiny").override(
            TRAIN | {f"train.{key}": value for key, value in more.items()}
        )
        digest = "b" * 64
        state: Any = SimpleNamespace(
            settings=settings, progress=Progress(), store=Store.open(tmp_path / "store", create=True),
            scene=SimpleNamespace(digest=digest), seed=lambda ref, purpose="": 5,
            ref=lambda stage, params: UnitRef(digest, stage, "c" * 32),
        )  # fmt: skip
        data = Dataset(torch.from_numpy(features), torch.from_numpy(target))
        first = Dataset(data.features[:1].nan_to_num(), data.target[:1])
        trainer = Trainer(state, UnitRef(digest, "train", "d" * 32), data, first)
        trainer.fit()
        return trainer

    return run


def frames(
    count: int, height: int, width: int, level: float = 1.0, noise: float = 0.1
) -> tuple[np.ndarray, np.ndarray]:
    """Features whose radiance is that of the target with noise."""
    rng = np.random.default_rng(1)
    target = (level * rng.random((count, height, width, 3))).astype(np.float32)
    features = rng.random((count, height, width, NUM_CHANNELS), dtype=np.float32)
    features[..., slice(*CHANNELS["ir"])] = target * (1 + noise * rng.normal(size=target.shape))
    return features, target


def check(trainer: Trainer) -> list[float]:
    scores = [point["psnr"] for point in trainer.curve]
    assert np.isfinite(scores).all()
    assert all(torch.isfinite(value).all() for value in trainer.best_state().values())
    assert trainer._score(trainer.validation_set, 0) <= PSNR_LIMIT_DB  # type: ignore[arg-type]
    assert max(scores) >= scores[0]
    return scores


@pytest.mark.parametrize("level", [1e-8, 1.0, 1e6])
def test_one_frame_of_any_level_is_learned(train: Any, level: float) -> None:
    trainer = train(*frames(1, 24, 24, level), epochs=60)
    scores = check(trainer)
    assert max(scores) > scores[0] and trainer.skipped == 0


def test_constant_frames_are_learned(train: Any) -> None:
    features = np.full((2, 16, 16, NUM_CHANNELS), 0.5, np.float32)
    scores = check(train(features, np.full((2, 16, 16, 3), 0.7, np.float32), epochs=60))
    assert max(scores) > scores[0]


def test_black_frames_stay_black(train: Any) -> None:
    """Exposure 1, distance scale 1, and the untrained network is already right."""
    trainer = train(np.zeros((2, 16, 16, NUM_CHANNELS), np.float32), np.zeros((2, 16, 16, 3), np.float32))
    assert trainer.encoding.exposure == trainer.encoding.distance_scale == 1.0
    assert check(trainer)[0] == PSNR_LIMIT_DB


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (1, 40), (9, 9)])
def test_frames_below_the_networks_multiple_are_trained_on(train: Any, size: tuple[int, int]) -> None:
    check(train(*frames(2, *size), epochs=4))


def test_crops_below_the_perceptual_networks_window_train_without_it(train: Any) -> None:
    trainer = train(*frames(1, 16, 16), perceptual_weight=0.03, epochs=2)
    check(trainer)
    assert trainer.loss.perceptual is None and "gradient" in trainer.loss.weights


def test_firefly_in_a_target_is_one_pixel_among_many(train: Any) -> None:
    features, target = frames(2, 24, 24)
    target[1, 7, 9] = 1e8
    trainer = train(features, target, epochs=60)
    scores = check(trainer)
    assert trainer.skipped == 0 and max(scores) > scores[0]


def test_steps_with_nan_are_skipped_and_refused_where_they_are_many(train: Any) -> None:
    features, target = frames(2, 16, 16)
    features[1, 3, 3, 0] = np.nan
    with pytest.raises(WorkerError, match="must have finite gradients, got 6 steps"):
        train(features, target, epochs=60)


def test_exploded_network_is_not_kept(train: Any) -> None:
    trainer = train(*frames(1, 16, 16), epochs=2)
    best = {name: value.clone() for name, value in trainer.best_state().items()}
    with torch.no_grad():
        trainer.network.head.bias.fill_(1e6)
    trainer._validate()
    assert trainer.curve[-1]["psnr"] == 0.0
    assert all(torch.equal(best[name], value) for name, value in trainer.best_state().items())
