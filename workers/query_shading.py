"""What the caches answer at a hit: patch, lattice points, gathers and the material at the pixel.

Dr.Jit counterpart of `workers/lattice.py`. What only some pixels need (any cached lobe, directional lobes,
principled materials) stands behind `dr.if_stmt`: a packet of rays without such lanes jumps over it.
"""

from dataclasses import dataclass

import numpy as np

from workers.backend import dr, mi
from workers.elements import NO_SLOT, NOT_BAKED, ElementSet
from workers.lobes import LobeClass, diffuse_reflectance, has, shown_albedo, specular_tint
from workers.query_directional import DirectionalLookup, four_channels, with_locators, xyz
from workers.surfaces import SurfaceTable
from workers.texels import DirectionalTexels

STAND_IN_WEIGHT = 1e-4  # a stand-in counts only where no baked point does


@dataclass(frozen=True)
class CacheArrays:
    """Baked values in memory, by slot.

    Attributes:
        diffuse: D (or the diffuse lobe itself, not demodulated) of every element, float32 [n, 3].
        directional: S of the elements in `ElementSet.glossy`; float32 [g, polar, azimuth, 3] is one grid for all.
        demodulated: whether `diffuse` is to be multiplied by the pixel's reflectance.
        exitant: whether `directional` holds all of the exitant radiance (paper-exact).
    """

    diffuse: np.ndarray
    directional: DirectionalTexels | np.ndarray
    demodulated: bool = True
    exitant: bool = False

    @property
    def texels(self) -> DirectionalTexels:
        """The directional cache as the query reads it."""
        if isinstance(self.directional, DirectionalTexels):
            return self.directional
        return DirectionalTexels.uniform(self.directional)


@dataclass
class Shaded:
    """One hit: radiance of its cached lobes and emission, albedo, lookups answered and asked, lobe bits."""

    radiance: "mi.Color3f"
    albedo: "mi.Color3f"
    covered: "mi.Float"
    asked: "mi.Float"
    bits: "mi.UInt32"


