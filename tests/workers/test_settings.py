"""Settings: presets, overrides by dotted key, one-line errors, JSON round trip."""

import dataclasses
import json
import re
import typing
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from workers.errors import WorkerError
from workers.setting_values import RANGES
from workers.settings import PRESETS, Settings, SettingsError


@pytest.mark.parametrize("name", PRESETS)
def test_preset_survives_json(name: str) -> None:
    settings = Settings.preset_named(name)
    assert settings.preset == name
    assert Settings.from_json(json.loads(json.dumps(settings.to_json()))) == settings


def test_presets_differ_and_grow() -> None:
    elements = [Settings.preset_named(name).cache.max_elements for name in ("draft", "balanced", "reference")]
    assert elements == sorted(set(elements))


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("width", "640", 640),
        ("cache.diffuse_spp", "256", 256),
        ("cache.demodulate", "no", False),
        ("cache.demodulate", True, True),
        ("cache.lobes", "exitant", "exitant"),
        ("cache.min_spacing_px", "0.5", 0.5),
        ("cache.min_spacing_px", 2, 2.0),
        ("train.widths", "8,16,24", (8, 16, 24)),
        ("train.widths", [8, 16, 24], (8, 16, 24)),
        ("evaluation.qualities", "fast,high", ("fast", "high")),
        ("train.seconds", "0", 0.0),
        ("cache.diffuse_spp", 8.0, 8),
        ("cache.diffuse_spp", "8.0", 8),
        ("cache.diffuse_spp", np.int64(8), 8),
        ("cache.min_spacing_px", np.float32(0.5), 0.5),
        ("evaluation.spp", "1,4.0", (1, 4)),
    ],
)
def test_override_sets_one_value(key: str, value: Any, expected: Any) -> None:
    before = Settings.preset_named("tiny")
    after = before.override({key: value})
    node: Any = after
    for name in key.split("."):
        node = getattr(node, name)
    assert node == expected and type(node) is type(expected)
    parts, changed = before.to_json(), after.to_json()
    *folders, leaf = key.split(".")
    for folder in folders:
        parts, changed = parts[folder], changed[folder]
    changed[leaf] = parts[leaf]
    assert changed == parts, "nothing else moved"


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("cache.bogus", 1, "max_elements"),
        ("bogus", 1, "width"),
        ("", 1, "width"),
        ("cache", 1, "cache.<name>"),
        ("width.x", 1, "width"),
        ("cache.lobes", "glossy", "split, exitant"),
        ("cache.diffuse_spp", "many", "must be a whole number, got 'many'"),
        ("cache.diffuse_spp", "1.5", "must be a whole number, got '1.5'"),
        ("cache.diffuse_spp", 1.7, "must be a whole number, got 1.7"),
        ("cache.diffuse_spp", True, "must be a whole number, got True"),
        ("cache.diffuse_spp", float("nan"), "must be a whole number, got nan"),
        ("cache.diffuse_spp", float("inf"), "must be a whole number, got inf"),
        ("cache.diffuse_spp", "1" + "0" * 400, "must be 1 to 16,777,216"),
        ("cache.diffuse_spp", None, "must be a whole number, got None"),
        ("cache.diffuse_spp", 0, "must be 1 to 16,777,216, got 0"),
        ("cache.diffuse_spp", "-4", "must be 1 to 16,777,216, got -4"),
        ("cache.min_spacing_px", "nan", "must be 0.001 to 10,000, got nan"),
        ("cache.min_spacing_px", True, "must be a number, got True"),
        ("cache.min_spacing_px", 10**400, "must be a number"),
        ("train.seconds", -1, "must be 0 to 31,536,000, got -1.0"),
        ("train.seconds", float("nan"), "must be 0 to 31,536,000, got nan"),
        ("train.seconds", [], "must be a number, got []"),
        ("evaluation.spp", "1,2.5", "must be a list, each entry a whole number"),
        ("evaluation.spp", (4, 0), "must be a list, each entry 1 to 16,777,216"),
        ("evaluation.spp", 4, "must be a list, got 4"),
        ("evaluation.qualities", [1], "must be a list, each entry text"),
        ("preset", None, "must be text, got None"),
        ("cache.demodulate", "perhaps", "true or false"),
        ("query.samples", 5, "1 to 4"),
        ("train.unshuffle", 3, "1, 2 or 4"),
        ("train.widths", "8,16", "three"),
        ("train.widths", "8,x,16", "train.widths"),
    ],
)
def test_bad_override_is_one_line_that_says_the_rule(key: str, value: Any, says: str) -> None:
    with pytest.raises(SettingsError) as caught:
        Settings().override({key: value})
    message = str(caught.value)
    assert "\n" not in message and says in message and "must" in message and repr(key) in message
    assert isinstance(caught.value, WorkerError) and isinstance(caught.value, ValueError)


def _numeric_settings() -> dict[str, type]:
    """Type of every setting that is a number or a list of them, by dotted key."""
    found = {}
    for section in (None, *(f.name for f in dataclasses.fields(Settings) if dataclasses.is_dataclass(f.type))):
        owner = Settings if section is None else type(getattr(Settings(), section))
        for name, kind in typing.get_type_hints(owner).items():
            entry = typing.get_args(kind)[0] if typing.get_origin(kind) is tuple else kind
            if entry in (int, float):
                found[name if section is None else f"{section}.{name}"] = entry
    return found


def test_every_numeric_setting_has_a_range_and_no_range_is_of_nothing() -> None:
    assert _numeric_settings().keys() == RANGES.keys()


@pytest.mark.parametrize("key", RANGES)
def test_range_holds_its_ends_and_refuses_what_lies_beyond(key: str) -> None:
    low, high = RANGES[key]
    step = 1 if _numeric_settings()[key] is int else high * 1e-6
    many = {"train.widths": 3, "evaluation.spp": 1}.get(key)

    def override(value: float) -> Settings:
        return Settings().override({key: value if many is None else [value] * many})

    assert override(low) != override(high)
    for value in (low - step, high + step):
        with pytest.raises(SettingsError, match=re.escape(f"{low:,} to {high:,}, got")):
            override(value)


@given(st.floats() | st.integers() | st.booleans() | st.text(max_size=8) | st.none())
def test_whole_number_is_never_rounded(value: Any) -> None:
    try:
        taken = Settings().override({"cache.diffuse_spp": value}).cache.diffuse_spp
    except SettingsError:
        return
    assert type(taken) is int and not isinstance(value, bool) and taken == float(value)


def test_unknown_preset_names_the_known_ones() -> None:
    with pytest.raises(SettingsError, match="draft, balanced, reference"):
        Settings.preset_named("best")


@given(st.integers(1, 10**6), st.floats(0.01, 100), st.booleans(), st.sampled_from(["split", "exitant"]))
def test_override_as_text_equals_override_as_value(spp: int, spacing: float, flag: bool, lobes: str) -> None:
    values = {
        "cache.diffuse_spp": spp,
        "cache.min_spacing_px": spacing,
        "cache.demodulate": flag,
        "cache.lobes": lobes,
    }
    text = {key: str(value) for key, value in values.items()}
    assert Settings().override(values) == Settings().override(text)


@pytest.mark.parametrize("value", [{"cahce": {"polar": 3}}, {"cache": {"polr": 3}}, {"cache": 3}, {"width": {"a": 1}},
                                   {"train": {"learning_rate": float("inf")}}, {"width": None}, []])  # fmt: skip
def test_from_json_refuses_what_does_not_fit(value: Any) -> None:
    with pytest.raises(SettingsError, match="must"):
        Settings.from_json(value)
