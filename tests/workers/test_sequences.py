"""Points of a bake's first vertex: stratified alone and together, independent of each other."""

import numpy as np
import pytest

from workers.backend import mi
from workers.sequences import PaddedPoints, nested_uniform_scramble

COUNT = 256


def pairs(first: int, count: int, seed: int, asked: int) -> np.ndarray:
    """The points of one of the sequences, [count, 2]."""
    points = PaddedPoints(mi.UInt32(np.arange(first, first + count, dtype=np.uint32)), mi.UInt32(seed))
    for _ in range(asked):
        points.next_2d()
    return np.array(points.next_2d()).T


def test_scramble_permutes_and_keeps_blocks_together() -> None:
    value = mi.UInt32(np.arange(COUNT, dtype=np.uint32))
    scrambled = nested_uniform_scramble(value, mi.UInt32(12345)).numpy().astype(np.int64)
    assert len(np.unique(scrambled)) == COUNT
    for size in (2, 8, 64):
        blocks = scrambled.reshape(-1, size) // size
        assert np.all(blocks == blocks[:, :1])


@pytest.mark.parametrize("seed", [0, 1, 77])
@pytest.mark.parametrize("asked", [0, 3])
@pytest.mark.parametrize(("first", "count"), [(0, 8), (8, 8), (64, 64), (0, 256)])
def test_each_aligned_run_fills_every_elementary_interval_once(first: int, count: int, seed: int, asked: int) -> None:
    found = pairs(first, count, seed, asked)
    assert found.min() >= 0 and found.max() < 1
    columns = 1
    while columns <= count:
        cell = np.floor(found * (columns, count // columns)).astype(int)
        assert len(np.unique(cell, axis=0)) == count
        columns *= 2


def test_sequences_and_seeds_are_independent() -> None:
    one, other, elsewhere = pairs(0, 4096, 5, 0), pairs(0, 4096, 5, 1), pairs(0, 4096, 6, 0)
    for a, b in ((one, other), (one, elsewhere)):
        correlation = np.corrcoef(a.T, b.T)[:2, 2:]
        assert np.abs(correlation).max() < 4 / np.sqrt(4096)


def test_one_number_is_stratified_too() -> None:
    points = PaddedPoints(mi.UInt32(np.arange(16, dtype=np.uint32)), mi.UInt32(3))
    assert sorted(np.floor(points.next_1d().numpy() * 16).astype(int)) == list(range(16))
