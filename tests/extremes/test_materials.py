"""Grazing views to 89.99 degrees and roughness 1e-4 to 1.

Bounds: no surface under a sky of 1 shows more than 1 (energy; 2 % for the noise of 256 paths a bin), nothing is
negative beyond rounding, and a Lambertian surface looks the same at 89.99 degrees. Dielectric principled materials may
show 15 % more: Disney's model lays its specular lobe over an undimmed diffuse one.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from workers.backend import dr, mi
from workers.bake_kernels import Batch, bake_diffuse, bake_directional
from workers.camera import Camera
from workers.elements import build_elements, surface_frame
from workers.lobes import MIN_TINT, diffuse_reflectance, specular_tint
from workers.progress import Progress
from workers.query import CHANNELS, CacheArrays, QueryProgram
from workers.settings import CacheSettings, QuerySettings
from workers.surfaces import SurfaceTable, build_surface_table
from workers.visibility import domain_hits

ROUGHNESS = [1e-4, 1e-3, 1e-2, 0.1, 1.0]
ANGLES_DEG = [0.0, 60.0, 85.0, 89.0, 89.9, 89.99]
COLOUR = {"type": "rgb", "value": [0.8, 0.5, 0.2]}
GRID = (4, 4)


def materials() -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {"diffuse": {"type": "diffuse", "reflectance": COLOUR}}
    for rough in ROUGHNESS:
        found[f"plastic {rough:g}"] = {"type": "roughplastic", "diffuse_reflectance": COLOUR, "alpha": rough,
                                       "distribution": "ggx"}  # fmt: skip
        found[f"metal {rough:g}"] = {"type": "roughconductor", "material": "Au", "alpha": rough, "distribution": "ggx"}
        for metallic in (0.0, 0.5, 1.0):
            found[f"principled {rough:g} {metallic:g}"] = {
                "type": "principled", "base_color": COLOUR, "metallic": metallic, "roughness": rough,
            }  # fmt: skip
    return found


NAMES = list(materials())
EVERY = pytest.mark.parametrize("name", NAMES)


class Patches:
    """A patch of every material under a sky of 1, none of which sees another."""

    def __init__(self) -> None:
        to = mi.ScalarTransform4f
        shapes = {
            name.replace(".", "_"): {"type": "rectangle", "to_world": to().translate([3.0 * i, 0, 0]), "bsdf": bsdf}
            for i, (name, bsdf) in enumerate(materials().items())
        }
        self.scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, **shapes}, optimize=False)
        self.table: SurfaceTable = build_surface_table(self.scene)
        ids = [shape.id() for shape in self.table.shapes]
        self.shape = np.array([ids.index(name.replace(".", "_")) for name in NAMES])
        count = len(NAMES)
        prim, uv = np.zeros(count, np.int64), np.full((count, 2), 0.3, np.float32)
        position, normal, _ = surface_frame(self.table, self.shape, prim, uv, np.zeros(count, np.uint8))
        self.elements: Any = SimpleNamespace(shape=self.shape, prim_local=prim, uv=uv, normal=normal, position=position)
        self.batch = Batch(np.arange(count), np.full(count, 3, np.uint64), np.arange(count, dtype=np.uint64))
        where = (self.scene, self.table, self.elements, self.batch)
        self.directional = bake_directional(*where, GRID, 256, 0, -1, False)
        self.exitant = bake_directional(*where, GRID, 256, 0, -1, True)
        self.diffuse = bake_diffuse(*where, 1024, 0, -1)[0]


@pytest.fixture(scope="module")
def patches() -> Patches:
    return Patches()


@EVERY
def test_no_roughness_makes_light(patches: Patches, within: Any, name: str) -> None:
    index = NAMES.index(name)
    exitant, lobe = patches.exitant[index], patches.directional[index]
    assert np.isfinite(exitant).all() and np.isfinite(lobe).all() and np.isfinite(patches.diffuse[index]).all()
    overlaid = name.startswith("principled") and not name.endswith(" 1")
    within("exitant radiance under a sky of 1", float(exitant.max()), 1.15 if overlaid else 1.02)
    within("negative radiance", -float(exitant.min()), 1e-4)
    within("irradiance", float(np.abs(patches.diffuse[index] - 1.0).max()), 0.05)


def test_query_factors_are_bounded_at_grazing_angles(patches: Patches, within: Any) -> None:
    """rho_d in [0, 1] and t_s in [MIN_TINT, 1] for every material to 89.99 degrees, and at exactly 90."""
    count = len(NAMES)
    for angle in [*ANGLES_DEG, 90.0]:
        si = patches.table.interaction(patches.shape, patches.elements.prim_local, patches.elements.uv)
        cosine = float(np.cos(np.radians(angle))) if angle < 90 else 0.0
        si.wi = mi.Vector3f(mi.Float(np.full(count, np.sqrt(1 - cosine**2))), 0.0, mi.Float(np.full(count, cosine)))
        bits = dr.gather(mi.UInt32, patches.table.lobe_bits_dr, mi.UInt32(patches.shape.astype(np.uint32)))
        union = patches.table.lobe_union
        rho, tint = (
            np.array(factor(si.bsdf(), si, bits, union, mi.Bool(True))).T
            for factor in (diffuse_reflectance, specular_tint)
        )
        assert np.isfinite(rho).all() and np.isfinite(tint).all(), angle
        within(f"rho_d at {angle:g}", float(rho.max()), 1.0 + 1e-5)
        assert rho.min() >= 0.0 and tint.min() >= MIN_TINT and tint.max() <= 1.0 + 1e-5
        lambertian = NAMES.index("diffuse")
        if angle < 90:
            within(f"Lambertian at {angle:g}", float(np.abs(rho[lambertian] - COLOUR["value"]).max()), 1e-5)


@pytest.mark.parametrize("angle", ANGLES_DEG)
def test_plane_looks_the_same_at_every_angle(angle: float, within: Any) -> None:
    """Caches of 1 on a Lambertian plane, seen along it: the albedo to 1e-4, coverage 1."""
    to = mi.ScalarTransform4f
    bsdf = {"type": "twosided", "b": {"type": "diffuse", "reflectance": COLOUR}}
    plane = {"type": "rectangle", "to_world": to().scale(1e5), "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant", "radiance": 0.0}, "plane": plane})
    tilt = np.radians(angle)
    target = [float(np.sin(tilt)), 0.0, 1.0 - float(np.cos(tilt))]
    camera = Camera.look_at([0, 0, 1], target, [0, 1, 0], 1e-3, 8, 8)
    table = build_surface_table(scene)
    hits = domain_hits(scene, table, [camera], 8, 256, Progress())
    elements = build_elements(table, hits, CacheSettings(max_elements=100))
    ones = np.ones((elements.num_elements, 3), np.float32)
    caches = CacheArrays(ones, np.zeros((0, 2, 2, 3), np.float32))
    features = QueryProgram(scene, table, elements, caches, QuerySettings()).run(camera)
    within("radiance", float(np.abs(features[..., :3] - COLOUR["value"]).max()), 1e-4)
    within("missing coverage", 1.0 - float(features[..., CHANNELS["coverage"][0]].min()), 1e-5)
