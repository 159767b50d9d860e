"""The query: fast program against the slow reference, and both against closed forms."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from workers.backend import mi
from workers.bake_kernels import Batch, bake_diffuse
from workers.camera import Camera
from workers.direction_grids import grid_of
from workers.elements import NOT_BAKED, ElementSet, build_elements
from workers.progress import Progress
from workers.query import CHANNELS, CacheArrays, QueryProgram
from workers.query_reference import bilinear, camera_rays, query_reference
from workers.scene import load_scene
from workers.settings import CacheSettings, QuerySettings
from workers.surfaces import SurfaceTable, build_surface_table
from workers.texels import DirectionalTexels, Packing
from workers.visibility import Hits, domain_hits

TOLERANCE = 1e-4
POLAR, AZIMUTH = 4, 8


@dataclass(frozen=True)
class Seen:
    """A scene, what one camera of its domain sees, and another camera that sees more."""

    scene: "mi.Scene"
    table: SurfaceTable
    hits: Hits
    camera: Camera
    domain: Camera


def seen(scene: "mi.Scene", camera: Camera, domain: Camera) -> Seen:
    table = build_surface_table(scene)
    return Seen(scene, table, domain_hits(scene, table, [domain], 40, 2500, Progress()), camera, domain)


@pytest.fixture(scope="module")
def tiny() -> Seen:
    scene = load_scene("tiny", width=40, height=30)
    return seen(scene.mi_scene, scene.keyframes[2].resized(40, 30), scene.camera)


def rgb(*values: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(values)}


@pytest.fixture(scope="module")
def vitrine() -> Seen:
    """Analytic shapes, glass, a mirror, a cut-out and the open sky: everything that `tiny` lacks."""
    to = mi.ScalarTransform4f
    grey = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)}}
    plastic = {"type": "plastic", "diffuse_reflectance": rgb(0.3, 0.5, 0.2)}
    metal = {"type": "principled", "base_color": rgb(0.7, 0.4, 0.2), "metallic": 0.6, "roughness": 0.3}
    tiled = {"type": "roughconductor", "alpha": 0.2, "specular_reflectance": {"type": "checkerboard"}}
    glow = {"type": "area", "radiance": rgb(2.0, 1.5, 1.0)}
    scene = {
        "type": "scene",
        "sky": {"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)},
        "floor": {"type": "disk", "to_world": to().rotate([1, 0, 0], -90) @ to().scale(2.0), "bsdf": grey},
        "ball": {"type": "sphere", "center": [-0.8, 0.5, 0.0], "radius": 0.5, "bsdf": plastic},
        "tin": {"type": "cylinder", "p0": [0.9, 0.0, -0.2], "p1": [0.9, 0.9, -0.2], "radius": 0.3,
                "bsdf": metal},
        "block": {"type": "cube", "to_world": to().translate([0.05, 0.5, 0.5]) @ to().rotate([0, 1, 0], 20)
                  @ to().scale([0.25, 0.4, 0.08]), "bsdf": {"type": "dielectric"}},
        "mirror": {"type": "rectangle", "to_world": to().translate([0, 1, -1.2]) @ to().scale(0.9),
                   "bsdf": {"type": "conductor", "material": "Cr"}},
        "tiles": {"type": "rectangle", "to_world": to().translate([-0.2, 0.01, 1.2]) @ to().rotate([1, 0, 0], -90)
                  @ to().scale(0.5), "bsdf": tiled},
        "screen": {"type": "rectangle", "to_world": to().translate([1.5, 0.8, 0.4]) @ to().scale(0.5),
                   "bsdf": {"type": "mask", "opacity": 0.4, "bsdf": grey}},
        "lamp": {"type": "sphere", "center": [0.4, 2.2, 0.0], "radius": 0.2, "emitter": glow, "bsdf": grey},
    }  # fmt: skip
    target, up = [0.1, 0.7, 0.0], [0, 1, 0]
    domain = Camera.look_at([0.3, 1.3, 3.2], target, up, 60.0, 40, 30)
    camera = Camera.look_at([-0.7, 1.6, 3.0], target, up, 65.0, 40, 30)
    return seen(mi.load_dict(scene, optimize=False), camera, domain)


def random_caches(elements: ElementSet, **kind: bool) -> CacheArrays:
    """Values without any smoothness: a wrong slot, weight or direction shows."""
    rng = np.random.default_rng(0)
    diffuse = rng.random((elements.num_elements, 3), dtype=np.float32)
    directional = rng.random((len(elements.glossy), POLAR, AZIMUTH, 3), dtype=np.float32)
    return CacheArrays(diffuse, directional, **kind)


def mixed_caches(elements: ElementSet, packing: Packing | None) -> CacheArrays:
    """As `random_caches`, on three grids at once: neighbours in the lattice lie on different ones."""
    rng = np.random.default_rng(1)
    rung = rng.integers(0, 3, len(elements.glossy)).astype(np.uint8)
    low = -0.5 if packing is not None and packing.signed else 0.0

    def load(one: int) -> np.ndarray:
        azimuth, polar = grid_of(one)
        return rng.uniform(low, 1.0, ((rung == one).sum(), polar, azimuth, 3)).astype(np.float32)

    diffuse = rng.random((elements.num_elements, 3), dtype=np.float32)
    return CacheArrays(diffuse, DirectionalTexels.ladder(rung, load, packing))


def constant_caches(elements: ElementSet, diffuse: float, directional: float) -> CacheArrays:
    return CacheArrays(
        np.full((elements.num_elements, 3), diffuse, np.float32),
        np.full((len(elements.glossy), POLAR, AZIMUTH, 3), directional, np.float32),
    )


def layers(image: np.ndarray) -> dict[str, np.ndarray]:
    return {name: image[..., low:high] for name, (low, high) in CHANNELS.items()}


def check_against_reference(
    where: Seen, cache: CacheSettings, query: QuerySettings, budget_px: int = 0, **kind: bool
) -> dict[str, np.ndarray]:
    elements = build_elements(where.table, where.hits, cache)
    caches = random_caches(elements, exitant=cache.lobes == "exitant", **kind)
    return compare_with_reference(where, elements, caches, query, budget_px)


def compare_with_reference(
    where: Seen, elements: ElementSet, caches: CacheArrays, query: QuerySettings, budget_px: int
) -> dict[str, np.ndarray]:
    """Compares every channel to 1e-4; at most `budget_px` pixels, at edges, may fall on another surface."""
    fast = layers(QueryProgram(where.scene, where.table, elements, caches, query).run(where.camera))
    slow = query_reference(where.scene, where.table, elements, caches, query, where.camera)
    assert fast.keys() == slow.keys()
    for name, value in fast.items():
        np.testing.assert_array_equal(np.isnan(value), np.isnan(slow[name]), err_msg=name)
        error = np.abs(value - slow[name]) / np.maximum(np.abs(slow[name]), 0.05)
        wrong = np.nan_to_num(error).max(-1) > TOLERANCE
        assert wrong.sum() <= budget_px, f"{name}: {wrong.sum()} pixels, error up to {np.nanmax(error)}"
    assert (slow["coverage"] < 0.999).any() and (slow["coverage"] > 0.5).any(), "stand-ins are tried"
    return slow


LATTICE = CacheSettings(max_elements=800)
PAPER = CacheSettings(elements="triangle", lobes="exitant")


@pytest.mark.parametrize(
    ("cache", "query"),
    [
        (LATTICE, QuerySettings(samples=1)),
        (LATTICE, QuerySettings(samples=2)),
        (LATTICE, QuerySettings(samples=3)),
        (LATTICE, QuerySettings(samples=2, supersample="everywhere")),
        (CacheSettings(elements="vertex"), QuerySettings(samples=1)),
        (CacheSettings(max_elements=800, lobes="exitant"), QuerySettings(samples=2, supersample="everywhere")),
        (PAPER, QuerySettings(weights="paper")),
        (PAPER, QuerySettings(weights="single")),
        (PAPER, QuerySettings(weights="paper", scale_free=True)),
    ],
    ids=["1x1", "edges", "edges-3x3", "2x2", "vertex", "exitant", "paper-3", "paper-1", "paper-scale-free"],
)
def test_program_agrees_with_the_reference(tiny: Seen, cache: CacheSettings, query: QuerySettings) -> None:
    check_against_reference(tiny, cache, query)


def test_program_agrees_with_the_reference_without_demodulation(tiny: Seen) -> None:
    check_against_reference(tiny, LATTICE, QuerySettings(samples=1), demodulated=False)


@pytest.mark.parametrize("query", [QuerySettings(samples=1), QuerySettings(samples=2, max_chain=2)])
def test_program_agrees_with_the_reference_behind_glass(vitrine: Seen, query: QuerySettings) -> None:
    slow = check_against_reference(vitrine, CacheSettings(max_elements=600), query, budget_px=3)
    assert 0.02 < np.isnan(slow["position"]).mean() < 0.9, "some rays meet the sky"


@pytest.mark.parametrize(
    "packing", [None, Packing(0, signed=False), Packing(0, signed=True)], ids=["float32", "rgb9e5", "signed"]
)
def test_program_agrees_with_the_reference_on_mixed_grids(vitrine: Seen, packing: Packing | None) -> None:
    """The reference reads the texels as they are unpacked, so packing makes no difference between the two."""
    elements = build_elements(vitrine.table, vitrine.hits, CacheSettings(max_elements=600))
    caches = mixed_caches(elements, packing)
    compare_with_reference(vitrine, elements, caches, QuerySettings(samples=1), budget_px=3)


def test_packed_texels_of_one_grid_change_the_image_by_their_bound(tiny: Seen) -> None:
    elements = build_elements(tiny.table, tiny.hits, LATTICE)
    caches, query = random_caches(elements), QuerySettings(samples=1)
    assert isinstance(caches.directional, np.ndarray)
    packing = Packing(0, signed=False)
    packed = dataclasses.replace(caches, directional=DirectionalTexels.uniform(caches.directional, packing))
    exact, close = (
        layers(QueryProgram(tiny.scene, tiny.table, elements, arrays, query).run(tiny.camera))["ir"]
        for arrays in (caches, packed)
    )
    assert 0 < np.abs(close - exact).max() <= packing.error * 1.01


def test_program_is_bit_identical_twice(tiny: Seen) -> None:
    elements = build_elements(tiny.table, tiny.hits, LATTICE)
    caches, query = random_caches(elements), QuerySettings(samples=2)
    images = [QueryProgram(tiny.scene, tiny.table, elements, caches, query).run(tiny.camera) for _ in range(2)]
    np.testing.assert_array_equal(images[0], images[1])


def test_program_runs_beside_a_material_without_a_scene(tiny: Seen) -> None:
    elements = build_elements(tiny.table, tiny.hits, LATTICE)
    caches = random_caches(elements)
    alone = mi.load_dict({"type": "diffuse"})
    program = QueryProgram(tiny.scene, tiny.table, elements, caches, QuerySettings(samples=1))
    failure = ""
    try:
        program.run(tiny.camera)
    except RuntimeError as error:
        failure = str(error)
    # A kept traceback would keep the material, and every later program would meet it.
    del alone, program
    assert not failure


# ------------------------------------------ closed forms ------------------------------------------


def test_unit_light_shows_the_albedo(tiny: Seen) -> None:
    """D = 1 and S = 0: every pixel that does not glow shows its diffuse reflectance, whatever the lattice."""
    elements = build_elements(tiny.table, tiny.hits, LATTICE)
    caches = constant_caches(elements, 1.0, 0.0)
    program = QueryProgram(tiny.scene, tiny.table, elements, caches, QuerySettings(samples=2))
    image = layers(program.run(tiny.camera))
    dark = (image["ir"] < 1.0).all(-1)
    assert dark.mean() > 0.9
    np.testing.assert_allclose(image["ir"][dark], image["albedo"][dark], rtol=1e-5, atol=1e-6)
    assert image["albedo"].std() > 0.05


def test_paper_weights_keep_a_constant(tiny: Seen) -> None:
    elements = build_elements(tiny.table, tiny.hits, PAPER)
    caches = dataclasses.replace(constant_caches(elements, 0.0, 0.7), exitant=True)
    program = QueryProgram(tiny.scene, tiny.table, elements, caches, QuerySettings(weights="paper"))
    np.testing.assert_allclose(layers(program.run(tiny.camera))["ir"], 0.7, rtol=1e-5)


def test_glass_pane_dims_the_wall_behind_it() -> None:
    """Straight through a thin pane: T = 1 - 2 R / (1 + R), plus the sky in the mirror image."""
    to = mi.ScalarTransform4f
    wall = {
        "type": "rectangle",
        "to_world": to().scale(5.0),
        "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.4, 0.3)},
    }
    pane = {"type": "rectangle", "to_world": to().translate([0, 0, 1]),
            "bsdf": {"type": "thindielectric", "int_ior": 1.5, "ext_ior": 1.0}}  # fmt: skip
    sky = {"type": "constant", "radiance": rgb(2.0, 2.0, 2.0)}
    scene = mi.load_dict({"type": "scene", "wall": wall, "pane": pane, "sky": sky}, optimize=False)
    camera = Camera.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0], 4.0, 8, 8)
    where = seen(scene, camera, camera)
    elements = build_elements(where.table, where.hits, CacheSettings(max_elements=100))
    caches = constant_caches(elements, 1.5, 0.0)
    program = QueryProgram(scene, where.table, elements, caches, QuerySettings(samples=1))
    image = layers(program.run(camera))
    reflected = 2 * 0.04 / 1.04
    expected = (1 - reflected) * 1.5 * np.array([0.5, 0.4, 0.3]) + reflected * 2.0
    np.testing.assert_allclose(image["ir"], np.broadcast_to(expected, image["ir"].shape), rtol=1e-3)
    np.testing.assert_allclose(image["distance"], 3.0, rtol=1e-2)


def test_baked_plane_shows_its_closed_form() -> None:
    """A textured Lambertian plane in the sun, baked and queried: L = rho / pi * E0 cos, exactly."""
    to = mi.ScalarTransform4f
    texture = {"type": "bitmap", "raw": True, "filter_type": "nearest",
               "bitmap": mi.Bitmap(np.random.default_rng(0).random((8, 8, 3), dtype=np.float32))}  # fmt: skip
    plane = {
        "type": "rectangle",
        "to_world": to().scale(2.0),
        "bsdf": {"type": "diffuse", "reflectance": texture},
    }
    sun = {"type": "directional", "direction": [0.0, -0.6, -0.8], "irradiance": rgb(3.0, 2.0, 1.0)}
    scene = mi.load_dict({"type": "scene", "plane": plane, "sun": sun}, optimize=False)
    camera = Camera.look_at([0, -1, 3], [0, 0, 0], [0, 1, 0], 40.0, 24, 24)
    where = seen(scene, camera, camera)
    elements = build_elements(where.table, where.hits, CacheSettings(max_elements=100))
    count = elements.num_elements
    batch = Batch(np.arange(count), np.zeros(count, np.uint64), np.arange(count, dtype=np.uint64))
    baked, _ = bake_diffuse(scene, where.table, elements, batch, 4, 0, -1)
    caches = CacheArrays(baked, np.zeros((0, POLAR, AZIMUTH, 3), np.float32))
    image = layers(QueryProgram(scene, where.table, elements, caches, QuerySettings(samples=2)).run(camera))
    expected = image["albedo"] / np.pi * np.array([3.0, 2.0, 1.0]) * 0.8
    np.testing.assert_allclose(image["ir"], expected, rtol=1e-4, atol=1e-6)
    assert image["albedo"].std() > 0.1, "the texture is at the pixel, not in the cache"


def test_stand_ins_count_only_where_nothing_was_baked(tiny: Seen) -> None:
    """Baked slots hold 1 and stand-ins 9: the image is 1 wherever any baked point answers."""
    elements = build_elements(tiny.table, tiny.hits, LATTICE)
    count = elements.num_elements
    slots = elements.diffuse_slot.copy()
    slots[(slots & NOT_BAKED) > 0] = np.uint32(count) | NOT_BAKED
    poisoned = dataclasses.replace(elements, diffuse_slot=slots)
    diffuse = np.full((count + 1, 3), 1.0, np.float32)
    diffuse[count] = 9.0
    caches = CacheArrays(diffuse, np.zeros((len(elements.glossy), POLAR, AZIMUTH, 3), np.float32))
    image = layers(QueryProgram(tiny.scene, tiny.table, poisoned, caches, QuerySettings(samples=1)).run(tiny.camera))
    with np.errstate(invalid="ignore", divide="ignore"):
        light = (image["ir"] / image["albedo"])[..., 0]
    plain = (image["ir"] < 6.0).all(-1) & (image["albedo"][..., 0] > 0.01)
    # All three stand in: 9. Else the baked ones, and stand-ins only for a share of weight below their 1e-4.
    answered = np.isclose(light[plain], 1.0, atol=0.05)
    borrowed = np.isclose(light[plain], 9.0, atol=0.05)
    assert borrowed.sum() > 0 and answered.sum() > 100 and (answered | borrowed).mean() > 0.97


# -------------------------------------- parts of the reference --------------------------------------


def test_reference_rays_agree_with_mitsubas_sensor(tiny: Seen) -> None:
    scene = load_scene("tiny", width=40, height=30)
    sensor = scene.make_sensor(tiny.camera)
    x, y = np.array([0.5, 39.2, 20.0, 3.3]), np.array([0.5, 2.0, 15.0, 29.9])
    position = mi.Point2f(np.stack([x / 40, y / 30]).astype(np.float32))
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    _, direction = camera_rays(tiny.camera, x, y)
    np.testing.assert_allclose(np.array(ray.d).T, direction, atol=1e-5)


def test_bilinear_returns_texels_at_their_centres() -> None:
    grids = np.random.default_rng(0).random((3, POLAR, AZIMUTH, 3))
    slot, row, column = np.meshgrid(np.arange(3), np.arange(POLAR), np.arange(AZIMUTH), indexing="ij")
    theta = (row.ravel() + 0.5) / POLAR * np.pi / 2
    phi = (column.ravel() + 0.5) / AZIMUTH * 2 * np.pi
    x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    np.testing.assert_allclose(bilinear(grids, slot.ravel(), x, y, z), grids.reshape(-1, 3), atol=1e-12)
    # Half-way between the last and the first azimuth: the mean of both.
    between = bilinear(grids, np.array([1]), np.sin([theta[0]]), np.zeros(1), np.cos([theta[0]]))
    np.testing.assert_allclose(between[0], (grids[1, 0, 0] + grids[1, 0, -1]) / 2, atol=1e-12)
