"""What a frame is worth: the metrics of every report, defined once.

LDR metrics compare display images: sRGB(clip(e * L, 0, 1)) with one exposure e a scene. HDR metrics compare
exposed linear radiance e * L, so that their epsilon means the same in every scene. Images are numpy HWC, row
0 on top.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass

import flip_evaluator
import numpy as np
import torch
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from models.errors import MetricError, ShapeError
from models.perceptual import MIN_SIZE_PX as MIN_PERCEPTUAL_PX
from models.transfer import srgb_forward

Image = NDArray[np.floating]
Perceptual = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]

EXPOSED_P80 = 0.6
"""The exposure puts the 80th percentile of luminance here."""
RELATIVE_EPSILON = 1e-2
"""Keeps relMSE and SMAPE finite in the dark; in exposed radiance, where 1 is display white."""
MIN_SSIM_PX = 11
PSNR_LIMIT_DB = 100.0
"""PSNR of identical images, for which the formula says infinity, which JSON cannot hold."""
LUMINANCE_REC709 = np.array((0.2126, 0.7152, 0.0722), dtype=np.float32)


def luminance(radiance: Image) -> Image:
    """...x3 linear Rec.709 radiance to ... luminance."""
    return radiance @ LUMINANCE_REC709.astype(radiance.dtype)


def exposure_from_luminance(luminances: Iterable[Image]) -> float:
    """Exposure of a scene: e = 0.6 / P80(luminance) over all pixels of its training references.

    Where more than 80 % of the pixels are black (an object before nothing) the percentile is taken over lit
    pixels; an entirely black scene gets 1.0.

    Args:
        luminances: Arrays of linear luminance, any shapes.

    Raises:
        MetricError: No pixel at all, or a luminance is not finite.
    """
    flat = [np.ravel(values) for values in luminances]
    pixels = np.concatenate(flat) if flat else np.empty(0)
    num_finite = int(np.isfinite(pixels).sum())
    if num_finite == 0 or num_finite < pixels.size:
        raise MetricError(f"luminances must all be finite, got {num_finite} finite of {pixels.size}")
    p80 = float(np.percentile(pixels, 80.0))
    if p80 <= 0.0 and (pixels > 0.0).any():
        p80 = float(np.percentile(pixels[pixels > 0.0], 80.0))
    exposure = EXPOSED_P80 / p80 if p80 > 0.0 else 1.0
    return exposure if math.isfinite(exposure) else 1.0


def tone_map(radiance: Image, exposure: float) -> NDArray[np.float32]:
    """Linear radiance (any shape) to display values in [0, 1]: sRGB(clip(exposure * L, 0, 1)).

    NaN stays NaN.
    """
    # Torch multiplies: an overflow is white, nothing to warn of.
    exposed = torch.from_numpy(np.ascontiguousarray(radiance, dtype=np.float32)) * exposure
    return srgb_forward(exposed).numpy()


def psnr(display: Image, reference: Image) -> float:
    """Peak signal-to-noise ratio in dB of HxWx3 display images in [0, 1], at most `PSNR_LIMIT_DB`."""
    _check_pair(display, reference)
    return _decibels(float(np.mean(np.square(display.astype(np.float64) - reference))))


def ssim(display: Image, reference: Image) -> float:
    """Structural similarity (Wang et al. 2004: Gaussian window, sigma 1.5) of HxWx3 display images.

    H and W must be at least 11. 1 is identical.
    """
    _check_pair(display, reference, min_size_px=MIN_SSIM_PX)
    score = structural_similarity(
        display.astype(np.float64), reference.astype(np.float64), data_range=1.0, channel_axis=2,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )  # fmt: skip
    return float(score)


def flip(display: Image, reference: Image) -> tuple[float, NDArray[np.float32]]:
    """LDR FLIP (Andersson et al. 2020) at the evaluator's default 67 pixels a degree.

    Args:
        display: HxWx3 sRGB values in [0, 1].
        reference: As display.

    Returns:
        Mean error in [0, 1], 0 for identical images, and the HxW error map.
    """
    _check_pair(display, reference)
    pair = (np.ascontiguousarray(image, dtype=np.float32) for image in (reference, display))
    error_map, mean, _ = flip_evaluator.evaluate(*pair, "LDR", inputsRGB=True, applyMagma=False)
    return float(mean), np.asarray(error_map, dtype=np.float32).reshape(display.shape[:2])


def relmse(exposed: Image, reference: Image, epsilon: float = RELATIVE_EPSILON) -> float:
    """Relative MSE: mean((x - y)^2 / (y^2 + epsilon)) over HxWx3 exposed radiance x and reference y."""
    _check_pair(exposed, reference)
    x, y = exposed.astype(np.float64), reference.astype(np.float64)
    return float(np.mean(np.square(x - y) / (np.square(y) + epsilon)))


def smape(exposed: Image, reference: Image, epsilon: float = RELATIVE_EPSILON) -> float:
    """Symmetric error: mean(|x - y| / (|x| + |y| + epsilon)) over HxWx3 exposed radiance, in [0, 1)."""
    _check_pair(exposed, reference)
    x, y = exposed.astype(np.float64), reference.astype(np.float64)
    return float(np.mean(np.abs(x - y) / (np.abs(x) + np.abs(y) + epsilon)))


def st_lpips(display: Image, reference: Image, perceptual: Perceptual) -> float:
    """ST-LPIPS (`models.perceptual.StLpips`) of HxWx3 display images, H, W >= 32; 0 is identical."""
    _check_pair(display, reference)
    pair = (torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None] for image in (display, reference))
    with torch.inference_mode():
        return float(perceptual(*pair))


def temporal_difference(
    display: Image,
    warped_previous: Image,
    reference: Image,
    warped_previous_reference: Image,
    valid: NDArray[np.bool_],
) -> float | None:
    """Flicker that the scene does not have.

    The mean over valid pixels of |(x - warp(x_previous)) - (y - warp(y_previous))|, frame x, reference y.

    Args:
        display: HxWx3 display image of this frame, in [0, 1].
        warped_previous: The previous frame's display image, reprojected into this one
            (`models.reprojection.reproject`).
        reference: As display, of the reference.
        warped_previous_reference: As warped_previous, of the reference.
        valid: HxW, where the reprojection holds.

    Returns:
        Mean absolute difference in display units, or None where no pixel is valid.
    """
    _check_pair(display, reference)
    _check_pair(warped_previous, warped_previous_reference)
    if not valid.any():
        return None
    ours = display[valid].astype(np.float64) - warped_previous[valid]
    theirs = reference[valid].astype(np.float64) - warped_previous_reference[valid]
    return float(np.mean(np.abs(ours - theirs)))


def reference_error_db(reference: Image, standard_error: Image, exposure: float) -> float:
    """PSNR in dB that a perfect frame would score against this noisy reference.

    A score near or above it says nothing about the frame.

    The standard error is carried through the tone map by central difference, (T(L + s) - T(L - s)) / 2, and
    taken as the noise's root mean square at each pixel. First order: too kind where the error exceeds the
    radiance itself.

    Args:
        reference: HxWx3 linear radiance.
        standard_error: HxWx3 standard error of the mean of `reference`, linear, >= 0.
        exposure: The scene's exposure.
    """
    _check_pair(reference, standard_error)
    above = tone_map(reference + standard_error, exposure)
    below = tone_map(reference - standard_error, exposure)
    return _decibels(float(np.mean(np.square((above.astype(np.float64) - below) / 2.0))))


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores of one frame against its reference.

    All but `non_finite` are None when the frame holds a non-finite value; `ssim` and `st_lpips` are None too where it
    is smaller than their windows.

    Attributes:
        psnr: dB, higher is better.
        ssim: 1 is identical.
        flip: Mean LDR FLIP, 0 is identical.
        st_lpips: ST-LPIPS, 0 is identical; None too where no perceptual network was given.
        relmse: On exposed linear radiance, epsilon `RELATIVE_EPSILON`.
        smape: As relmse.
        non_finite: NaN and infinite values in the frame, over all channels.
    """

    psnr: float | None = None
    ssim: float | None = None
    flip: float | None = None
    st_lpips: float | None = None
    relmse: float | None = None
    smape: float | None = None
    non_finite: int = 0

    def to_dict(self) -> dict[str, float | int | None]:
        """Name to value; strict JSON, since a score is a finite number or None."""
        return asdict(self)


