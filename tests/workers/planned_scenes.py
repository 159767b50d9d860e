"""Small YAML scenes for audits and plans: a floor, a ball and a light, whose materials are given."""

from pathlib import Path
from typing import Any

import yaml

from storage.store import Store
from workers.run_state import RunState
from workers.scene import load_scene
from workers.settings import Settings

GREY = {"type": "rgb", "value": [0.5, 0.5, 0.5]}
DIFFUSE = {"type": "diffuse", "reflectance": GREY}
SKY = {"type": "constant", "radiance": 1.0}


def scene_file(folder: Path, ball: dict[str, Any] | None = None, *, light: dict[str, Any] | None = None,
               floor: dict[str, Any] | None = None, shapes: dict[str, Any] | None = None,
               max_depth: int = 4) -> Path:  # fmt: skip
    """A scene of a floor seen from above, with a ball on it where its material is given."""
    scene: dict[str, Any] = {
        "integrator": {"type": "path", "max_depth": max_depth},
        "sensor": {
            "type": "perspective", "fov": 45,
            "to_world": {"look_at": {"origin": [0, 3, 3], "target": [0, 0, 0], "up": [0, 1, 0]}},
            "film": {"type": "hdrfilm", "width": 48, "height": 48},
        },
        "floor": {
            "type": "rectangle", "to_world": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 8}],
            "bsdf": floor or DIFFUSE,
        },
        **(shapes or {}),
    }  # fmt: skip
    if light is not None:
        scene["light"] = light
    if ball is not None:
        scene["ball"] = {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.5, "bsdf": ball}
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump({"scene": scene}))
    return path


def open_run(path: Path, store: Store | None = None, **overrides: Any) -> RunState:
    """A tiny run of a scene file; nothing is computed."""
    scene = load_scene(path)
    values = {"width": scene.camera.width, "height": scene.camera.height, "cache.max_elements": 300}
    settings = Settings.preset_named("tiny").override(values).choose(overrides)
    return RunState(scene, store, settings)  # type: ignore[arg-type]  # a plan needs none
