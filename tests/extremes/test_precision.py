"""bf16 against fp32 in every network configuration, on ordinary and on extreme input.

Bounds: a frame whose output is itself bf16 is rounded by up to 2^-9 of its values, 54 dB at display white, so 50 dB is
asked of it, which is also where `workers/reconstruct.py` refuses bf16. A network that adds to its input in fp32 rounds
only the correction: 60 dB.
"""

import copy
import itertools
from typing import Any

import numpy as np
import pytest
import torch

from models.metrics import psnr, tone_map
from models.network import FusionNet, NetworkConfig
from models.transfer import Transfer
from workers.query import CHANNELS, NUM_CHANNELS
from workers.reconstruct import GBUFFER_CHANNELS, Encoding, FrameModule

CONFIGS = [
    NetworkConfig(gbuffer_channels=GBUFFER_CHANNELS, widths=(16, 16, 32), fusion=fusion, unshuffle=block, residual=own)
    for fusion, block, own in itertools.product(("fuse", "concatenate"), (1, 2, 4), (True, False))
]  # fmt: skip
LEAST_DB = {True: 60.0, False: 50.0}
ENCODING = Encoding(1.0, 4.0, Transfer())


def name_of(config: NetworkConfig) -> str:
    return f"{config.fusion} {config.unshuffle} {'residual' if config.residual else 'frame'}"


def features(firefly: float = 0.0) -> torch.Tensor:
    rng = np.random.default_rng(7)
    frame = rng.random((32, 32, NUM_CHANNELS), dtype=np.float32)
    if firefly:
        frame[4, 9, slice(*CHANNELS["ir"])] = firefly
    return torch.from_numpy(frame)


def network_of(config: NetworkConfig) -> FusionNet:
    """Weights as they are before training, with a head that does something."""
    torch.manual_seed(1)
    network = FusionNet(config).eval()
    with torch.no_grad():
        network.head.weight.normal_(0, 0.05)
        network.head.bias.fill_(0.0 if config.residual else 0.5)  # type: ignore[union-attr]
    return network


@pytest.mark.parametrize("config", CONFIGS, ids=name_of)
@torch.inference_mode()
def test_bf16_is_close_to_fp32_in_every_configuration(config: NetworkConfig, within: Any) -> None:
    network = network_of(config)
    low = copy.deepcopy(network).to(torch.bfloat16)
    for what, data in (("ordinary", features()), ("a firefly of 1e8", features(1e8))):
        frames = [FrameModule(net, ENCODING)(data).numpy() for net in (network, low)]
        assert all(np.isfinite(frame).all() for frame in frames), what
        shown = [tone_map(frame, 1.0) for frame in frames]
        within(f"{what}, -dB", -psnr(shown[1], shown[0]), -LEAST_DB[config.residual])


@pytest.mark.parametrize("config", CONFIGS[:1], ids=name_of)
@pytest.mark.parametrize("level", [0.0, 1e-8, 1e4, 1e6])
@torch.inference_mode()
def test_network_of_any_level_is_finite(config: NetworkConfig, level: float) -> None:
    """The scene's exposure brings every level to the same range."""
    encoding = Encoding(1 / level if level else 1.0, 4.0, Transfer())
    data = features()
    data[..., slice(*CHANNELS["ir"])] *= level
    for dtype in (torch.float32, torch.bfloat16):
        frame = FrameModule(network_of(config).to(dtype), encoding)(data).numpy()
        assert np.isfinite(frame).all() and frame.min() >= 0.0
