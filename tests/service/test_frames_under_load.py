"""Frames when many ask: the bound and Retry-After, frames that are shared or remembered, clients that go away."""

import http.client
import json
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service import images
from service.app import create_app
from service.serving import bind, make_server

LIMIT = 3
PATH = "/v1/scenes/tabletop/frame"


def body(fov_deg: float = 45) -> dict[str, Any]:
    return {"camera": {"look_at": {"origin": [0, 1, 5], "target": [0, 1, 0]}}, "fov_deg": fov_deg, "width": 12,
            "height": 8}  # fmt: skip


Until = Callable[[Callable[[], bool]], None]


class Service:
    """The app behind a test client, whose requests run on threads while the render thread is held at the gate."""

    def __init__(self, client: TestClient, backend: Any, pool: ThreadPoolExecutor) -> None:
        self.client, self.backend, self._pool = client, backend, pool
        self.pictures = client.app.state.pictures  # type: ignore[attr-defined]

    def post(self, fov_deg: float = 45, accept: str = "image/png") -> Any:
        return self.client.post(PATH, json=body(fov_deg), headers={"Accept": accept})

    def begin(self, fov_deg: float = 45, accept: str = "image/png") -> "Future[Any]":
        return self._pool.submit(self.post, fov_deg, accept)

    def metric(self, name: str, **labels: str) -> float:
        value = self.pictures.metrics.registry.get_sample_value(name, labels)
        assert value is not None, f"no metric {name} {labels}"
        return value


@pytest.fixture
def service(backend: Any, until: Until) -> Iterator[Service]:
    app = create_app("unused", make_backend=lambda: backend, queue_limit=LIMIT)
    with TestClient(app, raise_server_exceptions=False) as client, ThreadPoolExecutor(16) as pool:
        until(lambda: client.get("/readyz").status_code == 200)
        yield Service(client, backend, pool)
        if backend.gate is not None:
            backend.gate.set()


def test_requests_beyond_the_bound_are_503_with_retry_after(service: Service, until: Until) -> None:
    service.backend.gate = threading.Event()
    waiting = [service.begin(30 + k) for k in range(LIMIT)]
    until(lambda: len(service.pictures) == LIMIT and service.backend.begun.is_set())
    refused = service.post(90)
    assert refused.status_code == 503 and refused.headers["content-type"] == "application/problem+json"
    assert "at most 3" in refused.json()["detail"]
    assert 1 <= int(refused.headers["retry-after"]) <= 120
    assert service.metric("lightwell_frames_rejected_total", reason="queue_full") == 1
    assert service.metric("lightwell_queue_depth") == LIMIT - 1
    service.backend.gate.set()
    assert [answer.result().status_code for answer in waiting] == [200] * LIMIT
    assert service.post(90).status_code == 200


def test_retry_after_follows_the_seconds_of_recent_frames(service: Service, until: Until) -> None:
    pictures = service.pictures
    pictures._frame_s = 20.0
    service.backend.gate = threading.Event()
    waiting = [service.begin(30 + k) for k in range(LIMIT)]
    until(lambda: len(pictures) == LIMIT)
    assert service.post(90).headers["retry-after"] == str(20 * LIMIT)
    service.backend.gate.set()
    assert [answer.result().status_code for answer in waiting] == [200] * LIMIT
    assert 0 < pictures._frame_s < 20.0


def test_the_same_frame_is_rendered_and_encoded_once(
    service: Service, monkeypatch: pytest.MonkeyPatch, until: Until
) -> None:
    encoded: list[str] = []
    encode = images.encode

    def counted(radiance: Any, exposure: float, media_type: str) -> bytes:
        encoded.append(media_type)
        return encode(radiance, exposure, media_type)

    monkeypatch.setattr(images, "encode", counted)
    service.backend.gate = threading.Event()
    asked = [service.begin(accept=accept) for accept in ["image/png"] * 6 + ["image/jpeg"] * 4]
    until(lambda: _num_waiting(service.pictures) == 10)
    service.backend.gate.set()
    answers = [answer.result() for answer in asked]
    assert {answer.status_code for answer in answers} == {200}
    assert len(service.backend.cameras) == 1 and sorted(encoded) == ["image/jpeg", "image/png"]
    assert len({answer.content for answer in answers}) == 2
    assert sorted(answer.headers["x-lightwell-source"] for answer in answers) == ["rendered"] * 2 + ["shared"] * 8
    assert service.metric("lightwell_frames_total", source="shared") == 8
    assert service.metric("lightwell_renders_total") == 1


def _num_waiting(pictures: Any) -> int:
    return sum(flight.num_waiting for flight in pictures._pictures._flights.values())


