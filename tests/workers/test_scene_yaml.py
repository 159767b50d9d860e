"""YAML scenes: transforms, files, camera keyframes, and errors that name the key."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from workers.errors import SceneError
from workers.scene import load_scene


def document() -> dict:
    return {
        "scene": {
            "sensor": {
                "type": "perspective",
                "fov": 45,
                "to_world": {"look_at": {"origin": [0, 1, 4], "target": [0, 1, 0], "up": [0, 1, 0]}},
                "film": {"type": "hdrfilm", "width": 40, "height": 20},
            },
            "floor": {
                "type": "rectangle",
                "to_world": [
                    {"rotate": {"axis": [1, 0, 0], "angle": -90}},
                    {"scale": 2},
                    {"translate": [0, 3, 0]},
                ],
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.4, 0.3]}},
            },
            "sky": {"type": "constant"},
        },
        "camera": {
            "keyframes": [
                {"origin": [0, 1, 4], "target": [0, 1, 0]},
                {"origin": [1, 1, 4], "target": [0, 1, 0], "fov": 30},
            ]
        },
        "settings": {"spp": 4},
    }


def write(folder: Path, content: object) -> Path:
    path = folder / "room.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def test_yaml_scene_is_read_whole(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path, document()))
    assert scene.name == "room" and scene.settings == {"spp": 4}
    assert (scene.camera.width, scene.camera.fov_deg) == (40, pytest.approx(45))
    np.testing.assert_allclose(scene.camera.origin, [0, 1, 4])
    assert [camera.fov_deg for camera in scene.keyframes] == [pytest.approx(45), 30.0]
    assert {camera.width for camera in scene.keyframes} == {40}


def test_transforms_apply_in_the_order_of_the_list(tmp_path: Path) -> None:
    box = load_scene(write(tmp_path, document())).mi_scene.shapes()[0].bbox()
    np.testing.assert_allclose(np.array(box.min).ravel(), [-2, 3, -2], atol=1e-5)
    np.testing.assert_allclose(np.array(box.max).ravel(), [2, 3, 2], atol=1e-5)


def test_exponents_without_a_dot_are_numbers(tmp_path: Path) -> None:
    text = yaml.safe_dump(document()).replace("fov: 45", "fov: 45e0")
    assert load_scene(write(tmp_path, text)).camera.fov_deg == pytest.approx(45)


def test_camera_and_settings_leave_the_digest_alone(tmp_path: Path) -> None:
    first = load_scene(write(tmp_path, document())).digest
    other = document()
    other["settings"], other["camera"] = {}, {}
    assert load_scene(write(tmp_path, other)).digest == first
    other["scene"]["floor"]["bsdf"]["reflectance"]["value"][0] = 0.6
    assert load_scene(write(tmp_path, other)).digest != first


def test_without_a_sensor_the_first_keyframe_is_the_view(tmp_path: Path) -> None:
    content = document()
    del content["scene"]["sensor"]
    assert load_scene(write(tmp_path, content), width=8, height=8).camera.fov_deg == 45
    del content["camera"]
    with pytest.raises(SceneError, match="sensor"):
        load_scene(write(tmp_path, content))


def test_files_are_relative_to_the_yaml(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    content = document()
    content["scene"]["floor"] = {"type": "obj", "filename": "a.obj"}
    first = load_scene(write(tmp_path, content)).digest
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 2 0 0\nv 0 1 0\nf 1 2 3\n")
    assert load_scene(tmp_path / "room.yaml").digest != first


def changed(*keys: str, value: object) -> dict:
    content: dict = document()
    inner = content
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    return content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("scene: [", "valid YAML.*line"),
        ("- 1", "mapping"),
        ({"camera": {}}, "must have the key scene"),
        ({"scene": {}}, "key scene must"),
        (changed("lights", value=1), "got lights"),
        (changed("scene", "floor", "to_world", value={"shear": 1}), "scene.floor.to_world"),
        (
            changed("scene", "floor", "to_world", value={"translate": [1, 2]}),
            "scene.floor.to_world.translate",
        ),
        (changed("scene", "floor", "to_world", value={"rotate": {"axis": [1, 0, 0]}}), "angle"),
        (changed("scene", "floor", "to_world", value={"matrix": [[1, 0], [0, 1]]}), "to_world.matrix"),
        (changed("scene", "floor", "bsdf", value={"reflectance": 1}), "scene.floor.bsdf must have a type"),
        (changed("scene", "floor", "bsdf", value=None), "scene.floor.bsdf"),
        (changed("scene", "floor", "type", value="pyramid"), "pyramid"),
        (changed("camera", "keyframes", value=[{"origin": [0, 0, 0]}]), r"keyframes\[0\].*target"),
        (
            changed("camera", "keyframes", value=[{"origin": [0, 0, 0], "target": [0, 0, 0]}]),
            r"keyframes\[0\]",
        ),
        (
            changed("camera", "keyframes", value=[{"origin": [0, 0, 0], "target": [0, 0, 1], "fov": 190}]),
            "fov",
        ),
        (changed("camera", "keyframes", value={"a": 1}), "keyframes must be a list"),
        (changed("settings", value=[1]), "key settings"),
    ],
)
def test_yaml_errors_name_the_key(tmp_path: Path, content: object, message: str) -> None:
    with pytest.raises(SceneError, match=message) as caught:
        load_scene(write(tmp_path, content))
    assert "\n" not in str(caught.value)
