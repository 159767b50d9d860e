"""Open scenes: the budget in bytes, the order of closing, failures that are not tried again at once."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import SceneTooLargeError
from service.scene_cache import OpenScenes, SceneKey
from storage.errors import DamagedUnitError


class Loader:
    """Opens scenes of given sizes; notes what was open at each moment."""

    def __init__(self, sizes: dict[str, int]) -> None:
        self.sizes = sizes
        self.opened: list[str] = []
        self.trims = 0
        self.failure: Exception | None = None

    def open(self, digest: str) -> Any:
        self.opened.append(digest)
        if self.failure is not None:
            raise self.failure
        return type("Scene", (), {"nbytes": self.sizes[digest], "digest": digest})()

    def trim(self) -> None:
        self.trims += 1


def key(digest: str, network: str = "n") -> SceneKey:
    return SceneKey(digest, network)


def make(sizes: dict[str, int], budget_nbytes: int) -> tuple[OpenScenes, Loader]:
    loader = Loader(sizes)
    return OpenScenes(loader.open, budget_nbytes=budget_nbytes, trim=loader.trim), loader


def test_an_open_scene_is_not_opened_again() -> None:
    scenes, loader = make({"a": 10}, 100)
    assert scenes.get(key("a")) is scenes.get(key("a"))
    assert loader.opened == ["a"] and scenes.nbytes == 10 and scenes.num_opened == 1


def test_the_scene_used_longest_ago_is_closed_when_bytes_are_short() -> None:
    scenes, loader = make({"a": 40, "b": 40, "c": 40}, 100)
    for digest in "abacab":
        scenes.get(key(digest))
    assert loader.opened == ["a", "b", "c", "b"]  # c closes b, the second b closes c
    assert scenes.nbytes == 80 and scenes.num_closed == 2 and loader.trims == 2


def test_a_large_scene_closes_as_many_as_it_needs() -> None:
    scenes, _ = make({"a": 30, "b": 30, "c": 30, "d": 70}, 100)
    for digest in "abcd":
        scenes.get(key(digest))
    assert scenes.nbytes == 100 and len(scenes) == 2  # c and d
    assert scenes.num_closed == 2


def test_room_is_made_before_a_scene_of_known_size_is_opened() -> None:
    scenes, loader = make({"a": 60, "b": 60}, 100)
    held: list[int] = []
    original = loader.open
    scenes._open_scene = lambda digest: held.append(scenes.nbytes) or original(digest)
    for digest in "aba":
        scenes.get(key(digest))
    assert held == [0, 60, 0]


def test_a_scene_larger_than_the_budget_is_refused_and_not_loaded_twice() -> None:
    scenes, loader = make({"a": 50, "big": 101}, 100)
    scenes.get(key("a"))
    for _ in range(2):
        with pytest.raises(SceneTooLargeError, match=r"got big of 101 B; raise the memory limit"):
            scenes.get(key("big"))
    assert loader.opened == ["a", "big"] and scenes.nbytes == 50


def test_another_network_replaces_the_open_one() -> None:
    scenes, loader = make({"a": 10, "b": 10}, 100)
    old = scenes.get(key("a", "n1"))
    scenes.get(key("b"))
    assert scenes.get(key("a", "n2")) is not old
    assert loader.opened == ["a", "b", "a"] and len(scenes) == 2


def test_a_scene_that_cannot_be_opened_is_not_tried_again_at_once() -> None:
    scenes, loader = make({"a": 10}, 100)
    clock = 0.0
    scenes._failures = type(scenes._failures)(10, 5.0, timer=lambda: clock)
    loader.failure = DamagedUnitError("unit x must match its marker")
    for _ in range(3):
        with pytest.raises(DamagedUnitError, match="unit x"):
            scenes.get(key("a"))
    assert loader.opened == ["a"]
    loader.failure, clock = None, 6.0
    assert scenes.get(key("a")).nbytes == 10


class Growing:
    """A scene whose operating points take memory as they are opened."""

    def __init__(self, own: int) -> None:
        self.own, self.points = own, 0

    @property
    def nbytes(self) -> int:
        return self.own + self.points

    def fit(self, nbytes: int) -> None:
        self.points = max(0, min(self.points, nbytes - self.own))


def growing(budget_nbytes: int, **own: int) -> tuple[OpenScenes, dict[str, Growing], list[int]]:
    made = {digest: Growing(nbytes) for digest, nbytes in own.items()}
    trims: list[int] = []
    load: Any = made.__getitem__
    return OpenScenes(load, budget_nbytes=budget_nbytes, trim=lambda: trims.append(1)), made, trims


def test_a_scene_that_grew_is_counted_anew_and_closes_others() -> None:
    scenes, made, trims = growing(100, a=40, b=40)
    scenes.get(key("a"))
    scenes.get(key("b"))
    made["b"].points = 15
    scenes.restate(key("b"))
    assert scenes.nbytes == 95 and len(scenes) == 2 and scenes.num_closed == 0
    made["b"].points = 50
    scenes.restate(key("b"))
    assert scenes.nbytes == 90 and len(scenes) == 1 and scenes.num_closed == 1 and trims
    assert scenes.get(key("b")) is made["b"]


def test_a_scene_that_outgrows_the_budget_gives_its_points_back() -> None:
    scenes, made, trims = growing(100, a=40, b=40)
    scenes.get(key("a"))
    scenes.get(key("b"))
    made["b"].points = 500
    scenes.restate(key("b"))
    assert made["b"].nbytes == 100 == scenes.nbytes and len(scenes) == 1 and trims


def test_a_scene_that_cannot_shrink_is_closed() -> None:
    scenes, made, _ = growing(100, a=40)
    scenes.get(key("a"))
    made["a"].own = 101
    scenes.restate(key("a"))
    assert len(scenes) == 0 and scenes.nbytes == 0 and scenes.num_closed == 1


def test_a_scene_that_is_not_open_is_not_counted() -> None:
    scenes, _, _ = growing(100, a=40)
    scenes.restate(key("a"))
    assert len(scenes) == 0


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 300)), max_size=30))
def test_open_scenes_never_exceed_the_budget(uses: list[tuple[str, int]]) -> None:
    scenes, made, _ = growing(100, a=30, b=60, c=100)
    for digest, points in uses:
        scenes.get(key(digest))
        made[digest].points = points
        scenes.restate(key(digest))
        held = sum(made[name].nbytes for name in "abc" if key(name) in scenes._open)
        assert scenes.nbytes == held <= 100
        for name in "abc":
            if key(name) not in scenes._open:
                made[name].points = 0
