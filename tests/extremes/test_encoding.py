"""What leaves: pictures of any radiance, and frames that never hold NaN or infinity.

Bounds: 8-bit values are exact for 0, white and beyond, monotone in between; a renderer whose query or network breaks
serves a finite frame with the exact count of what it replaced.
"""

import io
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from models.network import FusionNet, NetworkConfig
from models.transfer import Transfer
from service.images import EXR, JPEG, MEDIA_TYPES, NON_FINITE_COLOUR, PNG, display_image, encode
from storage.frames import decode_frame
from workers.camera import Camera
from workers.query import CHANNELS, NUM_CHANNELS
from workers.reconstruct import GBUFFER_CHANNELS, Encoding, Reconstructor
from workers.renderer import FrameRenderer

EXPOSURES = [1e-12, 1e-6, 1.0, 1e6, 1e12]
RADIANCES = [0.0, 1e-38, 1e-8, 1.0, 1e4, 1e6, 1e8, 3e38]
CAMERA = Camera.look_at([0, 0, 1], [0, 0, 0], [0, 1, 0], 50, 16, 12)


@pytest.mark.parametrize("exposure", EXPOSURES)
@pytest.mark.parametrize("radiance", RADIANCES)
def test_picture_of_any_radiance_is_that_of_its_product(radiance: float, exposure: float) -> None:
    pixels = display_image(np.full((2, 2, 3), radiance, np.float32), exposure)
    exposed = radiance * exposure
    if exposed >= 1.0:
        assert np.all(pixels == 255)
    elif exposed <= 1e-5:
        assert np.all(pixels == 0)
    assert not np.any(np.all(pixels == NON_FINITE_COLOUR, axis=-1))


levels = st.floats(0, 2, width=32)


@given(levels, levels)
def test_brighter_radiance_is_no_darker_a_pixel(a: float, b: float) -> None:
    low, high = (int(display_image(np.full((1, 1, 3), x, np.float32), 1.0)[0, 0, 0]) for x in sorted((a, b)))
    assert low <= high


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_picture_shows_what_is_not_finite(bad: float) -> None:
    radiance = np.full((2, 2, 3), 0.5, np.float32)
    radiance[1, 0, 2] = bad
    pixels = display_image(radiance, 1.0)
    assert tuple(pixels[1, 0]) == NON_FINITE_COLOUR
    assert np.all(pixels[0, 0] == 188)


@pytest.mark.parametrize("media_type", MEDIA_TYPES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 8192), (8192, 1)])
def test_frames_of_any_shape_are_encoded(shape: tuple[int, int], media_type: str) -> None:
    radiance = np.random.default_rng(0).random((*shape, 3), dtype=np.float32)
    data = encode(radiance, 1.0, media_type)
    if media_type == EXR:
        np.testing.assert_array_equal(decode_frame(data)["radiance"], radiance)
        return
    shown = np.asarray(Image.open(io.BytesIO(data)))
    assert shown.shape == (*shape, 3)
    if media_type == PNG:
        np.testing.assert_array_equal(shown, display_image(radiance, 1.0))
    assert media_type in (PNG, JPEG)


# ------------------------------------------- what is served -------------------------------------------


class BrokenProgram:
    """A query with chosen values that are not finite."""

    def __init__(self, **bad: float) -> None:
        self.features = np.full((12, 16, NUM_CHANNELS), 0.4, np.float32)
        self.features[..., slice(*CHANNELS["position"])] = np.nan  # a miss: no fault
        for name, value in bad.items():
            self.features[3, 5, CHANNELS[name][0]] = value

    def run(self, camera: Camera) -> np.ndarray:
        del camera
        return self.features.copy()


def renderer(program: Any, gain: float = 0.0) -> FrameRenderer:
    torch.manual_seed(0)
    network = FusionNet(NetworkConfig(gbuffer_channels=GBUFFER_CHANNELS, widths=(16, 16, 16)))
    if gain:
        with torch.no_grad():
            for parameter in network.head.parameters():
                parameter.normal_(0, gain)
    return FrameRenderer(program, Reconstructor(network, Encoding(1.0, 4.0, Transfer()), precision="fp32"))


@pytest.mark.parametrize("channel", ["ir", "normal", "albedo", "distance", "coverage"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_broken_query_poisons_one_value_and_is_counted(channel: str, bad: float) -> None:
    """Squeeze-and-excitation pools over the frame: one NaN made all of it NaN."""
    whole = renderer(BrokenProgram(), 0.01).render(CAMERA)
    frame = renderer(BrokenProgram(**{channel: bad}), 0.01).render(CAMERA)
    assert np.isfinite(frame.radiance).all() and whole.non_finite == 0
    assert frame.non_finite == 1
    assert 0.0 <= frame.coverage <= 1.0
    away = np.abs(np.arange(16) - 5) > 14
    np.testing.assert_allclose(frame.radiance[:, away], whole.radiance[:, away], rtol=0.05)


def test_exploding_network_is_answered_by_the_caches_and_counted() -> None:
    broken = renderer(BrokenProgram(), 1e6)
    frame = broken.render(CAMERA)
    raw = broken.unchecked(CAMERA)
    assert frame.non_finite == np.count_nonzero(~np.isfinite(raw)) > 0
    np.testing.assert_allclose(frame.radiance[~np.isfinite(raw)], 0.4)
    data = encode(frame.radiance, frame.exposure, EXR)
    assert np.isfinite(decode_frame(data)["radiance"]).all()
