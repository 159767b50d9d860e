"""Keys are part of the store's format: equal content, equal key, for years."""

import enum
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.errors import CanonicalError
from storage.keys import canonical_json, plain, seed_from_key, unit_key

PARAMS = {
    "spp": 32,
    "scale": 1e-6,
    "size": (256, 128),
    "name": "Küche ☕",
    "nested": {"a": [True, None, 0.5]},
}

PINNED_KEY = "6afbfede750bdbc470db26a4aefe716a"
PINNED_SEED = 1939055770

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


def test_unit_key_is_pinned() -> None:
    # This value may change only together with layout.LAYOUT_VERSION: a change orphans every stored unit.
    assert unit_key("0123abcd", "bake", PARAMS, 1) == PINNED_KEY


def test_seed_from_key_is_pinned() -> None:
    assert seed_from_key(PINNED_KEY) == PINNED_SEED


def test_canonical_json_is_sorted_compact_ascii() -> None:
    name = '"name":"K\\u00fcche \\u2615","nested":{"a":[true,null,0.5]}'
    assert canonical_json(PARAMS) == f'{{{name},"scale":1e-06,"size":[256,128],"spp":32}}'.encode()


@pytest.mark.parametrize(
    ("change", "value"),
    [
        ("spp", 33),
        ("scale", 1.0000000000000002e-6),
        ("size", (128, 256)),
        ("nested", {"a": [True, None, 0.25]}),
    ],
)
def test_unit_key_changes_with_every_parameter(change: str, value: object) -> None:
    assert unit_key("d", "bake", {**PARAMS, change: value}, 1) != unit_key("d", "bake", PARAMS, 1)


def test_unit_key_changes_with_scene_stage_and_schema() -> None:
    keys = {unit_key("d", "bake", {}, 1), unit_key("e", "bake", {}, 1)}
    keys |= {unit_key("d", "render", {}, 1), unit_key("d", "bake", {}, 2)}
    assert len(keys) == 4


@given(json_values)
def test_canonical_json_survives_a_json_round_trip(value: object) -> None:
    assert canonical_json(json.loads(canonical_json(value))) == canonical_json(value)
    assert json.loads(canonical_json(value)) == value


@given(st.dictionaries(st.text(), json_values))
def test_canonical_json_ignores_the_order_of_names(value: dict[str, object]) -> None:
    assert canonical_json(dict(reversed(value.items()))) == canonical_json(value)


@given(st.integers(-(2**53), 2**53))
def test_canonical_json_writes_whole_floats_as_integers(number: int) -> None:
    assert canonical_json(float(number)) == canonical_json(number) == str(number).encode()


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_canonical_json_keeps_floats_exact(number: float) -> None:
    assert float(json.loads(canonical_json(number))) == number


def test_plain_accepts_numpy_scalars_tuples_and_text_enumerations() -> None:
    class Mode(str, enum.Enum):  # noqa: UP042 - both kinds of text enumerations must work
        FAST = "fast"

    value = {"a": np.float32(0.5), "b": np.int64(3), "c": np.bool_(True), "d": (1, 2), "e": Mode.FAST}
    assert canonical_json(value) == b'{"a":0.5,"b":3,"c":true,"d":[1,2],"e":"fast"}'
    assert type(plain(np.bool_(True))) is bool


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, np.float32("nan")])
def test_canonical_json_refuses_what_is_not_finite(value: float) -> None:
    with pytest.raises(CanonicalError, match=r"value\.a\[1\] must be finite"):
        canonical_json({"a": [0, value]})


@pytest.mark.parametrize("value", [{1, 2}, b"bytes", object(), np.zeros(2), {1: 2}, 1j])
def test_canonical_json_refuses_what_json_cannot_say(value: object) -> None:
    with pytest.raises(CanonicalError, match="must be"):
        canonical_json(value)


@given(st.text(), st.text())
def test_seed_is_a_32_bit_number(key: str, purpose: str) -> None:
    assert 0 <= seed_from_key(key, purpose) < 2**32


def test_seed_differs_between_purposes_and_keys() -> None:
    seeds = {seed_from_key(key, purpose) for key in ("a", "b", "ab") for purpose in ("", "a", "b", "ab")}
    assert len(seeds) == 12
