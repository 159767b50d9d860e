"""The scene's surfaces in an order that does not change between processes.

Mitsuba loads shapes in parallel, so their order and their registry ids differ from run to run. Every cache
is therefore keyed by a *stable* shape index (shapes sorted by a hash of their geometry and material name) and
by the primitive's index in its shape.
"""

import hashlib
from dataclasses import dataclass

import numpy as np

from workers.backend import dr, mi
from workers.errors import SceneError
from workers.lobes import LobeClass, classify_bsdf
from workers.normal_maps import NormalMaps
from workers.world_frame import OWN, WorldFrame

PARAMETRIC_SHAPES = ("Disk", "Sphere", "Cylinder")


@dataclass(frozen=True)
class SurfaceTable:
    """Shapes in stable order and their primitives.

    Attributes:
        shapes: Mitsuba shapes, stable order.
        lobes: class of each shape's material.
        prim_offset: first global primitive of each shape, with the total at the end; int64 [num_shapes + 1].
        prim_edge: longest edge of each primitive in scene units; a parametric shape is one primitive, whose
            edge is half its circumference or its height, whichever is larger; float32 [num_prims].
        is_parametric: true where the primitive is a whole analytic shape, addressed by (u, v); [num_shapes].
        shape_pointers: Dr.Jit array of shape pointers in stable order.
        index_of_registry: stable shape index by registry id; mi.UInt32.
        prim_offset_dr: `prim_offset` on the device; mi.UInt32.
        lobe_bits_dr: `LobeClass` bits by stable shape index; mi.UInt32.
        normal_maps: of the shapes.
        diagonal: of the scene's bounding box.
        frame: where the scene lies; every length and place here is in that frame's local units.
    """

    shapes: list
    lobes: list[LobeClass]
    prim_offset: np.ndarray
    prim_edge: np.ndarray
    is_parametric: np.ndarray
    shape_pointers: "mi.ShapePtr"
    index_of_registry: "mi.UInt32"
    prim_offset_dr: "mi.UInt32"
    lobe_bits_dr: "mi.UInt32"
    normal_maps: NormalMaps
    diagonal: float
    frame: WorldFrame = OWN

    @property
    def num_prims(self) -> int:
        return int(self.prim_offset[-1])

    @property
    def lobe_union(self) -> LobeClass:
        """Lobes that occur anywhere in the scene."""
        union = LobeClass(0)
        for lobe in self.lobes:
            union |= lobe
        return union

    def shape_index(self, si: "mi.SurfaceInteraction3f", active: "mi.Bool") -> "mi.UInt32":
        """Stable shape index of each interaction (0 where inactive)."""
        registry = dr.reinterpret_array(mi.UInt32, si.shape)
        return dr.gather(mi.UInt32, self.index_of_registry, registry, active)

    def interaction(self, shape: np.ndarray, prim_local: np.ndarray, uv: np.ndarray) -> "mi.SurfaceInteraction3f":
        """Surface interactions at given places, without tracing a ray.

        Args:
            shape: stable shape index, int [n].
            prim_local: primitive in its shape, int [n].
            uv: barycentric (b1, b2) on a mesh, surface parameters on an analytic shape, float [n, 2].
        """
        pi = dr.zeros(mi.PreliminaryIntersection3f, len(shape))
        pi.valid = dr.full(mi.Bool, True, len(shape))
        pi.shape = dr.gather(mi.ShapePtr, self.shape_pointers, mi.UInt32(shape.astype(np.uint32)))
        pi.prim_index = mi.UInt32(prim_local.astype(np.uint32))
        pi.prim_uv = mi.Point2f(np.ascontiguousarray(self._prim_uv(shape, uv).T))
        ray, pi.t = self._probe_rays(shape, uv)
        return pi.compute_surface_interaction(ray, mi.RayFlags.All)

    def _prim_uv(self, shape: np.ndarray, uv: np.ndarray) -> np.ndarray:
        """What Mitsuba expects in `prim_uv`: a disk wants local (x, y) instead of its parameters."""
        result = uv.astype(np.float32)
        for index in np.unique(shape[self.is_parametric[shape]]):
            if self.shapes[index].class_name() == "Disk":
                chosen = shape == index
                result[chosen] = _parametric_local("Disk", uv[chosen].astype(np.float64))[:, :2]
        return result

    def _probe_rays(self, shape: np.ndarray, uv: np.ndarray) -> "tuple[mi.Ray3f, mi.Float]":
        """Rays whose point at t = 1 lies on analytic shapes (meshes ignore them)."""
        position = np.zeros((len(shape), 3), np.float32)
        for index in np.unique(shape[self.is_parametric[shape]]):
            chosen = shape == index
            position[chosen] = parametric_point(self.shapes[index], uv[chosen])
        ray = dr.zeros(mi.Ray3f, len(shape))
        ray.o = mi.Point3f(np.ascontiguousarray(position.T)) - mi.Vector3f(0, 0, 1)
        ray.d = mi.Vector3f(0, 0, 1)
        ray.maxt = dr.largest(mi.Float)
        return ray, dr.full(mi.Float, 1.0, len(shape))


