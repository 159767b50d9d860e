"""Two scenes made by code, so that everything can be tried without a file.

`tabletop`: a closed room around a glossy checkered table with a rough gold vase, plastic and matt objects;
about 21,600 triangles. `tiny`: the same idea with under 500 triangles, for tests. Both in metres, Y up, and
deterministic: the same code gives the same arrays, and `BUILTIN_VERSION` goes up when it gives others.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from workers.backend import mi
from workers.camera import Camera
from workers.errors import SceneError
from workers.mesh_building import MeshArrays, icosphere, revolve, sphere, to_mitsuba, torus
from workers.scene_draft import SceneDraft, text_hash
from workers.scene_nodes import parse_state

BUILTIN_VERSION = 1
_UP = (0.0, 1.0, 0.0)
_WHITE, _RED, _TEAL = (0.72, 0.70, 0.66), (0.55, 0.13, 0.09), (0.10, 0.35, 0.40)

Pose = tuple[tuple[float, float, float], tuple[float, float, float]]

TABLETOP_FOV_DEG = 48.0
TABLETOP_VIEW: Pose = ((0.0, 1.42, 1.25), (0.0, 0.88, -0.05))
TABLETOP_KEYFRAMES: tuple[Pose, ...] = (
    ((-0.75, 1.32, 0.95), (-0.05, 0.88, 0.0)),
    ((-0.40, 1.50, 1.20), (0.0, 0.86, 0.0)),
    TABLETOP_VIEW,
    ((0.42, 1.28, 1.18), (0.0, 0.90, -0.05)),
    ((0.80, 1.45, 0.90), (0.05, 0.86, 0.0)),
)
TABLETOP_TEST_KEYFRAMES: tuple[Pose, ...] = (
    ((0.62, 1.36, 1.02), (0.03, 0.88, 0.0)),
    ((0.20, 1.52, 1.16), (0.02, 0.86, -0.03)),
    ((-0.18, 1.34, 1.24), (0.0, 0.88, -0.03)),
    ((-0.58, 1.46, 1.04), (-0.04, 0.87, 0.0)),
)
TINY_FOV_DEG = 50.0
TINY_VIEW: Pose = ((0.0, 1.1, 1.75), (0.0, 0.55, 0.0))
TINY_KEYFRAMES: tuple[Pose, ...] = (
    ((-0.5, 1.0, 1.6), (0.0, 0.55, 0.0)),
    TINY_VIEW,
    ((0.5, 1.2, 1.6), (0.0, 0.55, 0.0)),
)
TINY_TEST_KEYFRAMES: tuple[Pose, ...] = (
    ((0.35, 1.05, 1.65), (0.0, 0.55, 0.0)),
    ((-0.35, 1.18, 1.65), (0.0, 0.55, 0.0)),
)


def tabletop() -> dict[str, Any]:
    """The scene for `mi.load_dict`: build it anew for each use, Mitsuba takes the meshes over."""
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.16, "distribution": "ggx"}
    vase = revolve(_vase_profile(), 96).moved((-0.02, 0.8, -0.16))
    return {
        **_room(width=3.6, height=2.5, depth=3.6),
        **_ceiling_light(size=1.1, height=2.49, centre=(0.1, 0.2), radiance=(11.0, 10.0, 8.6)),
        "table": _box((0.0, 0.76, 0.0), (0.85, 0.04, 0.62), _plastic(_tiles(), 0.1, nonlinear=True)),
        "table_foot": _box((0.0, 0.36, 0.0), (0.25, 0.36, 0.25), _diffuse((0.25, 0.18, 0.12))),
        "vase": _mesh("vase", vase, gold),
        "red_ball": _mesh("red_ball", sphere(0.15, 64, 32).moved((0.38, 0.95, 0.05)), _plastic(_RED, 0.08)),
        "ring": _mesh("ring", torus(0.135, 0.05, 56, 24).moved((-0.40, 0.85, 0.12)), _diffuse(_TEAL)),
        "matt_ball": _mesh("matt_ball", sphere(0.075, 40, 20).moved((0.10, 0.875, 0.28)),
                           _diffuse((0.75, 0.6, 0.2))),
        "steel_ball": _mesh("steel_ball", sphere(0.065, 40, 20).moved((-0.40, 0.865, 0.12)), _steel(0.2)),
        "blue_ball": _mesh("blue_ball", sphere(0.085, 40, 20).moved((-0.13, 0.885, 0.33)),
                           _plastic((0.05, 0.11, 0.42), 0.15)),
        "block": _box((0.44, 0.9, -0.3), (0.11, 0.1, 0.11), _diffuse((0.6, 0.58, 0.55)), turn_deg=28.0),
        "sensor": _sensor(TABLETOP_VIEW, TABLETOP_FOV_DEG, 512, 512),
    }  # fmt: skip


def tiny() -> dict[str, Any]:
    """The scene for `mi.load_dict`: under 500 triangles."""
    ball = icosphere(0.28, 2).moved((0.33, 0.28, 0.25))
    return {
        **_room(width=2.4, height=2.0, depth=4.2, floor=_plastic((0.35, 0.33, 0.30), 0.12)),
        **_ceiling_light(size=0.8, height=1.99, centre=(0.0, 0.1), radiance=(12.0, 11.0, 9.5)),
        "box": _box((-0.38, 0.42, -0.25), (0.26, 0.42, 0.26), _diffuse((0.65, 0.62, 0.58)), turn_deg=22.0),
        "ball": _mesh("ball", ball, {"type": "roughconductor", "material": "Au", "alpha": 0.2}),
        "sensor": _sensor(TINY_VIEW, TINY_FOV_DEG, 128, 128),
    }


_Builtin = tuple[Callable[[], dict[str, Any]], float, tuple[Pose, ...], tuple[Pose, ...]]
BUILTIN_SCENES: dict[str, _Builtin] = {
    "tabletop": (tabletop, TABLETOP_FOV_DEG, TABLETOP_KEYFRAMES, TABLETOP_TEST_KEYFRAMES),
    "tiny": (tiny, TINY_FOV_DEG, TINY_KEYFRAMES, TINY_TEST_KEYFRAMES),
}


def read_builtin(name: str) -> SceneDraft:
    """The draft of a built-in scene.

    Raises:
        SceneError: there is none of that name.
    """
    if name not in BUILTIN_SCENES:
        raise SceneError(f"built-in scene must be one of {', '.join(sorted(BUILTIN_SCENES))}, got {name!r}")
    make, fov_deg, keyframes, test_keyframes = BUILTIN_SCENES[name]
    what = f"built-in scene {name}"

    def cameras(poses: tuple[Pose, ...], view: Camera) -> tuple[Camera, ...]:
        return tuple(Camera.look_at(*pose, _UP, fov_deg, view.width, view.height) for pose in poses)

    return SceneDraft(
        what=what,
        state=parse_state(lambda config: mi.parser.parse_dict(config, {"type": "scene", **make()}), what),
        content=[(f"builtin:{name}", text_hash(f"{name}/{BUILTIN_VERSION}"))],
        make_keyframes=lambda view: cameras(keyframes, view),
        make_test_keyframes=lambda view: cameras(test_keyframes, view),
    )


def _room(width: float, height: float, depth: float, floor: dict[str, Any] | None = None) -> dict[str, Any]:
    """Six inward rectangles about the Y axis, the floor at 0."""
    half = (width / 2, height / 2, depth / 2)
    to = mi.ScalarTransform4f
    base = to().translate([0, half[1], 0])
    sides = {
        "floor": (
            to().rotate([1, 0, 0], -90),
            (half[0], half[2]),
            half[1],
            floor or _diffuse((0.4, 0.36, 0.32)),
        ),
        "ceiling": (to().rotate([1, 0, 0], 90), (half[0], half[2]), half[1], _diffuse(_WHITE)),
        "back_wall": (to(), (half[0], half[1]), half[2], _diffuse(_WHITE)),
        "front_wall": (to().rotate([0, 1, 0], 180), (half[0], half[1]), half[2], _diffuse(_WHITE)),
        "left_wall": (to().rotate([0, 1, 0], 90), (half[2], half[1]), half[0], _diffuse(_RED)),
        "right_wall": (to().rotate([0, 1, 0], -90), (half[2], half[1]), half[0], _diffuse(_TEAL)),
    }
    return {
        name: {
            "type": "rectangle",
            "to_world": base @ turn @ to().translate([0, 0, -distance]) @ to().scale([size[0], size[1], 1]),
            "bsdf": bsdf,
        }
        for name, (turn, size, distance, bsdf) in sides.items()
    }


def _ceiling_light(size: float, height: float, centre: tuple[float, float],
                   radiance: tuple[float, float, float]) -> dict[str, Any]:  # fmt: skip
    to = mi.ScalarTransform4f
    return {
        "light": {
            "type": "rectangle",
            "to_world": to().translate([centre[0], height, centre[1]]) @ to().rotate([1, 0, 0], 90)
            @ to().scale([size / 2, size / 2, 1]),
            "bsdf": _diffuse((0.1, 0.1, 0.1)),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}},
        }
    }  # fmt: skip


def _box(centre: tuple[float, float, float], half: tuple[float, float, float], bsdf: dict[str, Any],
         turn_deg: float = 0.0) -> dict[str, Any]:  # fmt: skip
    to = mi.ScalarTransform4f
    return {
        "type": "cube",
        "to_world": to().translate(list(centre)) @ to().rotate([0, 1, 0], turn_deg) @ to().scale(list(half)),
        "bsdf": bsdf,
    }


def _mesh(name: str, mesh: MeshArrays, bsdf: dict[str, Any]) -> Any:
    return to_mitsuba(name, mesh.positions, mesh.faces, normals=mesh.normals, texcoords=mesh.texcoords,
                      bsdf=mi.load_dict(bsdf))  # fmt: skip


def _vase_profile() -> np.ndarray:
    """Outside from the foot up, over the lip and down inside: [points, 2] radius and height in metres."""
    height = np.linspace(0.0, 1.0, 30)
    radius = 0.062 + 0.085 * np.sin(np.pi * height**0.75) ** 2 + 0.028 * height**3
    outside = np.column_stack([radius, 0.46 * height])
    inside = np.column_stack([radius[::-1][:22] - 0.012, 0.46 * height[::-1][:22]])
    lip = [[radius[-1] - 0.002, 0.465], [radius[-1] - 0.010, 0.465]]
    return np.concatenate([[[0.0, 0.0]], outside, lip, inside, [[0.0, inside[-1, 1]]]])


def _tiles(num_tiles: int = 8, texels: int = 32) -> dict[str, Any]:
    """Two-tone tiles with dark joints and a slight grain, as a bitmap texture in sRGB primaries, linear."""
    size = num_tiles * texels
    row, column = np.mgrid[0:size, 0:size]
    light = ((row // texels + column // texels) % 2).astype(np.float64)[..., None]
    image = light * [0.62, 0.52, 0.38] + (1 - light) * [0.20, 0.11, 0.07]
    image *= 1 + 0.12 * np.sin(column * 0.9 + 3 * np.sin(row * 0.06))[..., None]
    joint = (row % texels < 1) | (column % texels < 1)
    image[joint] = [0.06, 0.05, 0.05]
    bitmap = mi.Bitmap(np.clip(image, 0, 1).astype(np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True}


def _rgb(value: Any) -> Any:
    return value if isinstance(value, dict) else {"type": "rgb", "value": list(value)}


def _diffuse(reflectance: Any) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _rgb(reflectance)}}


def _plastic(reflectance: Any, alpha: float, nonlinear: bool = False) -> dict[str, Any]:
    bsdf = {
        "type": "roughplastic",
        "diffuse_reflectance": _rgb(reflectance),
        "alpha": alpha,
        "distribution": "ggx",
    }
    return {"type": "twosided", "bsdf": {**bsdf, "nonlinear": nonlinear}}


def _steel(alpha: float) -> dict[str, Any]:
    return {"type": "roughconductor", "material": "Cr", "alpha": alpha, "distribution": "ggx"}


def _sensor(view: Pose, fov_deg: float, width: int, height: int) -> dict[str, Any]:
    origin, target = view
    return {"type": "perspective", "fov": fov_deg, "fov_axis": "x",
            "to_world": mi.ScalarTransform4f().look_at(list(origin), list(target), list(_UP)),
            "film": {"type": "hdrfilm", "width": width, "height": height}}  # fmt: skip
