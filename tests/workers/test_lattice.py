"""Patch lattices: interpolation is exact for linear functions, stays in its primitive, inverts the layout."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workers.lattice import (
    MAX_LEVEL,
    MAX_PATCHES,
    PATCH_FOOTPRINTS,
    PatchTable,
    build_patch_table,
    locate_patch,
    locate_points,
    patch_counts,
    patch_levels,
    patches_per_prim,
    point_index,
    point_parameters,
)


def make_table(prim_patches: list[int], squares: list[bool], level: int | None, seed: int = 0) -> PatchTable:
    """A table of primitives; `level` None draws one per patch from 0 to 6."""
    m, square = np.array(prim_patches, np.uint32), np.array(squares)
    count = int(patches_per_prim(m, square).sum())
    rng = np.random.default_rng(seed)
    levels = rng.integers(0, 7, count) if level is None else np.full(count, level)
    return build_patch_table(m, levels, square)


def locate(table: PatchTable, prim: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(patch, lattice points [n, 3], weights [n, 3]) of places."""
    cell, b1, b2 = locate_patch(uv[:, 0], uv[:, 1], table.prim_patches[prim], table.prim_is_square[prim])
    patch = table.prim_base[prim].astype(np.int64) + cell
    index, weight = locate_points(b1, b2, table.patch_level[patch])
    return patch, table.patch_base[patch][:, None] + index, weight


def check_interpolation(table: PatchTable, prim: np.ndarray, uv: np.ndarray, tolerance: float) -> None:
    patch, point, weight = locate(table, prim, uv)
    point_prim, point_uv = point_parameters(table)
    assert np.all(weight >= -1e-12) and np.allclose(weight.sum(1), 1, atol=1e-12)
    assert np.all(point >= table.patch_base[patch][:, None]), "a point before its patch"
    assert np.all(point < table.patch_base[patch + 1][:, None]), "a point behind its patch"
    assert np.all(point_prim[point] == prim[:, None])
    mean = np.einsum("ij,ijk->ik", weight, point_uv[point])
    linear = table.patch_level[patch] > 0
    np.testing.assert_allclose(mean[linear], uv[linear], atol=tolerance)


def triangle_uv(rng: np.random.Generator, count: int) -> np.ndarray:
    uv = rng.random((count, 2))
    return np.where(uv.sum(1, keepdims=True) > 1, 1 - uv, uv)


@settings(max_examples=60, deadline=None)
@given(
    shapes=st.lists(st.tuples(st.integers(1, 9), st.booleans()), min_size=1, max_size=5),
    level=st.one_of(st.none(), st.integers(0, 9)),
    seed=st.integers(0, 2**32 - 1),
)
def test_interpolation_reproduces_linear_functions(
    shapes: list[tuple[int, bool]], level: int | None, seed: int
) -> None:
    table = make_table([m for m, _ in shapes], [square for _, square in shapes], level, seed)
    rng = np.random.default_rng(seed)
    prim = rng.integers(0, len(shapes), 200)
    uv = np.where(table.prim_is_square[prim][:, None], rng.random((200, 2)), triangle_uv(rng, 200))
    check_interpolation(table, prim, uv, 1e-9)


@pytest.mark.parametrize("square", [False, True])
@pytest.mark.parametrize("level", [1, 2, 5])
@pytest.mark.parametrize("m", [1, 2, 3, 64])
def test_edges_and_corners_stay_in_their_primitive(m: int, level: int, square: bool) -> None:
    table = make_table([2, m, 2], [False, square, True], level)
    steps = np.arange(m * level + 1) / (m * level)
    u, v = np.meshgrid(steps[:: max(1, len(steps) // 20)], steps[:: max(1, len(steps) // 20)])
    uv = np.column_stack([u.ravel(), v.ravel()])
    on_edge = np.column_stack([steps, 1 - steps])
    uv = np.concatenate([uv if square else uv[uv.sum(1) <= 1], on_edge, [[0, 0], [1, 0], [0, 1]]])
    check_interpolation(table, np.ones(len(uv), np.int64), uv, 1e-9)


def test_single_precision_places_past_the_diagonal_are_clamped() -> None:
    table = make_table([3, 5], [False, False], None)
    t = np.linspace(0, 1, 301)
    uv = np.column_stack([t, 1 - t]) * (1 + 3e-7) + np.array([-1e-7, 1e-7])
    check_interpolation(table, np.ones(len(uv), np.int64), uv, 2e-6)


@pytest.mark.parametrize("square", [False, True])
def test_level_zero_is_one_point_at_the_barycentre(square: bool) -> None:
    table = make_table([3], [square], 0)
    assert table.num_points == table.num_patches == (18 if square else 9)
    _, uv = point_parameters(table)
    patch, point, weight = locate(table, np.zeros(len(uv), np.int64), uv)
    np.testing.assert_array_equal(patch, np.arange(table.num_patches))
    np.testing.assert_array_equal(point[:, 0], np.arange(table.num_points))
    np.testing.assert_array_equal(weight, np.tile([1.0, 0.0, 0.0], (len(uv), 1)))
    assert uv.mean(0) == pytest.approx([0.5, 0.5] if square else [1 / 3, 1 / 3])


@settings(max_examples=40, deadline=None)
@given(m=st.integers(1, 12), level=st.integers(0, 40), square=st.booleans())
def test_points_are_found_where_they_lie(m: int, level: int, square: bool) -> None:
    table = make_table([m], [square], level)
    _, uv = point_parameters(table)
    assert uv.min() >= 0 and uv.max() <= 1 and (square or uv.sum(1).max() <= 1 + 1e-12)
    _, point, weight = locate(table, np.zeros(len(uv), np.int64), uv)
    assert np.all(weight.max(1) > 1 - 1e-6), "a lattice point answers for itself alone"
    nearest = uv[point[np.arange(len(uv)), weight.argmax(1)]]
    np.testing.assert_allclose(nearest, uv, atol=1e-9)


@pytest.mark.parametrize("n", [1, 2, 7, MAX_LEVEL])
def test_point_index_numbers_every_point_once(n: int) -> None:
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
    inside = i + j <= n
    indices = point_index(i[inside], j[inside], np.full(inside.sum(), n))
    np.testing.assert_array_equal(np.sort(indices), np.arange((n + 1) * (n + 2) // 2))


def test_largest_level_keeps_its_layout() -> None:
    table = make_table([1, 1], [False, True], MAX_LEVEL)
    assert table.num_points == 3 * (MAX_LEVEL + 1) * (MAX_LEVEL + 2) // 2
    rng = np.random.default_rng(3)
    check_interpolation(table, np.zeros(500, np.int64), triangle_uv(rng, 500), 1e-9)
    check_interpolation(table, np.ones(500, np.int64), rng.random((500, 2)), 1e-9)


def test_patch_counts_follow_the_size_on_screen() -> None:
    edge = np.array([1.0, PATCH_FOOTPRINTS, PATCH_FOOTPRINTS * 2.5, 1e9, 1.0], np.float32)
    footprint = np.array([1.0, 1.0, 1.0, 1.0, np.inf], np.float32)
    np.testing.assert_array_equal(patch_counts(edge, footprint), [1, 1, 3, MAX_PATCHES, 1])


def test_patch_levels_follow_the_spacing() -> None:
    edge = np.array([8.0, 8.0, 0.1, 1e9, 8.0])
    footprint = np.array([1.0, 0.5, 1.0, 1.0, np.inf])
    np.testing.assert_array_equal(patch_levels(edge, footprint, 2.0), [4, 8, 1, MAX_LEVEL, 0])
