"""Parts of operating points: opened once, counted, dropped by use; frames that had to prepare say so."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import workers.point_parts as point_parts
import workers.point_renderer as point_renderer
from tests.workers.test_operating_points import point
from workers.camera import Camera
from workers.operating_points import OperatingPoint
from workers.operating_table import OperatingTable
from workers.point_parts import PointParts, arrays_nbytes, imperfect_radiance
from workers.point_renderer import PointRenderer
from workers.query import CHANNELS, NUM_CHANNELS, CacheArrays
from workers.settings import Settings

PROGRAM_NBYTES, NETWORK_NBYTES = 1000, 100
CACHES = CacheArrays(np.zeros((10, 3), np.float32), np.zeros((0, 1, 1, 3), np.float32))  # 120 bytes


@dataclass
class FakeProgram:
    """Records a program a size, keeps two of them."""

    overrides: dict[str, Any]
    num_recordings: int = 0
    kept: list[tuple[int, int]] = field(default_factory=list)
    runs: int = 0

    def run(self, camera: Camera) -> np.ndarray:
        self.runs += 1
        size = (camera.width, camera.height)
        if size in self.kept:
            self.kept.remove(size)
        else:
            self.num_recordings += 1
        self.kept = [*self.kept, size][-2:]
        return np.ones((camera.height, camera.width, NUM_CHANNELS), np.float32)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was opened, in order; nothing touches a store."""
    log: list[str] = []

    def make_program(scene: Any, table: Any, elements: Any, caches: Any, settings: Any) -> FakeProgram:
        log.append(f"program {settings.samples}")
        return FakeProgram(vars(settings))

    def load_caches(run: Any, elements: Any) -> CacheArrays:
        log.append("caches")
        return CACHES

    monkeypatch.setattr(point_parts, "derived_run", lambda run, settings: SimpleNamespace(
        settings=settings, scene=SimpleNamespace(mi_scene=None), table=None))  # fmt: skip
    monkeypatch.setattr(point_parts, "elements_ref", lambda run: ("elements", run.settings.cache.max_elements))
    monkeypatch.setattr(point_parts, "run_elements", lambda run: CACHES)
    monkeypatch.setattr(point_parts, "bake_refs", lambda run, elements: {
        "diffuse": SimpleNamespace(key=str(run.settings.cache.max_elements))})  # fmt: skip
    monkeypatch.setattr(point_parts, "load_caches", load_caches)
    monkeypatch.setattr(point_parts, "QueryProgram", make_program)
    monkeypatch.setattr(point_parts, "program_nbytes", lambda program: PROGRAM_NBYTES)
    monkeypatch.setattr(point_parts, "load_network", lambda run, ref: (log.append(f"network {ref.key}"), None))
    monkeypatch.setattr(point_parts, "Reconstructor", lambda *_, **__: imperfect_radiance)
    monkeypatch.setattr(point_parts, "network_nbytes", lambda reconstructor: NETWORK_NBYTES)
    return log


@pytest.fixture
def parts(opened: list[str]) -> PointParts:
    run: Any = SimpleNamespace(settings=Settings(), scene=SimpleNamespace(digest="d1"))
    return PointParts(run)


FINE = point("fine", 30.0, 10.0, overrides={}, network="n1")
COARSE = point("coarse", 28.0, 5.0, overrides={"query.samples": 1}, network="n1")


def test_points_share_what_they_have_in_common(parts: PointParts, opened: list[str]) -> None:
    for each in (FINE, COARSE, FINE):
        parts.open(each)
    assert opened == ["caches", "program 2", "network n1", "program 1"]
    assert parts.nbytes == 2 * CACHES.diffuse.nbytes + 2 * PROGRAM_NBYTES + NETWORK_NBYTES


