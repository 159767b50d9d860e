"""The cache query: G-buffers and imperfect radiance (IR) of a camera pose, as one fused Dr.Jit program.

Every primary ray finds its patch and the three lattice points around its hit, gathers what they cached and
multiplies by the material at the pixel; delta surfaces are followed (both lobes at the first one, the likelier
afterwards) to what lies behind. `workers/query_reference.py` is the same in slow NumPy.
"""

from dataclasses import dataclass

import numpy as np

from workers.backend import dr, mi
from workers.camera import Camera
from workers.elements import NO_SLOT, NOT_BAKED, ElementSet
from workers.lobes import LobeClass, diffuse_reflectance, has, specular_tint
from workers.primary import DeviceCamera, delta_lobes, dominant_lobe
from workers.settings import QuerySettings
from workers.surfaces import SurfaceTable

CHANNELS = {
    "ir": (0, 3), "normal": (3, 6), "albedo": (6, 9), "distance": (9, 10), "coverage": (10, 11), "position": (11, 14),
}  # fmt: skip
NUM_CHANNELS = 16  # padded: one packet scatter a pixel; a scatter per channel would run the program once for each
PAPER_DELTA = 0.01
MIN_BRANCH = 0.01  # a reflection weaker than this is not followed from the first delta surface
GRAZING_COSINE = 0.02
# Sample places in a pixel, by samples along each axis.
_GRIDS = {n: [((i + 0.5) / n, (j + 0.5) / n) for j in range(n) for i in range(n)] for n in (1, 2, 3, 4)}


@dataclass(frozen=True)
class CacheArrays:
    """Baked values in memory, by slot.

    Attributes:
        diffuse: D (or the diffuse lobe itself, not demodulated) of every element, float32 [n, 3].
        directional: S of the elements in `ElementSet.glossy`, float32 [g, polar, azimuth, 3].
        demodulated: whether `diffuse` is to be multiplied by the pixel's reflectance.
        exitant: whether `directional` holds all of the exitant radiance (paper-exact).
    """

    diffuse: np.ndarray
    directional: np.ndarray
    demodulated: bool = True
    exitant: bool = False


@dataclass
class _Walk:
    """What one camera path gathers."""

    radiance: "mi.Color3f"
    albedo: "mi.Color3f"
    normal: "mi.Vector3f"
    distance: "mi.Float"
    position: "mi.Point3f"
    covered: "mi.Float"
    asked: "mi.Float"


