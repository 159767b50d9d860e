"""Baking kernels: exitant radiance of cache elements, one launch for a batch of elements.

A launch's lanes are (element, direction, sample) with the sample fastest. The first vertex draws from low-discrepancy
sequences that the elements of a unit share (`workers/sequences.py`), the rest of a path from a PCG32 stream of its own;
both are chosen by the element's unit seed, its place in the unit and the pass, so that the result does not depend
on how units are grouped into launches; the mean over samples is a block reduction in a fixed order. Both make a
bake bit-identical when it is run again.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from workers.backend import dr, mi
from workers.elements import ElementSet
from workers.lobes import LobeClass, directional_lobes, has, specular_tint
from workers.sequences import PaddedPoints
from workers.surfaces import SurfaceTable
from workers.transport import CachedLobes, exitant_start, incident_radiance, lambertian_start

if TYPE_CHECKING:
    from workers.gather import DiffuseGather

GRAZING_COSINE = 0.02  # directions below are baked at this cosine: a surface seen edge-on shows nothing


@dataclass(frozen=True)
class Batch:
    """Elements of one launch.

    Attributes:
        element: indices into the element set, int64 [n].
        seed: unit seed of each element, uint64 [n].
        place: position of each element in its unit, uint64 [n].
    """

    element: np.ndarray
    seed: np.ndarray
    place: np.ndarray


def _streams(batch: Batch, lanes_per_element: int, bake_pass: int) -> "mi.PCG32":
    """One random stream a lane."""
    n = len(batch.element)
    lane = dr.arange(mi.UInt32, n * lanes_per_element)
    owner = lane // lanes_per_element
    seed = dr.gather(mi.UInt64, mi.UInt64(batch.seed), owner)
    place = dr.gather(mi.UInt64, mi.UInt64(batch.place), owner)
    within = mi.UInt64(lane % lanes_per_element)
    low = mi.UInt32(place * lanes_per_element + within)
    high = mi.UInt32(seed) + dr.opaque(mi.UInt32, (bake_pass * 0x9E3779B9) & 0xFFFFFFFF)
    v0, v1 = mi.sample_tea_32(high, low, 6)
    # With a size, PCG32 adds the lane's place in the launch to its stream: grouping would change the result.
    return mi.PCG32(1, initstate=mi.UInt64(v0), initseq=mi.UInt64(v1))


def _points(batch: Batch, num_texels: int, spp: int, bake_pass: int) -> PaddedPoints:
    """Points of every lane: sequences a texel, that go on from one element of a unit to the next."""
    lanes_per_element = num_texels * spp
    lane = dr.arange(mi.UInt32, len(batch.element) * lanes_per_element)
    owner = lane // lanes_per_element
    place = mi.UInt32(dr.gather(mi.UInt64, mi.UInt64(batch.place), owner))
    texel, sample = lane % lanes_per_element // spp, lane % spp
    shift = dr.opaque(mi.UInt32, (bake_pass * 0x85EBCA6B) & 0xFFFFFFFF)
    seed, _ = mi.sample_tea_32(mi.UInt32(dr.gather(mi.UInt64, mi.UInt64(batch.seed), owner)) + shift, texel, 6)
    return PaddedPoints(place * spp + sample, seed)


def _interactions(
    table: SurfaceTable, elements: ElementSet, batch: Batch, lanes_per_element: int
) -> "tuple[mi.SurfaceInteraction3f, mi.Vector3f, mi.UInt32, mi.UInt32]":
    """(interaction, normal towards the cached side, lobe bits, lane in element) of every lane."""
    chosen = batch.element
    si = table.interaction(elements.shape[chosen], elements.prim_local[chosen], elements.uv[chosen])
    normal = mi.Vector3f(np.ascontiguousarray(elements.normal[chosen].T))
    bits = dr.gather(mi.UInt32, table.lobe_bits_dr, mi.UInt32(elements.shape[chosen].astype(np.uint32)))
    dr.eval(si, normal, bits)
    lane = dr.arange(mi.UInt32, len(chosen) * lanes_per_element)
    owner = lane // lanes_per_element
    return (
        dr.gather(mi.SurfaceInteraction3f, si, owner),
        dr.gather(mi.Vector3f, normal, owner),
        dr.gather(mi.UInt32, bits, owner),
        lane % lanes_per_element,
    )


def _block_mean(value: "mi.Color3f", block: int) -> np.ndarray:
    """Mean over runs of `block` lanes; float32 [lanes / block, 3].

    The lanes are evaluated first, all channels at once: a block reduction evaluates its own input, and would run
    the whole path-tracing loop again for each channel.
    """
    dr.eval(value)
    means = [dr.block_reduce(dr.ReduceOp.Add, channel, block) / block for channel in value]
    dr.eval(means)
    return np.stack([channel.numpy() for channel in means], -1)


def bake_diffuse(
    mi_scene: "mi.Scene", table: SurfaceTable, elements: ElementSet, batch: Batch, spp: int, bake_pass: int,
    max_depth: int, gather: "DiffuseGather | None" = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Irradiance over pi of a batch: D in L_diffuse = rho_d * D; `gather` as in `bake_directional`.

    Returns:
        (mean, mean of squares), float32 [n, 3] each, linear radiance.
    """
    si, normal, _, _ = _interactions(table, elements, batch, spp)
    rng = _streams(batch, spp, bake_pass)
    direct, start = lambertian_start(mi_scene, si, normal, _points(batch, 1, spp, bake_pass))
    value = direct + incident_radiance(mi_scene, start, rng, max_depth, gather)
    dr.eval(value)
    return _block_mean(value, spp), _block_mean(dr.square(value), spp)