def score_frame(frame: Image, reference: Image, exposure: float, perceptual: Perceptual | None = None) -> Scores:
    """All scores of a frame; refused (None) when it holds a non-finite value.

    Metrics absorb such values silently: FLIP takes NaN for black.

    Args:
        frame: HxWx3 linear radiance.
        reference: As frame.
        exposure: The scene's exposure.
        perceptual: `models.perceptual.StLpips`, or None to leave that score out.

    Raises:
        MetricError: The reference holds a non-finite value: nothing can be scored against it.
        ShapeError: Shapes differ.
    """
    _check_shapes(frame, reference)
    if not np.isfinite(reference).all():
        raise MetricError("a reference must be finite, got NaN or Inf; render it again")
    non_finite = int(frame.size - np.count_nonzero(np.isfinite(frame)))
    if non_finite:
        return Scores(non_finite=non_finite)
    display, target = tone_map(frame, exposure), tone_map(reference, exposure)
    x, y = (image.astype(np.float64) * exposure for image in (frame, reference))
    smallest = min(frame.shape[:2])
    return Scores(
        psnr=psnr(display, target),
        ssim=ssim(display, target) if smallest >= MIN_SSIM_PX else None,
        flip=flip(display, target)[0],
        st_lpips=None if perceptual is None or smallest < MIN_PERCEPTUAL_PX else st_lpips(display, target, perceptual),
        relmse=relmse(x, y),
        smape=smape(x, y),
    )


def _decibels(mean_square: float) -> float:
    if mean_square <= 0.0:
        return PSNR_LIMIT_DB
    return min(-10.0 * math.log10(mean_square), PSNR_LIMIT_DB)


def _check_pair(image: Image, reference: Image, *, min_size_px: int = 1) -> None:
    """Metrics absorb non-finite values silently, each in its own way: they are refused before."""
    _check_shapes(image, reference, min_size_px=min_size_px)
    bad = [values.size - int(np.count_nonzero(np.isfinite(values))) for values in (image, reference)]
    if any(bad):
        raise MetricError(
            f"images must be finite, got {bad[0]} and {bad[1]} of {image.size} values NaN or Inf; use score_frame"
        )


def _check_shapes(image: Image, reference: Image, *, min_size_px: int = 1) -> None:
    shape = image.shape
    if shape != reference.shape or len(shape) != 3 or shape[2] != 3 or min(shape[:2]) < min_size_px:
        raise ShapeError(f"images must both be HxWx3 with H, W >= {min_size_px}, got {shape} and {reference.shape}")
