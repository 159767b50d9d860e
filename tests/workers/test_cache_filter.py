"""The cache filter removes noise, keeps what stands out of it, and never crosses shapes, sides or corners."""

import dataclasses

import numpy as np
import pytest

from workers import directional_filter
from workers.cache_filter import filter_diffuse
from workers.directional_filter import filter_directional
from workers.elements import ElementSet
from workers.lattice import build_patch_table

SIDE = 24


@pytest.fixture
def plane() -> ElementSet:
    """A flat grid of elements in one shape."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    position = np.stack([x.ravel(), y.ravel(), np.zeros(SIDE * SIDE)], -1).astype(np.float32)
    n = len(position)
    patches = build_patch_table(np.ones(1, np.uint32), np.zeros(1, np.uint32), np.zeros(1, bool))
    return ElementSet(
        patches=patches,
        shape=np.zeros(n, np.int64),
        prim_local=np.zeros(n, np.int64),
        uv=np.zeros((n, 2), np.float32),
        side=np.zeros(n, np.uint8),
        position=position,
        normal=np.tile(np.float32([0, 0, 1]), (n, 1)),
        glossy=np.arange(n),
        spread=np.full(n, np.inf, np.float32),
        diffuse_slot=np.zeros(2, np.uint32),
        glossy_slot=np.zeros(2, np.uint32),
        spacing_px=1.0,
    )


def test_filter_keeps_a_constant(plane: ElementSet) -> None:
    value = np.full((plane.num_elements, 3), 0.7, np.float32)
    error = np.full_like(value, 0.1)
    np.testing.assert_allclose(filter_diffuse(plane, value, error), value, rtol=1e-6)
    grid = np.full((plane.num_elements, 2, 3, 3), 0.4, np.float32)
    np.testing.assert_allclose(filter_directional(plane, grid), grid, rtol=1e-5)


def test_filter_removes_most_noise_of_a_flat_field(plane: ElementSet) -> None:
    rng = np.random.default_rng(3)
    sigma = 0.2
    noisy = (1.0 + sigma * rng.normal(size=(plane.num_elements, 3))).astype(np.float32)
    filtered = filter_diffuse(plane, noisy, np.full_like(noisy, sigma))
    assert filtered.std() < 0.6 * sigma
    assert abs(filtered.mean() - 1.0) < 0.03


def test_filter_keeps_an_edge_that_stands_out_of_the_noise(plane: ElementSet) -> None:
    lit = plane.position[:, 0] >= SIDE // 2
    value = np.where(lit[:, None], 1.0, 0.1).astype(np.float32).repeat(3, axis=1)
    kept = filter_diffuse(plane, value, np.full_like(value, 0.02))
    np.testing.assert_allclose(kept, value, atol=0.01)
    blurred = filter_diffuse(plane, value, np.full_like(value, 5.0))
    assert np.abs(blurred - value).max() > 0.1


@pytest.mark.parametrize("attribute", ["shape", "side", "normal"])
def test_filter_never_mixes_other_surfaces(plane: ElementSet, attribute: str) -> None:
    other = plane.position[:, 0] >= SIDE // 2
    changed = getattr(plane, attribute).copy()
    changed[other] = np.float32([1, 0, 0]) if attribute == "normal" else 1
    apart = dataclasses.replace(plane, **{attribute: changed})
    value = np.where(other[:, None], 1.0, 0.0).astype(np.float32).repeat(3, axis=1)
    filtered = filter_diffuse(apart, value, np.full_like(value, 100.0))
    np.testing.assert_allclose(filtered, value, atol=1e-6)
    np.testing.assert_allclose(filter_directional(apart, value[:, None, None, :])[:, 0, 0], value, atol=1e-6)


def noisy_grids(elements: ElementSet, sigma: float, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (1 + sigma * rng.normal(size=(elements.num_elements, 4, 8, 1)) * np.ones(3)).astype(np.float32)


def test_directional_filter_removes_nearly_all_noise_of_a_flat_field(plane: ElementSet) -> None:
    filtered = filter_directional(plane, noisy_grids(plane, 0.5))
    assert filtered.std() < 0.5 / 8
    assert abs(filtered.mean() - 1.0) < 0.01


def test_directional_filter_keeps_a_reflection_s_edge(plane: ElementSet) -> None:
    """In half of the directions a light is seen from one half of the plane alone; the noise is a tenth of it."""
    lit = np.zeros((plane.num_elements, 4, 8, 1), np.float32)
    lit[plane.position[:, 0] >= SIDE // 2, :, :4] = 10.0
    filtered = filter_directional(plane, noisy_grids(plane, 1.0) + lit)
    error = np.abs(filtered - 1 - lit)
    away = np.abs(plane.position[:, 0] - SIDE / 2 + 0.5) > 2
    assert error[away].max() < 1.5 and np.sqrt(np.mean(error[away] ** 2)) < 0.25
    near = filtered[~away].reshape(-1, 4, 8, 3)[:, :, 1:3].mean()
    assert 4.5 < near < 7.5  # on both sides of the edge together: nothing is lost


def test_directional_filter_shares_out_a_firefly(plane: ElementSet) -> None:
    values = noisy_grids(plane, 0.1)
    values[SIDE * SIDE // 2 + SIDE // 2, 2, 3] = 1e4
    filtered = filter_directional(plane, values)
    assert filtered.max() < 2e3
    assert filtered.sum() == pytest.approx(values.sum(), rel=0.3)


@pytest.mark.parametrize("scale", [1e-20, 1e-8, 1e8, 1e20])
def test_directional_filter_does_not_depend_on_the_unit_of_radiance(plane: ElementSet, scale: float) -> None:
    values = noisy_grids(plane, 0.5)
    exact = np.float32(2.0 ** np.round(np.log2(scale)))
    np.testing.assert_array_equal(filter_directional(plane, values * exact), filter_directional(plane, values) * exact)


def test_directional_filter_in_bands_is_that_of_the_whole(plane: ElementSet, monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.tile(noisy_grids(plane, 0.5), (1, 4, 1, 1)) + np.arange(16, dtype=np.float32)[:, None, None]
    whole = filter_directional(plane, values)
    monkeypatch.setattr(directional_filter, "TEXELS_AT_ONCE", plane.num_elements * 8 * 9)
    np.testing.assert_allclose(filter_directional(plane, values), whole, rtol=1e-6)


def test_directional_filter_of_darkness_is_dark(plane: ElementSet) -> None:
    assert np.all(filter_directional(plane, np.zeros((plane.num_elements, 2, 8, 3), np.float32)) == 0)


def test_filter_of_few_elements_is_finite(plane: ElementSet) -> None:
    for count in (1, 2, 4):
        arrays = {
            name: getattr(plane, name)[:count]
            for name in ("shape", "prim_local", "uv", "side", "position", "normal", "glossy")
        }
        few = dataclasses.replace(plane, **arrays)
        assert np.isfinite(filter_diffuse(few, np.ones((count, 3), np.float32), np.zeros((count, 3), np.float32))).all()
        assert np.isfinite(filter_directional(few, np.ones((count, 2, 2, 3), np.float32))).all()
