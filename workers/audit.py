"""An audit of a loaded scene: what its materials are, how much of them cameras see, what varies at all.

    from workers.audit import audit_scene
    audit_scene(run, poses).to_json()

Nothing is rendered; the camera domain's rays are cast once more (`workers/domain_census.py`).
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from workers.backend import dr, mi
from workers.camera import Camera
from workers.domain_census import ChannelSpread, take_census
from workers.elements import ElementSet
from workers.material_audit import MEASURED_SAMPLES, MaterialFacts, material_facts
from workers.surfaces import SurfaceTable

__all__ = ["ElementAudit", "MaterialAudit", "SceneAudit", "audit_elements", "audit_scene"]

_PLAIN_NAMES = ("", "bsdf", "brdf_0", "nested_bsdf")
QUANTILES = (0.05, 0.5, 0.95)


@dataclass(frozen=True, kw_only=True)
class MaterialAudit:
    """One material of the scene.

    Attributes:
        name: its id, or that of the first shape that wears it where it has none.
        facts: what it is.
        num_shapes, num_primitives: that wear it.
        area: of these, scene units squared.
        visibility: share of the camera domain's first hits, in [0, 1].
        albedo_deviation: of its diffuse reflectance over these hits, in [0, 1]: texture, measured.
    """

    name: str
    facts: MaterialFacts
    num_shapes: int
    num_primitives: int
    area: float
    visibility: float
    albedo_deviation: float


@dataclass(frozen=True, kw_only=True)
class ElementAudit:
    """Cache elements in numbers; quantiles are those of `QUANTILES`.

    Attributes:
        num_elements, num_directional: in all, and with a directional lobe.
        num_back: on the back of their surface.
        share_directional: of the domain's hits that elements with a directional lobe answer.
        hits: quantiles of the domain's hits an element answers.
        area: quantiles of the area an element stands for, scene units squared (of a hexagon in a lattice of the
            distance to its nearest neighbour).
    """

    num_elements: int
    num_directional: int
    num_back: int
    share_directional: float
    hits: tuple[float, ...]
    area: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class SceneAudit:
    """What a scene is made of, and what its cameras see of it.

    Attributes:
        materials: the most visible first.
        num_shapes, num_primitives, area: of the scene; scene units squared.
        hit_share: of the domain's rays that hit anything.
        channels: how far each G-buffer channel varies; None where nothing is seen.
        moving: ids of animated shapes; always empty, as loaders refuse or ignore animation (see `Scene.notes`).
    """

    materials: tuple[MaterialAudit, ...]
    num_shapes: int
    num_primitives: int
    area: float
    hit_share: float
    channels: dict[str, ChannelSpread | None]
    moving: tuple[str, ...] = ()

    def share(self, *kinds: str) -> float:
        """Visibility of all materials of any of some kinds ("glossy", "delta", ...)."""
        return sum(material.visibility for material in self.materials if set(kinds) & set(material.facts.kinds))

    def to_json(self) -> dict[str, Any]:
        """Plain nested values."""
        return dataclasses.asdict(self)


def audit_scene(
    mi_scene: "mi.Scene", table: SurfaceTable, poses: list[Camera], rays_per_pose: int
) -> SceneAudit:  # fmt: skip
    """Audits a scene as the cameras of a domain see it.

    Args:
        mi_scene: the scene.
        table: its surfaces.
        poses: of the domain (`camera_path.domain_poses`).
        rays_per_pose: about how many rays a pose casts.
    """
    census = take_census(mi_scene, table, poses, rays_per_pose)
    areas = np.array([_area(shape) for shape in table.shapes]) / table.frame.scale**2
    seen = max(int(census.shape_hits.sum()), 1)
    materials = []
    for members in _by_material(table):
        first = table.shapes[members[0]]
        hits = census.shape_hits[members]
        weight = hits / max(int(hits.sum()), 1)
        materials.append(MaterialAudit(
            name=_name(first),
            facts=material_facts(first.bsdf(), is_emitter=first.is_emitter(), places=_places(table, members[0])),
            num_shapes=len(members),
            num_primitives=int(np.diff(table.prim_offset)[members].sum()),
            area=float(areas[members].sum()),
            visibility=float(hits.sum() / seen),
            albedo_deviation=float((census.shape_albedo_deviation[members] * weight).sum()),
        ))  # fmt: skip
    materials.sort(key=lambda material: (-material.visibility, -material.area, material.name))
    return SceneAudit(
        materials=tuple(materials), num_shapes=len(table.shapes), num_primitives=table.num_prims,
        area=float(areas.sum()), hit_share=float(census.shape_hits.sum() / max(census.num_rays, 1)),
        channels=census.channels, moving=tuple(shape.id() for shape in table.shapes if _moves(shape)),
    )  # fmt: skip


def _by_material(table: SurfaceTable) -> list[list[int]]:
    """Shapes that share a material and whether they emit, in stable order."""
    groups: dict[tuple[int, bool], list[int]] = {}
    for index, shape in enumerate(table.shapes):
        registry = int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(shape.bsdf()))[0])
        groups.setdefault((registry, shape.is_emitter()), []).append(index)
    return list(groups.values())


def _name(shape: "mi.Shape") -> str:
    name = shape.bsdf().id()
    return shape.id() if name in _PLAIN_NAMES or name.startswith("__") else name


def _area(shape: "mi.Shape") -> float:
    """Scene units squared of the table's frame."""
    if not shape.is_mesh():
        return float(np.array(shape.surface_area()).reshape(-1)[0])
    vertices = shape.vertex_positions_buffer().numpy().reshape(-1, 3).astype(np.float64)
    corners = vertices[shape.faces_buffer().numpy().reshape(-1, 3)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.nansum(np.linalg.norm(normals, axis=1)) / 2)


def _moves(shape: "mi.Shape") -> bool:
    """Whether a shape's transform is animated: Mitsuba 3.9 has none, a later one may say so."""
    return "animat" in type(mi.traverse(shape).get("to_world")).__name__.lower() if not shape.is_mesh() else False


def _places(table: SurfaceTable, shape: int) -> "mi.SurfaceInteraction3f":
    """Random places on a shape, its primitives alike."""
    rng = np.random.default_rng(0)
    count = int(table.prim_offset[shape + 1] - table.prim_offset[shape])
    uv = rng.random((MEASURED_SAMPLES, 2)).astype(np.float32)
    if not table.is_parametric[shape]:
        uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)
    return table.interaction(np.full(MEASURED_SAMPLES, shape), rng.integers(count, size=MEASURED_SAMPLES), uv)


def audit_elements(table: SurfaceTable, elements: ElementSet, hits: np.ndarray) -> ElementAudit:
    """Sums up cache elements.

    Args:
        table: the surfaces.
        elements: what is baked.
        hits: the domain's hits each of them answers (`domain_census.element_hits`).
    """
    from scipy.spatial import cKDTree

    nothing = tuple(0.0 for _ in QUANTILES)
    areas, counts = nothing, nothing
    if elements.num_elements > 1:
        distance = cKDTree(elements.position).query(elements.position, k=2)[0][:, 1] / table.frame.scale
        areas = tuple(map(float, np.quantile(np.sqrt(3) / 2 * distance**2, QUANTILES)))
        counts = tuple(map(float, np.quantile(hits, QUANTILES)))
    return ElementAudit(
        num_elements=elements.num_elements, num_directional=len(elements.glossy),
        num_back=int((elements.side == 1).sum()),
        share_directional=float(hits[elements.glossy].sum() / max(int(hits.sum()), 1)),
        hits=counts, area=areas,
    )  # fmt: skip
