"""A scene with other colours, lights and views: what may change, by how much, and from which seed.

A variation is part of a scene's name, so that whatever stores or sends a scene's source (a run's record, a job) names
the variant completely:

    tiny#seed=7,materials=0.6,light=0.5..2,light_colour=0.3,camera=0.1
"""

import hashlib
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from storage.keys import canonical_json, seed_from_key
from workers.errors import WorkerError

VARIATION_VERSION = 1
MARK = "#"
MAX_CAMERA = 0.5
MAX_SEED = 2**32


class VariationError(WorkerError, ValueError):
    """A variation cannot be read, or asks for more than can be changed."""


@dataclass(frozen=True, kw_only=True)
class Variation:
    """How far a scene is varied; the defaults change nothing.

    Attributes:
        seed: what the random draws derive from, uint32; 0 is a seed like any other.
        materials: share of a random colour in every reflectance, 0 to 1.
        light: lowest and highest factor of a light's intensity, each above 0; drawn log-uniformly, for each light.
        light_colour: share of a random colour in every light, 0 to 1; the light's luminance stays.
        camera: how far the scene's views are moved, as a share of the median distance of what they see, 0 to 0.5.

    Raises:
        VariationError: a value outside its range.
    """

    seed: int = 0
    materials: float = 0.0
    light: tuple[float, float] = (1.0, 1.0)
    light_colour: float = 0.0
    camera: float = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or not 0 <= self.seed < MAX_SEED:
            raise VariationError(f"variation seed must be a whole number from 0 to 2^32 - 1, got {self.seed!r}")
        for name, highest in (("materials", 1.0), ("light_colour", 1.0), ("camera", MAX_CAMERA)):
            object.__setattr__(self, name, _number(name, getattr(self, name)))
            if not 0.0 <= getattr(self, name) <= highest:
                raise VariationError(f"variation {name} must lie in 0 to {highest:g}, got {getattr(self, name):g}")
        object.__setattr__(self, "light", _light_range(self.light))

    def __str__(self) -> str:
        """The form that `parse` reads: the seed, then what differs from the defaults."""
        parts = [f"seed={self.seed}"]
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "seed" and value != field.default:
                parts.append(f"{field.name}={_text(value)}")
        return ",".join(parts)

    @classmethod
    def parse(cls, text: str) -> "Variation":
        """Reads "seed=7,materials=0.6,light=0.5..2".

        Raises:
            VariationError: an unknown or repeated name, or a value that is no number.
        """
        values: dict[str, Any] = {}
        known = [field.name for field in fields(cls)]
        for part in text.split(","):
            name, equals, value = (piece.strip() for piece in part.partition("="))
            if not equals or name not in known or name in values:
                raise VariationError(f"variation must give each of {', '.join(known)} at most once, got {part!r}")
            values[name] = _parsed(name, value)
        return cls(**values)

    @property
    def changes_something(self) -> bool:
        return self != Variation(seed=self.seed)

    @property
    def tag(self) -> str:
        """Six hex digits that tell variants of a scene apart in names."""
        return hashlib.sha256(str(self).encode()).hexdigest()[:6]

    def to_json(self) -> dict[str, Any]:
        return {"seed": self.seed, "materials": self.materials, "light": list(self.light),
                "light_colour": self.light_colour, "camera": self.camera}  # fmt: skip

    def random(self, *purpose: str) -> np.random.Generator:
        """The generator of one draw; it depends on the seed and on what is drawn, never on an order."""
        key = canonical_json([VARIATION_VERSION, self.seed, *purpose]).decode("ascii")
        return np.random.default_rng([seed_from_key(key, "low"), seed_from_key(key, "high")])


def split_source(source: str | Path) -> tuple[str, Variation | None]:
    """A scene's source as (file or built-in name, variation); a file whose own name holds a "#" stays whole.

    Raises:
        VariationError: what follows the "#" is no variation.
    """
    text = str(source)
    base, mark, tail = text.rpartition(MARK)
    if not mark or "=" not in tail or Path(text).exists():
        return text, None
    return base, Variation.parse(tail)


def join_source(source: str, variation: Variation | None) -> str:
    """Inverse of `split_source`; a variation that changes nothing is left out."""
    return source if variation is None or not variation.changes_something else f"{source}{MARK}{variation}"


def _text(value: Any) -> str:
    return f"{value[0]!r}..{value[1]!r}" if isinstance(value, tuple) else repr(value)


def _parsed(name: str, value: str) -> Any:
    try:
        if name == "seed":
            return int(value)
        if name == "light":
            low, dots, high = value.partition("..")
            return (float(low), float(high if dots else low))
        return float(value)
    except ValueError:
        raise VariationError(f"variation {name} must be a number, got {value!r}") from None


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise VariationError(f"variation {name} must be a finite number, got {value!r}")
    return float(value)


def _light_range(value: Any) -> tuple[float, float]:
    pair = (value, value) if isinstance(value, int | float) else tuple(value)
    if len(pair) != 2:
        raise VariationError(f"variation light must be a factor or a lowest and a highest one, got {value!r}")
    low, high = (_number("light", item) for item in pair)
    if not 0.0 < low <= high:
        raise VariationError(f"variation light must be above 0 and not fall, got {low:g}..{high:g}")
    return low, high
