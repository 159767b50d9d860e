"""Settings: presets, overrides by dotted key, one-line errors, JSON round trip."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from workers.errors import WorkerError
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
        ("cache.diffuse_spp", "many", "int"),
        ("cache.diffuse_spp", "1.5", "int"),
        ("cache.diffuse_spp", None, "int"),
        ("cache.diffuse_spp", 0, "above 0"),
        ("cache.diffuse_spp", "-4", "above 0"),
        ("cache.min_spacing_px", "nan", "above 0"),
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
