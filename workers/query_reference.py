"""The cache query in slow, readable NumPy (float64): what `workers/query.py` must return.

Only the ray cast and the material are Mitsuba's; camera rays, lattice, slots, directional lookup, averaging
and the paper's weights are plain arrays. One pass per sample and bounce: for tests and small frames.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from workers.backend import dr, mi
from workers.camera import Camera
from workers.elements import NO_SLOT, NOT_BAKED, ElementSet
from workers.lattice import locate_patch, locate_points
from workers.lobes import LobeClass, diffuse_reflectance, shown_albedo, specular_tint
from workers.primary import delta_lobes, dominant_lobe
from workers.query import CacheArrays
from workers.settings import QuerySettings
from workers.supersampling import (
    MAX_ALBEDO_STEP,
    MAX_BEND,
    MAX_RADIANCE_STEP,
    MAX_TURN,
    edge_places,
    grid_places,
)
from workers.surfaces import SurfaceTable

STAND_IN_WEIGHT = 1e-4  # a point that was not baked counts only where no baked point does
MIN_COSINE = 0.02  # elements are baked down to this cosine of the polar angle
MIN_THROUGHPUT = 0.01  # weaker delta lobes of the first hit are not followed
PAPER_DELTA = 0.01


@dataclass(frozen=True)
class HitRecords:
    """Hits of one wavefront; `n` rays, all vectors in world space.

    Attributes:
        si: Mitsuba's interactions, for the material.
        valid: whether the ray met a surface, bool [n].
        shape: stable shape index, int64 [n] (0 on a miss).
        prim: global primitive, int64 [n].
        uv: barycentrics or surface parameters, float64 [n, 2].
        side: 0 the side of the geometric normal, 1 the other; int64 [n].
        lobes: `LobeClass` bits, int64 [n] (0 on a miss).
        position, view, normal: hit, unit direction to the viewer, unit shading normal as stored; [n, 3] each.
        facing: +1 where the geometric normal looks at the viewer, -1 where not; float64 [n].
        distance: along the ray in scene units, float64 [n].
        prim_size: square root of |dp/du x dp/dv|, float64 [n].
        rho, tint, emission: rho_d, t_s and emitted radiance (the environment's on a miss); float64 [n, 3].
        albedo, mapped_normal: for the G-buffer; float64 [n, 3] each.
    """

    si: "mi.SurfaceInteraction3f"
    valid: np.ndarray
    shape: np.ndarray
    prim: np.ndarray
    uv: np.ndarray
    side: np.ndarray
    lobes: np.ndarray
    position: np.ndarray
    view: np.ndarray
    normal: np.ndarray
    facing: np.ndarray
    distance: np.ndarray
    prim_size: np.ndarray
    rho: np.ndarray
    tint: np.ndarray
    albedo: np.ndarray
    mapped_normal: np.ndarray
    emission: np.ndarray


def camera_rays(camera: Camera, x_px: np.ndarray, y_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions, float64 [n, 3] each; pixel coordinates (0, 0) are the top left corner."""
    tan_width = np.tan(np.radians(camera.fov_deg) / 2)
    left = (1 - 2 * x_px / camera.width) * tan_width
    up = (1 - 2 * y_px / camera.height) * tan_width * camera.height / camera.width
    local = np.stack([left, up, np.ones_like(left)], -1)
    direction = local @ camera.to_world[:3, :3].T
    origin = np.broadcast_to(camera.to_world[:3, 3], direction.shape)
    return origin, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def trace(mi_scene: "mi.Scene", table: SurfaceTable, origin: np.ndarray, direction: np.ndarray) -> HitRecords:
    """Casts rays (float [n, 3] each, world space) and reads surface and material of what they meet."""
    ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray(origin.T)), mi.Vector3f(np.ascontiguousarray(direction.T)))
    pi = mi_scene.ray_intersect_preliminary(ray)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    valid = si.is_valid()
    hit, miss = _array(valid).astype(bool), ~_array(valid).astype(bool)
    index = table.shape_index(si, valid)
    shape = _array(index).astype(np.int64)
    bits = np.where(hit, np.array([int(lobe) for lobe in table.lobes])[shape], 0)
    device_bits = mi.UInt32(bits.astype(np.uint32))
    rho = diffuse_reflectance(si.bsdf(), si, device_bits, table.lobe_union, valid)
    tint = specular_tint(si.bsdf(), si, device_bits, table.lobe_union, valid)
    normal, geometric = _rows(si.sh_frame.n), _rows(si.n)
    parametric = table.is_parametric[shape] & hit
    view = -_rows(ray.d)
    toward = (geometric * view).sum(1)
    prim_local = np.where(parametric, 0, _array(pi.prim_index).astype(np.int64))
    uv = np.where(parametric[:, None], _rows(si.uv), _rows(pi.prim_uv))
    return HitRecords(
        si=si,
        valid=hit,
        shape=shape,
        prim=np.where(hit, table.prim_offset[shape] + prim_local, 0),
        uv=np.where(hit[:, None], uv, 0.0),
        side=(toward < 0).astype(np.int64),
        lobes=bits,
        position=_rows(si.p),
        view=view,
        normal=np.where(miss[:, None], 0.0, normal),
        facing=np.where(toward < 0, -1.0, 1.0),
        distance=np.where(hit, _array(si.t), 0.0),
        prim_size=np.sqrt(np.linalg.norm(np.cross(_rows(si.dp_du), _rows(si.dp_dv)), axis=1)),
        rho=np.where(hit[:, None], _rows(rho), 0.0),
        tint=np.where(hit[:, None], _rows(tint), 1.0),
        albedo=np.where(hit[:, None], _rows(shown_albedo(rho, tint, device_bits, table.lobe_union)), 0.0),
        mapped_normal=np.where(miss[:, None], 0.0, _rows(table.normal_maps.normal(si, index, valid))),
        emission=_rows(si.emitter(mi_scene).eval(si)),
    )


