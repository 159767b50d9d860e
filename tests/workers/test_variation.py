"""Variations as text, and what each of them changes in scenes of every kind."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tests.workers.test_scene_xml import FLOOR, sensor, write
from workers import camera_variation
from workers.backend import mi
from workers.camera_clearance import clearance
from workers.scene import Scene, load_scene
from workers.scene_variation import LUMINANCE
from workers.variation import Variation, VariationError, join_source, split_source

SHARE = st.floats(0, 1)
VARIATIONS = st.builds(
    lambda seed, materials, light, colour, camera: Variation(
        seed=seed, materials=materials, light=tuple(sorted(light)), light_colour=colour, camera=camera
    ),
    st.integers(0, 2**32 - 1), SHARE, st.tuples(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3)), SHARE, st.floats(0, 0.5),
)  # fmt: skip
COLOURS = "#seed=1,materials=0.8"
LIGHTS = "#seed=1,light=2..4"


@given(VARIATIONS)
def test_variation_text_round_trips(variation: Variation) -> None:
    assert Variation.parse(str(variation)) == variation
    base, parsed = split_source(join_source("rooms/hall.xml", variation))
    assert base == "rooms/hall.xml"
    assert parsed == (variation if variation.changes_something else None)


@pytest.mark.parametrize("text", [
    "seed=-1", "seed=1.5", "materials=2", "materials=nan", "light=0", "light=3..1", "light_colour=x", "camera=0.6",
    "colour=1", "seed=1,seed=1", "materials", "light=1..inf",
])  # fmt: skip
def test_variation_refuses_what_it_cannot_do(text: str) -> None:
    with pytest.raises(VariationError, match="variation"):
        Variation.parse(text)


def test_source_with_a_mark_in_a_files_own_name_is_that_file(tmp_path: Path) -> None:
    path = write(tmp_path, sensor(), FLOOR, '<emitter type="constant"/>', name="a#seed=1.xml")
    assert split_source(path) == (str(path), None)
    assert split_source(tmp_path / "b#2.xml") == (str(tmp_path / "b#2.xml"), None)


def xml_scene(folder: Path) -> Path:
    """A red wall of a shared material, a green one of its own, an area light and a point light."""
    red = '<bsdf type="diffuse" id="red"><rgb name="reflectance" value="0.8,0.1,0.1"/></bsdf>'
    wall = '<shape type="rectangle" id="{0}"><transform name="to_world"><translate z="{1}"/></transform>{2}</shape>'
    light = '<shape type="sphere" id="lamp"><float name="radius" value="0.2"/><point name="center" x="0" y="3" z="2"/>'
    light += '<emitter type="area"><rgb name="radiance" value="5,6,7"/></emitter></shape>'
    point = '<emitter type="point"><rgb name="intensity" value="1,2,3"/><point name="position" x="0" y="2" z="2"/>'
    green = '<bsdf type="plastic"><rgb name="diffuse_reflectance" value="0.1,0.7,0.1"/></bsdf>'
    walls = [wall.format(*row) for row in (("a", 0, '<ref id="red"/>'), ("b", -1, '<ref id="red"/>'), ("c", -2, green))]
    return write(folder, sensor(), red, *walls, light, point + "</emitter>")


def yaml_scene(folder: Path) -> Path:
    path = folder / "room.yaml"
    path.write_text("""scene:
  sensor: {type: perspective, fov: 45, to_world: {look_at: {origin: [0, 0, 4], target: [0, 0, 0]}}}
  wall: {type: rectangle, bsdf: {type: diffuse, reflectance: {type: rgb, value: [0.5, 0.5, 0.5]}}}
  sky: {type: constant, radiance: {type: rgb, value: [1, 1, 1]}}
