"""The HTTP service with a stand-in renderer: formats, headers, problem documents, one render thread."""

import io
import json
import re
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image

from service.app import create_app
from service.routes_frames import server_timing
from storage.errors import DamagedUnitError, StorageError, StoreUnreachableError
from storage.frames import decode_frame

LOOK_AT = {"origin": [0, 1, 5], "target": [0, 1, 0], "up": [0, 1, 0]}
BODY: dict[str, Any] = {"camera": {"look_at": LOOK_AT}, "fov_deg": 45, "width": 12, "height": 8}


@pytest.fixture
def client(backend: Any) -> Iterator[TestClient]:
    app = create_app("unused", make_backend=lambda: backend, max_pixels=10_000)
    with TestClient(app, raise_server_exceptions=False) as client:
        yield client


def post(client: TestClient, scene: str = "tabletop", accept: str = "*/*", **values: Any) -> Any:
    return client.post(f"/v1/scenes/{scene}/frame", json={**BODY, **values}, headers={"Accept": accept})


def assert_problem(response: Any, status: int, words: str) -> None:
    assert response.status_code == status
    assert response.headers["content-type"] == "application/problem+json"
    document = response.json()
    assert document["status"] == status and document["title"]
    assert re.search(words, document["detail"]), document["detail"]


@pytest.mark.parametrize(("accept", "kind"), [("*/*", "PNG"), ("image/png", "PNG"), ("image/jpeg", "JPEG")])
def test_frame_is_the_picture_that_accept_asks_for(client: TestClient, accept: str, kind: str) -> None:
    response = post(client, accept=accept)
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == f"image/{kind.lower()}"
    picture = Image.open(io.BytesIO(response.content))
    assert picture.format == kind and picture.size == (12, 8)
    assert abs(int(np.asarray(picture)[0, 0, 0]) - 137) <= 1  # sRGB of 0.25


def test_frame_as_exr_is_the_radiance(client: TestClient) -> None:
    response = post(client, accept="image/x-exr")
    radiance = decode_frame(response.content)["radiance"]
    assert radiance.shape == (8, 12, 3) and (radiance == np.float32(0.25)).all()


def test_frame_tells_its_times_and_coverage(client: TestClient) -> None:
    headers = post(client).headers
    timing = dict(re.findall(r"(\w+);dur=([0-9.]+)", headers["server-timing"]))
    assert list(timing) == ["queue", "open", "query", "network", "encode"]
    assert (timing["query"], timing["network"]) == ("4.00", "1.50") and float(timing["encode"]) > 0
    assert headers["x-lightwell-coverage"] == "0.9753"
    assert headers["x-lightwell-non-finite"] == "0"
    assert headers["vary"] == "Accept"


def test_server_timing_is_in_milliseconds() -> None:
    assert server_timing({"query": 0.0125, "network": 2.0}) == "query;dur=12.50, network;dur=2000.00"


def test_the_camera_of_the_request_is_rendered(client: TestClient, backend: Any) -> None:
    matrix = [[-1, 0, 0, 0], [0, 1, 0, 1], [0, 0, -1, 5], [0, 0, 0, 1]]
    assert post(client, fov_deg=33).status_code == 200
    assert post(client, camera={"to_world": matrix}, fov_deg=33, accept="image/jpeg").status_code == 200
    first, second = backend.cameras
    assert first == second and first.fov_deg == 33.0
    assert np.allclose(first.to_world, matrix)


def test_scenes_lists_what_can_be_served(client: TestClient, backend: Any) -> None:
    response = client.get("/v1/scenes")
    assert response.json() == {"scenes": backend.scenes()}


def test_healthz(client: TestClient) -> None:
    assert client.get("/healthz").json() == {"status": "ok"}


def test_unknown_scene_is_404_and_names_those_there_are(client: TestClient, backend: Any) -> None:
    assert_problem(post(client, scene="attic"), 404, r"\(hall, tabletop\), got 'attic'")
    assert backend.opened == []


