"""The denoiser is called as everybody would call it: it is what our frames are measured against."""

import mitsuba_oidn
import numpy as np
import pytest

from workers.backend import dr, mi, pool_at_rest
from workers.denoise import denoise


def test_denoiser_has_all_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def stand_in(radiance: np.ndarray, *_: object, **__: object) -> np.ndarray:
        seen.append(dr.thread_count())
        return radiance

    monkeypatch.setattr(mitsuba_oidn, "denoise", stand_in)
    dr.eval(dr.arange(mi.Float, 10))
    denoise(np.ones((16, 16, 3), np.float32))
    assert seen == [dr.thread_count()]
    with pool_at_rest():
        assert dr.thread_count() < seen[0], "what the test looks for can be seen"


def test_denoised_noise_is_closer_to_what_it_came_from() -> None:
    rng = np.random.default_rng(1)
    truth = np.broadcast_to(np.linspace(0.2, 1.0, 64, dtype=np.float32)[:, None], (64, 64, 3)[:2])[..., None].repeat(
        3, 2
    )
    noisy = (truth * rng.gamma(4.0, 0.25, truth.shape)).astype(np.float32)
    for quality in ("fast", "balanced", "high"):
        result = denoise(noisy, quality=quality)
        assert np.mean((result - truth) ** 2) < 0.1 * np.mean((noisy - truth) ** 2)
