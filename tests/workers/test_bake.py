"""Baking kernels: every material's split against Mitsuba's path tracer, determinism, stratification.

The split is checked as an identity of expectations at the same points and directions; no bin width enters:

    E[(L - rho_d D - sum of delta lobes) / t_s] over a bin  ==  the baked S of that bin
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from workers.backend import dr, mi
from workers.bake_kernels import Batch, bake_diffuse, bake_directional, direction_in_bin
from workers.elements import surface_frame
from workers.lobes import LobeClass, diffuse_reflectance, has, specular_tint
from workers.primary import delta_lobes
from workers.surfaces import SurfaceTable, build_surface_table

COLOUR = {"type": "rgb", "value": [0.6, 0.4, 0.2]}
FLOOR_COLOUR = {"type": "rgb", "value": [0.5, 0.3, 0.4]}
DIFFUSE = {"type": "diffuse", "reflectance": COLOUR}
ROUGH_PLASTIC = {"type": "roughplastic", "diffuse_reflectance": COLOUR, "alpha": 0.2}
ROUGH_METAL = {"type": "roughconductor", "material": "Cr", "alpha": 0.3}


def principled(metallic: float, **more: Any) -> dict[str, Any]:
    return {"type": "principled", "base_color": COLOUR, "metallic": metallic, "roughness": 0.4, **more}


# A name that ends in _back is seen and baked from behind.
MATERIALS: dict[str, dict[str, Any]] = {
    "diffuse": DIFFUSE,
    "single_back": DIFFUSE,
    "twosided_back": {"type": "twosided", "bsdf": DIFFUSE},
    "plastic": {"type": "plastic", "diffuse_reflectance": COLOUR},
    "plastic_nonlinear": {"type": "plastic", "diffuse_reflectance": COLOUR, "nonlinear": True},
    "roughplastic": ROUGH_PLASTIC,
    "roughplastic_twosided_back": {"type": "twosided", "bsdf": ROUGH_PLASTIC},
    "roughconductor": ROUGH_METAL,
    "tiled_conductor": ROUGH_METAL | {"specular_reflectance": {"type": "checkerboard"}},
    "conductor": {"type": "conductor", "material": "Cr"},
    "principled_0": principled(0.0),
    "principled_half": principled(0.5),
    "principled_1": principled(1.0),
    "principled_coated": principled(0.2, clearcoat=1.0, sheen=0.5),
    "principled_glass": principled(0.0, spec_trans=0.6, eta=1.5),
    "principled_twosided_back": {"type": "twosided", "bsdf": principled(0.5)},
    "principled_single_back": principled(0.5),
    "mask": {"type": "mask", "opacity": 0.3, "bsdf": DIFFUSE},
    "mask_roughplastic": {"type": "mask", "opacity": 0.3, "bsdf": ROUGH_PLASTIC},
    "mask_principled": {"type": "mask", "opacity": 0.3, "bsdf": principled(0.5)},
    "blend": {"type": "blendbsdf", "weight": 0.3, "a": DIFFUSE, "b": ROUGH_METAL},
    "blend_principled": {"type": "blendbsdf", "weight": 0.3, "a": DIFFUSE, "b": principled(0.5)},
    "dielectric": {"type": "dielectric"},
    "thindielectric": {"type": "thindielectric"},
    "roughdielectric": {"type": "roughdielectric", "alpha": 0.3},
    "principledthin": {"type": "principledthin", "base_color": COLOUR, "roughness": 0.4, "diff_trans": 0.6},
}
NAMES = list(MATERIALS)
GRID = (2, 3)  # azimuth, polar
BINS = GRID[0] * GRID[1]
MAX_Z = 4.9  # two-sided 1e-6 per number, at fixed seeds
# The reflectance of a coated lobe is probed at one light direction (1 % low); noise is judged beside it.
MODEL_ERROR = 0.004


@dataclass(frozen=True)
class Samples:
    scene: "mi.Scene"
    table: SurfaceTable
    elements: Any


def patches() -> Samples:
    """A small patch of every material, in a row above a floor, lit by a lamp and the sky."""
    to = mi.ScalarTransform4f
    scene: dict[str, Any] = {
        "type": "scene",
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.6, 0.7]}},
        "lamp": {
            "type": "rectangle",
            "to_world": to().translate([1.5, 1, 3]) @ to().rotate([1, 0, 0], 180),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.5, 2.0]}},
        },
        "floor": {
            "type": "rectangle", "to_world": to().translate([0, 0, -0.6]) @ to().scale(8.0),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": FLOOR_COLOUR}},
        },
    }  # fmt: skip
    for index, (name, bsdf) in enumerate(MATERIALS.items()):
        place = to().translate([(index % 5) * 0.7 - 1.4, (index // 5) * 0.7 - 1.4, 0]) @ to().scale(0.12)
        scene[name] = {"type": "rectangle", "to_world": place, "bsdf": bsdf}
    loaded = mi.load_dict(scene, optimize=False)
    table = build_surface_table(loaded)
    ids = [shape.id() for shape in table.shapes]
    shape = np.array([ids.index(name) for name in NAMES])
    side = np.array([name.endswith("_back") for name in NAMES], np.uint8)
    prim, uv = np.zeros(len(NAMES), np.int64), np.full((len(NAMES), 2), 0.3, np.float32)
    _, normal, _ = surface_frame(table, shape, prim, uv, side)
    return Samples(loaded, table, SimpleNamespace(shape=shape, prim_local=prim, uv=uv, normal=normal))


@pytest.fixture(scope="module")
def samples() -> Samples:
    return patches()


def repeated(repeats: int, seed: int) -> Batch:
    """Every material `repeats` times with streams of its own."""
    place = np.tile(np.arange(repeats, dtype=np.uint64), len(NAMES))
    return Batch(np.repeat(np.arange(len(NAMES)), repeats), np.full(len(place), seed, np.uint64), place)


def moments(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    values = values.astype(np.float64)
    return values.mean(axis), values.std(axis, ddof=1) / np.sqrt(values.shape[axis])


# ------------------------------------------- the split -------------------------------------------


@dataclass(frozen=True)
class Split:
    """By material and bin: path-traced radiance, what it leaves to the directional lobe, what was baked."""

    radiance: np.ndarray
    left: np.ndarray
    baked: np.ndarray
    error: np.ndarray
    tint: np.ndarray


def rows(value: Any, count: int) -> np.ndarray:
    return np.array(value, dtype=np.float64).T.reshape(-1, 3) + np.zeros((count, 3))


@pytest.fixture(scope="module")
def split(samples: Samples, spp: int = 512, repeats: int = 32) -> Split:
    scene, table, elements = samples.scene, samples.table, samples.elements
    value, _ = bake_diffuse(scene, table, elements, repeated(repeats, 5), 64, 0, -1)
    irradiance, irradiance_error = moments(value.reshape(len(NAMES), repeats, 1, 3), 1)
    value = bake_directional(scene, table, elements, repeated(repeats, 9), GRID, 16, 0, -1, False)
    baked, baked_error = moments(value.reshape(len(NAMES), repeats, BINS, 3), 1)
    radiance, delta, rho, tint = (part.reshape(len(NAMES), BINS, spp, 3) for part in path_traced(samples, spp))
    left, error = moments((radiance - delta - rho * irradiance[:, :, None]) / tint, 2)
    error = np.sqrt(error**2 + baked_error**2 + ((rho / tint).mean(2) * irradiance_error) ** 2)
    return Split(radiance.mean(2), left, baked, error, tint.mean(2))


def path_traced(samples: Samples, spp: int) -> tuple[np.ndarray, ...]:
    """Radiance, that of the delta lobes, rho_d and t_s of every lane (material, bin, sample), RGB last."""
    table, elements = samples.table, samples.elements
    count = len(NAMES) * BINS * spp
    lane = dr.arange(mi.UInt32, count)
    owner = lane // (BINS * spp)
    rng = mi.PCG32(count, initstate=77)
    normal = dr.gather(mi.Vector3f, mi.Vector3f(np.ascontiguousarray(elements.normal.T)), owner)
    jitter = mi.Point2f(rng.next_float32(), rng.next_float32())
    view = direction_in_bin((lane // spp) % BINS, GRID, jitter, normal)
    place = table.interaction(elements.shape, elements.prim_local, elements.uv)
    dr.eval(place)
    si = dr.gather(mi.SurfaceInteraction3f, place, owner)
    si.wi = si.to_local(view)
    bits = dr.gather(mi.UInt32, table.lobe_bits_dr, mi.UInt32(elements.shape.astype(np.uint32)))
    bits = dr.gather(mi.UInt32, bits, owner)
    everything = mi.Bool(True)
    rho = diffuse_reflectance(si.bsdf(), si, bits, table.lobe_union, everything)
    tint = specular_tint(si.bsdf(), si, bits, table.lobe_union, everything)
    rays, weights = [(si.p + view * 0.05, -view)], []
    for lobe in delta_lobes(si.bsdf(), si, has(bits, LobeClass.DELTA)):
        ray = si.spawn_ray(si.to_world(lobe.wo))
        rays.append((ray.o, ray.d))
        weights.append(dr.select(lobe.valid, lobe.weight * lobe.pdf, 0.0))
    dr.eval(rho, tint, rays, weights)
    traced = radiance_along(samples.scene, rays, count)
    delta = sum(rows(w, count) * value for w, value in zip(weights, traced[1:], strict=True))
    return traced[0], delta, rows(rho, count), rows(tint, count)


def radiance_along(scene: "mi.Scene", rays: list[Any], count: int) -> np.ndarray:
    """What Mitsuba's own `path` integrator gives along rays, float64 [len(rays), count, 3]."""
    origin, direction = (np.concatenate([rows(ray[part], count) for ray in rays]).astype(np.float32) for part in (0, 1))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, len(origin))
    ray = mi.RayDifferential3f(mi.Point3f(origin.T.copy()), mi.Vector3f(direction.T.copy()))
    path = mi.load_dict({"type": "path", "max_depth": -1})
    value, _, _ = path.sample(scene, sampler, ray, None, mi.Bool(True))
    dr.eval(value)
    return rows(value, len(origin)).reshape(len(rays), count, 3)


