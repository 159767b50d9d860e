"""Materials: classes, the split of a BSDF into lobes, and delta lobes, against closed forms."""

from typing import Any

import numpy as np
import pytest

from workers.backend import dr, mi
from workers.lobes import LobeClass, classify_bsdf, context, diffuse_reflectance, specular_tint
from workers.primary import delta_lobes, dominant_lobe

BASE = (0.6, 0.4, 0.2)
COLOUR = {"type": "rgb", "value": list(BASE)}
DIFFUSE = {"type": "diffuse", "reflectance": COLOUR}
ROUGH_PLASTIC = {"type": "roughplastic", "diffuse_reflectance": COLOUR, "alpha": 0.2}
ROUGH_METAL = {"type": "roughconductor", "material": "Cr", "alpha": 0.3}
PRINCIPLED = {"type": "principled", "base_color": COLOUR, "metallic": 0.5, "roughness": 0.4}
TILES = {"type": "checkerboard", "color0": 0.8, "color1": 0.2}
MATERIALS: dict[str, dict[str, Any]] = {
    "diffuse": DIFFUSE,
    "twosided": {"type": "twosided", "bsdf": DIFFUSE},
    "plastic": {"type": "plastic", "diffuse_reflectance": COLOUR},
    "roughplastic": ROUGH_PLASTIC,
    "roughconductor": ROUGH_METAL,
    "conductor": {"type": "conductor", "material": "Cr"},
    "dielectric": {"type": "dielectric"},
    "thindielectric": {"type": "thindielectric"},
    "roughdielectric": {"type": "roughdielectric", "alpha": 0.3},
    "principled": PRINCIPLED,
    "tiled_principled": {"type": "principled", "base_color": TILES, "roughness": 0.4},
    "principled_twosided": {"type": "twosided", "bsdf": PRINCIPLED},
    "mask": {"type": "mask", "opacity": 0.3, "bsdf": DIFFUSE},
    "mask_principled": {"type": "mask", "opacity": 0.3, "bsdf": PRINCIPLED},
    "blend": {"type": "blendbsdf", "weight": 0.3, "a": DIFFUSE, "b": ROUGH_METAL},
    "blend_principled": {"type": "blendbsdf", "weight": 0.3, "a": DIFFUSE, "b": PRINCIPLED},
    "tiled_metal": {"type": "twosided", "bsdf": ROUGH_METAL | {"specular_reflectance": TILES}},
    "scratched_metal": ROUGH_METAL | {"alpha": TILES},
    "tiled_blend": {
        "type": "blendbsdf",
        "weight": 0.3,
        "a": {"type": "diffuse", "reflectance": TILES},
        "b": PRINCIPLED,
    },
    "tiled_weight": {"type": "blendbsdf", "weight": TILES, "a": DIFFUSE, "b": ROUGH_METAL},
    "tiled_normalmap": {
        "type": "twosided",
        "bsdf": {
            "type": "normalmap",
            "normalmap": {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((2, 2, 3), (0.5, 0.5, 1.0)))},
            "bsdf": {"type": "principled", "base_color": TILES, "roughness": 0.4},
        },
    },
}
D, G, DELTA, M, P = (
    LobeClass.DIFFUSE, LobeClass.GLOSSY, LobeClass.DELTA, LobeClass.MASKABLE, LobeClass.PRINCIPLED
)  # fmt: skip
CLASSES = {
    "diffuse": D | M,
    "twosided": D | M,
    "plastic": D | M | DELTA,
    "roughplastic": D | M | G,
    "roughconductor": G,
    "conductor": DELTA,
    "dielectric": DELTA,
    "thindielectric": DELTA,
    "roughdielectric": G,
    "principled": D | G | P | LobeClass.FRONT_ONLY,
    "tiled_principled": D | G | P | LobeClass.FRONT_ONLY,
    "principled_twosided": D | G | P,
    "mask": D | M | DELTA,
    "mask_principled": G | DELTA | LobeClass.WHOLE | LobeClass.STATED,
    "blend": D | M | G,
    "blend_principled": G | LobeClass.WHOLE | LobeClass.STATED,
    "tiled_metal": G | LobeClass.TINTED,
    "scratched_metal": G,
    "tiled_blend": G | LobeClass.WHOLE | LobeClass.TINTED | LobeClass.STATED,
    "tiled_weight": D | M | G | LobeClass.TINTED | LobeClass.PICKED,
    "tiled_normalmap": G | LobeClass.WHOLE | LobeClass.TINTED | LobeClass.STATED,
}
COSINES = np.array([1.0, 0.9, 0.6, 0.3, 0.1], np.float32)