def test_parts_used_longest_ago_go_first_and_come_back(parts: PointParts, opened: list[str]) -> None:
    parts.open(FINE)
    parts.open(COARSE)
    parts.fit(PROGRAM_NBYTES + NETWORK_NBYTES)
    assert parts.nbytes <= PROGRAM_NBYTES + NETWORK_NBYTES
    opened.clear()
    parts.open(COARSE)
    assert opened == []
    parts.open(FINE)
    assert opened == ["caches", "program 2"]
    parts.fit(0)
    assert parts.nbytes == 0


def test_a_point_without_a_network_shows_the_caches(parts: PointParts) -> None:
    reconstruct = parts.reconstruct(None, "fp32", 1)
    features = np.arange(NUM_CHANNELS, dtype=np.float32).reshape(1, 1, -1)
    assert reconstruct(features).tolist() == [[list(range(*CHANNELS["ir"]))]]


def test_arrays_of_nested_dataclasses_are_counted() -> None:
    @dataclass
    class Outer:
        inner: CacheArrays
        flags: np.ndarray
        number: float = 1.0

    assert arrays_nbytes(Outer(CACHES, np.zeros(5, np.uint8))) == 125


# ------------------------------------------------- the renderer -------------------------------------------------


@pytest.fixture
def renderer(opened: list[str], monkeypatch: pytest.MonkeyPatch) -> PointRenderer:
    table = OperatingTable(base=Settings().to_json(), points=(FINE, COARSE), result={})
    monkeypatch.setattr(point_renderer, "load_table", lambda store, digest: table)
    monkeypatch.setattr(point_renderer, "derived_run", lambda run, settings: SimpleNamespace(
        settings=settings, scene=run.scene))  # fmt: skip
    run: Any = SimpleNamespace(store=None, scene=SimpleNamespace(digest="d1"))
    reconstructor: Any = SimpleNamespace(encoding=SimpleNamespace(exposure=1.0))
    made = PointRenderer(FakeProgram({}), reconstructor, run)  # type: ignore[arg-type]
    made.__dict__["run_nbytes"] = 5000
    return made


def camera(edge: int) -> Camera:
    return Camera.look_at([0, 0, 5], [0, 0, 0], [0, 1, 0], 45.0, edge, edge)


def steps(renderer: PointRenderer, edge: int, asked: OperatingPoint) -> set[str]:
    return set(renderer.render(camera(edge), asked).seconds)


def test_first_frame_of_a_point_and_of_a_size_is_made_twice_and_says_so(renderer: PointRenderer) -> None:
    plain, first = {"query", "network"}, {"prepare", "query", "network"}
    assert [steps(renderer, 8, FINE), steps(renderer, 8, FINE)] == [first, plain]
    assert [steps(renderer, 9, FINE), steps(renderer, 9, FINE), steps(renderer, 8, FINE)] == [first, plain, plain]
    assert [steps(renderer, 8, COARSE), steps(renderer, 8, COARSE)] == [first, plain]


def test_a_size_whose_program_was_forgotten_prepares_again(renderer: PointRenderer) -> None:
    for edge in (8, 9, 10):  # the fake keeps two
        steps(renderer, edge, FINE)
    assert "prepare" in steps(renderer, 8, FINE)
    assert "prepare" not in steps(renderer, 8, FINE)


def test_memory_grows_with_points_and_shrinks_on_demand(renderer: PointRenderer) -> None:
    assert renderer.nbytes == 5000
    renderer.render(camera(8), FINE)
    one = renderer.nbytes
    assert one == 5000 + 2 * CACHES.diffuse.nbytes + PROGRAM_NBYTES + NETWORK_NBYTES
    renderer.render(camera(8), COARSE)
    assert renderer.nbytes == one + PROGRAM_NBYTES
    renderer.fit(one)
    assert renderer.nbytes <= one
    renderer.fit(0)
    assert renderer.nbytes == 5000  # the published run stays
    assert "prepare" in steps(renderer, 8, FINE)  # what came back has met nothing


def test_point_that_was_measured_anew_is_refused(renderer: PointRenderer) -> None:
    with pytest.raises(point_renderer.OperatingPointError, match="choose again"):
        renderer.render(camera(8), replace(FINE, psnr=1.0))
