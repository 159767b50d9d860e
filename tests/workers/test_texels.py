"""Packed texels: the stated bound for any finite values, at rest and in the buffer that the query reads."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from workers import texels
from workers.direction_grids import NUM_RUNGS, grid_of
from workers.errors import WorkerError
from workers.texels import DirectionalTexels, Packing, pack, pack_rows, top_exponent, unpack, unpack_rows

magnitudes = st.floats(-45, 38.5).map(lambda exponent: float(np.float32(10.0**exponent)))
radiance = st.one_of(st.just(0.0), magnitudes)
either_sign = st.builds(lambda value, sign: value * sign, radiance, st.sampled_from([-1.0, 1.0]))


def colours(values: st.SearchStrategy[float]) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float32, st.tuples(st.integers(1, 6), st.just(3)), elements=values)


def check_bound(values: np.ndarray, packing: Packing) -> None:
    error = np.abs(unpack(pack(values, packing), packing).astype(np.float64) - values).max(axis=-1)
    largest = np.abs(values).max(axis=-1).astype(np.float64)
    assert np.all(error <= np.maximum(packing.error * largest, 2.0 ** (packing.top - 32 - packing.bits)))


@given(colours(radiance))
def test_error_is_within_a_512th_of_the_largest_channel(values: np.ndarray) -> None:
    packing = Packing(top_exponent(values), signed=False)
    assert packing.error == 2.0**-9
    check_bound(values, packing)


@given(colours(either_sign))
def test_signed_error_is_within_a_256th_of_the_largest_channel(values: np.ndarray) -> None:
    packing = Packing(top_exponent(values), signed=True)
    assert packing.error == 2.0**-8
    check_bound(values, packing)


@given(colours(either_sign), st.booleans())
def test_packing_again_changes_nothing(values: np.ndarray, signed: bool) -> None:
    packing = Packing(top_exponent(values), signed)
    packed = pack(values, packing)
    np.testing.assert_array_equal(pack(unpack(packed, packing), packing), packed)


@given(st.lists(magnitudes, min_size=1, max_size=5), st.booleans())
def test_elements_keep_their_own_range_at_rest(levels: list[float], signed: bool) -> None:
    """1e-8 beside 1e6 (and far beyond): each element has a `top` of its own."""
    pattern = np.random.default_rng(1).random((len(levels), 2, 8, 3))
    values = (pattern * np.array(levels)[:, None, None, None]).astype(np.float32)
    stored = pack_rows(values, signed=signed)
    assert stored["texels"].dtype == np.uint32 and stored["top"].dtype == np.int16
    error = np.abs(unpack_rows(**stored, signed=signed).astype(np.float64) - values)
    bits = Packing(0, signed).bits
    lost = 2.0 ** (texels.LOWEST_TOP - 32 - bits) * 1.001  # near the smallest normal float32 no more is promised
    assert np.all(error.max(-1) <= 2.0**-bits * values.max(-1).astype(np.float64) + lost)


def test_extremes_survive() -> None:
    largest = np.full((1, 1, 1, 3), np.finfo(np.float32).max)
    restored = unpack_rows(**pack_rows(largest, signed=False), signed=False)
    np.testing.assert_allclose(restored, largest, rtol=2.0**-9)
    assert np.isfinite(restored).all()
    black = np.zeros((2, 2, 8, 3), np.float32)
    np.testing.assert_array_equal(unpack_rows(**pack_rows(black, signed=False), signed=False), black)
    firefly = np.float32([[1e8, 1e8, 1e8], [1.0, 0.5, 0.25]])
    check_bound(firefly, Packing(top_exponent(firefly), signed=False))


def test_unsigned_texels_clip_what_is_negative() -> None:
    values = np.float32([[-1.0, 0.5, 2.0]])
    np.testing.assert_array_equal(unpack(pack(values, Packing(2, False)), Packing(2, False)), [[0.0, 0.5, 2.0]])
    np.testing.assert_array_equal(unpack(pack(values, Packing(2, True)), Packing(2, True)), values)


def test_no_values_are_no_texels() -> None:
    assert pack(np.zeros((0, 2, 8, 3), np.float32), Packing(0, False)).shape == (0, 2, 8)


# ------------------------------------------- where grids lie -------------------------------------------

rungs = arrays(np.uint8, st.integers(1, 40), elements=st.integers(0, NUM_RUNGS - 1))


@given(rungs)
def test_locators_lead_to_every_grid_once(rung: np.ndarray) -> None:
    def load(one: int) -> np.ndarray:
        azimuth, polar = grid_of(one)
        slots = np.flatnonzero(rung == one).astype(np.float32)
        return np.broadcast_to(slots[:, None, None, None], (len(slots), polar, azimuth, 3))

    buffer = DirectionalTexels.ladder(rung, load)
    read = np.zeros(len(buffer.values), int)
    for slot, locator in enumerate(buffer.locators()):
        azimuth, polar = grid_of(int(locator & 7))
        first = int(locator >> 3) * texels.TEXELS_PER_BLOCK
        assert np.all(buffer.values[first : first + azimuth * polar] == slot)
        read[first : first + azimuth * polar] += 1
    assert np.all(read == 1)
    for slots, grids in buffer.grids():
        np.testing.assert_array_equal(grids[:, 0, 0, 0], slots)
        np.testing.assert_array_equal(grids[:, -1, -1, 2], slots)


def test_more_texels_than_an_index_tells_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texels, "MAX_TEXELS", 31)
    buffer = DirectionalTexels(np.zeros((32, 3), np.float32), grid_of(0), np.zeros(2, np.uint8))
    with pytest.raises(WorkerError, match="must have at most 31 texels, got 32; lower"):
        buffer.locators()
