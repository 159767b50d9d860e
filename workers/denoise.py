"""Open Image Denoise, as the training-target cleaner and as the adversary."""

import mitsuba_oidn
import numpy as np

from workers.backend import pool_at_rest
from workers.errors import WorkerError

QUALITIES = ("fast", "balanced", "high")


def denoise(
    radiance: np.ndarray,
    albedo: np.ndarray | None = None,
    normal: np.ndarray | None = None,
    *,
    quality: str = "high",
    clean_features: bool = False,
) -> np.ndarray:
    """Denoises linear HDR radiance.

    Args:
        radiance: float32 [height, width, 3], linear, finite (Open Image Denoise smears one Inf over a third of
            an image and swallows NaN).
        albedo: float32 [height, width, 3] in [0, 1].
        normal: float32 [height, width, 3] in [-1, 1].
        quality: one of `QUALITIES`.
        clean_features: albedo and normal carry no noise.

    Returns:
        float32 [height, width, 3].

    Raises:
        WorkerError: an unknown quality, or input that is not finite.
    """
    if quality not in QUALITIES:
        raise WorkerError(f"denoiser quality must be one of {', '.join(QUALITIES)}, got {quality!r}")
    if not np.isfinite(radiance).all():
        raise WorkerError("denoiser input must be finite, got NaN or Inf; render the image again")
    images = [None if x is None else np.ascontiguousarray(x, np.float32) for x in (radiance, albedo, normal)]
    strength = getattr(mitsuba_oidn.Quality, quality.capitalize())
    with pool_at_rest():
        result = mitsuba_oidn.denoise(*images, hdr=True, clean_aux=clean_features, quality=strength)
    return np.asarray(result)
