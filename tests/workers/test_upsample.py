"""Joint bilateral upsampling against closed forms."""

import numpy as np
import pytest
import torch
from torch import Tensor

from workers.query import CHANNELS, NUM_CHANNELS
from workers.upsample import HalfScaleReconstructor, halve, joint_bilateral_upsample

HEIGHT, WIDTH = 12, 16


def guide(*, height: int = HEIGHT, width: int = WIDTH, albedo: float = 0.5, distance: float = 2.0) -> Tensor:
    """A wall that faces the camera."""
    result = torch.zeros(1, 7, height, width)
    result[:, 2], result[:, 3:6], result[:, 6] = 1.0, albedo, distance
    return result


def upsampled(frame: Tensor, full_guide: Tensor, **options: bool) -> Tensor:
    """Halved and brought back."""
    return joint_bilateral_upsample(halve(frame), full_guide, halve(full_guide), **options)


@pytest.mark.parametrize("size", [(12, 16), (11, 15), (1, 1), (2, 3)])
@pytest.mark.parametrize("demodulate", [False, True])
def test_constant_stays_constant(size: tuple[int, int], demodulate: bool) -> None:
    frame = torch.full((1, 3, *size), 0.7)
    result = upsampled(frame, guide(height=size[0], width=size[1]), demodulate=demodulate)
    torch.testing.assert_close(result, frame)


def test_gradient_on_a_wall_is_bilinear_interpolation() -> None:
    frame = torch.linspace(0, 1, WIDTH).expand(1, 3, HEIGHT, WIDTH)
    result = upsampled(frame, guide())
    expected = torch.nn.functional.interpolate(halve(frame), scale_factor=2, mode="bilinear", align_corners=False)
    torch.testing.assert_close(result, expected)
    torch.testing.assert_close(result[..., 1:-1], frame[..., 1:-1])  # linear in, linear out


@pytest.mark.parametrize("channel", ["normal", "albedo", "distance"])
@pytest.mark.parametrize("edge", [8, 7])
def test_edge_in_the_guide_stays_an_edge(channel: str, edge: int) -> None:
    """Also where it runs through the middle of a block (7): the block's mean resembles neither side."""
    full = guide()
    if channel == "normal":
        full[:, :3, :, edge:] = torch.tensor((1.0, 0.0, 0.0))[None, :, None, None]
    elif channel == "albedo":
        full[:, 3:6, :, edge:] = 0.9
    else:
        full[:, 6, :, edge:] = 4.0
    frame = torch.full((1, 3, HEIGHT, WIDTH), 0.1)
    frame[..., edge:] = 0.8
    result = upsampled(frame, full, demodulate=False)
    plain = torch.nn.functional.interpolate(halve(frame), scale_factor=2, mode="bilinear", align_corners=False)
    if edge == 8:
        torch.testing.assert_close(result, frame, atol=2e-3, rtol=0)
        assert (plain - frame).abs().max() > 0.15
    else:
        assert (result - frame).abs().mean() < 0.5 * (plain - frame).abs().mean()


def test_texture_under_even_light_is_exact() -> None:
    """L = a E with constant E: means of a E divided by means of a are E everywhere."""
    generator = torch.Generator().manual_seed(3)
    full = guide()
    full[:, 3:6] = 0.3 + 0.4 * torch.rand(1, 3, HEIGHT, WIDTH, generator=generator)
    frame = full[:, 3:6] * 1.7
    torch.testing.assert_close(upsampled(frame, full), frame)
    assert (upsampled(frame, full, demodulate=False) - frame).abs().max() > 0.05


def test_light_on_a_dark_neighbour_is_never_amplified() -> None:
    full = guide(albedo=0.0)
    full[:, 3:6, :, 8:] = 1.0
    frame = torch.full((1, 3, HEIGHT, WIDTH), 1.0)
    assert upsampled(frame, full).max() <= 4.0


def test_misses_keep_to_themselves() -> None:
    full = guide()
    full[..., 8:] = 0.0  # sky: no normal, albedo or distance
    frame = torch.full((1, 3, HEIGHT, WIDTH), 0.25)
    frame[..., 8:] = 30.0
    result = upsampled(frame, full)
    torch.testing.assert_close(result, frame, atol=0.02, rtol=1e-3)


class Pass:
    """A network that returns its imperfect radiance, and notes the size it saw."""

    encoding, device = None, torch.device("cpu")

    def __call__(self, features: np.ndarray) -> np.ndarray:
        self.size = features.shape
        return np.ascontiguousarray(features[..., :3])


def test_half_scale_reconstructor_sees_half_the_pixels_and_returns_all() -> None:
    network = Pass()
    features = np.full((9, 14, NUM_CHANNELS), np.nan, np.float32)
    features[..., : CHANNELS["distance"][1]] = 0.5  # positions of misses are NaN and must not reach the frame
    frame = HalfScaleReconstructor(network)(features)  # type: ignore[arg-type]
    assert network.size == (5, 7, NUM_CHANNELS)
    assert frame.shape == (9, 14, 3) and frame.dtype == np.float32
    np.testing.assert_allclose(frame, 0.5, rtol=1e-6)
