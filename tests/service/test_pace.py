"""The slowdown that a server learns from its own frames, and what it does to the choice."""

from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.pace import FEWEST_FRAMES, KEPT_FRAMES, KEPT_S, Pace
from tests.service.test_frames_by_point import BODY, point
from workers.operating_points import FrameDemand, choose


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_slowdown_covers_nine_of_ten_frames() -> None:
    pace = Pace()
    for index in range(20):
        pace.note("a", 3.0 if index % 5 == 0 else 2.0)
    assert pace.slowdown("a") == 3.0
    assert pace.slowdown("b") == 1.0


def test_few_frames_and_fast_ones_tell_nothing() -> None:
    pace = Pace()
    for _ in range(FEWEST_FRAMES - 1):
        pace.note("a", 9.0)
    assert pace.slowdown("a") == 1.0
    for _ in range(KEPT_FRAMES):
        pace.note("a", 0.2)
    assert pace.slowdown("a") == 1.0


def test_old_frames_are_forgotten() -> None:
    clock = Clock()
    pace = Pace(clock)
    for _ in range(KEPT_FRAMES):
        pace.note("a", 5.0)
    clock.now_s += KEPT_S - 1
    assert pace.slowdown("a") == 5.0
    clock.now_s += 2
    assert pace.slowdown("a") == 1.0


@pytest.mark.parametrize("ratio", [0.0, -1.0, float("nan"), float("inf")])
def test_what_is_no_ratio_is_left_out(ratio: float) -> None:
    pace = Pace()
    for _ in range(KEPT_FRAMES):
        pace.note("a", ratio)
    assert pace.slowdown("a") == 1.0


POINTS = (point("fast", 25.0, 1.0), point("fine", 32.0, 5.0))  # the fake's frames take 5.5 ms


@pytest.fixture
def client(backend: Any) -> Iterator[TestClient]:
    render, slowdowns = backend.render, []

    def choose_among(digest: str, demand: Any, width: int, height: int, slowdown: float = 1.0) -> Any:
        slowdowns.append(slowdown)
        return choose(POINTS, FrameDemand(max_ms=demand.max_ms), width, height, slowdown).point

    backend.choose, backend.render, backend.slowdowns = (
        choose_among,
        lambda camera, point=None: render(camera),
        slowdowns,
    )
    with TestClient(create_app("unused", make_backend=lambda: backend), raise_server_exceptions=False) as client:
        yield client


def test_server_chooses_by_the_pace_of_its_frames(client: TestClient, backend: Any) -> None:
    answers = [
        client.post("/v1/scenes/tabletop/frame", json=BODY | {"fov_deg": 30 + index, "max_ms": 5.2})
        for index in range(FEWEST_FRAMES + 1)
    ]
    names = [answer.headers["X-Lightwell-Point"] for answer in answers]
    assert names == ["fine"] * FEWEST_FRAMES + ["fast"]  # 1.1 times 5 ms is too much
    assert backend.slowdowns[0] == 1.0
    assert backend.slowdowns[-1] == pytest.approx(1.1)
