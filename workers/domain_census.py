"""What the camera domain's rays hit first: counts by shape, and how far each G-buffer channel varies."""

from dataclasses import dataclass

import numpy as np

from workers.backend import dr, mi
from workers.camera import Camera
from workers.elements import NO_SLOT, NOT_BAKED, ElementSet
from workers.lattice import locate_patch, locate_points
from workers.lobes import diffuse_reflectance, shown_albedo, specular_tint
from workers.surfaces import SurfaceTable
from workers.visibility import Hits, pose_rays

CHANNELS = ("normal", "albedo", "distance")
# A channel whose deviation is below this (of a unit normal, of white, of the mean distance) tells a network nothing.
SMALLEST_DEVIATION = 1e-3


@dataclass(frozen=True, kw_only=True)
class ChannelSpread:
    """How far a G-buffer channel varies over the first hits of the domain.

    Attributes:
        mean: of each component; the distance in scene units.
        deviation: root of the summed variance of the components; the distance's relative to its mean.
        varies: whether that is above `SMALLEST_DEVIATION`.
    """

    mean: tuple[float, ...]
    deviation: float
    varies: bool


@dataclass(frozen=True, kw_only=True)
class DomainCensus:
    """First hits of the domain's rays.

    Attributes:
        num_rays: cast.
        shape_hits: first hits by stable shape index, int64 [num_shapes].
        shape_albedo_deviation: of the diffuse reflectance over a shape's hits, float64 [num_shapes].
        channels: spread of each of `CHANNELS`; None where nothing is hit.
    """

    num_rays: int
    shape_hits: np.ndarray
    shape_albedo_deviation: np.ndarray
    channels: dict[str, ChannelSpread | None]


def take_census(mi_scene: "mi.Scene", table: SurfaceTable, poses: list[Camera], rays_per_pose: int) -> DomainCensus:
    """Casts the rays of `visibility.domain_hits` (fewer of them, if asked) and looks at what they hit first."""
    num_shapes = len(table.shapes)
    moments = {name: np.zeros((num_shapes, 2, 3)) for name in CHANNELS}
    hits, num_rays = np.zeros(num_shapes, np.int64), 0
    for index, pose in enumerate(poses):
        shape, values = _first_hits(mi_scene, table, pose_rays(table, pose, rays_per_pose, index))
        num_rays += len(shape)
        seen = shape < num_shapes
        hits += np.bincount(shape[seen], minlength=num_shapes)
        for name, value in values.items():
            _add_moments(moments[name], shape[seen], value[seen].astype(np.float64))
    channels = {name: _spread(name, sums.sum(axis=0), int(hits.sum())) for name, sums in moments.items()}
    return DomainCensus(
        num_rays=num_rays, shape_hits=hits, shape_albedo_deviation=_deviation(moments["albedo"], hits),
        channels=channels,
    )  # fmt: skip


def _first_hits(mi_scene: "mi.Scene", table: SurfaceTable, ray: "mi.Ray3f") -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(stable shape index, num_shapes on a miss; channels [rays, components]) of each ray."""
    si = mi_scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    hit = si.is_valid()
    shape = table.shape_index(si, hit)
    bits = dr.gather(mi.UInt32, table.lobe_bits_dr, shape, hit)
    rho, tint = (read(si.bsdf(), si, bits, table.lobe_union, hit) for read in (diffuse_reflectance, specular_tint))
    albedo = dr.clip(shown_albedo(rho, tint, bits, table.lobe_union), 0.0, 1.0)
    normal = si.sh_frame.n * dr.sign(-dr.dot(si.n, ray.d))
    index = dr.select(hit, shape, len(table.shapes))
    distance = si.t / table.frame.scale
    dr.eval(index, albedo, normal, distance)
    columns = distance.numpy()[:, None]
    return index.numpy().astype(np.int64), {"normal": normal.numpy().T, "albedo": albedo.numpy().T, "distance": columns}


def _add_moments(sums: np.ndarray, shape: np.ndarray, values: np.ndarray) -> None:
    """Adds the first and second moments of values [n, components] to sums [num_shapes, 2, 3]."""
    for component in range(values.shape[1]):
        column = np.where(np.isfinite(values[:, component]), values[:, component], 0.0)
        sums[:, 0, component] += np.bincount(shape, weights=column, minlength=len(sums))
        sums[:, 1, component] += np.bincount(shape, weights=column**2, minlength=len(sums))


def _deviation(sums: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Root of the summed variance over components; float64 [...]."""
    number = np.maximum(count, 1)[..., None]
    variance = sums[..., 1, :] / number - (sums[..., 0, :] / number) ** 2
    return np.sqrt(np.maximum(variance, 0.0).sum(axis=-1))


def _spread(name: str, sums: np.ndarray, count: int) -> ChannelSpread | None:
    if count == 0:
        return None
    components = 1 if name == "distance" else 3
    mean = sums[0, :components] / count
    deviation = float(_deviation(sums, np.array(count)))
    if name == "distance":
        deviation /= max(float(mean[0]), 1e-30)
    return ChannelSpread(mean=tuple(map(float, mean)), deviation=deviation, varies=deviation > SMALLEST_DEVIATION)


def element_hits(elements: ElementSet, hits: Hits) -> np.ndarray:
    """Hits of the domain that each element answers for, by its nearest lattice point; int64 [num_elements]."""
    patches = elements.patches
    square, m = patches.prim_is_square[hits.prim], patches.prim_patches[hits.prim]
    cell, b1, b2 = locate_patch(hits.uv[:, 0], hits.uv[:, 1], m, square)
    patch = patches.prim_base[hits.prim].astype(np.int64) + cell
    index, weight = locate_points(b1, b2, patches.patch_level[patch])
    nearest = np.take_along_axis(index, weight.argmax(axis=1)[:, None], axis=1)[:, 0]
    point = (patches.patch_base[patch] + nearest) * 2 + hits.side
    owner = np.full(len(point), -1, np.int64)
    for slots, members in ((elements.glossy_slot, elements.glossy), (elements.diffuse_slot, None)):
        slot = slots[point]
        baked = (slot != NO_SLOT) & ((slot & NOT_BAKED) == 0)
        owner[baked] = slot[baked] if members is None else members[slot[baked]]
    return np.bincount(owner[owner >= 0], minlength=elements.num_elements)