@pytest.mark.parametrize(
    "name",
    [name for name in NAMES],
)
def test_lobes_sum_to_what_mitsuba_renders(split: Split, name: str) -> None:
    index = NAMES.index(name)
    radiance, tint = split.radiance[index], split.tint[index]
    assert np.all(split.error[index] * tint <= 0.1 * radiance.mean() + 1e-9), "the samples can tell"
    model = MODEL_ERROR * radiance / tint
    z = (split.left[index] - split.baked[index]) / np.sqrt(split.error[index] ** 2 + model**2 + 1e-14)
    assert np.abs(z).max() < MAX_Z, f"z by bin {np.round(z, 1).tolist()}"


def test_materials_are_told_apart(split: Split) -> None:
    """Guards the test above: the lobes it sums are there, and the black backs are black."""
    by_name = dict(zip(NAMES, split.baked.mean((1, 2)), strict=True))
    for name in ("roughplastic", "roughconductor", "principled_half", "blend", "roughdielectric"):
        assert by_name[name] > 0.02, name
    for name in ("diffuse", "plastic", "dielectric", "conductor", "mask"):
        assert by_name[name] == 0, name
    assert np.all(split.radiance[NAMES.index("single_back")] == 0)


# ------------------------------------------ determinism ------------------------------------------


