"""Any bits at rest: frames, caches and keys with NaN, infinity, subnormals and values beyond a half.

Bounds: 32-bit layers and caches come back bit for bit; a half keeps 2^-11 of the value or 2^-25 (its last subnormal
bit), values beyond 65504 are clamped and counted, NaN and infinity kept and counted.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from storage.caches import ArraySpec, CacheSet
from storage.errors import CanonicalError
from storage.frames import HALF_MAX, decode_frame, encode_frame, health
from storage.keys import canonical_json
from storage.store import Store, UnitRef
from workers.bake import _checked_health
from workers.errors import WorkerError

any_float = st.floats(width=32)
any_layer = arrays(np.float32, (2, 3, 3), elements=any_float)


@given(any_layer)
def test_float_layers_come_back_bit_for_bit(layer: np.ndarray) -> None:
    decoded = decode_frame(encode_frame({"radiance": layer}))["radiance"]
    np.testing.assert_array_equal(decoded.view(np.uint32), layer.view(np.uint32))


@given(any_layer)
def test_half_layers_clamp_and_keep_what_is_not_finite(layer: np.ndarray) -> None:
    decoded = decode_frame(encode_frame({"albedo": layer}))["albedo"]
    finite = np.isfinite(layer)
    np.testing.assert_array_equal(decoded[~finite], layer[~finite])
    assert np.isfinite(decoded[finite]).all(), "no overflow to infinity"
    clamped = np.clip(layer[finite].astype(np.float64), -HALF_MAX, HALF_MAX)
    assert np.all(np.abs(decoded[finite] - clamped) <= np.maximum(2.0**-11 * np.abs(clamped), 2.0**-25))


@given(any_layer)
def test_health_counts_every_value_once(layer: np.ndarray) -> None:
    counts = health({"radiance": layer})["radiance"]
    assert counts["nan"] + counts["inf"] == layer.size - np.isfinite(layer).sum()
    assert counts["over_half"] == (np.abs(layer[np.isfinite(layer)]) > HALF_MAX).sum()


@pytest.mark.parametrize("shape", [(1, 1), (1, 8192), (8192, 1)])
def test_frames_of_any_shape_come_back(shape: tuple[int, int]) -> None:
    layer = np.random.default_rng(0).random((*shape, 3), dtype=np.float32)
    np.testing.assert_array_equal(decode_frame(encode_frame({"radiance": layer}))["radiance"], layer)


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(arrays(np.float32, (3, 2, 3), elements=any_float))
def test_caches_come_back_bit_for_bit(tmp_path: Path, rows: np.ndarray) -> None:
    store = Store.open(tmp_path / "store", create=True)
    ref = UnitRef("a" * 64, "bake", rows.tobytes().hex()[:32])
    caches = CacheSet.create_or_open(store, ref, [ArraySpec("mean", rows.shape, "float32", 3)], {})
    caches.discard_unit(0)
    caches.write_unit(0, {"mean": rows}, {})
    loaded = CacheSet.open(store, ref).load()["mean"]
    np.testing.assert_array_equal(loaded.view(np.uint32), rows.view(np.uint32))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_keys_and_markers_refuse_what_json_cannot_say(bad: float) -> None:
    with pytest.raises(CanonicalError, match="must be finite"):
        canonical_json({"psnr": bad})


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_stray_values_of_a_unit_are_counted_and_many_refused(bad: float) -> None:
    """1 in 10,000: a stray sample is zeroed and counted in the marker, a broken material stops the bake."""

    def rows(count: int) -> dict[str, Any]:
        mean = np.ones((256, 8, 32, 3), np.float32)
        mean.reshape(-1)[:count] = bad
        return {"mean": mean}

    unit = rows(3)
    assert _checked_health("directional", 0, unit) == {"non_finite": 3, "negative": 0}
    assert np.isfinite(unit["mean"]).all() and np.all(unit["mean"].reshape(-1)[:3] == 0.0)
    with pytest.raises(WorkerError, match="must be finite, got 3000 of"):
        _checked_health("directional", 0, rows(3000))
