"""Paths that end in diffuse caches, against the same paths to their end."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from storage.store import UnitRef
from workers.backend import mi
from workers.bake_kernels import Batch, bake_diffuse, bake_directional
from workers.camera import Camera
from workers.elements import ElementSet, build_elements
from workers.gather import DiffuseGather, gather_params, gathers
from workers.lobes import LobeClass
from workers.progress import Progress
from workers.settings import CacheSettings
from workers.surfaces import SurfaceTable, build_surface_table
from workers.visibility import domain_hits

GRID = (2, 3)  # azimuth, polar
SPP = 16
MAX_Z = 4.9  # two-sided 1e-6 per number, at fixed seeds
CACHE = CacheSettings(max_elements=3000, min_spacing_px=0.5)


@pytest.fixture(scope="module")
def room() -> tuple[Any, SurfaceTable, ElementSet]:
    """A rough metal floor in a closed grey room with a lamp behind a screen: mostly indirect light."""
    to = mi.ScalarTransform4f
    grey = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.6, 0.5]}}}
    metal = {"type": "twosided", "bsdf": {"type": "roughconductor", "material": "Cr", "alpha": 0.2}}
    down = to().translate([0, -0.95, 0]) @ to().rotate([1, 0, 0], -90)
    scene = mi.load_dict(
        {
            "type": "scene",
            "walls": {"type": "cube", "bsdf": grey},
            "floor": {"type": "rectangle", "to_world": down @ to().scale(0.9), "bsdf": metal},
            "screen": {"type": "rectangle", "to_world": to().translate([0, 0.5, 0.1]) @ to().scale([0.4, 0.4, 1]),
                       "bsdf": grey},
            "lamp": {"type": "sphere", "center": [0, 0.5, -0.3], "radius": 0.15,
                     "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.0, 7.0]}}, "bsdf": grey},
        },
        optimize=False,
    )  # fmt: skip
    table = build_surface_table(scene)
    looks = [([0.6, 0.3, 0.8], [-1, -0.6, -1]), ([-0.7, 0.2, -0.8], [1, 0.2, 1]), ([0.1, 0.9, 0.7], [0, -1, -0.2]),
             ([0.0, -0.6, 0.8], [0, 1, 0.1]), ([-0.7, 0.1, 0.8], [0.3, 0.3, -0.4])]  # fmt: skip
    poses = [Camera.look_at(origin, target, [0.1, 0.9, 0.2], 110.0, 64, 64) for origin, target in looks]
    return scene, table, build_elements(table, domain_hits(scene, table, poses, 64, 60_000, Progress()), CACHE)


def baked(room: Any, gather: DiffuseGather | None, seed: int, elements_of: np.ndarray) -> np.ndarray:
    """S of some elements, once for each repeat; float64 [repeats, n, polar, azimuth, 3]."""
    scene, table, elements = room
    repeats = 24
    batch = Batch(np.tile(elements_of, repeats), np.full(len(elements_of) * repeats, seed, np.uint64),
                  np.arange(len(elements_of) * repeats, dtype=np.uint64))  # fmt: skip
    value = bake_directional(scene, table, elements, batch, GRID, SPP, 0, -1, False, gather)
    return value.reshape(repeats, len(elements_of), *value.shape[1:]).astype(np.float64)


@pytest.fixture(scope="module")
def gather(room: tuple[Any, SurfaceTable, ElementSet]) -> DiffuseGather:
    scene, table, elements = room
    owners = elements.diffuse
    batch = Batch(owners, np.full(len(owners), 7, np.uint64), np.arange(len(owners), dtype=np.uint64))
    diffuse = np.zeros((elements.num_elements, 3), np.float32)
    diffuse[owners] = bake_diffuse(scene, table, elements, batch, 1024, 0, -1)[0]
    return DiffuseGather(scene, table, elements, diffuse)


def test_gathered_paths_have_the_same_mean_and_less_noise(room: Any, gather: DiffuseGather) -> None:
    """Within noise and 2 % of interpolation between elements; at most half the variance."""
    _, _, elements = room
    chosen = elements.glossy[:: max(1, len(elements.glossy) // 40)]
    to_the_end, ended = baked(room, None, 1, chosen), baked(room, gather, 2, chosen)
    mean = [value.mean(axis=(0, 1)) for value in (to_the_end, ended)]
    error = np.sqrt(sum(value.mean(1).var(axis=0, ddof=1) / len(value) for value in (to_the_end, ended)))
    assert np.all(np.abs(mean[1] - mean[0]) < MAX_Z * error + 0.02 * mean[0])
    noise = [value.var(axis=0, ddof=1).mean() for value in (to_the_end, ended)]
    assert noise[0] > 2 * noise[1]


def test_only_baked_diffuse_surfaces_are_known(room: Any, gather: DiffuseGather) -> None:
    scene = room[0]
    ray = mi.Ray3f(mi.Point3f(0, 0, 0.6), mi.Vector3f(mi.Float([0, 0]), [-1.0, 0.1], [0.0, 1.0]))
    pi = scene.ray_intersect_preliminary(ray)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    value, known = gather.radiance(pi, si, mi.Bool(True))
    np.testing.assert_array_equal(np.array(known), [False, True])  # the metal floor, the wall behind
    assert np.all(np.array(value)[:, 0] == 0) and np.all(np.array(value)[:, 1] > 0)


def test_gathering_is_off_where_paths_are_short_or_could_hardly_end(room: Any) -> None:
    _, table, elements = room
    assert gathers(CACHE, -1, table, elements) and gathers(CACHE, 8, table, elements)
    assert not gathers(CACHE, 7, table, elements)
    assert not gathers(CacheSettings(gather="paths"), -1, table, elements)
    assert not gathers(CacheSettings(lobes="exitant"), -1, table, elements)
    metal_only = dataclasses.replace(table, lobes=[LobeClass.GLOSSY for _ in table.lobes])
    assert not gathers(CACHE, -1, metal_only, elements)


def test_keys_follow_what_is_gathered_from() -> None:
    refs = [UnitRef("scene", "bake", key) for key in "ab"]
    first = gather_params(refs[0], CACHE)
    assert first == gather_params(refs[0], CACHE) != gather_params(refs[1], CACHE)
    assert first != gather_params(refs[0], CacheSettings(denoise=False))