def directional(samples: Samples, batch: Batch, bake_pass: int = 0) -> np.ndarray:
    return bake_directional(samples.scene, samples.table, samples.elements, batch, GRID, 16, bake_pass, -1, False)


def diffuse(samples: Samples, batch: Batch, bake_pass: int = 0) -> np.ndarray:
    return bake_diffuse(samples.scene, samples.table, samples.elements, batch, 64, bake_pass, -1)[0]


def unit(elements: list[int], seed: int) -> Batch:
    place = np.arange(len(elements), dtype=np.uint64)
    return Batch(np.array(elements), np.full(len(elements), seed, np.uint64), place)


def joined(*batches: Batch) -> Batch:
    return Batch(*(np.concatenate([getattr(b, name) for b in batches]) for name in ("element", "seed", "place")))


LIT = [NAMES.index(name) for name in ("roughplastic", "principled_half", "blend", "roughconductor")]


@pytest.mark.parametrize("bake", [diffuse, directional])
def test_units_are_bit_identical_alone_and_together(samples: Samples, bake: Any) -> None:
    a, b = unit(LIT[:3], 123), unit(LIT[1:], 2**32 - 5)
    alone = [bake(samples, a), bake(samples, b)]
    np.testing.assert_array_equal(bake(samples, a), alone[0])
    together, reversed_ = bake(samples, joined(a, b)), bake(samples, joined(b, a))
    np.testing.assert_array_equal(together, np.concatenate(alone))
    np.testing.assert_array_equal(reversed_, np.concatenate(alone[::-1]))