def test_shared_name_is_409_and_a_digest_resolves_it(client: TestClient, backend: Any) -> None:
    assert_problem(post(client, scene="hall"), 409, "d2, d3")
    assert post(client, scene="d3").status_code == 200 and backend.opened == ["d3"]


def test_unacceptable_format_is_406_before_anything_is_rendered(client: TestClient, backend: Any) -> None:
    assert_problem(post(client, accept="image/webp"), 406, "image/png, image/jpeg, image/x-exr")
    assert backend.cameras == []


def test_too_many_pixels_are_413(client: TestClient) -> None:
    assert_problem(post(client, width=101, height=100), 413, "at most 10000 pixels, got 101x100")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"camera": {}}, "camera: .*exactly one of look_at and to_world"),
        ({"camera": {"look_at": {**LOOK_AT, "target": [0, 1, 5]}}}, "target must differ from its origin"),
        ({"camera": {"to_world": np.diag([2.0, 2, 2, 1]).tolist()}}, "orthonormal"),
        ({"fov_deg": 200}, "fov_deg: .*less than 180"),
        ({"width": 0}, "width: "),
        ({"height": 20000}, "height: "),
        ({"colour": "red"}, "colour: "),
    ],
)
def test_bad_cameras_are_422_and_say_where(client: TestClient, values: dict, words: str) -> None:
    assert_problem(post(client, **values), 422, words)


@pytest.mark.parametrize("body", ['{"camera"', "[]", "null", json.dumps({**BODY, "fov_deg": float("nan")})])
def test_bodies_that_are_no_request_are_422(client: TestClient, body: str) -> None:
    headers = {"Content-Type": "application/json"}
    assert_problem(client.post("/v1/scenes/tabletop/frame", content=body, headers=headers), 422, ".")


def test_unknown_paths_and_methods_are_problems_too(client: TestClient) -> None:
    assert_problem(client.get("/v2"), 404, "Not Found")
    response = client.get("/v1/scenes/tabletop/frame")
    assert_problem(response, 405, "Method Not Allowed")
    assert response.headers["allow"] == "POST"


@pytest.mark.parametrize(
    ("failure", "status", "words"),
    [
        (DamagedUnitError("unit x must match\nits marker"), 500, "unit x must match its marker"),
        (StorageError("gone"), 500, "gone"),
        (StoreUnreachableError("store s3://b must answer"), 503, "must answer"),
        (MemoryError(), 503, "not enough memory"),
        (ZeroDivisionError("secret detail"), 500, r"failed on this request \(ZeroDivisionError\)"),
    ],
)
def test_failures_while_rendering_are_problems(
    client: TestClient, backend: Any, failure: Exception, status: int, words: str
) -> None:
    backend.failure = failure
    response = post(client)
    assert_problem(response, status, words)
    assert "secret" not in response.text
    backend.failure = None
    assert post(client).status_code == 200


def test_all_rendering_happens_on_one_thread_one_frame_at_a_time(client: TestClient, backend: Any) -> None:
    backend.seconds_a_frame = 0.02
    with ThreadPoolExecutor(8) as pool:
        responses = list(pool.map(lambda k: post(client, fov_deg=30 + k), range(8)))
    assert [response.status_code for response in responses] == [200] * 8
    assert len(backend.cameras) == 8 and backend.most_busy == 1
    assert len(backend.threads) == 1 and threading.get_ident() not in backend.threads
    assert backend.opened == ["d1"]


def test_a_store_that_cannot_be_opened_stops_the_start() -> None:
    def make_backend() -> Any:
        raise StorageError("no store there")

    with (
        pytest.raises(StorageError, match="no store there"),
        TestClient(create_app("x", make_backend=make_backend)),
    ):
        pass


def test_openapi_documents_formats_and_problems(client: TestClient) -> None:
    operation = client.get("/openapi.json").json()["paths"]["/v1/scenes/{scene}/frame"]["post"]
    responses = operation["responses"]
    assert set(responses["200"]["content"]) == {"image/png", "image/jpeg", "image/x-exr"}
    for status in ("404", "406", "409", "413", "422", "500", "503", "507"):
        assert list(responses[status]["content"]) == ["application/problem+json"]
