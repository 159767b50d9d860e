"""Networks, checkpoints and perceptual weights as bytes."""

import sys
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest
import torch

from storage import perceptual_weights
from storage.errors import CanonicalError, WeightsError
from storage.perceptual_weights import find_stlpips
from storage.weights import decode_checkpoint, decode_network, encode_checkpoint, encode_network

CONFIG = {"network": {"widths": (8, 16), "fusion": "fuse"}, "transfer": "log1p", "metrics": {"psnr_db": 30.5}}


def state() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(4, 3, 3, 3, generator=generator)
    return {
        "a.weight": weight,
        "a.tied": weight,
        "b": weight.permute(0, 2, 3, 1),
        "n": torch.tensor(3),
        "h": weight.half(),
    }


def test_network_round_trips_bit_for_bit() -> None:
    decoded, config = decode_network(*encode_network(state(), CONFIG))
    assert decoded.keys() == state().keys()
    for name, tensor in state().items():
        assert decoded[name].dtype == tensor.dtype
        assert torch.equal(decoded[name], tensor)
    assert config == {**CONFIG, "network": {"widths": [8, 16], "fusion": "fuse"}}


def test_network_bytes_are_reproducible() -> None:
    assert encode_network(state(), CONFIG) == encode_network(state(), CONFIG)


def test_network_refuses_weights_of_another_run() -> None:
    weights, _ = encode_network(state(), CONFIG)
    _, other = encode_network({"a": torch.zeros(1)}, CONFIG)
    with pytest.raises(WeightsError, match="must match the SHA-256"):
        decode_network(weights, other)


@pytest.mark.parametrize("damaged", [b"", b"{}", b"[]", b"\xff"])
def test_network_refuses_a_damaged_description(damaged: bytes) -> None:
    with pytest.raises(WeightsError, match="must be safetensors and JSON"):
        decode_network(encode_network(state(), CONFIG)[0], damaged)


def test_network_refuses_what_cannot_be_described() -> None:
    with pytest.raises(WeightsError, match="at least one tensor"):
        encode_network({}, CONFIG)
    with pytest.raises(CanonicalError, match=r"config\.psnr must be finite"):
        encode_network(state(), {"psnr": float("nan")})


def test_checkpoint_resumes_training_exactly() -> None:
    def steps(net: torch.nn.Module, optimizer: torch.optim.Optimizer, count: int) -> None:
        for _ in range(count):
            optimizer.zero_grad()
            net(torch.randn(8, 3)).square().sum().backward()
            optimizer.step()

    torch.manual_seed(0)
    net = torch.nn.Linear(3, 2)
    optimizer = torch.optim.Adam(net.parameters())
    steps(net, optimizer, 2)
    numpy_rng = np.random.default_rng(0).bit_generator.state
    parts = {"net": net.state_dict(), "optimizer": optimizer.state_dict(), "rng": torch.get_rng_state()}
    data = encode_checkpoint({**parts, "numpy_rng": numpy_rng, "cursor": (0, 5)})
    steps(net, optimizer, 3)

    again = torch.nn.Linear(3, 2)
    other = torch.optim.Adam(again.parameters())
    loaded = decode_checkpoint(data)
    again.load_state_dict(loaded["net"])
    other.load_state_dict(loaded["optimizer"])
    torch.set_rng_state(loaded["rng"])
    steps(again, other, 3)
    assert torch.equal(net.weight, again.weight)
    assert (loaded["cursor"], loaded["numpy_rng"]) == ((0, 5), numpy_rng)


@pytest.mark.parametrize("content", [{"net": torch.nn.Linear(1, 1)}, {"a": np.zeros(3)}, {"f": lambda: 0}])
def test_checkpoint_refuses_more_than_data_when_it_is_made(content: dict[str, object]) -> None:
    with pytest.raises(WeightsError, match="checkpoint must be plain data"):
        encode_checkpoint(content)


@pytest.mark.parametrize("keep", [0, 10, -10])
def test_checkpoint_refuses_damaged_bytes(keep: int) -> None:
    with pytest.raises(WeightsError, match="checkpoint must be plain data"):
        decode_checkpoint(encode_checkpoint({"a": torch.zeros(3)})[:keep])


def test_stlpips_weights_are_read_without_importing_the_package() -> None:
    weights = find_stlpips(("alex",))
    if weights is None:
        pytest.skip("stlpips_pytorch is not installed")
    assert weights["alex"]["net.slice1.0.weight"].shape == (64, 3, 11, 11)
    assert all(isinstance(tensor, torch.Tensor) for tensor in weights["alex"].values())
    assert "stlpips_pytorch" not in sys.modules


def test_stlpips_weights_are_none_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perceptual_weights, "find_spec", lambda name: None)
    assert find_stlpips() is None


def test_stlpips_weights_that_are_damaged_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = tmp_path / "weights" / "vST0.0"
    folder.mkdir(parents=True)
    spec = ModuleSpec("stlpips_pytorch", None, is_package=True)
    spec.submodule_search_locations = [str(tmp_path)]
    monkeypatch.setattr(perceptual_weights, "find_spec", lambda name: spec)
    assert find_stlpips() is None
    (folder / "alex_shift_tolerant.pth").write_bytes(b"not a state dict")
    with pytest.raises(WeightsError, match=r"alex_shift_tolerant\.pth must be a torch state dict"):
        find_stlpips()