class QueryProgram:
    """Caches of one scene, in device memory, and the program that queries them."""

    def __init__(
        self, mi_scene: "mi.Scene", table: SurfaceTable, elements: ElementSet, caches: CacheArrays,
        settings: QuerySettings,
    ) -> None:  # fmt: skip
        self.scene, self.table, self.settings, self.caches = mi_scene, table, settings, caches
        patches = elements.patches
        self.prim_record = mi.UInt32(patches.prim_patches * np.uint32(2) + patches.prim_is_square)
        self.prim_base = mi.UInt32(patches.prim_base)
        self.patch_level = mi.UInt32(patches.patch_level)
        self.patch_base = mi.UInt32(patches.patch_base[:-1].astype(np.uint32))
        self.diffuse_slot, self.glossy_slot = mi.UInt32(elements.diffuse_slot), mi.UInt32(elements.glossy_slot)
        self.diffuse = mi.Float(_padded(caches.diffuse))
        self.directional = mi.Float(_padded(caches.directional))
        self.polar, self.azimuth = caches.directional.shape[1:3] if caches.directional.ndim == 4 else (1, 1)
        self.glossy_normal = mi.Float(_padded(elements.normal[elements.glossy]))
        self.glossy_position = mi.Float(_padded(elements.position[elements.glossy]))
        self.is_parametric = mi.UInt32(table.is_parametric.astype(np.uint32))
        self.union = table.lobe_union
        self.has_slots = {
            "diffuse": bool(np.any(elements.diffuse_slot != NO_SLOT)),
            "glossy": bool(np.any(elements.glossy_slot != NO_SLOT)),
        }

    def run(self, camera: Camera) -> np.ndarray:
        """Queries one frame.

        Args:
            camera: the pose and size.

        Returns:
            float32 [height, width, NUM_CHANNELS]; channels by `CHANNELS`. IR in linear scene radiance,
            normals unit and towards the viewer (0 on a miss), albedo in [0, 1], distance in scene units (0 on a
            miss), coverage the share of radiance lookups answered by baked elements, position the first sample's hit in
            world space (NaN on a miss).
        """
        if self.settings.weights != "barycentric":
            return self._run_paper(camera)
        width, height = camera.width, camera.height
        lane = dr.arange(mi.UInt32, width * height)
        places = _GRIDS[self.settings.samples]
        device = DeviceCamera.upload(camera)
        total = self._average(device, lane, width, height, places)
        return self._store(lane, total, width, height)

    def _average(self, device, lane, width: int, height: int, places) -> _Walk:  # type: ignore[no-untyped-def]
        x, y = mi.Float(lane % width), mi.Float(lane // width)
        if len(places) == 1:
            return self._walk(device.ray(x + 0.5, y + 0.5, width, height))
        offsets = mi.Float(np.array(places, np.float32).reshape(-1))
        return self._average_loop(device, x, y, width, height, offsets, len(places))

    @dr.syntax
    def _average_loop(self, device, x, y, width: int, height: int, offsets, count: int):  # type: ignore[no-untyped-def]
        radiance, albedo = dr.zeros(mi.Color3f, dr.width(x)), dr.zeros(mi.Color3f, dr.width(x))
        normal, position = dr.zeros(mi.Vector3f, dr.width(x)), dr.zeros(mi.Point3f, dr.width(x))
        distance = dr.zeros(mi.Float, dr.width(x))
        covered, asked = dr.zeros(mi.Float, dr.width(x)), dr.zeros(mi.Float, dr.width(x))
        index = mi.UInt32(0)
        while index < count:
            place = dr.gather(mi.Point2f, offsets, index)
            walk = self._walk(device.ray(x + place.x, y + place.y, width, height))
            radiance += walk.radiance
            albedo += walk.albedo
            normal += walk.normal
            distance += walk.distance
            covered += walk.covered
            asked += walk.asked
            position[index == 0] = walk.position
            index += 1
        scale = 1.0 / count
        return _Walk(
            radiance * scale, albedo * scale, normal * scale, distance * scale, position, covered, asked
        )  # fmt: skip

    def _store(self, lane, walk: _Walk, width: int, height: int) -> np.ndarray:  # type: ignore[no-untyped-def]
        buffer = dr.empty(mi.Float, width * height * NUM_CHANNELS)
        coverage = dr.select(walk.asked > 0, walk.covered / walk.asked, 1.0)
        values = [*walk.radiance, *walk.normal, *walk.albedo, walk.distance, coverage, *walk.position]
        values += [mi.Float(0)] * (NUM_CHANNELS - len(values))
        dr.scatter(buffer, mi.ArrayXf(values), lane)
        dr.eval(buffer)
        return buffer.numpy().reshape(height, width, NUM_CHANNELS)

    # ------------------------------------------- walking -------------------------------------------

    def _walk(self, ray: "mi.Ray3f") -> _Walk:
        """Follows one camera ray to its radiance and G-buffer."""
        pi = self.scene.ray_intersect_preliminary(ray, coherent=True)
        active = dr.full(mi.Bool, True, dr.width(ray))
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        hit = si.is_valid()
        radiance, albedo, covered, asked, bits = self._shade(pi, si, active)
        facing = dr.sign(-dr.dot(si.n, ray.d))
        walk = _Walk(
            radiance=radiance,
            albedo=albedo,
            normal=mi.Vector3f(dr.select(hit, si.sh_frame.n * facing, 0.0)),
            distance=dr.select(hit, si.t, 0.0),
            position=mi.Point3f(dr.select(hit, si.p, dr.nan)),
            covered=covered,
            asked=asked,
        )
        if self.union & LobeClass.DELTA and not self.caches.exitant:
            self._follow(walk, si, hit & has(bits, LobeClass.DELTA))
        return walk

    def _follow(self, walk: _Walk, si: "mi.SurfaceInteraction3f", active: "mi.Bool") -> None:
        """Adds what the delta lobes of the first hit see: each of them, then the likelier one at later hits."""
        for lobe in delta_lobes(si.bsdf(), si, active):
            throughput = lobe.weight * lobe.pdf
            go = lobe.valid & (dr.max(throughput) > MIN_BRANCH)
            ray = si.spawn_ray(si.to_world(lobe.wo))
            radiance, albedo, covered, asked = self._chain(ray, dr.select(go, throughput, 0.0), go)
            walk.radiance += radiance
            walk.albedo += albedo
            walk.covered += covered
            walk.asked += asked

    @dr.syntax
    def _chain(self, ray, throughput, active):  # type: ignore[no-untyped-def]
        ray = mi.Ray3f(ray)
        beta = mi.Color3f(throughput)
        active = mi.Bool(active)
        radiance, albedo = dr.zeros(mi.Color3f, dr.width(beta)), dr.zeros(mi.Color3f, dr.width(beta))
        covered, asked = dr.zeros(mi.Float, dr.width(beta)), dr.zeros(mi.Float, dr.width(beta))
        depth = mi.UInt32(0)
        while active:
            pi = self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            value, rho, c, a, bits = self._shade(pi, si, active)
            weight = dr.mean(beta)
            radiance += dr.select(active, beta * value, 0.0)
            albedo += dr.select(active, beta * rho, 0.0)
            covered += dr.select(active, weight * c, 0.0)
            asked += dr.select(active, weight * a, 0.0)
            active &= si.is_valid() & has(bits, LobeClass.DELTA) & (depth + 1 < self.settings.max_chain)
            first, second = delta_lobes(si.bsdf(), si, active)
            wo, lobe_weight, valid = dominant_lobe(first, second)
            ray = si.spawn_ray(si.to_world(wo))
            beta *= lobe_weight
            active &= valid
            depth += 1
        return radiance, albedo, covered, asked

    # ------------------------------------------- shading -------------------------------------------

    def _shade(self, pi, si, active):  # type: ignore[no-untyped-def]
        """(radiance of the cached lobes and emission, albedo, covered lookups, lookups, lobe bits) of a hit."""
        hit = active & si.is_valid()
        shape = self.table.shape_index(si, hit)
        bits = dr.gather(mi.UInt32, self.table.lobe_bits_dr, shape, hit)
        bsdf = si.bsdf()
        rho = diffuse_reflectance(bsdf, si, bits, self.union, hit)
        covered, asked = dr.zeros(mi.Float, dr.width(si)), dr.zeros(mi.Float, dr.width(si))
        points, weights = self._locate(shape, pi, si, hit)
        radiance = dr.zeros(mi.Color3f, dr.width(si))
        if self.caches.exitant:
            value, share = self._directional(points, weights, si, hit, reflect=False)
            outside = active & ~si.is_valid()
            radiance = value + dr.select(outside, si.emitter(self.scene).eval(si, outside), 0.0)
            return radiance, rho, share, dr.select(hit, 1.0, 0.0), bits
        radiance += si.emitter(self.scene).eval(si, active)
        if self.has_slots["diffuse"]:
            wanted = hit & has(bits, LobeClass.DIFFUSE)
            value, share = self._diffuse(points, weights, wanted)
            radiance += dr.select(wanted, value * (rho if self.caches.demodulated else 1.0), 0.0)
            covered += share
            asked += dr.select(wanted, 1.0, 0.0)
        if self.has_slots["glossy"]:
            wanted = hit & has(bits, LobeClass.GLOSSY)
            value, share = self._directional(points, weights, si, wanted, reflect=True)
            tint = specular_tint(bsdf, si, bits, self.union, wanted)
            radiance += dr.select(wanted, value * tint, 0.0)
            covered += share
            asked += dr.select(wanted, 1.0, 0.0)
        return dr.maximum(radiance, 0.0), dr.clip(rho, 0.0, 1.0), covered, asked, bits

    def _locate(self, shape, pi, si, active):  # type: ignore[no-untyped-def]
        """(lattice point * 2 + side, weight) three times: `lattice.locate_patch` and `locate_points` on the device."""
        parametric = dr.gather(mi.UInt32, self.is_parametric, shape, active) != 0
        uv = dr.select(parametric, si.uv, pi.prim_uv)
        prim = dr.gather(mi.UInt32, self.table.prim_offset_dr, shape, active)
        prim += dr.select(parametric, 0, pi.prim_index)
        record = dr.gather(mi.UInt32, self.prim_record, prim, active)
        square = (record & 1) != 0
        cell, b1, b2 = _patch_cell(uv, mi.Int32(record >> 1), square)
        patch = dr.gather(mi.UInt32, self.prim_base, prim, active) + mi.UInt32(cell)
        level = mi.Int32(dr.gather(mi.UInt32, self.patch_level, patch, active))
        base = dr.gather(mi.UInt32, self.patch_base, patch, active)
        side = dr.select(dr.dot(si.n, si.to_world(si.wi)) < 0, mi.UInt32(1), mi.UInt32(0))
        indices, weights = _lattice_points(b1, b2, level)
        return [(base + mi.UInt32(index)) * 2 + side for index in indices], weights

    def _diffuse(self, points, weights, active):  # type: ignore[no-untyped-def]
        value, covered, total = dr.zeros(mi.Color3f, dr.width(active)), mi.Float(0), mi.Float(0)
        for point, weight in zip(points, weights, strict=True):
            slot, baked = self._slot(self.diffuse_slot, point, active)
            # A stand-in counts only where no baked point does.
            weight = dr.select(baked, weight, weight * 1e-4)
            texel = dr.gather(mi.Vector4f, self.diffuse, slot, active)
            value += mi.Color3f(texel.x, texel.y, texel.z) * weight
            covered += dr.select(baked, weight, 0.0)
            total += weight
        return value * dr.rcp(dr.maximum(total, 1e-20)), dr.select(active, covered / dr.maximum(total, 1e-20), 0.0)

    def _directional(self, points, weights, si, active, *, reflect: bool):  # type: ignore[no-untyped-def]
        """Directional lookup. With `reflect`, elements are compared at the same *reflected* direction, so that the
        reflection on a curved surface follows the pixel's own normal instead of the element's."""
        view = si.to_world(si.wi)
        normal = si.sh_frame.n
        mirrored = 2 * dr.dot(view, normal) * normal - view
        value, covered, total = dr.zeros(mi.Color3f, dr.width(active)), mi.Float(0), mi.Float(0)
        for point, weight in zip(points, weights, strict=True):
            slot, baked = self._slot(self.glossy_slot, point, active)
            weight = dr.select(baked, weight, weight * 1e-4)
            n = _xyz(dr.gather(mi.Vector4f, self.glossy_normal, slot, active))
            direction = 2 * dr.dot(mirrored, n) * n - mirrored if reflect else view
            value += self._bilinear(slot, mi.Frame3f(n).to_local(direction), active) * weight
            covered += dr.select(baked, weight, 0.0)
            total += weight
        return value * dr.rcp(dr.maximum(total, 1e-20)), dr.select(active, covered / dr.maximum(total, 1e-20), 0.0)

    def _slot(self, table, point, active):  # type: ignore[no-untyped-def]
        raw = dr.gather(mi.UInt32, table, point, active)
        return raw & mi.UInt32(int(NOT_BAKED) - 1), (raw & mi.UInt32(int(NOT_BAKED))) == 0

    def _bilinear(self, slot, local, active):  # type: ignore[no-untyped-def]
        """Bilinear lookup by polar angle and azimuth of one element's grid."""
        cos_theta = dr.maximum(local.z, GRAZING_COSINE)
        theta = dr.safe_acos(cos_theta) * (2 / dr.pi) * self.polar - 0.5
        phi = dr.atan2(local.y, local.x) * dr.inv_two_pi * self.azimuth - 0.5
        phi = dr.select(phi < 0, phi + self.azimuth, phi)
        row = dr.clip(dr.floor(theta), 0.0, max(self.polar - 2, 0))
        column = dr.floor(phi)
        ft, fp = dr.clip(theta - row, 0.0, 1.0), phi - column
        r0 = mi.UInt32(row)
        r1 = dr.minimum(r0 + 1, self.polar - 1)
        c0 = mi.UInt32(column) % self.azimuth
        c1 = (c0 + 1) % self.azimuth
        result = dr.zeros(mi.Color3f, dr.width(slot))
        for r, c, w in ((r0, c0, (1 - ft) * (1 - fp)), (r0, c1, (1 - ft) * fp), (r1, c0, ft * (1 - fp)),
                        (r1, c1, ft * fp)):  # fmt: skip
            index = (slot * self.polar + r) * self.azimuth + c
            result += _xyz(dr.gather(mi.Vector4f, self.directional, index, active)) * w
        return mi.Color3f(result)

    # --------------------------------------- paper's weights ---------------------------------------

    def _run_paper(self, camera: Camera) -> np.ndarray:
        """Three rays a pixel, W = Wd Wn + 0.01; the offset rays are the neighbours' primary rays, traced once."""
        width, height = camera.width, camera.height
        columns = width + 1
        lane = dr.arange(mi.UInt32, columns * (height + 1))
        device = DeviceCamera.upload(camera)
        x, y = mi.Float(lane % columns) + 0.5, mi.Float(lane // columns) + 0.5
        ray = device.ray(x, y, width, height)
        walk = self._walk(ray)
        weight = self._paper_weight(ray)
        rays = 1 if self.settings.weights == "single" else 3
        buffer = dr.empty(mi.Float, columns * (height + 1) * 4)
        dr.scatter(buffer, mi.Vector4f(*(walk.radiance * weight), weight), lane)
        image = self._store(lane, walk, columns, height + 1)
        weighted = buffer.numpy().reshape(height + 1, columns, 4)
        total = weighted[:-1, :-1].copy()
        if rays == 3:
            total += weighted[:-1, 1:] + weighted[1:, :-1]
        result = np.ascontiguousarray(image[:-1, :-1])
        result[..., :3] = total[..., :3] / total[..., 3:]
        return result

    def _paper_weight(self, ray: "mi.Ray3f") -> "mi.Float":
        """Eq. 5 to 7 of the paper, for the element that answers the hit."""
        pi = self.scene.ray_intersect_preliminary(ray, coherent=True)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        hit = si.is_valid()
        shape = self.table.shape_index(si, hit)
        points, _ = self._locate(shape, pi, si, hit)
        slot, _ = self._slot(self.glossy_slot, points[0], hit)
        centre = mi.Point3f(_xyz(dr.gather(mi.Vector4f, self.glossy_position, slot, hit)))
        normal = _xyz(dr.gather(mi.Vector4f, self.glossy_normal, slot, hit))
        facing = dr.sign(-dr.dot(si.n, ray.d))
        distance = dr.norm(centre - si.p)
        if self.settings.scale_free:
            distance /= dr.maximum(dr.sqrt(dr.norm(dr.cross(si.dp_du, si.dp_dv))), 1e-8)
        cosine = dr.maximum(dr.dot(normal, si.sh_frame.n * facing), 0.0)
        return dr.select(hit, dr.exp(-distance) * cosine, 0.0) + PAPER_DELTA


def _padded(values: np.ndarray) -> np.ndarray:
    """[..., 3] as a flat array with four floats a texel: one packet gather instead of three."""
    flat = values.reshape(-1, 3).astype(np.float32)
    if len(flat) == 0:
        flat = np.zeros((1, 3), np.float32)
    return np.ascontiguousarray(np.pad(flat, ((0, 0), (0, 1)))).reshape(-1)


def _xyz(value: "mi.Vector4f") -> "mi.Vector3f":
    return mi.Vector3f(value.x, value.y, value.z)


def _patch_cell(uv, m, square):  # type: ignore[no-untyped-def]
    """`lattice.locate_patch` on the device."""
    su, sv = dr.clip(uv.x, 0.0, 1.0) * m, dr.clip(uv.y, 0.0, 1.0) * m
    i, j = dr.minimum(mi.Int32(su), m - 1), dr.minimum(mi.Int32(sv), m - 1)
    i = dr.select(square, i, dr.clip(i, 0, m - 1 - j))
    fu, fv = su - i, sv - j
    upper = (fu + fv > 1) & (square | (i + j < m - 1))
    row = dr.select(square, j * 2 * m, j * (2 * m - j))
    cell = row + 2 * i + dr.select(upper, mi.Int32(1), mi.Int32(0))
    return cell, dr.select(upper, 1 - fu, fu), dr.select(upper, 1 - fv, fv)


def _lattice_points(b1, b2, level):  # type: ignore[no-untyped-def]
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


def _point(i, j, n):  # type: ignore[no-untyped-def]
    return j * (n + 1) - j * (j - 1) // 2 + i
