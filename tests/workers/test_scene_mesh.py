"""Mesh files: geometry, transforms, materials and textures arrive; light and camera are added and said so."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from workers.backend import mi
from workers.errors import SceneError
from workers.mesh_material import read_material
from workers.scene import Scene, load_scene

PBR = trimesh.visual.material.PBRMaterial


def textured_quad() -> trimesh.Trimesh:
    """Upper half red, lower half blue, facing +Z."""
    image = np.zeros((16, 16, 3), np.uint8)
    image[:8, :, 0], image[8:, :, 2] = 255, 255
    quad = trimesh.Trimesh([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    material = PBR(baseColorTexture=Image.fromarray(image), metallicFactor=0.0, roughnessFactor=1.0)
    quad.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    return quad


def albedo_at(scene: Scene, x: float, y: float) -> np.ndarray:
    """Diffuse reflectance of what a ray along -Z meets at (x, y)."""
    ray = mi.Ray3f(mi.Point3f(x, y, 5), mi.Vector3f(0, 0, -1))
    si = scene.mi_scene.ray_intersect(ray)
    return np.array(si.bsdf().eval_diffuse_reflectance(si)).ravel()


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_texture_is_the_right_way_up(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"quad{suffix}"
    textured_quad().export(path)
    scene = load_scene(path, width=8, height=8)
    np.testing.assert_allclose(albedo_at(scene, 0, 1.5), [1, 0, 0], atol=1e-3)
    np.testing.assert_allclose(albedo_at(scene, 0, 0.5), [0, 0, 1], atol=1e-3)


def test_node_transforms_are_applied_and_keep_normals_outward(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.visual = trimesh.visual.TextureVisuals(material=PBR(baseColorFactor=[0.5, 0.5, 0.5, 1.0]))
    assert ball.vertex_normals is not None
    flipped = trimesh.Scene()
    flipped.add_geometry(ball, node_name="ball", transform=np.diag([-1.0, 2.0, 1.0, 1.0]))
    flipped.export(tmp_path / "ball.glb")
    mesh = next(s for s in load_scene(tmp_path / "ball.glb").mi_scene.shapes() if s.id() == "ball")
    positions = np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)
    normals = np.array(mesh.vertex_normals_buffer()).reshape(-1, 3)
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
    assert positions[:, 1].max() == pytest.approx(2, rel=1e-2)
    assert ((normals * positions).sum(1) > 0).all()
    corners = positions[faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((facing * corners.mean(1)).sum(1) > 0).all()


@pytest.mark.parametrize("suffix", [".stl", ".ply"])
def test_light_and_camera_are_added_and_the_bounds_are_in_view(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"box{suffix}"
    trimesh.creation.box(extents=(1, 2, 3)).export(path)
    scene = load_scene(path, width=40, height=20)
    assert any("environment" in note for note in scene.notes) and any("view" in note for note in scene.notes)
    corners = trimesh.creation.box(extents=(1, 2, 3)).vertices
    local = np.c_[corners, np.ones(8)] @ scene.camera.world_to_camera.T
    half = np.tan(np.radians([scene.camera.fov_deg, scene.camera.fov_y_deg]) / 2)
    assert (local[:, 2] > 0).all() and (np.abs(local[:, :2] / local[:, 2:3]) < half).all()
    assert scene.camera.up[2] > 0.5, "Z is up in these files"
    path_tracer = mi.load_dict({"type": "path", "max_depth": 4})
    image = np.array(mi.render(scene.mi_scene, sensor=scene.make_sensor(scene.camera), integrator=path_tracer, spp=4))
    assert np.isfinite(image).all() and image.mean() > 0.05


def test_vertex_colours_become_linear_reflectance(tmp_path: Path) -> None:
    quad = trimesh.Trimesh([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    quad.visual.vertex_colors = [188, 0, 255, 255]
    quad.export(tmp_path / "q.ply")
    np.testing.assert_allclose(albedo_at(load_scene(tmp_path / "q.ply"), 0.2, 0.5), [0.503, 0, 1], atol=2e-3)


@pytest.mark.parametrize(
    ("material", "plugin"),
    [
        (PBR(baseColorFactor=[1.0, 1, 1, 0.2], alphaMode="BLEND"), "thindielectric"),
        (PBR(baseColorFactor=[1.0, 1, 1, 0.8], alphaMode="BLEND"), "mask"),
        (PBR(baseColorFactor=[1.0, 1, 1, 0.2]), "twosided"),
        (trimesh.visual.material.SimpleMaterial(diffuse=[10, 20, 30, 255]), "twosided"),
    ],
)
def test_alpha_decides_the_plugin(material: object, plugin: str) -> None:
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(material=material)
    assert read_material(box, has_texcoords=False).bsdf["type"] == plugin


def test_emissive_factor_becomes_an_area_light(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(material=PBR(emissiveFactor=[1.0, 0.5, 0.0]))
    box.export(tmp_path / "lamp.glb")
    scene = load_scene(tmp_path / "lamp.glb")
    assert sum(shape.is_emitter() for shape in scene.mi_scene.shapes()) == 2  # the lamp and the added light


CASES = (
    ("a.glb", "a.glb"),
    ("b.gltf", "gone.bin"),
    ("c.obj", "finite"),
    ("d.obj", "triangles"),
    ("e.stl", "e.stl"),
    ("f.ply", "exist"),
)


def test_missing_and_broken_mesh_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(b"not a glb")
    (tmp_path / "b.gltf").write_text('{"asset": {"version": "2.0"}, "buffers": [{"uri": "gone.bin"}]}')
    (tmp_path / "c.obj").write_text("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "d.obj").write_text("v 0 0 0\n")
    (tmp_path / "e.stl").write_text("")
    for name, message in CASES:
        with pytest.raises(SceneError, match=message) as caught:
            load_scene(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_digest_follows_external_textures(tmp_path: Path) -> None:
    textured_quad().export(tmp_path / "quad.obj")
    image = next(file for file in tmp_path.iterdir() if file.suffix == ".png" or file.suffix == ".jpeg")
    first = load_scene(tmp_path / "quad.obj").digest
    Image.new("RGB", (4, 4), (9, 9, 9)).save(image)
    assert load_scene(tmp_path / "quad.obj").digest != first