@dataclass(frozen=True)
class _Query:
    """One scene's caches, and what is read from them."""

    mi_scene: "mi.Scene"
    table: SurfaceTable
    elements: ElementSet
    caches: CacheArrays
    settings: QuerySettings

    # ------------------------------------------- reading -------------------------------------------

    def lattice_points(self, hits: HitRecords) -> tuple[np.ndarray, np.ndarray]:
        """(lattice point * 2 + side, weight) around each hit, [n, 3] each."""
        patches = self.elements.patches
        m, square = patches.prim_patches[hits.prim], patches.prim_is_square[hits.prim]
        cell, b1, b2 = locate_patch(hits.uv[:, 0], hits.uv[:, 1], m, square)
        patch = patches.prim_base[hits.prim] + cell
        index, weight = locate_points(b1, b2, patches.patch_level[patch])
        return (patches.patch_base[patch][:, None] + index) * 2 + hits.side[:, None], weight

    def blend(
        self, slots: np.ndarray, weight: np.ndarray, read: Callable[[np.ndarray], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weighted mean of what `read` gives for three slots, and the share of it that was baked there."""
        baked = (slots & NOT_BAKED) == 0
        weight = np.where(baked, weight, STAND_IN_WEIGHT * weight)
        index = (slots & (NOT_BAKED - np.uint32(1))).astype(np.int64)
        values = np.stack([read(slot) for slot in index.T], 1)
        total = weight.sum(1)
        mean = (weight[:, :, None] * values).sum(1) / total[:, None]
        return mean, np.where(baked, weight, 0.0).sum(1) / total

    def diffuse(self, slot: np.ndarray) -> np.ndarray:
        """Cached diffuse values, float64 [n, 3]."""
        return self.caches.diffuse[slot].astype(np.float64)

    def directional(self, hits: HitRecords, slot: np.ndarray) -> np.ndarray:
        """Directional radiance of elements towards each hit's viewer, float64 [n, 3].

        The split lobe is looked up at equal *reflected* direction: an element with another normal answers for
        the viewer who would see the same reflection in it. All of the exitant radiance is looked up as it is.
        """
        normal = self.elements.normal[self.elements.glossy][slot].astype(np.float64)
        seen = hits.view if self.caches.exitant else _mirror(_mirror(hits.view, hits.normal), normal)
        frame = mi.Frame3f(mi.Vector3f(np.ascontiguousarray(normal.T)))
        x, y, z = ((_rows(axis) * seen).sum(1) for axis in (frame.s, frame.t, frame.n))
        result = np.empty((len(slot), 3))
        for members, grids in self.caches.texels.grids():  # those of one size at a time
            row = np.searchsorted(members, slot).clip(max=len(members) - 1)
            here = members[row] == slot
            result[here] = bilinear(grids.astype(np.float64), row[here], x[here], y[here], z[here])
        return result

    # ------------------------------------------- shading -------------------------------------------

    def shade(self, hits: HitRecords) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(radiance [n, 3] of cached lobes and emission, baked lookups [n], lookups [n])."""
        points, weight = self.lattice_points(hits)
        baked, asked = np.zeros(len(weight)), np.zeros(len(weight))
        radiance = np.where((hits.valid & self.caches.exitant)[:, None], 0.0, hits.emission)
        lobes = [
            (LobeClass.DIFFUSE, self.elements.diffuse_slot),
            (LobeClass.GLOSSY, self.elements.glossy_slot),
        ]
        for lobe, table in lobes[1:] if self.caches.exitant else lobes:
            wanted = hits.valid & ((hits.lobes & int(lobe)) != 0) | (hits.valid & self.caches.exitant)
            if not np.any(table != NO_SLOT) or not np.any(wanted):
                continue
            part = _take(hits, wanted)
            slots = table[points[wanted]]
            if lobe == LobeClass.DIFFUSE:
                value, share = self.blend(slots, weight[wanted], self.diffuse)
                value = value * (part.rho if self.caches.demodulated else 1.0)
            else:
                value, share = self.blend(slots, weight[wanted], partial(self.directional, part))
                value = value * (1.0 if self.caches.exitant else part.tint)
            radiance[wanted] += value
            baked[wanted] += share
            asked[wanted] += 1
        return (radiance if self.caches.exitant else np.maximum(radiance, 0.0)), baked, asked

    # ------------------------------------------- walking -------------------------------------------

    def walk(self, origin: np.ndarray, direction: np.ndarray) -> dict[str, np.ndarray]:
        """What camera rays gather, by channel; `baked` and `asked` make up the coverage."""
        hits = trace(self.mi_scene, self.table, origin, direction)
        radiance, baked, asked = self.shade(hits)
        albedo = np.clip(hits.albedo, 0, 1)
        if not self.caches.exitant:
            for more in self.first_delta(hits):
                radiance, albedo = radiance + more[0], albedo + more[1]
                baked, asked = baked + more[2], asked + more[3]
        return {
            "ir": radiance,
            "albedo": albedo,
            "normal": hits.mapped_normal * hits.facing[:, None],
            "distance": hits.distance[:, None],
            "position": np.where(hits.valid[:, None], hits.position, np.nan),
            "baked": baked,
            "asked": asked,
            "paper_weight": self.paper_weight(hits) if self.settings.weights != "barycentric" else asked,
        }

    def first_delta(self, hits: HitRecords) -> Iterator[tuple[np.ndarray, ...]]:
        """Both delta lobes of the first hit, each followed to its end."""
        delta = hits.valid & ((hits.lobes & int(LobeClass.DELTA)) != 0)
        for lobe in delta_lobes(hits.si.bsdf(), hits.si, mi.Bool(delta)):
            throughput = _rows(lobe.weight * lobe.pdf)
            go = _array(lobe.valid).astype(bool) & (throughput.max(1) > MIN_THROUGHPUT)
            if np.any(go):
                yield self.chain(hits, lobe.wo, throughput, go)

    def chain(self, hits: HitRecords, wo: "mi.Vector3f", beta: np.ndarray, go: np.ndarray) -> tuple[np.ndarray, ...]:
        """Follows the likelier delta lobe of every later hit, at most `max_chain` segments."""
        radiance, albedo = np.zeros_like(beta), np.zeros_like(beta)
        baked, asked = np.zeros(len(beta)), np.zeros(len(beta))
        for _ in range(self.settings.max_chain):
            ray = hits.si.spawn_ray(hits.si.to_world(wo))
            o, d = _rows(ray.o), _rows(ray.d)
            o[~go], d[~go] = 0.0, (0.0, 0.0, 1.0)
            hits = trace(self.mi_scene, self.table, o, d)
            value, one_baked, one_asked = self.shade(hits)
            radiance += np.where(go[:, None], beta * value, 0.0)
            albedo += np.where(go[:, None], beta * np.clip(hits.albedo, 0, 1), 0.0)
            baked += np.where(go, beta.mean(1) * one_baked, 0.0)
            asked += np.where(go, beta.mean(1) * one_asked, 0.0)
            go = go & hits.valid & ((hits.lobes & int(LobeClass.DELTA)) != 0)
            if not np.any(go):
                break
            wo, weight, valid = dominant_lobe(*delta_lobes(hits.si.bsdf(), hits.si, mi.Bool(go)))
            beta = beta * _rows(weight)
            go = go & _array(valid).astype(bool)
        return radiance, albedo, baked, asked

    # --------------------------------------- paper's weights ---------------------------------------

    def paper_weight(self, hits: HitRecords) -> np.ndarray:
        """W = exp(-|c - x|) max(0, n_c . n_x) + 0.01 for the element that answers (eq. 5 to 7), [n]."""
        points, _ = self.lattice_points(hits)
        slots = self.elements.glossy_slot[points[:, 0]]
        element = self.elements.glossy[np.where(hits.valid, slots & (NOT_BAKED - np.uint32(1)), 0)]
        unit = 1.0 / self.table.frame.scale
        distance = np.linalg.norm(self.elements.position[element] - hits.position, axis=1) * unit
        if self.settings.scale_free:
            distance = distance / np.maximum(hits.prim_size * unit, 1e-38)
        cosine = (self.elements.normal[element] * hits.normal * hits.facing[:, None]).sum(1)
        return np.where(hits.valid, np.exp(-distance) * np.maximum(cosine, 0), 0.0) + PAPER_DELTA


def query_reference(
    mi_scene: "mi.Scene", table: SurfaceTable, elements: ElementSet, caches: CacheArrays,
    settings: QuerySettings, camera: Camera,
) -> dict[str, np.ndarray]:  # fmt: skip
    """One frame of the query.

    Args:
        mi_scene: the scene.
        table: its surfaces.
        elements: its cache elements.
        caches: their baked values.
        settings: samples, weights and chain length.
        camera: the pose and size.

    Returns:
        float64 [height, width, channels] by the names of `workers.query.CHANNELS`, with the same meaning.
    """
    query = _Query(mi_scene, table, elements, caches, settings)
    camera, unit = table.frame.local_camera(camera), 1.0 / table.frame.scale
    y, x = (axis.reshape(-1) for axis in np.mgrid[: camera.height, : camera.width])
    if settings.weights == "barycentric":
        walks = [query.walk(*camera_rays(camera, x + i, y + j)) for i, j in _places(settings)]
        taken = np.ones((len(walks), len(x), 1))
        if settings.samples > 1 and settings.supersample == "edges":
            taken[1:] = edge_contrast(walks[0], camera).reshape(1, -1, 1) > 1
        radiance = _mean(walks, "ir", taken)
    else:
        offsets = [(0, 0), (1, 0), (0, 1)] if settings.weights == "paper" else [(0, 0)]
        rays = [query.walk(*camera_rays(camera, x + 0.5 + i, y + 0.5 + j)) for i, j in offsets]
        weight = np.stack([ray["paper_weight"] for ray in rays])[..., None]
        radiance = (weight * [ray["ir"] for ray in rays]).sum(0) / weight.sum(0)
        walks, taken = rays[:1], np.ones((1, len(x), 1))
    baked, asked = (np.sum([walk[name] for walk in walks] * taken[..., 0], axis=0) for name in ("baked", "asked"))
    with np.errstate(invalid="ignore"):
        coverage = np.where(asked > 0, baked / asked, 1.0)[:, None]
    image = {name: _mean(walks, name, taken) for name in ("normal", "albedo", "distance")}
    image["distance"] = image["distance"] * unit
    image |= {"ir": radiance, "coverage": coverage, "position": walks[0]["position"] * unit}
    return {name: value.reshape(camera.height, camera.width, -1) for name, value in image.items()}


def _places(settings: QuerySettings) -> np.ndarray:
    """[n, 2] places of a pixel's samples, the one that every pixel has first."""
    if settings.samples > 1 and settings.supersample == "edges":
        return np.concatenate([[(0.5, 0.5)], edge_places(settings.samples)])
    return grid_places(settings.samples)


def _mean(walks: list[dict[str, np.ndarray]], name: str, taken: np.ndarray) -> np.ndarray:
    """Mean of a channel over the samples that were taken, [n, components]."""
    values = np.stack([walk[name] for walk in walks])
    return np.sum(np.where(taken > 0, values, 0.0), axis=0) / taken.sum(0)


def edge_contrast(look: dict[str, np.ndarray], camera: Camera) -> np.ndarray:
    """How far a pixel differs from its four neighbours, as a share of what makes it an edge: [height, width].

    Args:
        look: radiance "ir", "normal", "albedo" and "distance" of one sample a pixel.
        camera: gives the size.
    """
    ir, normal, albedo, distance = (
        np.pad(look[name].reshape(camera.height, camera.width, -1), ((1, 1), (1, 1), (0, 0)), mode="edge")
        for name in ("ir", "normal", "albedo", "distance")
    )
    nearness = np.divide(1.0, distance, out=np.zeros_like(distance), where=distance > 0)[..., 0]
    centre = (slice(1, -1), slice(1, -1))
    contrast = np.zeros((camera.height, camera.width))
    for back, on in (((1, 0), (1, 2)), ((0, 1), (2, 1))):  # rows and columns to start at
        before, after = ((slice(i, i + camera.height), slice(j, j + camera.width)) for i, j in (back, on))
        for other in (before, after):
            brighter = np.maximum(ir[centre].max(-1), ir[other].max(-1))
            step = np.abs(ir[centre] - ir[other]).max(-1)
            relative = np.divide(step, brighter, out=np.zeros_like(step), where=brighter > 0)
            turn = np.linalg.norm(normal[centre] - normal[other], axis=-1)
            contrast = np.maximum(contrast, turn / MAX_TURN)
            contrast = np.maximum(contrast, np.abs(albedo[centre] - albedo[other]).max(-1) / MAX_ALBEDO_STEP)
            contrast = np.maximum(contrast, relative / MAX_RADIANCE_STEP)
        bend = np.abs(nearness[before] + nearness[after] - 2 * nearness[centre])
        share = np.divide(bend, nearness[centre], out=np.full_like(bend, np.inf), where=nearness[centre] > 0)
        contrast = np.maximum(contrast, np.where(bend > 0, share / MAX_BEND, 0.0))
    return contrast


def bilinear(grids: np.ndarray, slot: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Looks local directions up in grids [g, polar, azimuth, 3]: polar held at the ends, azimuth periodic."""
    polar, azimuth = grids.shape[1:3]
    row = np.arccos(np.clip(z, MIN_COSINE, 1)) / (np.pi / 2) * polar - 0.5
    row = np.clip(row, 0, polar - 1)
    column = np.arctan2(y, x) / (2 * np.pi) * azimuth - 0.5
    r, c = np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)
    ft, fp = (row - r)[:, None], (column - c)[:, None]
    above = np.minimum(r + 1, polar - 1)
    low = grids[slot, r, c % azimuth] * (1 - fp) + grids[slot, r, (c + 1) % azimuth] * fp
    high = grids[slot, above, c % azimuth] * (1 - fp) + grids[slot, above, (c + 1) % azimuth] * fp
    return low * (1 - ft) + high * ft


def _mirror(direction: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return 2 * (direction * normal).sum(1, keepdims=True) * normal - direction


def _array(value: Any) -> np.ndarray:
    dr.eval(value)
    return np.asarray(value.numpy())


def _rows(value: Any) -> np.ndarray:
    """A Mitsuba vector as float64 [n, components]."""
    dr.eval(value)
    return np.ascontiguousarray(np.array(value, dtype=np.float64).T)


def _take(hits: HitRecords, chosen: np.ndarray) -> HitRecords:
    arrays = {name: value[chosen] for name, value in vars(hits).items() if isinstance(value, np.ndarray)}
    return HitRecords(si=hits.si, **arrays)