def parametric_point(shape: "mi.Shape", uv: np.ndarray) -> np.ndarray:
    """Point of an analytic shape at surface parameters (u, v); float32 [n, 3]."""
    local = _parametric_local(shape.class_name(), uv.astype(np.float64))
    matrix = _to_world(shape)
    return (local @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)


def _parametric_local(kind: str, uv: np.ndarray) -> np.ndarray:
    if kind == "Disk":
        radius, phi = uv[:, 0], 2 * np.pi * uv[:, 1]
        return np.stack([radius * np.cos(phi), radius * np.sin(phi), 0 * phi], 1)
    phi = 2 * np.pi * uv[:, 0]
    if kind == "Sphere":
        theta = np.pi * uv[:, 1]
        return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1)
    return np.stack([np.cos(phi), np.sin(phi), uv[:, 1]], 1)


def _to_world(shape: "mi.Shape") -> np.ndarray:
    parameters = mi.traverse(shape)
    return np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)


def build_surface_table(mi_scene: "mi.Scene", frame: WorldFrame = OWN) -> SurfaceTable:
    """Reads shapes, primitives and material classes of a loaded scene.

    Raises:
        SceneError: a shape is neither a mesh nor a disk, sphere or cylinder.
    """
    shapes = sorted(mi_scene.shapes(), key=_stable_key)
    if not shapes:
        raise SceneError("scene must hold at least one shape, got none; add geometry")
    edges = [_prim_edges(shape) for shape in shapes]
    counts = [len(e) for e in edges]
    offset = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    lobes = [classify_bsdf(shape.bsdf(), is_emitter=shape.is_emitter()) for shape in shapes]
    registry = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
    lookup = np.zeros(max(registry) + 1, np.uint32)
    lookup[registry] = np.arange(len(shapes))
    order = {id_: i for i, id_ in enumerate(registry)}
    by_load = mi_scene.shapes_dr()
    load_registry = dr.reinterpret_array(mi.UInt32, by_load).numpy()
    permutation = np.empty(len(shapes), np.uint32)
    for position, id_ in enumerate(load_registry):
        permutation[order[int(id_)]] = position
    return SurfaceTable(
        shapes=shapes,
        lobes=lobes,
        prim_offset=offset,
        prim_edge=np.concatenate(edges).astype(np.float32),
        is_parametric=np.array([not shape.is_mesh() for shape in shapes]),
        shape_pointers=dr.gather(mi.ShapePtr, by_load, mi.UInt32(permutation)),
        index_of_registry=mi.UInt32(lookup),
        prim_offset_dr=mi.UInt32(offset.astype(np.uint32)),
        lobe_bits_dr=mi.UInt32(np.array([int(lobe) for lobe in lobes], np.uint32)),
        normal_maps=NormalMaps(shapes),
        diagonal=float(dr.norm(mi_scene.bbox().extents())),
        frame=frame,
    )


def _stable_key(shape: "mi.Shape") -> str:
    digest = hashlib.sha256(f"{shape.class_name()}|{shape.id()}|{shape.bsdf().id()}".encode())
    if shape.is_mesh():
        digest.update(np.ascontiguousarray(shape.vertex_positions_buffer().numpy()).tobytes())
        digest.update(np.ascontiguousarray(shape.faces_buffer().numpy()).tobytes())
    else:
        digest.update(str(shape.bbox()).encode())
    return digest.hexdigest()


def _prim_edges(shape: "mi.Shape") -> np.ndarray:
    if shape.is_mesh():
        vertices = shape.vertex_positions_buffer().numpy().reshape(-1, 3)
        corners = vertices[shape.faces_buffer().numpy().reshape(-1, 3)]
        sides = corners - np.roll(corners, 1, axis=1)
        return np.linalg.norm(sides, axis=2).max(axis=1)
    if shape.class_name() not in PARAMETRIC_SHAPES:
        raise SceneError(
            f"shape of type {shape.class_name()} must be a mesh, disk, sphere or cylinder; convert it to a mesh"
        )
    columns = np.linalg.norm(_to_world(shape)[:3, :3], axis=0)
    return np.array([np.pi * columns.max()], np.float32)
