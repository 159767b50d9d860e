"""One setting's value: from text, JSON or Python to the field's own type, and the range that it must lie in."""

import numbers
import typing
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal

_MOST_SPP = 2**24
_MOST_PX = 16_384

RANGES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "width": (1, _MOST_PX),
        "height": (1, _MOST_PX),
        "cache.max_elements": (1, 2**28),
        "cache.min_spacing_px": (0.001, 10_000),
        "cache.domain_poses": (1, 100_000),
        "cache.diffuse_spp": (1, _MOST_SPP),
        "cache.azimuth": (1, 4096),
        "cache.polar": (1, 4096),
        "cache.directional_spp": (1, _MOST_SPP),
        "cache.passes": (1, 65_536),
        "cache.elements_per_unit": (1, 2**20),
        "cache.max_edge_fraction": (0, 1),
        "query.samples": (1, 4),
        "query.max_chain": (0, 1024),
        "frames.num_train": (1, 1_000_000),
        "frames.num_validation": (1, 1_000_000),
        "frames.num_test": (1, 1_000_000),
        "frames.train_spp": (1, _MOST_SPP),
        "frames.test_spp": (1, _MOST_SPP),
        "frames.reference_floor_db": (0, 200),
        "frames.passes": (1, 65_536),
        "train.widths": (1, 4096),
        "train.unshuffle": (1, 4),
        "train.l1_weight": (0, 1_000_000),
        "train.perceptual_weight": (0, 1_000_000),
        "train.gradient_weight": (0, 1_000_000),
        "train.perceptual_every": (1, 1_000_000),
        "train.epochs": (0, 1_000_000),
        "train.seconds": (0, 31_536_000),  # a year
        "train.batch": (1, 65_536),
        "train.crop": (1, _MOST_PX),
        "train.learning_rate": (1e-9, 10),
        "train.clip_norm": (1e-6, 1_000_000),
        "train.clip_quantile": (0, 1),
        "train.negative_slope": (0, 0.99),
        "evaluation.spp": (1, _MOST_SPP),
        "evaluation.timing_repeats": (1, 100_000),
        "plan.noise": (1e-4, 10.0),
    }
)
"""Smallest and largest value of every numeric setting, both allowed; of each entry where the setting is a list."""


def converted(value: Any, kind: Any) -> Any:
    """The value as a field of this type holds it; nothing is rounded.

    Args:
        value: text (a command line's), JSON or Python.
        kind: bool, int, float, str, a Literal of texts, or a tuple of one of them.

    Raises:
        ValueError: it does not fit; the message is the rule, "a whole number".
    """
    origin = typing.get_origin(kind)
    if origin is Literal:
        choices = typing.get_args(kind)
        if value not in choices:
            raise ValueError(f"one of {', '.join(map(str, choices))}")
        return value
    if origin is tuple:
        items = value.split(",") if isinstance(value, str) else value
        if not isinstance(items, list | tuple):
            raise ValueError("a list")
        try:
            return tuple(converted(item, typing.get_args(kind)[0]) for item in items)
        except ValueError as error:
            raise ValueError(f"a list, each entry {error}") from error
    return _CONVERSIONS[kind](value)


def out_of_range(key: str, value: Any) -> str | None:
    """The rule that a setting's converted value breaks, "1 to 4"; None where it lies in its range."""
    if key not in RANGES:
        return None
    low, high = RANGES[key]
    if isinstance(value, tuple):
        return None if all(low <= item <= high for item in value) else f"a list, each entry {low:,} to {high:,}"
    return None if low <= value <= high else f"{low:,} to {high:,}"


def _whole_number(value: Any) -> int:
    """8, 8.0, "8" and "8.0", but neither 1.7 nor True."""
    rule = "a whole number"
    if isinstance(value, str):
        try:
            return int(value)
        except ValueError:
            value = _number(value, rule)
    if isinstance(value, numbers.Integral) and not isinstance(value, bool):
        return int(value)
    if not isinstance(value, float) or not value.is_integer():
        raise ValueError(rule)
    return int(value)


def _number(value: Any, rule: str = "a number") -> float:
    if isinstance(value, bool) or not isinstance(value, str | numbers.Real):
        raise ValueError(rule)
    try:
        return float(value)
    except (ValueError, OverflowError) as error:
        raise ValueError(rule) from error


def _boolean(value: Any) -> bool:
    if isinstance(value, bool):
        return value
    words = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}
    if str(value).lower() not in words:
        raise ValueError("true or false")
    return words[str(value).lower()]


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("text")
    return value


_CONVERSIONS: Mapping[type, Callable[[Any], Any]] = MappingProxyType(
    {bool: _boolean, int: _whole_number, float: _number, str: _text}
)
