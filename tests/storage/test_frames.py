"""Frames: exact round trips, clamped halves that are counted, and damage that is found."""

import io

import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from storage.errors import FrameError
from storage.frames import FEATURES, HALF_MAX, decode_frame, encode_frame, health

SIZE = (5, 7)


def random_layer(channels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(*SIZE, channels)).astype(np.float32)


def all_layers() -> dict[str, np.ndarray]:
    return {name: random_layer(len(feature.channels), i) for i, (name, feature) in enumerate(FEATURES.items())}


def test_every_layer_round_trips_at_its_own_precision() -> None:
    layers = all_layers()
    decoded = decode_frame(encode_frame(layers))
    assert list(decoded) == list(layers)
    for name, layer in layers.items():
        expected = layer if FEATURES[name].dtype == "float" else layer.astype(np.float16).astype(np.float32)
        np.testing.assert_array_equal(decoded[name], expected, strict=True)


def test_radiance_and_position_are_floats() -> None:
    assert {FEATURES[name].dtype for name in ("radiance", "ir", "position", "distance")} == {"float"}
    assert {FEATURES[name].dtype for name in ("normal", "albedo", "coverage")} == {"half"}


def test_parts_and_channels_carry_the_names_of_the_denoiser() -> None:
    data = encode_frame({name: random_layer(3) for name in ("radiance", "albedo", "normal")})
    parts = OpenEXR.File(io.BytesIO(data), separate_channels=True).parts
    assert {part.name(): set(part.channels) for part in parts} == {
        "hdr": {"hdr.R", "hdr.G", "hdr.B"},
        "alb": {"alb.R", "alb.G", "alb.B"},
        "nrm": {"nrm.X", "nrm.Y", "nrm.Z"},
    }
    assert {part.compression() for part in parts} == {OpenEXR.ZIP_COMPRESSION}
    assert parts[1].channels["alb.R"].pixels.dtype == np.float16


def test_table_has_no_part_twice() -> None:
    assert len({feature.part for feature in FEATURES.values()}) == len(FEATURES)


@pytest.mark.parametrize("channels", [1, 3, 12, 101])
def test_unknown_layers_keep_their_channels_in_order(channels: int) -> None:
    layer = random_layer(channels) * np.float32(1e9)
    decoded = decode_frame(encode_frame({"Küche ☕.x": layer}))
    np.testing.assert_array_equal(decoded["Küche ☕.x"], layer, strict=True)


@given(hnp.arrays(np.float32, (2, 3, 3), elements=st.floats(width=32)))
def test_float_layers_keep_every_bit_pattern_of_value(layer: np.ndarray) -> None:
    decoded = decode_frame(encode_frame({"radiance": layer}))["radiance"]
    np.testing.assert_array_equal(decoded, layer, strict=True)


@given(hnp.arrays(np.float32, (2, 3, 3), elements=st.floats(width=32)))
def test_half_layers_clamp_exactly_what_health_counts(layer: np.ndarray) -> None:
    decoded = decode_frame(encode_frame({"albedo": layer}))["albedo"]
    over = np.isfinite(layer) & (np.abs(layer) > HALF_MAX)
    assert int(over.sum()) == health({"albedo": layer})["albedo"]["over_half"]
    np.testing.assert_array_equal(decoded[over], np.sign(layer[over]) * np.float32(HALF_MAX))
    np.testing.assert_array_equal(decoded[~over], layer[~over].astype(np.float16).astype(np.float32))


def test_nan_and_infinity_are_stored_as_such() -> None:
    layer = np.array([[[np.nan, np.inf, -np.inf], [7e4, -7e4, 1]]], np.float32)
    for name in ("radiance", "albedo"):
        decoded = decode_frame(encode_frame({name: layer}))[name]
        np.testing.assert_array_equal(decoded[0, 0], layer[0, 0])
    np.testing.assert_array_equal(decoded[0, 1], [65504, -65504, 1])


def test_health_counts_each_kind() -> None:
    layer = np.array([[[np.nan, np.inf, -np.inf], [7e4, -7e4, -1], [0, -0.0, 65504]]], np.float32)
    assert health({"radiance": layer, "albedo": layer[:, 2:]}) == {
        "radiance": {"nan": 1, "inf": 2, "negative": 3, "over_half": 2},
        "albedo": {"nan": 0, "inf": 0, "negative": 0, "over_half": 0},
    }


def test_strided_layers_are_stored_as_seen() -> None:
    layer = random_layer(6)[::-1, :, ::2]
    np.testing.assert_array_equal(decode_frame(encode_frame({"ir": layer}))["ir"], layer)


@pytest.mark.parametrize(
    "layers",
    [
        {},
        {"radiance": np.zeros((4, 4), np.float32)},
        {"radiance": np.zeros((4, 4, 3), np.float64)},
        {"radiance": np.zeros((4, 4, 1), np.float32)},
        {"radiance": np.zeros((0, 4, 3), np.float32)},
        {"radiance": np.zeros((4, 4, 3), np.float32), "albedo": np.zeros((4, 5, 3), np.float32)},
        {"hdr": np.zeros((4, 4, 3), np.float32)},
        {"": np.zeros((4, 4, 3), np.float32)},
        {"☕" * 67: np.zeros((4, 4, 3), np.float32)},
    ],
)
def test_encode_refuses_layers_that_do_not_fit(layers: dict[str, np.ndarray]) -> None:
    with pytest.raises(FrameError, match="must"):
        encode_frame(layers)


def test_damaged_bytes_never_become_another_frame(capfd: pytest.CaptureFixture[str]) -> None:
    # The library itself only prints a warning, and drops parts or returns pixels that it has not read.
    layers = {"radiance": random_layer(3), "ir": random_layer(3, seed=1)}
    data = encode_frame(layers)
    refused = 0
    for position in range(len(data) // 2, len(data), 5):
        flipped = data[:position] + bytes([data[position] ^ 4]) + data[position + 1 :]
        for damaged in (flipped, data[:position]):
            try:
                decoded = decode_frame(damaged)
            except FrameError:
                refused += 1
                continue
            assert decoded.keys() == layers.keys()
            for name, layer in layers.items():
                np.testing.assert_array_equal(decoded[name], layer)
    assert refused > len(data) // 10


@pytest.mark.parametrize("data", [b"", b"no frame at all", b"v/1\x01\x02\x00\x00\x00"])
def test_decode_refuses_what_is_no_frame(data: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(FrameError, match="must"):
        decode_frame(data)


def test_decode_refuses_an_image_of_another_program() -> None:
    stream = io.BytesIO()
    channels = {"R": np.zeros((2, 2), np.float32)}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(stream)
    with pytest.raises(FrameError, match="lightwellLayer"):
        decode_frame(stream.getvalue())
