"""The cache query: G-buffers and imperfect radiance (IR) of a camera pose, as one fused Dr.Jit program.

Every primary ray finds its patch and the three lattice points around its hit, gathers what they cached and
multiplies by the material at the pixel (`workers/query_shading.py`); delta surfaces are followed (both lobes
at the first one, the likelier afterwards) to what lies behind. Pixels on edges get more samples
(`workers/supersampling.py`). The program is traced once for each image size and then replayed (`dr.freeze`): the
pose and the caches are its inputs. `workers/query_reference.py` is the same in slow NumPy.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from workers.backend import dr, mi
from workers.camera import Camera
from workers.elements import ElementSet
from workers.lobes import LobeClass, has
from workers.primary import DeltaLobe, DeviceCamera, delta_lobes, dominant_lobe
from workers.query_shading import CacheArrays, CacheShading, xyz
from workers.settings import QuerySettings
from workers.supersampling import edge_pixels, edge_places, grid_places
from workers.surfaces import SurfaceTable

__all__ = ["CHANNELS", "NUM_CHANNELS", "CacheArrays", "QueryProgram"]

CHANNELS = {
    "ir": (0, 3), "normal": (3, 6), "albedo": (6, 9), "distance": (9, 10), "coverage": (10, 11),
    "position": (11, 14),
}  # fmt: skip
NUM_CHANNELS = 16  # with the number of lookups and a pad: one packet scatter a pixel
PAPER_DELTA = 0.01
MIN_BRANCH = 0.01  # a reflection weaker than this is not followed from the first delta surface
MAX_RECORDINGS = 8  # image sizes whose recorded programs are kept


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

    @classmethod
    def none(cls, width: int) -> "_Walk":
        """Nothing gathered yet, on so many lanes."""
        kinds = (mi.Color3f, mi.Color3f, mi.Vector3f, mi.Float, mi.Point3f, mi.Float, mi.Float)
        return cls(*(dr.zeros(kind, width) for kind in kinds))

    def scaled(self, share: float) -> "_Walk":
        """A sum as a mean; position is no sum, and coverage needs `covered` and `asked` only by their ratio."""
        return _Walk(self.radiance * share, self.albedo * share, self.normal * share, self.distance * share,
                     self.position, self.covered, self.asked)  # fmt: skip


class QueryProgram:
    """Caches of one scene, in device memory, and the program that queries them."""

    def __init__(
        self, mi_scene: "mi.Scene", table: SurfaceTable, elements: ElementSet, caches: CacheArrays,
        settings: QuerySettings,
    ) -> None:  # fmt: skip
        self.scene, self.table, self.settings = mi_scene, table, settings
        self.shading = CacheShading(mi_scene, table, elements, caches)
        self.follows_delta = bool(table.lobe_union & LobeClass.DELTA) and not caches.exitant
        self.finds_edges = settings.samples > 1 and settings.supersample == "edges"
        places = edge_places(settings.samples) if self.finds_edges else grid_places(settings.samples)
        self._num_places = len(places)
        self._places = mi.Float(places.astype(np.float32).reshape(-1))
        self._state = (self._places, *self.shading.state())
        program = self._program if settings.weights == "barycentric" else self._paper_program
        self._program_unfrozen = program
        self._replay = dr.freeze(program, state_fn=lambda *_: self._state, limit=MAX_RECORDINGS, warn_after=1000)

    @property
    def num_recordings(self) -> int:
        """How often a frame's program was traced and compiled; 0 where it cannot be recorded."""
        return int(getattr(self._replay, "n_recordings", 0))

    def run(self, camera: Camera) -> np.ndarray:
        """Queries one frame.

        Args:
            camera: the pose and size.

        Returns:
            float32 [height, width, NUM_CHANNELS]; channels by `CHANNELS`. IR in linear scene radiance, normals
            unit, turned by normal maps and towards the viewer (0 on a miss), albedo in [0, 1], distance in scene
            units (0 on a miss), coverage the share of radiance lookups answered by baked elements, position the first
            sample's hit in scene units from `WorldFrame.origin` (NaN on a miss).
        """
        width, height = camera.width, camera.height
        device = DeviceCamera.upload(self.table.frame.local_camera(camera))
        with _no_collection():
            try:
                outputs = self._replay(device, width, height)
            except RuntimeError:
                # Dr.Jit 1.5 cannot record while a material outside any scene is alive in this process.
                self._replay = self._program_unfrozen
                outputs = self._replay(device, width, height)
        if self.settings.weights == "barycentric":
            return outputs.numpy().reshape(height, width, NUM_CHANNELS)
        image, weighted = outputs
        return self._blend_paper(image, weighted, width, height)

    def _program(self, device: DeviceCamera, width: int, height: int) -> "mi.Float":
        """One frame, flat [height * width * NUM_CHANNELS]."""
        lane = dr.arange(mi.UInt32, width * height)
        x, y = mi.Float(lane % width), mi.Float(lane // width)
        if self.settings.samples > 1 and not self.finds_edges:
            return self._store(lane, self._average(device, x, y, width, height))
        image = self._store(lane, self._walk(device.ray(x + 0.5, y + 0.5, width, height)))
        if self.finds_edges:
            edges = edge_pixels(image, width, height, NUM_CHANNELS)
            dr.eval(edges)
            self._refine(image, device, edges, width, height)
        return image

    def _average(self, device, x, y, width: int, height: int) -> _Walk:
        """Mean over all sample places of each pixel; position is that of the first."""
        total = self._add_samples(_Walk.none(dr.width(x)), device, x, y, mi.Bool(True), width, height, first=0)
        return total.scaled(1.0 / self._num_places)

    def _refine(self, image, device, pixel, width: int, height: int) -> None:
        """Averages further samples into some pixels of an image; the place of the first sample stays."""
        active = pixel < width * height
        pixel = dr.select(active, pixel, 0)
        x, y = mi.Float(pixel % width), mi.Float(pixel // width)
        first = self._load(image, pixel, active)
        total = self._add_samples(first, device, x, y, active, width, height, first=-1)
        mean = total.scaled(1.0 / (1 + self._num_places))
        dr.scatter(image, mi.ArrayXf(self._channels(mean)), pixel, active)

    @dr.syntax
    def _add_samples(self, total: _Walk, device, x, y, active, width: int, height: int, first: int) -> _Walk:
        """`total` and the walks through every sample place of a pixel, summed; position is that of the place with
        index `first`, or `total`'s where none has it."""
        radiance, normal, albedo = mi.Color3f(total.radiance), mi.Vector3f(total.normal), mi.Color3f(total.albedo)
        distance, position = mi.Float(total.distance), mi.Point3f(total.position)
        covered, asked = mi.Float(total.covered), mi.Float(total.asked)
        index = dr.zeros(mi.Int32, dr.width(x))
        while active & (index < self._num_places):
            place = dr.gather(mi.Point2f, self._places, mi.UInt32(index))
            walk = self._walk(device.ray(x + place.x, y + place.y, width, height))
            radiance += walk.radiance
            albedo += walk.albedo
            normal += walk.normal
            distance += walk.distance
            covered += walk.covered
            asked += walk.asked
            position[index == first] = walk.position
            index += 1
        return _Walk(radiance, albedo, normal, distance, position, covered, asked)

    def _load(self, image, pixel, active) -> _Walk:
        """What `_store` wrote."""
        packets = NUM_CHANNELS // 4
        values = [value for k in range(packets) for value in dr.gather(mi.Vector4f, image, pixel * packets + k, active)]
        scale = self.table.frame.scale
        asked = mi.Float(values[14])
        return _Walk(
            radiance=mi.Color3f(values[0:3]), albedo=mi.Color3f(values[6:9]), normal=mi.Vector3f(values[3:6]),
            distance=mi.Float(values[9]) * scale, position=mi.Point3f(values[11:14]) * scale,
            covered=values[10] * asked, asked=asked,
        )  # fmt: skip

    def _store(self, pixel, walk: _Walk) -> "mi.Float":
        buffer = dr.empty(mi.Float, dr.width(pixel) * NUM_CHANNELS)
        dr.scatter(buffer, mi.ArrayXf(self._channels(walk)), pixel)
        return buffer

    def _channels(self, walk: _Walk) -> "list[mi.Float]":
        """By `CHANNELS`, then the number of lookups."""
        coverage = dr.select(walk.asked > 0, walk.covered / walk.asked, 1.0)
        unit = 1.0 / self.table.frame.scale  # scene units
        place = (walk.distance * unit, coverage, *(walk.position * unit))
        values = [*walk.radiance, *walk.normal, *walk.albedo, *place]
        return [*values, walk.asked, mi.Float(0)]

    # ------------------------------------------- walking -------------------------------------------

    def _walk(self, ray: "mi.Ray3f") -> _Walk:
        """Follows one camera ray to its radiance and G-buffer."""
        pi = self.scene.ray_intersect_preliminary(ray, coherent=True)
        active = dr.full(mi.Bool, True, dr.width(ray))
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        hit = si.is_valid()
        shaded = self.shading.shade(pi, si, active)
        light = (shaded.radiance, shaded.albedo, shaded.covered, shaded.asked)
        if self.follows_delta:
            light = self._follow(light, si, hit & has(shaded.bits, LobeClass.DELTA))
        radiance, albedo, covered, asked = light
        normal = si.sh_frame.n
        if self.table.normal_maps.textures:
            normal = self.table.normal_maps.normal(si, self.table.shape_index(si, hit), hit)
        facing = dr.sign(-dr.dot(si.n, ray.d))
        return _Walk(
            radiance=radiance,
            albedo=albedo,
            normal=mi.Vector3f(dr.select(hit, normal * facing, 0.0)),
            distance=dr.select(hit, si.t, 0.0),
            position=mi.Point3f(dr.select(hit, si.p, dr.nan)),
            covered=covered,
            asked=asked,
        )

    def _follow(self, light, si, active):
        """Adds what the delta lobes of the first hit see: both of them, then the likelier at later hits."""

        def both_lobes(*light):
            return self._lobes(light, si, active, *delta_lobes(si.bsdf(), si, active))

        return dr.if_stmt(light, active, both_lobes, lambda *light: light)

    @dr.syntax
    def _lobes(self, light, si, active, last: DeltaLobe, first: DeltaLobe):
        """A loop over the two lobes, so that the chain's program is compiled once."""
        radiance, albedo, covered, asked = light
        index = mi.UInt32(0)
        while index < 2:
            throughput = dr.select(index == 0, last.weight * last.pdf, first.weight * first.pdf)
            wo = dr.select(index == 0, last.wo, first.wo)
            go = active & dr.select(index == 0, last.valid, first.valid) & (dr.max(throughput) > MIN_BRANCH)
            seen = self._chain(si.spawn_ray(si.to_world(wo)), dr.select(go, throughput, 0.0), go)
            radiance += seen[0]
            albedo += seen[1]
            covered += seen[2]
            asked += seen[3]
            index += 1
        return radiance, albedo, covered, asked

    @dr.syntax
    def _chain(self, ray, throughput, active):
        ray = mi.Ray3f(ray)
        beta = mi.Color3f(throughput)
        active = mi.Bool(active)
        radiance, albedo = dr.zeros(mi.Color3f, dr.width(beta)), dr.zeros(mi.Color3f, dr.width(beta))
        covered, asked = dr.zeros(mi.Float, dr.width(beta)), dr.zeros(mi.Float, dr.width(beta))
        depth = mi.UInt32(0)
        while active:
            pi = self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            shaded = self.shading.shade(pi, si, active)
            weight = dr.mean(beta)
            radiance += dr.select(active, beta * shaded.radiance, 0.0)
            albedo += dr.select(active, beta * shaded.albedo, 0.0)
            covered += dr.select(active, weight * shaded.covered, 0.0)
            asked += dr.select(active, weight * shaded.asked, 0.0)
            active &= si.is_valid() & has(shaded.bits, LobeClass.DELTA) & (depth + 1 < self.settings.max_chain)
            first, second = delta_lobes(si.bsdf(), si, active)
            wo, lobe_weight, valid = dominant_lobe(first, second)
            ray = si.spawn_ray(si.to_world(wo))
            beta *= lobe_weight
            active &= valid
            depth += 1
        return radiance, albedo, covered, asked

    # --------------------------------------- paper's weights ---------------------------------------

    def _paper_program(self, device: DeviceCamera, width: int, height: int) -> "tuple[mi.Float, mi.Float]":
        """One frame with a column and a row more: (as `_program`, IR times weight and weight a ray)."""
        lane = dr.arange(mi.UInt32, (width + 1) * (height + 1))
        x, y = mi.Float(lane % (width + 1)) + 0.5, mi.Float(lane // (width + 1)) + 0.5
        ray = device.ray(x, y, width, height)
        walk = self._walk(ray)
        weight = self._paper_weight(ray)
        weighted = dr.empty(mi.Float, (width + 1) * (height + 1) * 4)
        dr.scatter(weighted, mi.Vector4f(*(walk.radiance * weight), weight), lane)
        return self._store(lane, walk), weighted

    def _blend_paper(self, image: "mi.Float", weighted: "mi.Float", width: int, height: int) -> np.ndarray:
        """Three rays a pixel, W = Wd Wn + 0.01; the offset rays are the neighbours' primary rays."""
        rays = weighted.numpy().reshape(height + 1, width + 1, 4)
        total = rays[:-1, :-1].copy()
        if self.settings.weights == "paper":
            total += rays[:-1, 1:] + rays[1:, :-1]
        features = image.numpy().reshape(height + 1, width + 1, NUM_CHANNELS)
        result = np.ascontiguousarray(features[:-1, :-1])
        result[..., :3] = total[..., :3] / total[..., 3:]
        return result

    def _paper_weight(self, ray: "mi.Ray3f") -> "mi.Float":
        """Eq. 5 to 7 of the paper, for the element that answers the hit."""
        pi = self.scene.ray_intersect_preliminary(ray, coherent=True)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        hit = si.is_valid()
        shape = self.table.shape_index(si, hit)
        points, _ = self.shading.locate(shape, pi, si, hit)
        slot, _ = self.shading.slot(self.shading.glossy_slot, points[0], hit)
        centre = mi.Point3f(xyz(dr.gather(mi.Vector4f, self.shading.glossy_position, slot, hit)))
        normal = xyz(dr.gather(mi.Vector4f, self.shading.glossy_normal, slot, hit))
        facing = dr.sign(-dr.dot(si.n, ray.d))
        distance = dr.norm(centre - si.p) / self.table.frame.scale
        if self.settings.scale_free:
            size = dr.sqrt(dr.norm(dr.cross(si.dp_du, si.dp_dv))) / self.table.frame.scale
            distance /= dr.maximum(size, dr.smallest(mi.Float))
        cosine = dr.maximum(dr.dot(normal, si.sh_frame.n * facing), 0.0)
        return dr.select(hit, dr.exp(-distance) * cosine, 0.0) + PAPER_DELTA


@contextmanager
def _no_collection() -> Iterator[None]:
    """Holds Python's cycle collector back: freeing an array that maps NumPy memory aborts a recording."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
