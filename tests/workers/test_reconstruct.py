"""Inference: padding, encoding round trip, the identity of an untrained network, precision's gate."""

import dataclasses

import numpy as np
import pytest
import torch

from models.network import FusionNet, NetworkConfig
from models.transfer import Transfer
from workers import reconstruct
from workers.query import CHANNELS, NUM_CHANNELS
from workers.reconstruct import GBUFFER_CHANNELS, MAX_COMPILED, MAX_SIZES, Encoding, Reconstructor, pad_to_multiple

CONFIG = NetworkConfig(gbuffer_channels=GBUFFER_CHANNELS, widths=(16, 16, 16), unshuffle=2, residual=True)
ENCODING = Encoding(exposure=0.5, distance_scale=4.0, transfer=Transfer())


@pytest.fixture
def features() -> np.ndarray:
    rng = np.random.default_rng(5)
    frame = rng.random((21, 35, NUM_CHANNELS)).astype(np.float32)
    frame[..., slice(*CHANNELS["ir"])] *= 10.0
    return frame


def working_network() -> FusionNet:
    """One that corrects the imperfect radiance a little."""
    network = FusionNet(CONFIG)
    torch.nn.init.constant_(network.head.bias, 1e-3)
    return network


@pytest.mark.parametrize("curve", ["mu-law", "log1p"])
def test_encoding_round_trips_radiance(features: np.ndarray, curve: str) -> None:
    encoding = Encoding(exposure=0.5, distance_scale=4.0, transfer=Transfer(curve=curve))
    ir, gbuffer = encoding.inputs(torch.from_numpy(features)[None])
    assert gbuffer.shape == (1, GBUFFER_CHANNELS, 21, 35)
    radiance = encoding.radiance(ir)[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(radiance, features[..., :3], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(gbuffer[0, -1].numpy(), features[..., CHANNELS["distance"][0]] / 4.0, rtol=1e-6)
    assert Encoding.from_json(encoding.to_json()) == encoding


def test_untrained_network_returns_the_imperfect_radiance_at_any_size(features: np.ndarray) -> None:
    reconstructor = Reconstructor(FusionNet(CONFIG), ENCODING, precision="fp32")
    assert reconstructor.hands_on
    np.testing.assert_array_equal(reconstructor(features), features[..., :3])
    with torch.inference_mode():  # what is left out would have changed nothing
        frame = reconstructor._fp32(torch.from_numpy(features)).numpy()
    assert frame.shape == (21, 35, 3)
    np.testing.assert_allclose(frame, features[..., :3], rtol=1e-4, atol=1e-5)


def test_network_that_corrects_or_replaces_is_computed(features: np.ndarray) -> None:
    correcting, replacing = FusionNet(CONFIG), FusionNet(dataclasses.replace(CONFIG, residual=False))
    with torch.no_grad():
        correcting.head.bias[0] = 1e-3
        for parameter in replacing.head.parameters():
            parameter.zero_()
    for network in (correcting, replacing):
        reconstructor = Reconstructor(network, ENCODING, precision="fp32")
        assert not reconstructor.hands_on
        assert (reconstructor(features) != features[..., :3]).any()


def test_padding_repeats_the_edge_to_a_multiple() -> None:
    tensor = torch.arange(6.0).reshape(1, 1, 2, 3)
    padded = pad_to_multiple(tensor, 4)
    assert padded.shape == (1, 1, 4, 4)
    assert padded[0, 0, 3, 3] == 5.0
    assert pad_to_multiple(padded, 4) is padded


def test_bf16_is_refused_where_it_would_show(features: np.ndarray) -> None:
    network = FusionNet(CONFIG)
    with torch.no_grad():
        for parameter in network.head.parameters():
            parameter.normal_(0, 30.0)
    reconstructor = Reconstructor(network, ENCODING, precision="bf16")
    reconstructor(features)
    assert reconstructor.choices == {"35x21": "fp32"}


def test_non_finite_input_is_not_hidden(features: np.ndarray) -> None:
    features[4, 4, 0] = np.nan
    frame = Reconstructor(working_network(), ENCODING, precision="fp32")(features)
    assert not np.isfinite(frame).all()


def frame_of(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(7).random((height, width, NUM_CHANNELS)).astype(np.float32)


def test_sizes_are_remembered_up_to_a_bound_and_the_oldest_is_measured_again(monkeypatch: pytest.MonkeyPatch) -> None:
    reconstructor = Reconstructor(working_network(), ENCODING, precision="fp32")
    measured: list[tuple[int, ...]] = []
    choose = reconstructor._choose

    def counted(features: torch.Tensor, before: object) -> object:
        measured.append(tuple(features.shape[:2]))
        return choose(features, before)

    monkeypatch.setattr(reconstructor, "_choose", counted)
    sizes = [(8 + i, 8) for i in range(MAX_SIZES)]
    frames = [reconstructor(frame_of(*size)) for size in sizes]
    reconstructor(frame_of(*sizes[0]))
    assert measured == sizes and len(reconstructor.choices) == MAX_SIZES
    reconstructor(frame_of(8, 40))
    assert len(reconstructor.choices) == MAX_SIZES and reconstructor.choices["40x8"] == "fp32"
    assert "8x8" in reconstructor.choices and "8x9" not in reconstructor.choices, "asked for longest ago"
    np.testing.assert_array_equal(reconstructor(frame_of(*sizes[1])), frames[1])
    assert measured == [*sizes, (8, 40), sizes[1]]


def test_candidates_are_measured_after_what_runs_before_a_frame(
    features: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workers.reconstruct.bf16_is_fast", lambda device: True)
    monkeypatch.setattr(Reconstructor, "_passes_gate", lambda *_: True)
    calls: list[int] = []
    reconstructor = Reconstructor(working_network(), ENCODING, precision="auto")
    reconstructor(features, lambda: calls.append(1))
    assert len(calls) >= 2 * reconstruct.MIN_PROBE_ROUNDS
    measured = len(calls)
    reconstructor(features, lambda: calls.append(1))
    assert len(calls) == measured, "the choice is remembered"


def test_bf16_is_not_tried_where_the_device_does_not_compute_in_it(
    features: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Reconstructor, *_: object) -> bool:
        raise AssertionError("minutes on such a machine")

    monkeypatch.setattr(Reconstructor, "_passes_gate", refuse)
    monkeypatch.setattr("workers.reconstruct.bf16_is_fast", lambda device: False)
    reconstructor = Reconstructor(working_network(), ENCODING, precision="auto")
    reconstructor(features)
    assert set(reconstructor.choices.values()) == {"fp32"}


def test_sizes_share_one_copy_in_bf16() -> None:
    reconstructor = Reconstructor(working_network(), ENCODING, precision="bf16")
    for height in (8, 12, 16):
        reconstructor(frame_of(height, 8))
    assert set(reconstructor.choices.values()) == {"bf16"}
    modules = {id(module) for _, module in reconstructor._chosen.values()}
    assert modules == {id(reconstructor._bf16)}


def test_no_more_sizes_are_compiled_than_torch_should_keep(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[object] = []
    monkeypatch.setattr(reconstruct, "_try_compile", lambda module, features: compiled.append(features.shape))
    reconstructor = Reconstructor(working_network(), ENCODING, precision="fp32", compile=True)
    for extra in range(MAX_COMPILED + 3):
        reconstructor(frame_of(8, 8 + extra))
    assert len(compiled) == len(set(compiled)) == MAX_COMPILED
