"""Built-in scenes: size, light, determinism, and exact shapes of the code-made meshes."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from workers.backend import mi
from workers.builtin_scenes import BUILTIN_SCENES
from workers.mesh_building import MeshArrays, icosphere, revolve, sphere, torus
from workers.scene import Scene, load_scene


def volume(mesh: MeshArrays) -> float:
    a, b, c = (mesh.positions[mesh.faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def num_triangles(scene: Scene) -> int:
    return sum(shape.face_count() for shape in scene.mi_scene.shapes())


@pytest.mark.parametrize(("name", "low", "high"), [("tabletop", 15_000, 25_000), ("tiny", 100, 500)])
def test_builtin_has_its_size_and_all_meshes(name: str, low: int, high: int) -> None:
    scene = load_scene(name)
    assert low <= num_triangles(scene) <= high
    assert all(shape.is_mesh() and shape.id() for shape in scene.mi_scene.shapes())
    assert scene.notes == () and len(scene.keyframes) >= 2 and len(scene.test_keyframes) >= 2
    assert load_scene(f"builtin:{name}").digest == scene.digest


def test_builtin_digests_differ() -> None:
    assert len({load_scene(name).digest for name in BUILTIN_SCENES}) == len(BUILTIN_SCENES)


@pytest.mark.parametrize("name", BUILTIN_SCENES)
def test_builtin_is_the_same_twice(name: str) -> None:
    scenes = [load_scene(name, width=4, height=4) for _ in range(2)]
    meshes = [
        {shape.id(): np.array(shape.vertex_positions_buffer()) for shape in scene.mi_scene.shapes()} for scene in scenes
    ]
    assert meshes[0].keys() == meshes[1].keys()
    assert all(np.array_equal(meshes[0][key], meshes[1][key]) for key in meshes[0])


@pytest.mark.parametrize("name", BUILTIN_SCENES)
def test_builtin_room_is_closed_and_lit(name: str) -> None:
    scene = load_scene(name, width=16, height=16)
    integrator = mi.load_dict({"type": "aov", "aovs": "t:depth", "i": {"type": "path", "max_depth": 4}})
    image = np.array(mi.render(scene.mi_scene, sensor=scene.make_sensor(scene.camera), integrator=integrator, spp=16))
    assert np.isfinite(image).all()
    assert (image[..., 3] > 0).all(), "every ray meets a surface"
    assert 0.05 < image[..., :3].mean() < 2


def test_meshes_enclose_their_volume() -> None:
    assert volume(sphere(1.0, 96, 48)) == pytest.approx(4 / 3 * np.pi, rel=5e-3)
    assert volume(icosphere(1.0, 4)) == pytest.approx(4 / 3 * np.pi, rel=5e-3)
    assert volume(torus(1.0, 0.3, 96, 48)) == pytest.approx(2 * np.pi**2 * 0.3**2, rel=1e-2)
    cylinder = revolve([[0, 0], [1, 0], [1, 2], [0, 2]], 96)
    assert volume(cylinder) == pytest.approx(2 * np.pi, rel=5e-3)


@pytest.mark.parametrize("mesh", [sphere(0.5, 24, 12), torus(1.0, 0.3, 24, 12), icosphere(0.5, 2)])
def test_mesh_normals_are_unit_and_outward(mesh: MeshArrays) -> None:
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-9)
    a, b, c = (mesh.positions[mesh.faces[:, corner]] for corner in range(3))
    facing = np.cross(b - a, c - a)
    assert ((facing * mesh.normals[mesh.faces].mean(1)).sum(1) > 0).all()
    assert (np.linalg.norm(facing, axis=1) > 0).all()
    assert mesh.texcoords.min() >= 0 and mesh.texcoords.max() <= 1


def test_frame_that_the_readme_asks_for_is_seen_from_where_tabletop_was_baked() -> None:
    text = (Path(__file__).parents[2] / "README.md").read_text()
    body = re.search(r"-d '(\{.*\})' \\\n.*/v1/scenes/tabletop/frame", text)
    assert body is not None
    asked = json.loads(body[1])["camera"]["look_at"]
    own = load_scene("tabletop").camera.to_world
    forward = np.subtract(asked["target"], asked["origin"])
    assert np.linalg.norm(asked["origin"] - own[:3, 3]) < 0.05
    assert forward / np.linalg.norm(forward) @ own[:3, 2] > 0.999
