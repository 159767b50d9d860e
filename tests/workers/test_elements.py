"""Cache elements: budget, determinism, who answers for what, and how many there are."""

import dataclasses

import numpy as np
import pytest

from workers.backend import mi
from workers.camera import Camera
from workers.elements import NO_SLOT, NOT_BAKED, ElementSet, build_elements, surface_frame
from workers.lattice import point_parameters
from workers.lobes import LobeClass
from workers.mesh_building import icosphere, to_mitsuba
from workers.progress import Progress
from workers.scene import load_scene
from workers.settings import CacheSettings
from workers.surfaces import SurfaceTable, build_surface_table
from workers.visibility import Hits, domain_hits

Built = tuple[SurfaceTable, Hits]


@pytest.fixture(scope="module")
def tiny() -> Built:
    scene = load_scene("tiny", width=64, height=48)
    table = build_surface_table(scene.mi_scene)
    return table, domain_hits(scene.mi_scene, table, [scene.camera], 64, 4000, Progress())


def quad_grid(cells: int, half: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a grid of squares in the plane z = 0, facing +Z."""
    t = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(t, t)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1)
    a, b, c, d = corner, corner + 1, corner + cells + 2, corner + cells + 1
    return np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), np.concatenate(
        [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    )


def seen_from_above(positions: np.ndarray, faces: np.ndarray, fov_deg: float, rays: int = 6000) -> Built:
    """A mesh and what a camera 4 above its middle sees of it."""
    mesh = to_mitsuba("mesh", positions, faces, bsdf=mi.load_dict({"type": "diffuse"}))
    scene = mi.load_dict({"type": "scene", "mesh": mesh, "light": {"type": "constant"}}, optimize=False)
    camera = Camera.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0], fov_deg, 64, 64)
    table = build_surface_table(scene)
    return table, domain_hits(scene, table, [camera], 64, rays, Progress())


def arrays(elements: ElementSet) -> dict[str, np.ndarray]:
    named = {**vars(elements), **vars(elements.patches)}
    return {name: value for name, value in named.items() if isinstance(value, np.ndarray)}


def point_places(table: SurfaceTable, elements: ElementSet, side: int) -> np.ndarray:
    """World position of every lattice point."""
    prim, uv = point_parameters(elements.patches)
    shape = np.searchsorted(table.prim_offset, prim, side="right") - 1
    sides = np.full(len(prim), side, np.uint8)
    return surface_frame(table, shape, prim - table.prim_offset[shape], uv.astype(np.float32), sides)[0]


@pytest.mark.parametrize("budget", [500, 900, 1500])
def test_budget_is_respected_and_used(tiny: Built, budget: int) -> None:
    elements = build_elements(*tiny, CacheSettings(max_elements=budget))
    assert 0.5 * budget < elements.num_elements <= budget
    assert elements.spacing_px >= CacheSettings().min_spacing_px


def test_budget_below_the_coarsest_lattice_gives_the_coarsest(tiny: Built) -> None:
    smallest = build_elements(*tiny, CacheSettings(max_elements=500)).num_elements
    assert build_elements(*tiny, CacheSettings(max_elements=20)).num_elements <= smallest


def test_spacing_grows_as_the_budget_shrinks(tiny: Built) -> None:
    spacing = [build_elements(*tiny, CacheSettings(max_elements=n)).spacing_px for n in (1500, 500)]
    assert spacing == sorted(spacing) and spacing[0] < spacing[-1]


def test_elements_are_the_same_twice_and_for_shuffled_hits(tiny: Built) -> None:
    table, hits = tiny
    order = np.random.default_rng(1).permutation(len(hits.prim))
    shuffled = Hits(*(getattr(hits, field.name)[order] for field in dataclasses.fields(Hits)))
    first = arrays(build_elements(table, hits, CacheSettings(max_elements=400)))
    for again in (hits, shuffled):
        other = arrays(build_elements(table, again, CacheSettings(max_elements=400)))
        assert first.keys() == other.keys()
        assert all(np.array_equal(first[name], other[name]) for name in first)


@pytest.mark.parametrize("kind", ["lattice", "vertex", "triangle"])
def test_every_point_has_a_valid_slot_of_the_right_lobe(tiny: Built, kind: str) -> None:
    table, hits = tiny
    elements = build_elements(table, hits, CacheSettings(max_elements=400, elements=kind))  # type: ignore[arg-type]
    assert len(elements.diffuse_slot) == len(elements.glossy_slot) == 2 * elements.patches.num_points
    bits = np.array([int(lobe) for lobe in table.lobes])[elements.shape]
    np.testing.assert_array_equal(elements.glossy, np.flatnonzero(bits & int(LobeClass.GLOSSY)))
    index = elements.diffuse_slot & ~NOT_BAKED
    assert index.max() < elements.num_elements, "a slot for every lattice point and side"
    assert np.all(bits[index] & int(LobeClass.DIFFUSE)), "only elements with a diffuse lobe answer for one"
    assert (elements.glossy_slot & ~NOT_BAKED).max() < len(elements.glossy)
    unseen = (elements.diffuse_slot & NOT_BAKED) > 0
    assert 0 < unseen.sum() < len(unseen)


def test_own_slots_lie_on_their_points(tiny: Built) -> None:
    table, hits = tiny
    elements = build_elements(table, hits, CacheSettings(max_elements=1500))
    places = np.repeat(point_places(table, elements, 0), 2, axis=0)
    prim, _ = point_parameters(elements.patches)
    patch = np.searchsorted(elements.patches.patch_base, np.arange(len(prim)), side="right") - 1
    level = np.maximum(elements.patches.patch_level[patch], 1)
    spacing = np.repeat(table.prim_edge[prim] / elements.patches.prim_patches[prim] / level, 2)
    baked = (elements.diffuse_slot & NOT_BAKED) == 0
    slot = elements.diffuse_slot[baked]
    away = np.linalg.norm(places[baked] - elements.position[slot], axis=1)
    # A voxel's diagonal: 0.45 of the spacing, at most sqrt 2 more after rounding to a power of two.
    assert np.all(away <= 0.45 * np.sqrt(2) * np.sqrt(3) * spacing[baked] * 1.01)
    shape = np.repeat(np.searchsorted(table.prim_offset, prim, side="right") - 1, 2)[baked]
    np.testing.assert_array_equal(elements.shape[slot], shape)
    np.testing.assert_array_equal(elements.side[slot], np.tile([0, 1], len(prim))[baked])


def test_unseen_points_borrow_from_the_nearest_baked_element() -> None:
    table, hits = seen_from_above(*quad_grid(8), fov_deg=14.0)
    elements = build_elements(table, hits, CacheSettings(max_elements=150))
    places = point_places(table, elements, 0)
    front = elements.diffuse_slot[0::2]
    unseen = (front & NOT_BAKED) > 0
    assert 0 < unseen.sum() < len(unseen)
    assert np.all((elements.diffuse_slot[1::2] & NOT_BAKED) > 0), "nobody sees the back"
    distance = np.linalg.norm(places[unseen][:, None] - elements.position[None], axis=2)
    chosen = distance[np.arange(len(distance)), front[unseen] & ~NOT_BAKED]
    np.testing.assert_allclose(chosen, distance.min(1), atol=1e-5)


def test_lobe_that_does_not_occur_has_no_slots() -> None:
    table, hits = seen_from_above(*quad_grid(2), fov_deg=40.0)
    elements = build_elements(table, hits, CacheSettings(max_elements=50))
    assert len(elements.glossy) == 0 and np.all(elements.glossy_slot == NO_SLOT)


def test_vertex_and_triangle_modes_count_as_the_mesh_does() -> None:
    table, hits = seen_from_above(*quad_grid(6), fov_deg=40.0)
    vertices = build_elements(table, hits, CacheSettings(elements="vertex", max_edge_fraction=0.0))
    triangles = build_elements(table, hits, CacheSettings(elements="triangle", max_edge_fraction=0.0))
    assert vertices.num_elements == 7 * 7, "one per mesh vertex"
    assert triangles.num_elements == 2 * 6 * 6, "one per triangle"
    positions, faces = quad_grid(6)
    centres = positions[faces].mean(1)
    order = np.lexsort(np.round(triangles.position, 4).T)
    np.testing.assert_allclose(triangles.position[order], centres[np.lexsort(np.round(centres, 4).T)], atol=1e-5)


def test_long_edges_are_cut_for_the_papers_caches() -> None:
    table, hits = seen_from_above(*quad_grid(2), fov_deg=40.0)
    settings = CacheSettings(elements="triangle", max_edge_fraction=0.1)
    elements = build_elements(table, hits, settings)
    cuts = elements.patches.prim_patches
    # Edges of sqrt 2 against a tenth of the mesh's diagonal, 2 sqrt 2: five patches along each.
    np.testing.assert_array_equal(cuts, 5)
    assert elements.num_elements == 8 * 5 * 5


def test_fine_meshes_share_elements() -> None:
    ball = icosphere(0.5, 4)
    table, hits = seen_from_above(ball.positions, ball.faces, fov_deg=60.0, rays=20000)
    touched = len(np.unique(hits.prim))
    elements = build_elements(table, hits, CacheSettings(max_elements=touched // 4, min_spacing_px=4.0))
    assert elements.num_elements <= touched // 4 < touched, "fewer elements than triangles seen"
    baked = np.unique(elements.diffuse_slot[(elements.diffuse_slot & NOT_BAKED) == 0])
    np.testing.assert_array_equal(baked, np.arange(elements.num_elements))


def test_normals_look_to_their_side(tiny: Built) -> None:
    table, hits = tiny
    elements = build_elements(table, hits, CacheSettings(max_elements=400))
    np.testing.assert_allclose(np.linalg.norm(elements.normal, axis=1), 1, atol=1e-5)
    flipped = surface_frame(table, elements.shape, elements.prim_local, elements.uv, 1 - elements.side)[1]
    np.testing.assert_allclose(flipped, -elements.normal, atol=1e-6)


def test_exitant_caches_give_every_element_a_direction(tiny: Built) -> None:
    elements = build_elements(*tiny, CacheSettings(elements="triangle", lobes="exitant"))
    np.testing.assert_array_equal(elements.glossy, np.arange(elements.num_elements))
    assert np.all(elements.diffuse_slot == NO_SLOT)