class CacheShading:
    """Caches of one scene in device memory."""

    def __init__(self, mi_scene: "mi.Scene", table: SurfaceTable, elements: ElementSet, caches: CacheArrays) -> None:
        self.scene, self.table = mi_scene, table
        self.demodulated, self.exitant = caches.demodulated, caches.exitant
        self.union = table.lobe_union
        patches = elements.patches
        self.prim = mi.UInt32(
            _interleaved(patches.prim_patches * np.uint32(2) + patches.prim_is_square, patches.prim_base)
        )
        self.patch = mi.UInt32(_interleaved(patches.patch_level, patches.patch_base[:-1]))
        self.diffuse_slot, self.glossy_slot = (
            mi.UInt32(elements.diffuse_slot),
            mi.UInt32(elements.glossy_slot),
        )
        self.diffuse = mi.Float(four_channels(caches.diffuse))
        self.directional = DirectionalLookup(caches.texels)
        normals = four_channels(elements.normal[elements.glossy])
        self.glossy_normal = mi.Float(with_locators(normals, caches.texels))
        self.glossy_position = mi.Float(four_channels(elements.position[elements.glossy]))
        self.is_parametric = mi.UInt32(table.is_parametric.astype(np.uint32))
        self.has_diffuse = bool(np.any(elements.diffuse_slot != NO_SLOT))
        self.has_glossy = bool(np.any(elements.glossy_slot != NO_SLOT))

    def state(self) -> tuple:
        """All device memory that a frozen program reads."""
        table = self.table
        arrays = tuple(value for value in vars(self).values() if dr.is_array_v(value))
        arrays += (self.directional.texels,)
        maps = (table.normal_maps.textures, table.normal_maps.numbers)
        return arrays, self.scene, table.index_of_registry, table.prim_offset_dr, table.lobe_bits_dr, maps

    def shade(self, pi, si, active) -> Shaded:
        """Answers the interactions `si` of intersections `pi`; adds emission, also that of the sky."""
        hit = active & si.is_valid()
        shape = self.table.shape_index(si, hit)
        bits = dr.gather(mi.UInt32, self.table.lobe_bits_dr, shape, hit)
        emission = si.emitter(self.scene).eval(si, active)
        cached = hit if self.exitant else hit & (has(bits, LobeClass.DIFFUSE) | has(bits, LobeClass.GLOSSY))

        def answer(*_):
            points, weights = self.locate(shape, pi, si, cached)
            rho, tint = self._material(si, bits, cached)
            lobes = self._exitant if self.exitant else self._lobes
            return (*lobes(points, weights, si, bits, cached, rho, tint), shown_albedo(rho, tint, bits, self.union))

        width = dr.width(si)
        black, none = dr.zeros(mi.Color3f, width), dr.zeros(mi.Float, width)
        radiance, covered, asked, albedo = dr.if_stmt(
            (black, none, mi.Float(none), mi.Color3f(black)), cached, answer, lambda *nothing: nothing
        )
        if self.exitant:
            return Shaded(radiance + dr.select(hit, 0.0, emission), albedo, covered, asked, bits)
        radiance = dr.maximum(radiance + emission, 0.0)
        return Shaded(radiance, dr.clip(albedo, 0.0, 1.0), covered, asked, bits)

    def _exitant(self, points, weights, si, bits, active, rho, tint):
        """(radiance, lookups answered, asked) where one lookup holds everything."""
        value, share = self._directional(points, weights, si, active, reflect=False)
        return value, share, dr.select(active, 1.0, 0.0)

    def _lobes(self, points, weights, si, bits, active, rho, tint):
        """(radiance, lookups answered, asked) of the diffuse and the directional lobe."""
        radiance, covered, asked = mi.Color3f(0), mi.Float(0), mi.Float(0)
        if self.has_diffuse:
            wanted = active & has(bits, LobeClass.DIFFUSE)
            value, share = self.diffuse_radiance(points, weights, wanted)
            radiance += dr.select(wanted, value * (rho if self.demodulated else 1.0), 0.0)
            covered += share
            asked += dr.select(wanted, 1.0, 0.0)
        if self.has_glossy:
            wanted = active & has(bits, LobeClass.GLOSSY)
            value, share = self._directional(points, weights, si, wanted, reflect=True)
            radiance += value * tint
            covered += share
            asked += dr.select(wanted, 1.0, 0.0)
        return radiance, covered, asked

    def _material(self, si, bits, hit):
        """(diffuse reflectance, tint of the directional lobe) at the pixel."""
        bsdf = si.bsdf()
        rho = diffuse_reflectance(bsdf, si, bits, self.union & ~LobeClass.PRINCIPLED, hit)
        tint = dr.full(mi.Color3f, 1.0, dr.width(si))
        if self.union & LobeClass.TINTED:
            tinted = hit & has(bits, LobeClass.TINTED)
            sampled = self.union & ~LobeClass.PRINCIPLED
            tint = dr.if_stmt(
                (tint,), tinted, lambda _: (specular_tint(bsdf, si, bits, sampled, tinted),), lambda one: (one,)
            )[0]
        if not self.union & LobeClass.PRINCIPLED:
            return rho, tint
        principled = hit & has(bits, LobeClass.PRINCIPLED)

        def by_parameters(*_):
            parameters = _AskedOnce(bsdf)
            return (
                diffuse_reflectance(parameters, si, bits, LobeClass.PRINCIPLED, principled),
                specular_tint(parameters, si, bits, LobeClass.PRINCIPLED, principled),
            )

        return dr.if_stmt((rho, tint), principled, by_parameters, lambda *plain: plain)

    def locate(self, shape, pi, si, active):
        """(lattice point * 2 + side, weight) three times.

        `lattice.locate_patch` and `lattice.locate_points` on the device.
        """
        parametric = dr.gather(mi.UInt32, self.is_parametric, shape, active) != 0
        uv = dr.select(parametric, si.uv, pi.prim_uv)
        index = dr.gather(mi.UInt32, self.table.prim_offset_dr, shape, active)
        index += dr.select(parametric, 0, pi.prim_index)
        prim = dr.gather(mi.Vector2u, self.prim, index, active)
        cell, b1, b2 = _patch_cell(uv, mi.Int32(prim.x >> 1), (prim.x & 1) != 0)
        patch = dr.gather(mi.Vector2u, self.patch, prim.y + mi.UInt32(cell), active)
        side = dr.select(dr.dot(si.n, si.to_world(si.wi)) < 0, mi.UInt32(1), mi.UInt32(0))
        indices, weights = _lattice_points(b1, b2, mi.Int32(patch.x))
        return [(patch.y + mi.UInt32(index)) * 2 + side for index in indices], weights

    def diffuse_radiance(self, points, weights, active):
        """(interpolated diffuse cache, share that baked elements answered)."""
        value, covered, total = mi.Color3f(0), mi.Float(0), mi.Float(0)
        for point, weight in zip(points, weights, strict=True):
            slot, baked = self.slot(self.diffuse_slot, point, active)
            weight = dr.select(baked, weight, weight * STAND_IN_WEIGHT)
            value += mi.Color3f(xyz(dr.gather(mi.Vector4f, self.diffuse, slot, active))) * weight
            covered += dr.select(baked, weight, 0.0)
            total += weight
        scale = dr.rcp(dr.maximum(total, 1e-20))
        return value * scale, dr.select(active, covered * scale, 0.0)

    def _directional(self, points, weights, si, active, *, reflect: bool):
        """(value, share answered) of the directional cache, 0 where inactive.

        With `reflect`, elements are compared at the same *reflected* direction, so that the reflection on a
        curved surface follows the pixel's own normal instead of the element's.
        """
        view = si.to_world(si.wi)
        normal = si.sh_frame.n
        mirrored = 2 * dr.dot(view, normal) * normal - view

        def look_up(value, covered):
            value, covered, total = mi.Color3f(0), mi.Float(0), mi.Float(0)
            for point, weight in zip(points, weights, strict=True):
                slot, baked = self.slot(self.glossy_slot, point, active)
                weight = dr.select(baked, weight, weight * STAND_IN_WEIGHT)
                packet = dr.gather(mi.Vector4f, self.glossy_normal, slot, active)
                n = xyz(packet)
                direction = 2 * dr.dot(mirrored, n) * n - mirrored if reflect else view
                local = mi.Frame3f(n).to_local(direction)
                value += self.directional.bilinear(slot, packet.w, local, active) * weight
                covered += dr.select(baked, weight, 0.0)
                total += weight
            scale = dr.select(active, dr.rcp(dr.maximum(total, 1e-20)), 0.0)
            return value * scale, covered * scale

        width = dr.width(si)
        nothing = dr.zeros(mi.Color3f, width), dr.zeros(mi.Float, width)
        return dr.if_stmt(nothing, active, look_up, lambda value, covered: (value, covered))

    def slot(self, table, point, active):
        """(slot of a lattice point, whether it was baked there)."""
        raw = dr.gather(mi.UInt32, table, point, active)
        return raw & mi.UInt32(int(NOT_BAKED) - 1), (raw & mi.UInt32(int(NOT_BAKED))) == 0