""")
    return path


def mesh_scene(folder: Path) -> Path:
    """A white textured quad that faces +Z."""
    quad = trimesh.Trimesh([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    texture = Image.fromarray(np.full((8, 8, 3), 255, np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=texture, metallicFactor=0.0, roughnessFactor=1.0)
    quad.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    path = folder / "quad.glb"
    quad.export(path)
    return path


def coloured_mesh_scene(folder: Path) -> Path:
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.visual = trimesh.visual.ColorVisuals(ball, vertex_colors=np.full((len(ball.vertices), 4), 255, np.uint8))
    path = folder / "ball.ply"
    ball.export(path)
    return path


KINDS = {"xml": xml_scene, "yaml": yaml_scene, "mesh": mesh_scene, "attribute": coloured_mesh_scene,
         "built-in": lambda folder: "tiny"}  # fmt: skip


def image(scene: Scene, aov: str | None = None) -> np.ndarray:
    integrator = {"type": "aov", "aovs": aov} if aov else {"type": "path", "max_depth": 3}
    sensor_of_scene = scene.make_sensor(scene.camera.resized(24, 24))
    rendered = mi.render(scene.mi_scene, sensor=sensor_of_scene, integrator=mi.load_dict(integrator), spp=16, seed=3)
    return np.array(rendered)[..., :3]


@pytest.mark.parametrize("kind", KINDS)
def test_materials_of_every_kind_of_scene_change_and_enter_the_digest(kind: str, tmp_path: Path) -> None:
    source = KINDS[kind](tmp_path)
    marks = ("", COLOURS, COLOURS, COLOURS.replace("seed=1", "seed=2"))
    plain, varied, again, other = (load_scene(f"{source}{mark}") for mark in marks)
    assert len({plain.digest, varied.digest, other.digest}) == 3
    assert again.digest == varied.digest and again.name == varied.name != plain.name
    before, after = image(plain, "a:albedo"), image(varied, "a:albedo")
    changed = (np.abs(after - before).max(axis=2) > 0.02) & (before.max(axis=2) > 0)
    assert changed.mean() > 0.05
    assert (after >= 0).all() and after.max() <= max(1.001, before.max())  # gold reflects a little over 1 in red
    np.testing.assert_array_equal(image(again, "a:albedo"), after)
    assert plain.camera == varied.camera


@pytest.mark.parametrize("kind", KINDS)
def test_lights_of_every_kind_of_scene_change_within_their_range(kind: str, tmp_path: Path) -> None:
    source = KINDS[kind](tmp_path)
    plain, brighter = load_scene(source), load_scene(f"{source}{LIGHTS}")
    ratio = image(brighter).mean() / image(plain).mean()
    assert 1.99 <= ratio <= 4.01
    assert brighter.digest != plain.digest
    assert len(brighter.variation["changes"]) == len(plain.mi_scene.emitters())


def test_light_colour_keeps_the_luminance() -> None:
    plain, tinted = load_scene("tiny"), load_scene("tiny#seed=5,light_colour=0.8")
    assert abs(image(tinted)[..., 0].mean() / image(plain)[..., 0].mean() - 1) > 0.02
    (change,) = tinted.variation["changes"]
    gain = np.array(change["value"]) / [12.0, 11.0, 9.5]
    assert gain @ LUMINANCE == pytest.approx(1.0, rel=1e-4)
    assert np.ptp(gain) > 0.05


def test_shared_material_changes_once_and_lights_keep_their_names(tmp_path: Path) -> None:
    source = xml_scene(tmp_path)
    changed = [change["parameter"] for change in load_scene(f"{source}#materials=1,light=2").variation["changes"]]
    reflectances = [name for name in changed if "reflectance" in name and not name.startswith("lamp")]
    assert reflectances == ["a.bsdf.reflectance.value", "c.bsdf.diffuse_reflectance.value"]
    assert any(name == "lamp.emitter.radiance.value" for name in changed)
    assert any(name.startswith("PointLight-") and name.endswith("intensity.value") for name in changed)


def test_variation_that_changes_nothing_is_the_scene_itself() -> None:
    plain, same = load_scene("tiny"), load_scene("tiny#seed=9")
    assert (same.digest, same.name) == (plain.digest, plain.name)


def test_camera_variation_moves_all_views_and_leaves_the_light_alone() -> None:
    plain, moved = load_scene("tiny"), load_scene("tiny#seed=4,camera=0.1")
    assert moved.digest != plain.digest and moved.variation["changes"] == []
    shift = moved.camera.origin - plain.camera.origin
    assert 0.01 < np.linalg.norm(shift) < 0.3
    for before, after in zip(plain.keyframes, moved.keyframes, strict=True):
        np.testing.assert_allclose(after.origin - before.origin, shift, atol=1e-9)
        assert after.forward @ before.forward > 0.9
    assert load_scene("tiny#seed=4,camera=0.1").camera == moved.camera
    np.testing.assert_array_equal(image(moved, "a:albedo").shape, image(plain, "a:albedo").shape)


def test_views_that_cannot_move_stay_and_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_variation, "_clear", lambda *arguments: False)
    moved = load_scene("tiny#camera=0.5")
    assert moved.camera == load_scene("tiny").camera
    assert any("could not be moved" in note for note in moved.notes)


def test_moved_views_keep_clear_of_surfaces() -> None:
    plain = load_scene("tiny")
    for seed in range(6):
        moved = load_scene(f"tiny#seed={seed},camera=0.5")
        views = [moved.camera, *moved.keyframes, *moved.test_keyframes]
        assert not moved.notes
        assert clearance(plain, np.array([view.origin for view in views])).min() > 0.02