def test_a_recent_frame_is_sent_again_and_bears_the_same_tag(service: Service) -> None:
    first, again, other = service.post(), service.post(), service.post(accept="image/jpeg")
    assert again.headers["x-lightwell-source"] == "recent" and "server-timing" not in again.headers
    assert first.content == again.content and first.headers["etag"] == again.headers["etag"]
    assert first.headers["etag"].startswith('W/"') and other.headers["etag"] != first.headers["etag"]
    assert len(service.backend.cameras) == 2


def test_remembered_frames_stay_within_their_bytes(backend: Any) -> None:
    app = create_app("unused", make_backend=lambda: backend, recent_nbytes=5000)
    with TestClient(app) as client:
        for fov_deg in (30, 40, 50, 30):
            client.post(PATH, json=body(fov_deg))
        recent = app.state.pictures._recent
        assert 0 < recent.currsize <= 5000 and len(recent) == 2
    assert len(backend.cameras) == 4  # the first was forgotten


def test_a_frame_of_a_new_network_is_rendered_anew(service: Service) -> None:
    first = service.post()
    scenes = service.backend.scenes()
    service.backend.scenes = lambda: [entry | {"network": "n2"} for entry in scenes]
    service.pictures.rendering.catalogue._fresh_s = 0.0
    second = service.post()
    assert second.headers["x-lightwell-source"] == "rendered"
    assert second.headers["etag"] != first.headers["etag"]
    assert service.backend.opened == ["d1", "d1"]


def test_a_frame_that_is_not_finite_is_refused_counted_and_not_kept(service: Service) -> None:
    service.backend.non_finite = 7
    for _ in range(2):
        answer = service.post()
        assert answer.status_code == 500 and answer.json()["non_finite"] == 7
        assert "got 7 of 288 values" in answer.json()["detail"]
    assert service.metric("lightwell_non_finite_values_total") == 14
    assert service.metric("lightwell_non_finite_frames_total") == 2
    service.backend.non_finite = 0
    assert service.post().status_code == 200


def test_a_scene_beyond_the_memory_is_507(backend: Any) -> None:
    with TestClient(create_app("unused", make_backend=lambda: backend, memory_nbytes=999)) as client:
        answer = client.post(PATH, json=body())
    assert answer.status_code == 507 and "raise the memory limit" in answer.json()["detail"]


@pytest.fixture
def port(backend: Any, until: Until) -> Iterator[int]:
    """A real server: only that has connections that can be closed."""
    app = create_app("unused", make_backend=lambda: backend, queue_limit=LIMIT)
    with bind("127.0.0.1", 0) as listener:
        server = make_server(app, log_level="error")
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        until(lambda: server.started)
        backend.app = app
        yield listener.getsockname()[1]
        server.should_exit = True
        thread.join(10)
        assert not thread.is_alive()


Ask = Callable[[float], http.client.HTTPConnection]


@pytest.fixture
def ask(port: int) -> Iterator[Ask]:
    """Sends a request on a connection of its own, which is closed at the end."""
    connections = []

    def send(fov_deg: float) -> http.client.HTTPConnection:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connections.append(connection)
        connection.request("POST", PATH, json.dumps(body(fov_deg)), {"Content-Type": "application/json"})
        return connection

    yield send
    for connection in connections:
        connection.close()


def status(connection: http.client.HTTPConnection) -> int:
    with connection.getresponse() as answer:
        answer.read()
        return answer.status


def test_a_client_that_went_away_is_not_rendered_for(ask: Ask, backend: Any, until: Until) -> None:
    pictures = backend.app.state.pictures
    backend.gate = threading.Event()
    first = ask(30)
    assert backend.begun.wait(10)
    gone = [ask(40), ask(50)]
    until(lambda: len(pictures) == 3)
    for connection in gone:
        connection.close()
    until(lambda: len(pictures) == 1)  # their places are free before anything was rendered for them
    stays = ask(60)
    until(lambda: len(pictures) == 2)
    backend.gate.set()
    assert [status(first), status(stays)] == [200, 200]
    assert [camera.fov_deg for camera in backend.cameras] == [30, 60]
    assert pictures.metrics.registry.get_sample_value("lightwell_frames_abandoned_total") == 2


def test_one_of_two_clients_that_share_a_frame_may_leave(ask: Ask, backend: Any, until: Until) -> None:
    pictures = backend.app.state.pictures
    backend.gate = threading.Event()
    blocks = ask(30)
    assert backend.begun.wait(10)
    stays, leaves = ask(40), ask(40)
    until(lambda: _num_waiting(pictures) == 3)
    leaves.close()
    until(lambda: _num_waiting(pictures) == 2)
    backend.gate.set()
    assert [status(blocks), status(stays)] == [200, 200]
    assert [camera.fov_deg for camera in backend.cameras] == [30, 40]
