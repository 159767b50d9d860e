"""Cameras that differ from each other: no two requests of a load test may share a frame by accident."""

import math
from collections.abc import Iterator
from typing import Any

FOV_DEG = 50.0
GOLDEN = (math.sqrt(5) - 1) / 2


def poses(first: int, stride: int) -> Iterator[dict[str, Any]]:
    """Request bodies without a size: views from the front of either scene, each another one.

    Args:
        first, stride: number of the first pose, and from one to the next.
    """
    number = first
    while True:
        u, v = (number * GOLDEN) % 1.0, (number * GOLDEN * GOLDEN * 7) % 1.0
        origin = [0.8 * (u - 0.5), 0.9 + 0.4 * v, 1.75 - 0.2 * u * v]
        yield {"camera": {"look_at": {"origin": origin, "target": [0.0, 0.6, 0.0]}}, "fov_deg": FOV_DEG}
        number += stride
