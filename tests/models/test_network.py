"""The fusion network: shapes, starting point, size and cost, and what it may depend on."""

import dataclasses
import json

import pytest
import torch
from torch import nn

from models.blocks import FusionBlock, SqueezeExcitation
from models.errors import ConfigError, ShapeError
from models.network import FusionNet, NetworkConfig, network_flops, num_parameters

SMALL = {"widths": (16, 16, 16)}


def inputs(config: NetworkConfig, height: int = 32, width: int = 48) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    shape = (height, width)
    ir = torch.rand(2, config.ir_channels, *shape, generator=generator)
    return ir, torch.rand(2, config.gbuffer_channels, *shape, generator=generator)


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(7)


@pytest.mark.parametrize("fusion", ["fuse", "concatenate"])
@pytest.mark.parametrize("unshuffle", [1, 2, 4])
def test_network_starts_as_the_identity_on_radiance(fusion: str, unshuffle: int) -> None:
    config = NetworkConfig(ir_channels=5, gbuffer_channels=9, fusion=fusion, unshuffle=unshuffle, **SMALL)
    ir, gbuffer = inputs(config)
    assert torch.equal(FusionNet(config)(ir, gbuffer), ir[:, :3])


def test_paper_exact_network_predicts_the_frame_itself() -> None:
    config = NetworkConfig.paper_exact()
    assert (config.unshuffle, config.residual, config.size_multiple) == (1, False, 4)
    ir, gbuffer = inputs(config)
    frame = FusionNet(config)(ir, gbuffer)
    assert frame.shape == (2, 3, 32, 48)
    assert not torch.allclose(frame, ir, atol=1e-3)


@pytest.mark.parametrize("fusion", ["fuse", "concatenate"])
def test_every_parameter_gets_a_gradient(fusion: str) -> None:
    network = FusionNet(NetworkConfig(fusion=fusion, residual=False, **SMALL))
    network(*inputs(network.config)).square().mean().backward()
    without = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert without == []


def test_output_depends_on_both_inputs() -> None:
    network = FusionNet(NetworkConfig(residual=False, **SMALL))
    ir, gbuffer = inputs(network.config)
    frame = network(ir, gbuffer)
    assert not torch.allclose(frame, network(ir, 1.0 - gbuffer), atol=1e-4)
    assert not torch.allclose(frame, network(1.0 - ir, gbuffer), atol=1e-4)


def test_network_learns_to_correct_imperfect_radiance() -> None:
    """Light that is missing from the IR map, but told by a smooth G-buffer, is filled in."""
    network = FusionNet(NetworkConfig(gbuffer_channels=3, **SMALL))
    gbuffer = nn.functional.interpolate(torch.rand(2, 3, 4, 6), size=(32, 48), mode="bilinear")
    frame = torch.rand(2, 3, 32, 48)
    ir = frame - 0.5 * gbuffer
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(60):
        loss = (network(ir, gbuffer) - frame).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]


def test_default_network_is_as_small_and_cheap_as_promised() -> None:
    costs = {}
    for fusion in ("fuse", "concatenate"):
        config = NetworkConfig(fusion=fusion)
        parameters = num_parameters(FusionNet(config))
        costs[fusion] = (parameters, network_flops(config, 64, 64) / 64**2)
        assert 0.3e6 <= parameters <= 0.6e6
        assert 30e3 <= costs[fusion][1] <= 60e3
    for fuse, concatenate in zip(costs["fuse"], costs["concatenate"], strict=True):
        assert concatenate == pytest.approx(fuse, rel=0.15)


def test_network_flops_are_those_of_the_convolutions_by_hand() -> None:
    config = NetworkConfig(fusion="concatenate", unshuffle=1, widths=(16, 16, 16))
    height, width, macs = 8, 8, 0

    def hook(module: nn.Conv2d, _: object, output: torch.Tensor) -> None:
        nonlocal macs
        macs += module.weight.numel() * output.shape[-1] * output.shape[-2]

    network = FusionNet(config)
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            module.register_forward_hook(hook)
    network(torch.rand(1, 3, height, width), torch.rand(1, 7, height, width))
    assert network_flops(config, height, width) == 2 * macs