class Materials:
    """Materials that live in a scene: one without would be met by every program recorded meanwhile."""

    def __init__(self, materials: dict[str, dict[str, Any]]) -> None:
        shapes = {name: {"type": "rectangle", "bsdf": config} for name, config in materials.items()}
        self.scene = mi.load_dict({"type": "scene", **shapes}, optimize=False)
        self._bsdfs = {shape.id(): shape.bsdf() for shape in self.scene.shapes()}

    def __getitem__(self, name: str) -> "mi.BSDF":
        return self._bsdfs[name]


@pytest.fixture(scope="module")
def bsdfs() -> Materials:
    return Materials(MATERIALS)


def seen_from(cosines: np.ndarray) -> "mi.SurfaceInteraction3f":
    """Interactions whose viewer stands at these cosines of the polar angle (negative: behind)."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(cosines))
    si.wi = mi.Vector3f(mi.Float(np.sqrt(1 - cosines**2)), 0.0, mi.Float(cosines))
    si.uv = mi.Point2f(0.5)
    return si


def reflectance(bsdf: "mi.BSDF", si: "mi.SurfaceInteraction3f") -> np.ndarray:
    bits = classify_bsdf(bsdf)
    return np.array(diffuse_reflectance(mi.BSDFPtr(bsdf), si, mi.UInt32(int(bits)), bits, mi.Bool(True))).T


@pytest.mark.parametrize("name", MATERIALS)
def test_classes(bsdfs: Materials, name: str) -> None:
    assert classify_bsdf(bsdfs[name]) == CLASSES[name]
    assert classify_bsdf(bsdfs[name], is_emitter=True) == CLASSES[name] | LobeClass.EMITTER


@pytest.mark.parametrize(
    ("name", "front", "back"),
    [("diffuse", 1, 0), ("twosided", 1, 1), ("mask", 0.3, 0), ("blend", 0.7, 0), ("principled", 0.5, 0),
     ("principled_twosided", 0.5, 0.5), ("roughconductor", 0, 0), ("dielectric", 0, 0)],
)  # fmt: skip
def test_diffuse_reflectance_is_the_albedo_of_the_diffuse_lobe(
    bsdfs: Materials, name: str, front: float, back: float
) -> None:
    for sign, share in ((1, front), (-1, back)):
        rho = reflectance(bsdfs[name], seen_from(sign * COSINES))
        np.testing.assert_allclose(rho, np.broadcast_to(np.multiply(BASE, share), rho.shape), atol=1e-6)


def test_diffuse_reflectance_of_a_principled_texture_without_three_channels(bsdfs: Materials) -> None:
    np.testing.assert_allclose(reflectance(bsdfs["tiled_principled"], seen_from(COSINES)), 0.8, atol=1e-6)


@pytest.mark.parametrize("name", ["plastic", "roughplastic"])
def test_coated_reflectance_is_the_hemispherical_one(bsdfs: Materials, name: str) -> None:
    """The probe at 60 degrees against the whole hemisphere under uniform light: within 1.5 %."""
    bsdf, count = bsdfs[name], 20_000
    grid = np.stack(np.meshgrid((np.arange(200) + 0.5) / 200, (np.arange(100) + 0.5) / 100), -1).reshape(-1, 2)
    light = mi.warp.square_to_cosine_hemisphere(mi.Point2f(np.ascontiguousarray(grid.T, np.float32)))
    for cosine in COSINES:
        si = seen_from(np.full(count, cosine, np.float32))
        value = np.array(bsdf.eval(context(int(mi.BSDFFlags.Diffuse)), si, light)).T
        albedo = (value * (np.pi / np.array(light.z)[:, None])).mean(0)
        np.testing.assert_allclose(reflectance(bsdf, seen_from(np.array([cosine])))[0], albedo, rtol=0.015)


@pytest.mark.parametrize("name", ["diffuse", "roughplastic", "blend", "mask", "twosided"])
def test_masked_lobes_sum_to_the_material(bsdfs: Materials, name: str) -> None:
    rng = np.random.default_rng(0)
    directions = [dr.normalize(mi.Vector3f(rng.normal(size=(3, 500)))) for _ in range(2)]
    si = dr.zeros(mi.SurfaceInteraction3f, 500)
    si.wi, light = directions
    parts = (mi.BSDFFlags.Diffuse, mi.BSDFFlags.Glossy, mi.BSDFFlags.All)
    diffuse, glossy, everything = (np.array(bsdfs[name].eval(context(int(p)), si, light)) for p in parts)
    assert everything.max() > 0.01
    np.testing.assert_allclose(diffuse + glossy, everything, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(("metallic", "expected"), [(0.0, (0.04,) * 3), (1.0, BASE)])
def test_specular_tint_is_schlick(metallic: float, expected: tuple[float, ...]) -> None:
    materials = Materials({"one": {**PRINCIPLED, "metallic": metallic}})
    bsdf = materials["one"]
    bits = classify_bsdf(bsdf)
    tint = specular_tint(mi.BSDFPtr(bsdf), seen_from(COSINES), mi.UInt32(int(bits)), bits, mi.Bool(True))
    f0 = np.array(expected)
    schlick = f0 + (1 - f0) * (1 - COSINES[:, None]) ** 5
    np.testing.assert_allclose(np.array(tint).T, schlick, rtol=1e-4)


@pytest.mark.parametrize("side", [1, -1])
def test_specular_tint_of_tiles_is_their_reflectance(bsdfs: Materials, side: int) -> None:
    """From any direction: that of the metal along its normal, times the texture."""
    tints = {}
    for name in ("tiled_metal", "tiled_blend"):
        bits = classify_bsdf(bsdfs[name])
        si = seen_from(side * COSINES)
        tints[name] = []
        for v in (0.25, 0.75):
            si.uv = mi.Point2f(0.25, v)
            tint = specular_tint(mi.BSDFPtr(bsdfs[name]), si, mi.UInt32(int(bits)), bits, mi.Bool(True))
            tints[name].append(np.array(tint).T)
    light, dark = tints["tiled_metal"]
    np.testing.assert_allclose(light, 4 * dark, rtol=1e-5)
    assert np.ptp(light, axis=0).max() < 1e-6 and 0.3 < light.min() < light.max() < 0.8
    if side == 1:  # behind, the blend is black
        assert np.all(tints["tiled_blend"][0] > 1.3 * tints["tiled_blend"][1])


@pytest.mark.parametrize("side", [1, -1])
def test_specular_tint_of_a_hidden_principled_is_its_base_colour(bsdfs: Materials, side: int) -> None:
    bits = classify_bsdf(bsdfs["tiled_normalmap"])
    si = seen_from(side * COSINES)
    for v, base in ((0.25, 0.8), (0.75, 0.2)):
        si.uv = mi.Point2f(0.25, v)
        tint = specular_tint(mi.BSDFPtr(bsdfs["tiled_normalmap"]), si, mi.UInt32(int(bits)), bits, mi.Bool(True))
        np.testing.assert_allclose(np.array(tint), base + 0.04, rtol=1e-5)


def test_specular_tint_of_a_blend_is_the_share_that_is_glossy(bsdfs: Materials) -> None:
    """To an eighth: the share is sampled."""
    bits, metal = classify_bsdf(bsdfs["tiled_weight"]), classify_bsdf(bsdfs["roughconductor"])
    si = seen_from(COSINES)
    middle = mi.Point2f(0.5)
    _, full = bsdfs["roughconductor"].sample(mi.BSDFContext(), seen_from(np.ones(1, np.float32)), 0.5, middle)
    assert not metal & LobeClass.PICKED
    for v in (0.25, 0.75):
        si.uv = mi.Point2f(0.25, v)
        tint = specular_tint(mi.BSDFPtr(bsdfs["tiled_weight"]), si, mi.UInt32(int(bits)), bits, mi.Bool(True))
        share = 1 - reflectance(bsdfs["tiled_weight"], si)[0, 0] / BASE[0]
        assert share == pytest.approx(0.2) or share == pytest.approx(0.8)
        np.testing.assert_allclose(np.array(tint) / np.array(full), share, atol=1 / 16)


def test_specular_tint_is_one_where_nothing_is_divided(bsdfs: Materials) -> None:
    bits = classify_bsdf(bsdfs["roughconductor"])
    union = bits | LobeClass.PRINCIPLED
    pointer = mi.BSDFPtr(bsdfs["roughconductor"])
    tint = specular_tint(pointer, seen_from(COSINES), mi.UInt32(int(bits)), union, mi.Bool(True))
    assert np.all(np.array(tint) == 1)


def fresnel(cosine: np.ndarray, eta: float) -> np.ndarray:
    """Unpolarised reflectance of a smooth interface, from the side of the viewer."""
    inside = np.sqrt(1 - (1 - cosine**2) / eta**2)
    parallel = (inside - eta * cosine) / (inside + eta * cosine)
    perpendicular = (cosine - eta * inside) / (cosine + eta * inside)
    return (parallel**2 + perpendicular**2) / 2


@pytest.mark.parametrize("name", ["dielectric", "thindielectric"])
def test_delta_lobes_of_glass_are_fresnels(name: str) -> None:
    materials = Materials({"one": {"type": name, "int_ior": 1.5, "ext_ior": 1.0}})
    bsdf = materials["one"]
    si = seen_from(COSINES)
    through, mirror = delta_lobes(mi.BSDFPtr(bsdf), si, mi.Bool(True))
    expected = fresnel(COSINES.astype(np.float64), 1.5)
    expected = 2 * expected / (1 + expected) if name == "thindielectric" else expected
    np.testing.assert_allclose(np.array(mirror.weight * mirror.pdf)[0], expected, rtol=1e-4)
    # Radiance is squeezed by 1 / eta^2 on its way into the denser medium.
    squeeze = 1 / 1.5**2 if name == "dielectric" else 1.0
    np.testing.assert_allclose(np.array(through.weight * through.pdf)[0], (1 - expected) * squeeze, rtol=1e-4)
    np.testing.assert_allclose(np.array(mirror.wo.z), COSINES, rtol=1e-5)
    assert np.all(np.array(through.wo.z) < 0) and np.all(np.array(mirror.valid & through.valid))
    _, weight, valid = dominant_lobe(through, mirror)
    likelier = np.where(expected > 0.5, 1.0, squeeze)
    assert np.all(np.array(valid))
    np.testing.assert_allclose(np.array(weight)[0], likelier, rtol=1e-4)


def test_delta_lobe_of_a_mask_goes_straight_on(bsdfs: Materials) -> None:
    si = seen_from(COSINES)
    hole, other = delta_lobes(mi.BSDFPtr(bsdfs["mask"]), si, mi.Bool(True))
    np.testing.assert_allclose(np.array(hole.weight * hole.pdf), 0.7, rtol=1e-5)
    np.testing.assert_allclose(np.array(hole.wo), -np.array(si.wi), atol=1e-6)
    assert not np.any(np.array(other.valid))


@pytest.mark.parametrize("name", ["diffuse", "roughplastic", "roughconductor"])
def test_smooth_materials_have_no_delta_lobe(bsdfs: Materials, name: str) -> None:
    for lobe in delta_lobes(mi.BSDFPtr(bsdfs[name]), seen_from(COSINES), mi.Bool(True)):
        assert not np.any(np.array(lobe.valid))


def test_delta_lobes_are_delta_where_a_nested_material_ignores_the_mask(bsdfs: Materials) -> None:
    hole, other = delta_lobes(mi.BSDFPtr(bsdfs["mask_principled"]), seen_from(COSINES), mi.Bool(True))
    np.testing.assert_allclose(np.array(hole.weight * hole.pdf), 0.7, rtol=1e-5)
    assert not np.any(np.array(other.valid))
