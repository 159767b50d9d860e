"""Content addresses: canonical JSON, the key of a unit and the seeds that derive from it.

Two runs that mean the same thing must meet at the same key, on any machine and in any year, so the canonical
form is part of the store's format: changing it orphans every unit already stored (a test pins one key).
"""

import hashlib
import json
import math
import numbers
from collections.abc import Mapping
from typing import Any

import numpy as np

from storage.errors import CanonicalError

KEY_LENGTH = 32  # hex digits: 128 bits, so a clash among 10^9 units has a chance below 10^-20
_LARGEST_EXACT_INT = 2**53  # up to here every integer is a float64 too


def plain(value: Any, where: str = "value") -> Any:
    """Reduces a value to what JSON can say, in one form only.

    Tuples become lists, numpy scalars Python numbers. A float without a fraction becomes an integer, so a 45
    from a YAML file and a 45.0 from a flag are one value, and so are 0.0 and -0.0.

    Args:
        value: None, bool, int, float, str, or lists, tuples and string-keyed mappings of these.
        where: name of the value, for the error message.

    Returns:
        The same content as None, bool, int, float, str, list and dict.

    Raises:
        CanonicalError: NaN, infinity, a key that is no string, or any other type.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return str.__str__(value)  # the text itself, also of an enumeration
    if isinstance(value, numbers.Integral):
        return int(value)
    if isinstance(value, numbers.Real):
        return _plain_float(float(value), where)
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{where}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, Mapping):
        return {_plain_name(name, where): plain(item, f"{where}.{name}") for name, item in value.items()}
    raise CanonicalError(
        f"{where} must be None, a bool, number, string, list or mapping, got {type(value).__name__}; "
        "convert it first (dataclasses.asdict, str(path), sorted(set), array.tolist())"
    )


def _plain_float(value: float, where: str) -> int | float:
    if not math.isfinite(value):
        raise CanonicalError(f"{where} must be finite, got {value}; store the count of such values, or None")
    return int(value) if value.is_integer() and abs(value) <= _LARGEST_EXACT_INT else value


def _plain_name(name: Any, where: str) -> str:
    if not isinstance(name, str):
        raise CanonicalError(f"names in {where} must be strings, got {name!r}; use str(name)")
    return str.__str__(name)


def canonical_json(obj: Any) -> bytes:
    """Writes a value as JSON with sorted names, no spaces, ASCII only and the shortest exact floats.

    Raises:
        CanonicalError: the value has no such form, see `plain`.
    """
    return json.dumps(plain(obj), sort_keys=True, separators=(",", ":"), allow_nan=False).encode("ascii")


def unit_key(scene_digest: str, stage: str, params: Mapping[str, Any], schema_version: int) -> str:
    """Hashes everything that determines a unit's bytes.

    Args:
        scene_digest: digest of the scene's own content.
        stage: name of the stage that makes the unit.
        params: every parameter that changes the bytes; nothing that does not (thread counts, paths).
        schema_version: of the stage's code; raise it when the same parameters give other bytes.

    Returns:
        The key: 32 hex digits.

    Raises:
        CanonicalError: a parameter has no canonical form.
    """
    content = {"params": params, "scene": scene_digest, "schema": schema_version, "stage": stage}
    return hashlib.sha256(canonical_json(content)).hexdigest()[:KEY_LENGTH]


def seed_from_key(key: str, purpose: str = "") -> int:
    """Derives a seed in [0, 2**32) from a key, another one for each purpose. 0 is a seed like any other."""
    digest = hashlib.sha256(canonical_json([key, purpose])).digest()
    return int.from_bytes(digest[:4], "big")
