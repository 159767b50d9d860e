"""Grids by the width of the lobe: measured widths against their closed form, and what is chosen from them."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from workers.backend import mi
from workers.direction_grids import (
    CELL_PER_SPREAD,
    NUM_RUNGS,
    choose_grids,
    grid_of,
    measure_spread,
    samples_per_direction,
)
from workers.elements import surface_frame
from workers.settings import CacheSettings
from workers.surfaces import build_surface_table

EVERY_GRID = CacheSettings(azimuth=128, polar=32)
ROUGHNESS = [0.01, 0.03, 0.06, 0.12, 0.25, 0.5, 0.8]
COLOUR = {"type": "rgb", "value": [0.6, 0.4, 0.2]}


def spreads(materials: list[dict[str, Any]], u: float = 0.3) -> np.ndarray:
    """Measured spread of some materials, each on a rectangle, at u across it."""
    to = mi.ScalarTransform4f
    shapes = {
        f"m{i:03}": {"type": "rectangle", "to_world": to().translate([3.0 * i, 0, 0]), "bsdf": bsdf}
        for i, bsdf in enumerate(materials)
    }
    table = build_surface_table(mi.load_dict({"type": "scene", **shapes}, optimize=False))
    ids = [shape.id() for shape in table.shapes]
    shape = np.array([ids.index(name) for name in shapes])
    prim, uv = np.zeros(len(shape), np.int64), np.full((len(shape), 2), 0.3, np.float32)
    uv[:, 0] = 0.9 - u  # in the first triangle u is what the barycentrics leave
    uv[:, 1] = 0.1
    _, normal, _ = surface_frame(table, shape, prim, uv, np.zeros(len(shape), np.uint8))
    return measure_spread(table, shape, prim, uv, normal)


def conductor(alpha: Any) -> dict[str, Any]:
    return {"type": "roughconductor", "alpha": alpha, "distribution": "ggx"}


def plastic(alpha: Any) -> dict[str, Any]:
    return {"type": "roughplastic", "alpha": alpha, "distribution": "ggx", "diffuse_reflectance": COLOUR}


def principled(roughness: Any) -> dict[str, Any]:
    return {"type": "principled", "roughness": roughness, "base_color": COLOUR, "metallic": 0.3}


def glass(alpha: Any) -> dict[str, Any]:
    return {"type": "roughdielectric", "alpha": alpha, "distribution": "ggx"}


def checks(left: float, right: float) -> dict[str, Any]:
    """A texture of two halves along u."""
    data = np.repeat(np.float32([[left, right]]), 2, axis=0)[..., None]
    return {"type": "bitmap", "raw": True, "filter_type": "nearest", "bitmap": mi.Bitmap(data)}


@pytest.mark.parametrize("material", [conductor, plastic, principled, glass])
def test_rougher_lobes_are_wider_and_get_coarser_grids(material: Callable[[float], dict[str, Any]]) -> None:
    spread = spreads([material(alpha) for alpha in ROUGHNESS])
    assert np.isfinite(spread).all() and np.all(np.diff(spread) >= 0) and spread[-1] > 20 * spread[0], spread
    rungs = choose_grids(spread, EVERY_GRID)
    assert rungs is not None and np.all(np.diff(rungs.astype(int)) <= 0), rungs
    assert rungs[0] == NUM_RUNGS - 1 and rungs[-1] <= 2


def test_narrow_lobes_have_their_closed_form() -> None:
    """GGX fills 12 pi alpha^2 cos(theta): sqrt(3 cos(theta)) alpha, at the sharper view of 1.05 radians."""
    alpha = np.array([0.01, 0.02, 0.05, 0.1])
    expected = np.sqrt(3 * np.cos(1.05)) * alpha
    np.testing.assert_allclose(spreads([conductor(a) for a in alpha.tolist()]), expected, rtol=0.1)


def test_a_rough_metal_gets_the_coarsest_grid_and_a_near_mirror_a_fine_one() -> None:
    rungs = choose_grids(spreads([conductor(0.8), conductor(0.05)]), EVERY_GRID)
    assert rungs is not None and grid_of(rungs[0]) == (8, 2) and grid_of(rungs[1])[0] >= 64


@pytest.mark.parametrize("material", [conductor, principled])
def test_textured_roughness_is_seen_where_the_element_is(material: Callable[[Any], dict[str, Any]]) -> None:
    smooth, rough = spreads([material(0.1)]), spreads([material(0.7)])
    textured = material(checks(0.1, 0.7))
    np.testing.assert_allclose(spreads([textured], u=0.2), smooth, rtol=1e-3)
    np.testing.assert_allclose(spreads([textured], u=0.8), rough, rtol=1e-3)


def test_lambertian_part_of_a_principled_material_does_not_widen_it() -> None:
    plain, metal = spreads([principled(0.3), principled(0.3) | {"metallic": 1.0}])
    assert plain == pytest.approx(metal, rel=0.15)


def test_materials_without_a_usable_lobe_get_the_coarsest_grid() -> None:
    """Black, purely diffuse, perfectly specular, and roughness that is not a number."""
    nothing = [conductor(0.1) | {"specular_reflectance": 0.0}, {"type": "diffuse"}, {"type": "plastic"},
               {"type": "conductor"}, conductor(checks(np.nan, np.nan))]  # fmt: skip
    spread = spreads(nothing)
    assert not np.isnan(spread).any() and np.isinf(spread[:4]).all()
    rungs = choose_grids(spread, EVERY_GRID)
    assert rungs is not None and np.all(rungs[:4] == 0)


def test_measurement_repeats_to_the_bit() -> None:
    materials = [plastic(0.2), principled(checks(0.1, 0.6))]
    np.testing.assert_array_equal(spreads(materials), spreads(materials))


def test_no_elements_have_no_spread() -> None:
    assert spreads([conductor(0.1)])[:0].shape == (0,)
    rungs = choose_grids(np.zeros(0, np.float32), EVERY_GRID)
    assert rungs is not None and len(rungs) == 0


# ------------------------------------------------ the choice ------------------------------------------------

spread_values = st.one_of(st.floats(0, 4, width=32), st.just(float("inf")))


@given(spread_values, st.integers(0, NUM_RUNGS - 1))
def test_choice_is_the_coarsest_grid_whose_cell_fits(spread: float, finest: int) -> None:
    azimuth, polar = grid_of(finest)
    cache = CacheSettings(azimuth=azimuth, polar=polar)
    rungs = choose_grids(np.float32([spread]), cache)
    assert rungs is not None
    cell = np.pi / 2 / grid_of(rungs[0])[1]
    limit = CELL_PER_SPREAD * spread
    assert rungs[0] == finest or cell <= limit * (1 + 1e-5)
    assert rungs[0] == 0 or 2 * cell > limit * (1 - 1e-5)


@given(st.lists(spread_values, min_size=1, max_size=30), st.integers(0, NUM_RUNGS - 1), st.integers(1, 64))
def test_adaptive_grids_never_cost_more_paths_than_uniform(spread: list[float], finest: int, spp: int) -> None:
    azimuth, polar = grid_of(finest)
    cache = CacheSettings(azimuth=azimuth, polar=polar, directional_spp=spp)
    rungs = choose_grids(np.float32(spread), cache)
    assert rungs is not None
    for rung in rungs.tolist():
        columns, rows = grid_of(rung)
        paths = columns * rows * samples_per_direction(rung, cache)
        assert paths == azimuth * polar * spp / 2 ** (finest - rung)
        assert samples_per_direction(rung, cache) >= spp


@pytest.mark.parametrize(
    "changes",
    [{"grids": "uniform"}, {"lobes": "exitant"}, {"azimuth": 7}, {"polar": 1}],
)
def test_one_grid_for_all(changes: dict[str, Any]) -> None:
    assert choose_grids(np.float32([0.1, 1.0]), CacheSettings(**changes)) is None


def test_grid_between_two_rungs_allows_the_lower_one() -> None:
    rungs = choose_grids(np.float32([0.0]), CacheSettings(azimuth=60, polar=40))
    assert rungs is not None and grid_of(rungs[0]) == (32, 8)
