"""Fronts against their definition."""

import math

from hypothesis import given
from hypothesis import strategies as st

from workers.pareto import dominates, pareto_front

COSTS = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=12)


def test_front_of_a_staircase() -> None:
    assert pareto_front([(1, 3), (2, 2), (3, 1), (3, 3), (2, 2.5)]) == [True, True, True, False, False]


def test_equal_methods_stand_beside_each_other() -> None:
    assert pareto_front([(1, 1), (1, 1)]) == [True, True]


def test_nan_is_never_on_the_front_and_beats_nobody() -> None:
    assert pareto_front([(math.nan, 0.0), (1.0, 1.0)]) == [False, True]


@given(COSTS)
def test_whoever_is_off_the_front_is_dominated_by_one_on_it(costs: list[tuple[int, int]]) -> None:
    front = pareto_front(costs)
    kept = [cost for cost, is_kept in zip(costs, front, strict=True) if is_kept]
    for cost, is_kept in zip(costs, front, strict=True):
        assert is_kept != any(dominates(other, cost) for other in kept)
