"""Path tracing from surface points against closed forms: furnaces, closed rooms, known lights."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from workers.backend import mi
from workers.bake_kernels import Batch, bake_diffuse, bake_directional
from workers.elements import surface_frame
from workers.surfaces import build_surface_table
from workers.transport import power_heuristic

# Two-sided significance of 1e-6 per test, with fixed seeds: a failure is a defect, not chance.
MAX_Z = 4.9
COLOUR = {"type": "rgb", "value": [0.6, 0.4, 0.2]}


def grey(value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": [value] * 3}


class Probe:
    """Points on the shapes of a scene, baked many times with independent seeds."""

    def __init__(self, config: dict[str, Any], places: list[tuple[str, int, tuple[float, float], int]]) -> None:
        self.scene = mi.load_dict({"type": "scene", **config}, optimize=False)
        self.table = build_surface_table(self.scene)
        ids = [shape.id() for shape in self.table.shapes]
        shape = np.array([ids.index(name) for name, *_ in places])
        prim = np.array([place[1] for place in places])
        uv = np.array([place[2] for place in places], np.float32)
        side = np.array([place[3] for place in places], np.uint8)
        position, normal, _ = surface_frame(self.table, shape, prim, uv, side)
        self.elements: Any = SimpleNamespace(shape=shape, prim_local=prim, uv=uv, normal=normal, position=position)
        self.count = len(places)

    def batch(self, repeats: int, seed: int) -> Batch:
        place = np.tile(np.arange(repeats, dtype=np.uint64), self.count)
        return Batch(np.repeat(np.arange(self.count), repeats), np.full(len(place), seed, np.uint64), place)

    def diffuse(self, max_depth: int, repeats: int = 32, spp: int = 64) -> tuple[np.ndarray, np.ndarray]:
        """(mean, standard error) of D at every place, float64 [places, 3]."""
        value, _ = bake_diffuse(self.scene, self.table, self.elements, self.batch(repeats, 11), spp, 0, max_depth)
        return moments(value.reshape(self.count, repeats, 3))

    def directional(
        self,
        max_depth: int,
        *,
        exitant: bool,
        repeats: int = 32,
        spp: int = 16,
        grid: tuple[int, int] = (2, 2),
    ) -> tuple[np.ndarray, np.ndarray]:
        """(mean, standard error) of every direction, float64 [places, polar * azimuth, 3]."""
        value = bake_directional(
            self.scene, self.table, self.elements, self.batch(repeats, 12), grid, spp, 0, max_depth, exitant
        )
        return moments(value.reshape(self.count, repeats, -1, 3))


def moments(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values = values.astype(np.float64)
    return values.mean(1), values.std(1, ddof=1) / np.sqrt(values.shape[1])


def check(estimate: tuple[np.ndarray, np.ndarray], expected: Any, *, max_error: float = 0.02) -> None:
    """z-test; `max_error` keeps it honest: the standard error must be that small a share of the value."""
    mean, error = estimate
    expected = np.broadcast_to(expected, mean.shape)
    # Rounding of 1e-5 stands beside the noise, which may be nil.
    assert np.all(error <= max_error * np.maximum(expected, 1e-3))
    z = (mean - expected) / np.hypot(error, 1e-5 * np.maximum(expected, 1e-3))
    assert np.abs(z).max() < MAX_Z, f"{mean} against {expected}, standard error {error}"


def enclosure(rho: float, radiance: float) -> Probe:
    """A closed room whose every wall emits `radiance` and reflects `rho`."""
    wall = {"type": "diffuse", "reflectance": grey(rho)}
    glow = {"type": "area", "radiance": grey(radiance)}
    cube = {"type": "cube", "flip_normals": True, "bsdf": wall, "emitter": glow}
    return Probe({"cube": cube}, [("cube", 0, (0.3, 0.3), 0), ("cube", 7, (0.1, 0.8), 0)])


def series(rho: float, radiance: float, terms: int) -> float:
    return radiance / (1 - rho) if terms < 0 else radiance * (1 - rho**terms) / (1 - rho)


@pytest.fixture(scope="module")
def room() -> Probe:
    return enclosure(0.6, 0.5)


@pytest.mark.parametrize("max_depth", [2, 3, 7, -1])
def test_closed_room_has_its_series(room: Probe, max_depth: int) -> None:
    """L = Le (1 - rho^n) / (1 - rho) for n segments; D sees one segment fewer. Roulette starts inside."""
    incident = series(0.6, 0.5, max_depth if max_depth < 0 else max_depth - 1)
    check(room.diffuse(max_depth), incident)


def test_closed_room_leaves_with_its_series(room: Probe) -> None:
    check(room.directional(3, exitant=True), series(0.6, 0.5, 3))


def test_bright_room_converges_despite_long_paths() -> None:
    check(enclosure(0.9, 0.1).diffuse(-1, repeats=64), 1.0, max_error=0.03)


def test_white_furnace_leaves_only_the_reflectance() -> None:
    """Convex bodies in light of 1 from everywhere: D is 1, the exitant radiance the albedo; glass shows 1."""
    ball = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": COLOUR}}
    glass = {"type": "sphere", "center": [9, 0, 0], "bsdf": {"type": "dielectric"}}
    probe = Probe(
        {"light": {"type": "constant"}, "ball": ball, "glass": glass},
        [("ball", 0, (0.2, 0.4), 0), ("ball", 0, (0.9, 0.7), 0), ("glass", 0, (0.2, 0.4), 0)],
    )
    check(probe.diffuse(-1), 1.0)
    expected = np.array([COLOUR["value"]] * 2 + [[1.0] * 3])[:, None]
    # A ray that enters the sphere gains nothing and loses nothing: eta^2 in, 1 / eta^2 out.
    check(probe.directional(-1, exitant=True, repeats=48), expected)


def test_point_and_directional_lights_have_no_noise() -> None:
    """E = I cos / d^2 and E = E0 cos; a plane does not see itself."""
    plane = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": COLOUR}}
    probe = Probe(
        {
            "plane": plane,
            "lamp": {"type": "point", "position": [0.5, 1.0, 2.0], "intensity": grey(4.0)},
            "sun": {"type": "directional", "direction": [0, -0.6, -0.8], "irradiance": grey(3.0)},
        },
        [("plane", 0, (0.25, 0.5), 0), ("plane", 1, (0.2, 0.2), 0), ("plane", 0, (0.25, 0.5), 1)],
    )  # fmt: skip
    to_lamp = np.array([0.5, 1.0, 2.0]) - probe.elements.position
    irradiance = 4.0 * to_lamp[:, 2] / np.linalg.norm(to_lamp, axis=1) ** 3 + 3.0 * 0.8
    irradiance[2] = 0.0  # the back
    # Two lights, one drawn at a time: the mean over them is noisy, each is exact.
    mean, error = probe.diffuse(-1)
    check((mean, error), irradiance[:, None] / np.pi)
    assert np.all(mean[2] == 0)


def test_disc_light_has_its_solid_angle() -> None:
    """E = pi L r^2 / (r^2 + h^2) on the axis of a disc; sampled by light and by cosine, weighted."""
    to = mi.ScalarTransform4f
    radius, height = 2.0, 1.5
    lamp = {
        "type": "disk",
        "to_world": to().translate([0, 0, height]) @ to().rotate([1, 0, 0], 180) @ to().scale(radius),
        "emitter": {"type": "area", "radiance": grey(5.0)},
    }
    floor = {"type": "disk", "bsdf": {"type": "diffuse", "reflectance": COLOUR}}
    probe = Probe({"lamp": lamp, "floor": floor}, [("floor", 0, (0.0, 0.0), 0)])
    expected = 5.0 * radius**2 / (radius**2 + height**2)
    check(probe.diffuse(2), expected)
    check(probe.directional(2, exitant=True, grid=(2, 1)), expected * np.array(COLOUR["value"]))


def test_power_heuristics_sum_to_one() -> None:
    a, b = mi.Float([0.0, 1.0, 0.5, 1e-12, 3.0]), mi.Float([2.0, 0.0, 0.25, 1e-12, 3e4])
    total = (power_heuristic(a, b) + power_heuristic(b, a)).numpy()
    np.testing.assert_allclose(total, 1, rtol=1e-5)
    assert np.isfinite(power_heuristic(mi.Float(0.0), mi.Float(0.0)).numpy()).all()
