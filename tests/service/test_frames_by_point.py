"""Frames asked for by quality, time or PSNR over HTTP: the point that answers is named, and decides the picture."""

from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.frame_choice import Demand
from workers.operating_points import FrameDemand, FrameTime, OperatingPoint, choose

LOOK_AT = {"origin": [0, 1, 5], "target": [0, 1, 0], "up": [0, 1, 0]}
BODY: dict[str, Any] = {"camera": {"look_at": LOOK_AT}, "fov_deg": 45, "width": 10, "height": 10}


def point(name: str, psnr: float, ms: float) -> OperatingPoint:
    return OperatingPoint(
        name=name, overrides={"query.samples": 1, "train.widths": [16, 16, 16]}, network=name, precision="fp32",
        scale=1, psnr=psnr, flip=None, temporal=None, times=(FrameTime(width=10, height=10, ms=ms),),
        bake_seconds=1.0, nbytes=10,
    )  # fmt: skip


@pytest.fixture
def client(backend: Any) -> Iterator[TestClient]:
    points = (point("fast", 25.0, 5.0), point("fine", 32.0, 50.0))
    rendered: list[Any] = []
    render = backend.render

    def choose_among(digest: str, demand: Demand, width: int, height: int, slowdown: float = 1.0) -> OperatingPoint:
        wanted: dict[str, Any] = vars(demand)
        return choose(points, FrameDemand(**wanted), width, height, slowdown).point

    def render_point(camera: Any, point: OperatingPoint | None = None) -> Any:
        rendered.append(point and point.name)
        return render(camera)

    backend.choose, backend.render, backend.points = choose_among, render_point, rendered
    app = create_app("unused", make_backend=lambda: backend)
    with TestClient(app, raise_server_exceptions=False) as client:
        yield client


def post(client: TestClient, **values: Any) -> Any:
    return client.post("/v1/scenes/tabletop/frame", json={**BODY, **values})


def test_frame_names_the_point_that_made_it(client: TestClient, backend: Any) -> None:
    for demand, name in (({"quality": "draft"}, "fast"), ({"max_ms": 60}, "fine"), ({"min_psnr": 30}, "fine")):
        response = post(client, **demand)
        assert response.status_code == 200, response.text
        assert response.headers["X-Lightwell-Point"] == name
    assert response.headers["X-Lightwell-Point-PSNR"] == "32.00"
    assert response.headers["X-Lightwell-Point-Ms"] == "50.00"
    assert backend.points == ["fast", "fine"]  # the third was remembered


def test_frame_without_a_demand_is_the_published_run_and_another_picture(client: TestClient, backend: Any) -> None:
    plain, fine = post(client), post(client, quality="best")
    assert "X-Lightwell-Point" not in plain.headers
    assert plain.headers["ETag"] != fine.headers["ETag"]
    assert backend.points == [None, "fine"]


def test_demand_that_no_point_meets_is_422_with_the_nearest(client: TestClient) -> None:
    response = post(client, max_ms=10, min_psnr=30)
    assert response.status_code == 422
    document = response.json()
    assert document["reachable"]["best"]["point"] == "fast"
    assert document["reachable"]["fastest"]["point"] == "fine"
    assert "within 10 ms with at least 30 dB" in document["detail"]


@pytest.mark.parametrize("demand", [{"quality": "great"}, {"max_ms": 0}, {"max_ms": "soon"}, {"min_psnr": "NaN"}])
def test_demand_that_is_none_is_422(client: TestClient, demand: dict[str, Any]) -> None:
    response = post(client, **demand)
    assert response.status_code == 422 and "errors" in response.json()


def test_tradeoff_of_the_app_answers_a_problem_where_there_is_no_store(client: TestClient) -> None:
    response = client.get("/v1/scenes/nowhere/tradeoff")
    assert response.status_code == 404
    assert response.headers["content-type"] == "application/problem+json"
