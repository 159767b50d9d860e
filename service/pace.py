"""How fast this process makes frames now, against what the sweep measured.

The sweep's times hold for an idle machine of the same kind. A server learns from its own frames how much longer they
take, and `max_ms` is promised by that: under load it chooses faster points, or refuses, instead of being late.
"""

import math
import time
from collections import deque
from collections.abc import Callable

import numpy as np

KEPT_FRAMES = 32
KEPT_S = 30.0
"""Older frames are forgotten: a scene that was refused while the machine was busy must be tried again."""
FEWEST_FRAMES = 8
"""Fewer tell nothing: one slow frame must not turn requests away."""
SHARE = 0.9
"""Of the recent frames that the slowdown covers."""


class Pace:
    """Recent frames of each scene as ratios of their time over the typical one. Belongs to one event loop.

    Args:
        now: clock, seconds.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._ratios: dict[str, deque[tuple[float, float]]] = {}

    def note(self, digest: str, ratio: float) -> None:
        """Adds a frame of a scene; a ratio that is none (no time was measured) is left out."""
        if math.isfinite(ratio) and ratio > 0:
            self._ratios.setdefault(digest, deque(maxlen=KEPT_FRAMES)).append((self._now(), ratio))

    def slowdown(self, digest: str) -> float:
        """How many times its typical milliseconds a frame of the scene takes now, at least 1."""
        recent = self._ratios.get(digest)
        while recent and self._now() - recent[0][0] > KEPT_S:
            recent.popleft()
        if not recent or len(recent) < FEWEST_FRAMES:
            return 1.0
        return max(1.0, float(np.quantile([ratio for _, ratio in recent], SHARE)))
