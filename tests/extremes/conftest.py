"""One small scene at any size and place, shared by the suite: every stated bound compares with it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from workers.elements import ElementSet, build_elements
from workers.progress import Progress
from workers.query import CacheArrays, QueryProgram
from workers.scene import Scene, load_scene
from workers.settings import CacheSettings, QuerySettings
from workers.surfaces import SurfaceTable, build_surface_table
from workers.visibility import domain_hits

SIZE = 24
MakeScene = Callable[..., Scene]


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def diffuse(*value: float) -> dict[str, Any]:
    return {"type": "twosided", "inner": {"type": "diffuse", "reflectance": rgb(*value)}}


def document(scale: float, offset: tuple[float, float, float], emission: float, size: int) -> dict[str, Any]:
    """A box and a ball on a floor before a wall, under a lamp and a point light, about 6 units across."""

    def place(*steps: dict[str, Any]) -> list[dict[str, Any]]:
        return [*steps, {"scale": scale}, {"translate": list(offset)}]

    def point(*at: float) -> list[float]:
        return [float(a * scale + o) for a, o in zip(at, offset, strict=True)]

    turn = {"rotate": {"axis": [1, 0, 0], "angle": -90}}
    return {
        "sensor": {
            "type": "perspective", "fov": 50, "film": {"type": "hdrfilm", "width": size, "height": size},
            "to_world": {"look_at": {"origin": point(0.0, 1.5, 3.0), "target": point(0.0, 0.5, 0.0)}},
        },
        "integrator": {"type": "path", "max_depth": 6},
        "floor": {"type": "rectangle", "to_world": place({"scale": 2.0}, turn), "b": diffuse(0.6, 0.5, 0.4)},
        "wall": {"type": "rectangle", "to_world": place({"scale": 2.0}, {"translate": [0, 1, -1]}),
                 "b": diffuse(0.3, 0.5, 0.6)},
        "box": {"type": "cube", "to_world": place({"scale": 0.4}, {"translate": [0.3, 0.4, 0]}),
                "b": diffuse(0.7, 0.7, 0.7)},
        "ball": {"type": "sphere", "center": point(-0.5, 0.3, 0.0), "radius": 0.3 * scale, "b": diffuse(0.7, 0.2, 0.7)},
        "lamp": {"type": "rectangle", "emitter": {"type": "area", "radiance": rgb(*[5 * emission] * 3)},
                 "to_world": place({"scale": 0.5}, {"rotate": {"axis": [1, 0, 0], "angle": 90}},
                                   {"translate": [0, 2.5, 0]})},
        "point": {"type": "point", "position": point(0.5, 2.0, 1.0),
                  "intensity": rgb(*[float(2 * emission * scale**2)] * 3)},
    }  # fmt: skip


@pytest.fixture(scope="session")
def make_scene(tmp_path_factory: pytest.TempPathFactory) -> MakeScene:
    """The scene at a scale and an offset, loaded from a file as a user's would be; equal ones are loaded once."""
    folder, made = tmp_path_factory.mktemp("scenes"), {}

    def make(
        scale: float = 1.0, offset: tuple[float, float, float] = (0.0, 0.0, 0.0), emission: float = 1.0,
        size: int = SIZE, **more: Any,
    ) -> Scene:  # fmt: skip
        key = repr((scale, offset, emission, size, more))
        if key not in made:
            path = Path(folder) / f"scene{len(made)}.yaml"
            path.write_text(yaml.safe_dump({"scene": document(scale, offset, emission, size) | more}))
            made[key] = load_scene(path)
        return made[key]

    return make


Within = Callable[[str, float, float], None]


@pytest.fixture
def within(record_property: Callable[[str, object], None]) -> Within:
    """Asserts that a measured value keeps its bound; `--junitxml FILE -o junit_family=xunit1` lists both."""

    def check(what: str, measured: float, bound: float) -> None:
        record_property(what, f"{measured:.2g} of {bound:g}")
        assert measured <= bound, f"{what} must be at most {bound:g}, got {measured:g}"

    return check


class Prepared:
    """A scene with its surfaces, the elements that its camera sees, and the query with caches of one."""

    def __init__(self, scene: Scene, max_elements: int = 300) -> None:
        self.scene = scene
        self.table: SurfaceTable = build_surface_table(scene.mi_scene, scene.frame)
        self.settings = CacheSettings(max_elements=max_elements)
        hits = domain_hits(scene.mi_scene, self.table, [scene.camera], 64, 2500, Progress())
        self.elements: ElementSet = build_elements(self.table, hits, self.settings)

    def program(self, diffuse_value: float = 1.0) -> QueryProgram:
        values = np.full((self.elements.num_elements, 3), diffuse_value, np.float32)
        none = np.zeros((len(self.elements.glossy), 2, 2, 3), np.float32)
        caches = CacheArrays(values, none)
        return QueryProgram(self.scene.mi_scene, self.table, self.elements, caches, QuerySettings(samples=1))


@pytest.fixture(scope="session")
def prepare(make_scene: MakeScene) -> Callable[..., Prepared]:
    made: dict[str, Prepared] = {}

    def make(**arguments: Any) -> Prepared:
        key = repr(sorted(arguments.items()))
        if key not in made:
            made[key] = Prepared(make_scene(**arguments))
        return made[key]

    return make
