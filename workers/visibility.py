"""What the camera domain sees: non-delta surface hits of every pose, with the size of a pixel there.

The domain is the volume that `camera_path.domain_poses` states: the training path and jittered poses around
it.
"""

from dataclasses import dataclass

import numpy as np

from workers.backend import dr, mi
from workers.camera import Camera
from workers.lobes import LobeClass, has
from workers.primary import DeviceCamera, delta_lobes, dominant_lobe
from workers.progress import Progress
from workers.surfaces import SurfaceTable

MAX_CHAIN = 8
MIN_PROBABILITY = 0.02


@dataclass(frozen=True)
class Hits:
    """Hits of the domain on cached surfaces.

    Attributes:
        prim: global primitive, int64 [n].
        uv: barycentrics or surface parameters, float32 [n, 2].
        side: 0 the side of the geometric normal, 1 the other; uint8 [n].
        footprint: edge of a pixel at the hit in the table's local units, float32 [n].
    """

    prim: np.ndarray
    uv: np.ndarray
    side: np.ndarray
    footprint: np.ndarray


def domain_hits(
    mi_scene: "mi.Scene",
    table: SurfaceTable,
    poses: list[Camera],
    target_width: int,
    rays_per_pose: int,
    progress: Progress,
) -> Hits:
    """Traces every pose of the domain, through delta surfaces (both lobes at the first one).

    Args:
        mi_scene: the scene.
        table: its surfaces.
        poses: cameras of the domain.
        target_width: image width in pixels for which footprints are stated.
        rays_per_pose: about how many rays a pose casts.
        progress: told pose by pose.
    """
    collected: list[Hits] = []
    with progress.track("visibility", len(poses)) as advance:
        for index, pose in enumerate(poses):
            collected += _pose_hits(mi_scene, table, pose, target_width, rays_per_pose, index)
            advance()
    names = ("prim", "uv", "side", "footprint")
    return Hits(*(np.concatenate([getattr(h, name) for h in collected]) for name in names))


def _pose_hits(
    mi_scene: "mi.Scene", table: SurfaceTable, pose: Camera, target_width: int, rays: int, index: int
) -> list[Hits]:
    ray = pose_rays(table, pose, rays, index)
    count = dr.width(ray)
    pixel = dr.opaque(mi.Float, 2 * np.tan(np.radians(pose.fov_deg) / 2) / target_width)
    follows = bool(table.lobe_union & LobeClass.DELTA)
    waves = [(ray, dr.zeros(mi.Float, count), 0)]
    found = []
    while waves:
        ray, travelled, depth = waves.pop()
        pi = mi_scene.ray_intersect_preliminary(ray, coherent=depth == 0)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        travelled = travelled + dr.select(si.is_valid(), si.t, 0.0)
        hits = _hits(table, pi, si, travelled * pixel, ray)
        following = _next_rays(table, si, depth) if follows and depth < MAX_CHAIN else []
        # One launch a wave; what follows starts from memory instead of repeating the waves before it.
        dr.eval(hits, following, travelled)
        found.append(_read_hits(*hits))
        for next_ray, valid in following:
            lanes = dr.compress(valid)
            if len(lanes):
                next_ray = dr.gather(mi.Ray3f, next_ray, lanes)
                waves.append((next_ray, dr.gather(mi.Float, travelled, lanes), depth + 1))
    return found


def pose_rays(table: SurfaceTable, pose: Camera, rays: int, index: int) -> "mi.Ray3f":
    """Rays of a pose in the table's local units, one a cell of a raster with the image's aspect, jittered.

    Args:
        table: says in which frame the scene lies.
        pose: the camera.
        rays: about how many.
        index: of the pose, which seeds the jitter.
    """
    scale = np.sqrt(rays / (pose.width * pose.height))
    width, height = max(1, round(pose.width * scale)), max(1, round(pose.height * scale))
    lane = dr.arange(mi.UInt32, width * height)
    rng = mi.PCG32(width * height, initstate=dr.opaque(mi.UInt64, index), initseq=mi.UInt64(lane))
    x, y = lane % width, lane // width
    camera = DeviceCamera.upload(table.frame.local_camera(pose))
    return camera.ray(x + rng.next_float32(), y + rng.next_float32(), width, height)


def _hits(table, pi, si, footprint, ray):
    """(whether the hit is on a cached surface, primitive, uv, side, footprint) of every lane."""
    valid = si.is_valid()
    shape = table.shape_index(si, valid)
    bits = dr.gather(mi.UInt32, table.lobe_bits_dr, shape, valid)
    cached = valid & (has(bits, LobeClass.DIFFUSE) | has(bits, LobeClass.GLOSSY))
    parametric = dr.gather(mi.Bool, mi.Bool(table.is_parametric), shape, valid)
    uv = dr.select(parametric, si.uv, pi.prim_uv)
    prim = dr.gather(mi.UInt32, table.prim_offset_dr, shape, valid) + dr.select(parametric, 0, pi.prim_index)
    side = dr.select(dr.dot(si.n, ray.d) > 0, mi.UInt32(1), mi.UInt32(0))
    return cached, prim, uv, side, footprint


def _read_hits(cached, prim, uv, side, footprint) -> Hits:
    keep = cached.numpy().astype(bool)
    return Hits(
        prim.numpy()[keep].astype(np.int64),
        uv.numpy().T[keep].astype(np.float32),
        side.numpy()[keep].astype(np.uint8),
        footprint.numpy()[keep].astype(np.float32),
    )


def _next_rays(table, si, depth):
    """(ray, whether it is followed) behind delta surfaces: both lobes at the first hit, then the likelier."""
    valid = si.is_valid()
    bits = dr.gather(mi.UInt32, table.lobe_bits_dr, table.shape_index(si, valid), valid)
    a, b = delta_lobes(si.bsdf(), si, valid & has(bits, LobeClass.DELTA))
    if depth == 0:
        options = [(lobe.wo, lobe.valid & (lobe.pdf * dr.max(lobe.weight) > MIN_PROBABILITY)) for lobe in (a, b)]
    else:
        wo, _, valid = dominant_lobe(a, b)
        options = [(wo, valid)]
    return [(si.spawn_ray(si.to_world(wo)), valid) for wo, valid in options]
