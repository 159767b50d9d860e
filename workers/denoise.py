"""Open Image Denoise, as the training-target cleaner and as the adversary."""

import mitsuba_oidn
import numpy as np

from workers.errors import WorkerError

QUALITIES = ("fast", "balanced", "high")
DARK_MEAN = 1e-4  # radiance; below, images are scaled before they are denoised


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
    unit = _unit(radiance)
    if unit == 0.0:  # Open Image Denoise makes 3e-6 of black, which an exposure would raise to white
        return np.zeros_like(radiance, np.float32)
    scaled = radiance if unit == 1.0 else radiance / unit
    images = [None if x is None else np.ascontiguousarray(x, np.float32) for x in (scaled, albedo, normal)]
    strength = getattr(mitsuba_oidn.Quality, quality.capitalize())
    # Not with Dr.Jit's pool at rest: this denoiser computes on that pool, and would take twice as long.
    result = mitsuba_oidn.denoise(*images, hdr=True, clean_aux=clean_features, quality=strength)
    return np.asarray(result) if unit == 1.0 else np.asarray(result) * np.float32(unit)


def _unit(radiance: np.ndarray) -> float:
    """What the denoiser is to take for 1: 1 unless the image is very dark, 0 for black.

    Open Image Denoise adds constants to what it takes logarithms of: radiance of 1e-8 came out 15 % wrong. Brighter
    images are left as they are, so that it is timed as everybody would call it.
    """
    mean = float(np.mean(radiance))
    if mean >= DARK_MEAN:
        return 1.0
    mean = float(np.mean(np.maximum(radiance, 0.0), dtype=np.float64))
    return float(2.0 ** np.round(np.log2(mean))) if mean > 0.0 else 0.0
