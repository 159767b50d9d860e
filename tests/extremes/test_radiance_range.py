"""Radiance of 0, 1e-8, 1e4 and 1e6, a firefly of 1e8, a black scene, and the longest light paths there are.

Bounds: light is linear, so a scene lit k times as strongly has k times the caches, filtered caches, denoised targets
and 1 / k the exposure; 1e-5 is single precision after a few thousand operations, statistics are judged at 1e-6
(4.9 sigma).
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.metrics import exposure_from_luminance, luminance
from workers.backend import mi
from workers.bake_kernels import Batch, bake_diffuse
from workers.cache_filter import MAX_SPACINGS, PASSES, filter_diffuse
from workers.denoise import denoise
from workers.elements import ElementSet, surface_frame
from workers.lattice import build_patch_table
from workers.pathtrace import trace
from workers.surfaces import build_surface_table
from workers.transport import power_heuristic

LEVELS = [1e-8, 1e4, 1e6]
FIREFLY, NUM_SAMPLES = 1e8, 32
MAX_Z = 4.9
SIDE = 24
levels = pytest.mark.parametrize("level", LEVELS)


def bake(config: dict[str, Any], name: str, repeats: int, spp: int, max_depth: int) -> np.ndarray:
    """D of one point of a shape, `repeats` times with streams of their own; float64 [repeats, 3]."""
    scene = mi.load_dict({"type": "scene", **config}, optimize=False)
    table = build_surface_table(scene)
    shape = np.array([[s.id() for s in table.shapes].index(name)])
    uv, prim = np.full((1, 2), 0.3, np.float32), np.zeros(1, np.int64)
    position, normal, _ = surface_frame(table, shape, prim, uv, np.zeros(1, np.uint8))
    elements: Any = SimpleNamespace(shape=shape, prim_local=prim, uv=uv, normal=normal, position=position)
    batch = Batch(np.zeros(repeats, np.int64), np.full(repeats, 11, np.uint64), np.arange(repeats, dtype=np.uint64))
    return bake_diffuse(scene, table, elements, batch, spp, 0, max_depth)[0].astype(np.float64)


def grey(value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": [value] * 3}


def box(albedo: float, emission: float) -> dict[str, Any]:
    """A closed cube whose every wall emits."""
    return {
        "cube": {
            "type": "cube", "flip_normals": True, "bsdf": {"type": "diffuse", "reflectance": grey(albedo)},
            "emitter": {"type": "area", "radiance": grey(emission)},
        }
    }  # fmt: skip


@levels
def test_bake_is_linear_in_the_light(level: float, within: Any) -> None:
    one, scaled = bake(box(0.6, 1.0), "cube", 8, 64, 6), bake(box(0.6, level), "cube", 8, 64, 6)
    within("diffuse cache", float(np.abs(scaled / level / one - 1).max()), 1e-5)


@levels
def test_path_tracing_and_its_denoiser_are_linear_in_the_light(make_scene: Any, within: Any, level: float) -> None:
    one, scaled = (trace(scene, scene.camera, 16, 1).radiance for scene in (make_scene(), make_scene(emission=level)))
    within("path tracing", float(np.abs(scaled / level - one).mean() / one.mean()), 1e-5)
    clean, scaled_clean = denoise(one), denoise((one * np.float32(level)).astype(np.float32))
    within("denoised", float(np.abs(scaled_clean / level - clean).max() / clean.mean()), 1e-4)
    exposures = [exposure_from_luminance([luminance(image)]) for image in (one, scaled)]
    within("exposure", abs(exposures[1] * level / exposures[0] - 1), 1e-5)


def test_black_scene_is_black_and_has_an_exposure_of_one(make_scene: Any) -> None:
    scene = make_scene(emission=0.0)
    black = trace(scene, scene.camera, 8, 1).radiance
    assert np.all(black == 0.0)
    assert np.all(denoise(black) == 0.0), "Open Image Denoise alone makes 3e-6, which P80 would raise to white"
    assert exposure_from_luminance([luminance(denoise(black))]) == 1.0
    assert np.all(bake(box(0.6, 0.0), "cube", 4, 64, -1) == 0.0)


@pytest.mark.parametrize("terms", [12, -1])
def test_closed_box_of_albedo_099_has_its_series(terms: int, within: Any) -> None:
    """L = Le (1 - rho^n) / (1 - rho): 100 times the emission. A survival of 0.95 gave 0.75 +- 0.06 of it."""
    albedo, emission = 0.99, 0.01
    expected = emission * (1 - albedo ** (terms - 1)) / (1 - albedo) if terms > 0 else emission / (1 - albedo)
    values = bake(box(albedo, emission), "cube", 128, 64, terms)[:, 0]
    error = values.std(ddof=1) / np.sqrt(len(values))
    within("relative standard error", error / expected, 0.03)
    within("deviation in sigma", abs(values.mean() - expected) / np.hypot(error, 1e-5 * expected), MAX_Z)


def test_tiny_light_of_a_huge_density_has_its_inverse_square(within: Any) -> None:
    """A lamp of 2e-7 units at a distance of 1e4: its density of 2.5e21 a steradian overflows when it is squared."""
    half, distance, radiance = 1e-7, 1e4, 1e22
    to = mi.ScalarTransform4f
    floor = {"type": "rectangle", "to_world": to().scale(0.5), "bsdf": {"type": "diffuse", "reflectance": grey(0.5)}}
    turned = to().translate([0, 0, distance]) @ to().rotate([1, 0, 0], 180) @ to().scale(half)
    lamp = {"type": "rectangle", "to_world": turned, "emitter": {"type": "area", "radiance": grey(radiance)}}
    value = bake({"floor": floor, "lamp": lamp}, "floor", 4, 64, 2)
    assert np.isfinite(value).all()
    expected = radiance * (2 * half / distance) ** 2 / np.pi  # E / pi = L A / d^2 / pi, both cosines 1
    within("inverse square", float(np.abs(value / expected - 1).max()), 1e-4)


densities = st.floats(-37, 38).map(lambda exponent: 10.0**exponent)


@given(densities, densities)
def test_power_heuristics_of_any_two_densities_sum_to_one(a: float, b: float) -> None:
    weights = [power_heuristic(mi.Float(x), mi.Float(y)).numpy()[0] for x, y in ((a, b), (b, a))]
    assert sum(weights) == pytest.approx(1.0, abs=1e-5)


# ------------------------------------------- the cache filter -------------------------------------------


@pytest.fixture(scope="module")
def plane() -> ElementSet:
    """A flat grid of elements, one unit apart."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij"))
    count = SIDE * SIDE
    patches = build_patch_table(np.ones(1, np.uint32), np.zeros(1, np.uint32), np.zeros(1, bool))
    return ElementSet(
        patches=patches, shape=np.zeros(count, np.int64), prim_local=np.zeros(count, np.int64),
        uv=np.zeros((count, 2), np.float32), side=np.zeros(count, np.uint8),
        position=np.stack([x, y, 0 * x], -1).astype(np.float32),
        normal=np.tile(np.float32([0, 0, 1]), (count, 1)), glossy=np.arange(0), spread=np.zeros(0, np.float32),
        diffuse_slot=np.zeros(2, np.uint32), glossy_slot=np.zeros(2, np.uint32), spacing_px=1.0,
    )  # fmt: skip