class _AskedOnce:
    """A BSDF pointer that looks each attribute up once a hit, however often it is asked.

    A virtual call is never merged with an equal one, and each reads its texture again.
    """

    def __init__(self, bsdf: "mi.BSDFPtr") -> None:
        self._bsdf = bsdf
        self._known: dict = {}
        self.eval = bsdf.eval

    def has_attribute(self, name, active):
        return self._ask("has_attribute", name, active)

    def eval_attribute_1(self, name, si, active):
        return self._ask("eval_attribute_1", name, si, active)

    def eval_diffuse_reflectance(self, si, active):
        return self._ask("eval_diffuse_reflectance", si, active)

    def _ask(self, method: str, *arguments):
        key = (method, *(argument for argument in arguments if isinstance(argument, str)))
        if key not in self._known:
            self._known[key] = getattr(self._bsdf, method)(*arguments)
        return self._known[key]


def _interleaved(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.stack([first, second], 1).astype(np.uint32).reshape(-1)


def _patch_cell(uv, m, square):
    """`lattice.locate_patch` on the device."""
    su, sv = dr.clip(uv.x, 0.0, 1.0) * m, dr.clip(uv.y, 0.0, 1.0) * m
    i, j = dr.minimum(mi.Int32(su), m - 1), dr.minimum(mi.Int32(sv), m - 1)
    i = dr.select(square, i, dr.clip(i, 0, m - 1 - j))
    fu, fv = su - i, sv - j
    upper = (fu + fv > 1) & (square | (i + j < m - 1))
    row = dr.select(square, j * 2 * m, j * (2 * m - j))
    cell = row + 2 * i + dr.select(upper, mi.Int32(1), mi.Int32(0))
    return cell, dr.select(upper, 1 - fu, fu), dr.select(upper, 1 - fv, fv)


def _lattice_points(b1, b2, level):
    """`lattice.locate_points` on the device."""
    n = dr.maximum(level, 1)
    su, sv = dr.clip(b1, 0.0, 1.0) * n, dr.clip(b2, 0.0, 1.0) * n
    i, j = dr.minimum(mi.Int32(su), n - 1), dr.minimum(mi.Int32(sv), n - 1)
    i = dr.clip(i, 0, n - 1 - j)
    fu, fv = dr.clip(su - i, 0.0, 1.0), dr.clip(sv - j, 0.0, 1.0)
    upper = (fu + fv > 1) & (i + j < n - 1)
    over = dr.maximum(fu + fv, 1.0)
    w2 = dr.select(upper, 1 - fu, fu / over)
    w3 = dr.select(upper, 1 - fv, fv / over)
    low, high_u, high_v = _point(i, j, n), _point(i + 1, j, n), _point(i, j + 1, n)
    single = level == 0
    indices = [
        dr.select(upper, _point(i + 1, j + 1, n), low),
        dr.select(upper, high_v, high_u),
        dr.select(upper, high_u, high_v),
    ]
    zero = mi.Int32(0)
    weights = [
        dr.select(single, 1.0, 1 - w2 - w3),
        dr.select(single, 0.0, w2),
        dr.select(single, 0.0, w3),
    ]
    return [dr.select(single, zero, index) for index in indices], weights


def _point(i, j, n):
    return j * (n + 1) - j * (j - 1) // 2 + i
