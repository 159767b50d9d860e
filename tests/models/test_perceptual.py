"""ST-LPIPS: its definition on tiny random trunks, and the authors' numbers where weights are installed."""

import pytest
import torch

from models.errors import ShapeError, WeightsError
from models.perceptual import TRUNKS, StLpips, unit_length
from storage.perceptual_weights import find_stlpips

KERNELS = {"vgg": (3,) * 13, "alex": (11, 5, 3, 3, 3)}
BLUR = torch.tensor([1.0, 2.0, 1.0])


def tiny_weights(trunk: str, channels: int = 4) -> dict[str, torch.Tensor]:
    """A random trunk with the published names and few channels."""
    generator = torch.Generator().manual_seed(11)
    weights = {
        "scaling_layer.shift": torch.zeros(1, 3, 1, 1),
        "scaling_layer.scale": torch.full((1, 3, 1, 1), 0.5),
    }
    kernels, index, in_channels = iter(KERNELS[trunk]), 0, 3
    for number, kinds in enumerate(TRUNKS[trunk], start=1):
        for kind in kinds:
            name = f"net.slice{number}.{index}"
            if kind == "conv":
                size = next(kernels)
                shape = (channels, in_channels, size, size)
                weights[f"{name}.weight"] = torch.randn(shape, generator=generator) / (size * in_channels**0.5)
                weights[f"{name}.bias"] = 0.1 * torch.ones(channels)
                in_channels = channels
            elif kind == "blur":
                weights[f"{name}.filt"] = (BLUR[:, None] * BLUR / 16.0).repeat(channels, 1, 1, 1)
            index += 1
        weights[f"lin{number - 1}.model.1.weight"] = torch.ones(1, channels, 1, 1)
    return weights


def waves(phase: float, height: int = 48, width: int = 40) -> torch.Tensor:
    """1,3,H,W display image of smooth waves: a formula, so that it is the same with every library version."""
    row, column = torch.arange(float(height))[:, None], torch.arange(float(width))[None]
    planes = [0.11 * (k + 1) * row + 0.07 * (k + 2) * column + phase * (k + 1) for k in range(3)]
    return torch.stack([0.5 + 0.4 * torch.sin(plane) for plane in planes])[None]


@pytest.mark.parametrize("trunk", ["vgg", "alex"])
def test_trunk_is_recognised_and_frozen(trunk: str) -> None:
    metric = StLpips(tiny_weights(trunk))
    assert metric.trunk == trunk
    assert not any(p.requires_grad for p in metric.parameters())


@pytest.mark.parametrize("trunk", ["vgg", "alex"])
def test_distance_is_zero_for_identical_symmetric_and_per_image(trunk: str) -> None:
    metric = StLpips(tiny_weights(trunk))
    x, y = torch.cat((waves(0.0), waves(0.3))), torch.cat((waves(0.9), waves(0.3)))
    distance = metric(x, y)
    assert distance.shape == (2,)
    assert distance[0] > 0.0
    assert distance[1] == 0.0
    assert torch.allclose(distance, metric(y, x))


def test_calibration_weights_scale_their_own_slice() -> None:
    weights = tiny_weights("vgg")
    x, y = waves(0.0), waves(1.0)
    parts = []
    for kept in range(5):
        only = {k: v * (k == f"lin{kept}.model.1.weight") if k.startswith("lin") else v for k, v in weights.items()}
        parts.append(StLpips(only)(x, y))
    assert all(part > 0.0 for part in parts)
    assert torch.allclose(sum(parts, torch.zeros(1)), StLpips(weights)(x, y), rtol=1e-5)


def test_gradient_is_finite_where_every_feature_is_dead() -> None:
    weights = {k: -v.abs() if k.endswith("bias") else v for k, v in tiny_weights("alex").items()}
    weights["scaling_layer.shift"] -= 1.0  # black becomes exactly zero after scaling
    image = torch.zeros(1, 3, 32, 32, requires_grad=True)
    StLpips(weights)(image, waves(0.0, 32, 32)).sum().backward()
    assert image.grad is not None
    assert image.grad.isfinite().all()


def test_unit_length_is_one_and_kind_to_zero() -> None:
    feature = torch.tensor([[3.0, 0.0], [4.0, 0.0]]).reshape(1, 2, 1, 2).requires_grad_()
    scaled = unit_length(feature)
    scaled.sum().backward()
    assert scaled.flatten().tolist() == pytest.approx([0.6, 0.0, 0.8, 0.0])
    assert feature.grad is not None
    assert feature.grad.isfinite().all()


def test_missing_weights_are_named() -> None:
    weights = tiny_weights("vgg")
    del weights["net.slice3.12.weight"]
    with pytest.raises(WeightsError, match=r"net\.slice3\.12\.weight"):
        StLpips(weights)


@pytest.mark.parametrize("shapes", [((1, 3, 31, 64), (1, 3, 31, 64)), ((1, 3, 32, 32), (2, 3, 32, 32))])
def test_images_of_wrong_shape_are_refused(shapes: tuple) -> None:
    with pytest.raises(ShapeError, match="must"):
        StLpips(tiny_weights("vgg"))(*(torch.zeros(shape) for shape in shapes))


@pytest.fixture(scope="module", params=["vgg", "alex"])
def published(request: pytest.FixtureRequest) -> StLpips:
    weights = find_stlpips((request.param,))
    if weights is None:
        pytest.skip("stlpips_pytorch is not installed")
    return StLpips(weights[request.param])


def test_distance_equals_the_authors_code(published: StLpips) -> None:
    """The numbers are those of stlpips_pytorch 0.0.2's own network on the same images."""
    expected = {
        "vgg": (0.01582404412, 0.22219271958, 0.62729501724),
        "alex": (0.00723826792, 0.12211866677, 0.41816028953),
    }[published.trunk]
    with torch.inference_mode():
        distances = [published(waves(0.0), waves(phase)).item() for phase in (0.1, 0.5, 1.5)]
    assert distances == pytest.approx(expected, rel=1e-3)


def test_distance_grows_with_noise(published: StLpips) -> None:
    noise = torch.randn(1, 3, 48, 40, generator=torch.Generator().manual_seed(5))
    clean = waves(0.0)
    with torch.inference_mode():
        distances = [published(clean, (clean + s * noise).clamp(0, 1)).item() for s in (0.0, 0.02, 0.06, 0.18)]
    assert distances[0] == 0.0
    assert distances == sorted(distances)
    assert distances[1] > 0.0


def test_one_pixel_shift_costs_less_than_noise_of_the_same_error(published: StLpips) -> None:
    wide = waves(0.0, 48, 41)
    clean, shifted = wide[..., :-1], wide[..., 1:]
    noise = torch.randn(1, 3, 48, 40, generator=torch.Generator().manual_seed(5))
    noisy = clean + noise * (shifted - clean).square().mean().sqrt()
    with torch.inference_mode():
        assert published(clean, shifted) < 0.7 * published(clean, noisy)
