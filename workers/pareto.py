"""Which of several measured methods no other one beats."""

from collections.abc import Sequence

import numpy as np

Costs = Sequence[float]


def dominates(a: Costs, b: Costs) -> bool:
    """Whether a is nowhere above b and somewhere below it; lower is better."""
    pairs = list(zip(a, b, strict=True))
    return all(x <= y for x, y in pairs) and any(x < y for x, y in pairs)


def pareto_front(costs: Sequence[Costs]) -> list[bool]:
    """For each method, whether no other one dominates it. Equal methods stand beside each other.

    Args:
        costs: one tuple a method, all of one length; lower is better, NaN never belongs to the front.
    """
    clean = [not np.isnan(cost).any() for cost in costs]
    return [
        clean[i] and not any(clean[j] and dominates(other, own) for j, other in enumerate(costs))
        for i, own in enumerate(costs)
    ]