def shadow_edge() -> tuple[np.ndarray, np.ndarray]:
    """Noisy light with a sharp shadow, and its standard error."""
    rng = np.random.default_rng(3)
    lit = np.where(np.arange(SIDE * SIDE)[:, None] // SIDE < SIDE // 2, 1.0, 0.2)
    return lit * (1 + 0.02 * rng.normal(size=(SIDE * SIDE, 3))), np.broadcast_to(0.02 * lit, (SIDE * SIDE, 3))


@levels
def test_filter_keeps_a_shadow_at_every_level_of_light(plane: ElementSet, within: Any, level: float) -> None:
    """An absolute floor of 1e-12 in the range weight washed every edge away at 1e-8."""
    value, error = shadow_edge()
    one = filter_diffuse(plane, value.astype(np.float32), error)
    scaled = filter_diffuse(plane, (value * level).astype(np.float32), error * level)
    within("filtered cache", float(np.abs(scaled / level - one).max()), 1e-5)
    assert one.reshape(SIDE, SIDE, 3)[SIDE // 2 - 1].min() > 0.8, "the edge stands"


def test_firefly_stays_among_its_neighbours(plane: ElementSet, within: Any) -> None:
    """One of 32 samples is 1e8: the value is 3e6 and so is its standard error. Unbiased light may spread, so far."""
    value, error = (np.array(part) for part in shadow_edge())
    centre = SIDE * (SIDE // 4) + SIDE // 2
    clean = filter_diffuse(plane, value.astype(np.float32), error)
    samples = np.full(NUM_SAMPLES, 1.0)
    samples[0] = FIREFLY
    value[centre], error[centre] = samples.mean(), samples.std(ddof=1) / np.sqrt(NUM_SAMPLES)
    filtered = filter_diffuse(plane, value.astype(np.float32), error)
    assert np.isfinite(filtered).all()
    assert filtered.max() <= samples.mean()
    # Values reach that far in two passes, and the doubt of the pooled variance one neighbourhood further.
    reach = (PASSES + 1) * MAX_SPACINGS * np.sqrt(2)
    away = np.linalg.norm(plane.position - plane.position[centre], axis=1) > reach
    assert away.sum() > 50
    within("change beyond its neighbours", float(np.abs(filtered - clean)[away].max()), 1e-6)


def test_firefly_does_not_move_the_exposure(within: Any) -> None:
    image = np.random.default_rng(0).gamma(1, 1, (64, 64)).astype(np.float32)
    before = exposure_from_luminance([image])
    image[3, 5] = FIREFLY
    within("exposure", abs(exposure_from_luminance([image]) / before - 1), 1e-2)


def test_firefly_leaves_the_denoiser_finite() -> None:
    image = np.random.default_rng(0).gamma(1, 1, (40, 48, 3)).astype(np.float32)
    image[10, 30] = FIREFLY
    result = denoise(image)
    assert np.isfinite(result).all() and result.min() >= 0.0 and result.max() <= FIREFLY