@pytest.mark.parametrize("bake", [diffuse, directional])
def test_passes_seeds_and_places_are_independent(samples: Samples, bake: Any) -> None:
    one = LIT[0]
    base = bake(samples, unit([one, one], 7))
    others = {
        "pass": bake(samples, unit([one, one], 7), 1)[0],
        "seed": bake(samples, unit([one, one], 8))[0],
        "place": base[1],
    }
    for what, value in others.items():
        assert np.all(value != base[0]), what
        np.testing.assert_allclose(value.mean(), base[0].mean(), rtol=0.5, err_msg=what)


def test_mean_of_squares_belongs_to_the_mean(samples: Samples) -> None:
    batch = repeated(4, 21)
    mean, squares = bake_diffuse(samples.scene, samples.table, samples.elements, batch, 64, 0, -1)
    assert np.all(squares >= mean**2 * (1 - 1e-5)) and squares.mean() > 1.05 * (mean**2).mean()


def test_stratified_directions_reduce_variance() -> None:
    """Spread of repeated bakes against what as many independent paths would give, under a walled sky."""
    to = mi.ScalarTransform4f
    wall = {
        "type": "rectangle",
        "to_world": to().translate([1, 0, 0]) @ to().rotate([0, 1, 0], -90) @ to().scale(3.0),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.0] * 3}},
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}},
    }  # fmt: skip
    floor = {"type": "rectangle", "bsdf": DIFFUSE}
    scene = mi.load_dict({"type": "scene", "wall": wall, "floor": floor}, optimize=False)
    table = build_surface_table(scene)
    shape = np.array([[s.id() for s in table.shapes].index("floor")])
    prim, uv = np.zeros(1, np.int64), np.full((1, 2), 0.3, np.float32)
    _, normal, _ = surface_frame(table, shape, prim, uv, np.zeros(1, np.uint8))
    elements: Any = SimpleNamespace(shape=shape, prim_local=prim, uv=uv, normal=normal)
    spp, repeats = 64, 256
    batch = unit([0] * repeats, 3)
    mean, squares = bake_diffuse(scene, table, elements, batch, spp, 0, 2)
    independent = (squares.mean(0) - mean.mean(0) ** 2) / spp
    assert np.all(mean.var(0, ddof=1) < 0.7 * independent), f"{mean.var(0)} against {independent}"