def bake_directional(
    mi_scene: "mi.Scene", table: SurfaceTable, elements: ElementSet, batch: Batch, grid: tuple[int, int],
    spp: int, bake_pass: int, max_depth: int, exitant: bool, gather: "DiffuseGather | None" = None,
) -> np.ndarray:  # fmt: skip
    """Exitant radiance by direction of a batch.

    Args:
        mi_scene: the scene.
        table: its surfaces.
        elements: all elements.
        batch: those of this launch.
        grid: (azimuth, polar) directions over the hemisphere around the element's normal.
        spp: samples per direction, spread over its bin.
        bake_pass: index of the pass.
        max_depth: longest path (camera's count).
        exitant: all of the exitant radiance, emission and delta lobes included (the paper); else the directional
            lobe divided by its tint, without the diffuse lobe.
        gather: diffuse caches that end paths (`workers/gather.py`); None: paths end by themselves.

    Returns:
        float32 [n, polar, azimuth, 3].
    """
    azimuth, polar = grid
    lanes = azimuth * polar * spp
    si, normal, bits, lane = _interactions(table, elements, batch, lanes)
    rng, points = _streams(batch, lanes, bake_pass), _points(batch, azimuth * polar, spp, bake_pass)
    view = direction_in_bin(lane // spp, grid, points.next_2d(), normal)
    si.wi = si.to_local(view)
    everything = mi.Bool(True)
    tint = mi.Color3f(1.0)
    if exitant:
        lobes = CachedLobes(mi.BSDFContext(), mi.Color3f(0.0), True, None)
        direct, start = exitant_start(mi_scene, si, lobes, points)
        direct += si.emitter(mi_scene).eval(si)
    else:
        whole = has(bits, LobeClass.WHOLE) if table.lobe_union & LobeClass.WHOLE else None
        lobes = CachedLobes(*directional_lobes(si, bits, table.lobe_union), False, whole)
        direct, start = exitant_start(mi_scene, si, lobes, points)
        tint = specular_tint(si.bsdf(), si, bits, table.lobe_union, everything)
    value = (direct + incident_radiance(mi_scene, start, rng, max_depth, gather)) / tint
    return _block_mean(value, spp).reshape(len(batch.element), polar, azimuth, 3)


def direction_in_bin(
    bin_index: "mi.UInt32", grid: tuple[int, int], jitter: "mi.Point2f", normal: "mi.Vector3f"
) -> "mi.Vector3f":
    """World direction in a bin of the hemisphere around `normal`; polar angle and azimuth are uniform in bins."""
    azimuth, polar = grid
    column, row = bin_index % azimuth, bin_index // azimuth
    theta = (row + jitter.y) / polar * (dr.pi / 2)
    phi = (column + jitter.x) / azimuth * dr.two_pi
    sin_theta, cos_theta = dr.sincos(theta)
    cos_theta = dr.maximum(cos_theta, GRAZING_COSINE)
    sin_theta = dr.minimum(sin_theta, dr.sqrt(1 - GRAZING_COSINE**2))
    sin_phi, cos_phi = dr.sincos(phi)
    return mi.Frame3f(normal).to_world(mi.Vector3f(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta))