def test_bfloat16_weights_keep_the_radiance_in_float32() -> None:
    network = FusionNet(NetworkConfig(**SMALL)).to(torch.bfloat16)
    ir, gbuffer = inputs(network.config)
    frame = network(ir, gbuffer)
    assert frame.dtype == torch.float32
    assert torch.equal(frame, ir)
    plain = FusionNet(NetworkConfig(residual=False, **SMALL))
    assert torch.allclose(plain(ir, gbuffer), plain.to(torch.bfloat16)(ir, gbuffer), atol=0.02)


def test_channels_last_gives_the_same_frame() -> None:
    network = FusionNet(NetworkConfig(residual=False, **SMALL)).eval()
    ir, gbuffer = inputs(network.config)
    with torch.inference_mode():
        plain = network(ir, gbuffer)
        network = network.to(memory_format=torch.channels_last)
        last = network(*(x.contiguous(memory_format=torch.channels_last) for x in (ir, gbuffer)))
    assert torch.allclose(plain, last, atol=1e-5)


def test_network_exports_as_one_graph() -> None:
    network = FusionNet(NetworkConfig(residual=False, **SMALL)).eval()
    ir, gbuffer = inputs(network.config)
    program = torch.export.export(network, (ir, gbuffer))
    with torch.inference_mode():
        assert torch.allclose(program.module()(ir, gbuffer), network(ir, gbuffer), atol=1e-5)


def test_fusion_block_with_silent_residual_passes_the_ir_branch() -> None:
    block = FusionBlock(16, 0.0)
    for parameter in block.residual.parameters():
        nn.init.zeros_(parameter)
    ir, gbuffer = torch.rand(1, 16, 8, 8), torch.rand(1, 16, 8, 8)
    guided, skip = block(ir, gbuffer)
    assert torch.equal(guided, ir)
    assert skip.shape == (1, 32, 8, 8)


def test_squeeze_excitation_scales_each_channel_by_one_gate() -> None:
    x = torch.rand(2, 16, 5, 7) + 0.5
    gate = SqueezeExcitation(16)(x) / x
    assert ((gate > 0.0) & (gate < 1.0)).all()
    assert torch.allclose(gate, gate[:, :, :1, :1].expand_as(gate), atol=1e-6)


def test_config_survives_json() -> None:
    config = NetworkConfig(ir_channels=4, widths=(16, 32, 48), unshuffle=4, residual=False)
    assert NetworkConfig(**json.loads(json.dumps(dataclasses.asdict(config)))) == config


@pytest.mark.parametrize("fusion", ["fuse", "concatenate"])
def test_slope_reaches_every_activation_and_a_record_without_one_is_relu(fusion: str) -> None:
    leaky = FusionNet(NetworkConfig(fusion=fusion, negative_slope=0.2, **SMALL))
    old = dataclasses.asdict(leaky.config)
    del old["negative_slope"]
    plain = FusionNet(NetworkConfig(**old))
    slopes = [module.negative_slope for module in leaky.modules() if isinstance(module, nn.LeakyReLU)]
    assert slopes == [0.2] * sum(isinstance(module, nn.ReLU) for module in plain.modules())
    assert not any(isinstance(module, nn.ReLU) for module in leaky.modules())
    plain.load_state_dict(leaky.state_dict())


@pytest.mark.parametrize(
    "values",
    [
        {"ir_channels": 2},
        {"gbuffer_channels": 0},
        {"widths": (32, 48)},
        {"widths": (32, 48, 50)},
        {"widths": (0, 16, 16)},
        {"fusion": "add"},
        {"unshuffle": 3},
        {"negative_slope": -0.1},
        {"negative_slope": 1.0},
    ],
)
def test_config_rejects_values_outside_its_rules(values: dict) -> None:
    with pytest.raises(ConfigError, match="got"):
        NetworkConfig(**values)


@pytest.mark.parametrize(
    ("ir_shape", "gbuffer_shape"),
    [
        ((1, 4, 16, 16), (1, 7, 16, 16)),
        ((1, 3, 16, 16), (1, 6, 16, 16)),
        ((1, 3, 16, 12), (1, 7, 16, 12)),
        ((1, 3, 16, 16), (1, 7, 16, 24)),
        ((2, 3, 16, 16), (1, 7, 16, 16)),
        ((3, 16, 16), (7, 16, 16)),
    ],
)
def test_network_rejects_shapes_it_was_not_made_for(ir_shape: tuple, gbuffer_shape: tuple) -> None:
    network = FusionNet(NetworkConfig(**SMALL))
    with pytest.raises(ShapeError, match="must"):
        network(torch.zeros(ir_shape), torch.zeros(gbuffer_shape))
