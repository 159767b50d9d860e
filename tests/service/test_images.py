"""Radiance to picture files: the sRGB curve in closed form, exact round trips, Accept by the RFC."""

import io

import numpy as np
import pytest
from PIL import Image

from models.metrics import tone_map
from service import images
from service.errors import NotAcceptableError, OptionError
from storage.frames import decode_frame


def srgb_8bit(linear: float) -> int:
    """IEC 61966-2-1, written apart from the code under test."""
    encoded = 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055
    return int(255 * encoded + 0.5)


@pytest.mark.parametrize("linear", [0.0, 0.001, 0.0031308, 0.01, 0.18, 0.5, 0.999, 1.0])
def test_display_image_is_the_srgb_curve_of_exposed_radiance(linear: float) -> None:
    radiance = np.full((2, 3, 3), linear / 4.0, np.float32)
    assert np.unique(images.display_image(radiance, 4.0)).tolist() == [srgb_8bit(linear)]


def test_display_image_is_what_the_metrics_see_to_a_rounding() -> None:
    radiance = np.geomspace(1e-6, 2.0, 300_000, dtype=np.float32).reshape(-1, 100, 3)
    exact = tone_map(radiance, 0.8) * 255.0
    assert np.abs(images.display_image(radiance, 0.8) - exact).max() < 0.53


@pytest.mark.parametrize("exposure", [1e-30, 1.0, 1e37])
def test_display_image_of_the_brightest_and_the_darkest_is_white_and_black(exposure: float) -> None:
    radiance = np.array([[[0.0, 3e38, 1e-38 / exposure]]], np.float32)
    assert images.display_image(radiance, exposure).tolist() == [[[0, 255, 0]]]


def test_display_image_clips_to_the_screen() -> None:
    radiance = np.array([[[-1.0, 1e30, 65504.0]]], np.float32)
    assert images.display_image(radiance, 1.0).tolist() == [[[0, 255, 255]]]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_display_image_shows_non_finite_pixels(value: float) -> None:
    radiance = np.zeros((2, 2, 3), np.float32)
    radiance[1, 0, 2] = value
    pixels = images.display_image(radiance, 1.0)
    assert tuple(pixels[1, 0]) == images.NON_FINITE_COLOUR
    assert np.count_nonzero(pixels) == 2


def test_png_keeps_every_pixel() -> None:
    rng = np.random.default_rng(0)
    radiance = rng.random((7, 5, 3), dtype=np.float32)
    decoded = np.asarray(Image.open(io.BytesIO(images.encode(radiance, 1.0, images.PNG))))
    np.testing.assert_array_equal(decoded, images.display_image(radiance, 1.0))


def test_jpeg_is_close_to_the_display_image() -> None:
    radiance = np.tile(np.linspace(0, 1, 32, dtype=np.float32)[None, :, None], (16, 1, 3))
    picture = Image.open(io.BytesIO(images.encode(radiance, 1.0, images.JPEG)))
    assert picture.format == "JPEG"
    difference = np.asarray(picture).astype(int) - images.display_image(radiance, 1.0)
    assert np.abs(difference).max() <= 4


def test_exr_keeps_the_radiance_whatever_the_exposure() -> None:
    radiance = np.array([[[0.0, 1e-8, 70000.0]], [[1.5, 2.5, 3e9]]], np.float32)
    decoded = decode_frame(images.encode(radiance, 0.001, images.EXR))
    np.testing.assert_array_equal(decoded["radiance"], radiance)


@pytest.mark.parametrize(
    ("accept", "media_type"),
    [
        (None, images.PNG),
        ("", images.PNG),
        ("*/*", images.PNG),
        ("image/*", images.PNG),
        ("image/jpeg", images.JPEG),
        ("IMAGE/JPEG", images.JPEG),
        ("image/x-exr", images.EXR),
        ("image/png;q=0.5, image/x-exr;q=0.9", images.EXR),
        ("image/*;q=0.2, image/jpeg;q=0.8", images.JPEG),
        ("image/png;q=0, */*", images.JPEG),
        ("text/html, image/webp, */*;q=0.1", images.PNG),
    ],
)
def test_negotiate_follows_quality_and_specificity(accept: str | None, media_type: str) -> None:
    assert images.negotiate(accept) == media_type


@pytest.mark.parametrize("accept", ["text/html", "image/webp", "*/*;q=0", "image/png;q=2", "image/png;q=x", ";"])
def test_negotiate_refuses_what_it_cannot_write(accept: str) -> None:
    with pytest.raises(NotAcceptableError, match="image/png, image/jpeg, image/x-exr"):
        images.negotiate(accept)


def test_media_type_of_goes_by_the_suffix() -> None:
    assert [images.media_type_of(name) for name in ("a.PNG", "b/c.jpeg", "d.exr")] == list(images.MEDIA_TYPES)
    with pytest.raises(OptionError, match=r"\.png, \.jpg, \.jpeg, \.exr"):
        images.media_type_of("frame.tiff")
