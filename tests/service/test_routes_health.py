"""Readiness before, after and at the end of a service's work; metrics as Prometheus reads them."""

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from service.app import create_app
from service.metrics import job_metrics, make_registry
from service.routes_health import Phase, Readiness
from storage.errors import DamagedUnitError

Until = Callable[[Callable[[], bool]], None]
PATH = "/v1/scenes/tabletop/frame"
BODY = {"camera": {"look_at": {"origin": [0, 1, 5], "target": [0, 1, 0]}}, "width": 12, "height": 8}


def samples(text: str) -> dict[str, float]:
    """Every sample by its name and labels, such as 'lightwell_frames_total{source="recent"}'."""
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = ",".join(f'{name}="{value}"' for name, value in sorted(sample.labels.items()))
            found[sample.name + (f"{{{labels}}}" if labels else "")] = sample.value
    return found


def test_ready_only_after_the_warm_up(backend: Any, until: Until) -> None:
    gate = threading.Event()
    backend.warm_up = lambda: gate.wait(10)
    with TestClient(create_app("unused", make_backend=lambda: backend, preload=["tabletop"])) as client:
        early = client.get("/readyz")
        assert early.status_code == 503 and early.headers["retry-after"] == "1"
        assert early.json()["phase"] == "starting" and backend.opened == []
        assert client.get("/healthz").json() == {"status": "ok"}
        gate.set()
        until(lambda: client.get("/readyz").status_code == 200)
        assert client.get("/readyz").json() == {"status": "ready"}
        assert backend.opened == ["d1"]


@pytest.mark.parametrize(
    ("preload", "failure", "words"),
    [("attic", None, "got 'attic'"), ("tabletop", DamagedUnitError("unit x must match its marker"), "unit x")],
)
def test_a_scene_that_cannot_be_preloaded_is_named(
    backend: Any, until: Until, preload: str, failure: Exception | None, words: str
) -> None:
    def fail(digest: str) -> Any:
        assert failure is not None
        raise failure

    if failure is not None:
        backend.open = fail
    with TestClient(create_app("unused", make_backend=lambda: backend, preload=[preload])) as client:
        until(lambda: client.get("/readyz").json().get("phase") == "failed")
        assert words in client.get("/readyz").json()["detail"]


def test_frames_under_way_at_shutdown_are_finished_and_no_more_begun(backend: Any, until: Until) -> None:
    app = create_app("unused", make_backend=lambda: backend)
    backend.gate = threading.Event()

    async def scenario() -> tuple[int, int, str]:
        async with app.router.lifespan_context(app):
            answers = asyncio.ensure_future(_post(app, 30))
            while not backend.begun.is_set():
                await asyncio.sleep(0.005)
            leaving = asyncio.ensure_future(app.state.pictures.drain(10))
            await asyncio.sleep(0.01)
            assert not leaving.done()
            late = await _post(app, 60)
            backend.gate.set()
            await leaving
            return await answers, late, app.state.readiness.phase

    assert asyncio.run(scenario()) == (200, 503, "ready")
    assert app.state.readiness.phase == Phase.STOPPING
    assert len(backend.cameras) == 1


async def _post(app: Any, fov_deg: float) -> int:
    """A request without a server, in the running event loop."""
    import httpx

    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://service") as client:
        return (await client.post(PATH, json=BODY | {"fov_deg": fov_deg})).status_code


def test_stopping_outlasts_a_warm_up_that_ends_late() -> None:
    readiness = Readiness()
    readiness.stopping()
    readiness.ready()
    readiness.failed("too late")
    assert readiness.phase is Phase.STOPPING


def test_metrics_tell_frames_steps_queue_scenes_and_memory(backend: Any) -> None:
    with TestClient(create_app("unused", make_backend=lambda: backend, queue_limit=5)) as client:
        for fov_deg in (30, 40, 40):
            assert client.post(PATH, json=BODY | {"fov_deg": fov_deg}).status_code == 200
        answer = client.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=")
    found = samples(answer.text)
    assert found['lightwell_frames_total{source="rendered"}'] == 2
    assert found['lightwell_frames_total{source="recent"}'] == 1
    assert found["lightwell_frame_seconds_count"] == 3
    for step, count in {"queue": 2, "open": 1, "query": 2, "network": 2, "encode": 2}.items():
        assert found[f'lightwell_frame_step_seconds_count{{step="{step}"}}'] == count
    assert found['lightwell_frame_step_seconds_sum{step="query"}'] == pytest.approx(0.008)
    assert found['lightwell_frame_step_seconds_bucket{le="0.005",step="query"}'] == 2
    assert found["lightwell_frames_under_way"] == 0 and found["lightwell_frames_under_way_limit"] == 5
    assert found["lightwell_queue_depth"] == 0
    assert found["lightwell_open_scenes"] == 1 and found["lightwell_open_scenes_bytes"] == 1000
    assert found["lightwell_scenes_opened_total"] == 1 and found["lightwell_scenes_closed_total"] == 0
    assert found["lightwell_non_finite_values_total"] == 0
    assert found["process_resident_memory_bytes"] > 2**20


def test_metrics_as_open_metrics_where_accept_asks(backend: Any) -> None:
    with TestClient(create_app("unused", make_backend=lambda: backend)) as client:
        answer = client.get("/metrics", headers={"Accept": "application/openmetrics-text; version=1.0.0"})
    assert answer.headers["content-type"].startswith("application/openmetrics-text")
    assert answer.text.endswith("# EOF\n")


def test_two_apps_count_apart(backend: Any) -> None:
    apps = [create_app("unused", make_backend=lambda: backend) for _ in range(2)]
    with TestClient(apps[0]) as client:
        client.post(PATH, json=BODY)
    counts = [app.state.registry.get_sample_value("lightwell_renders_total") for app in apps]
    assert counts == [1, 0]


def test_job_metrics_are_read_at_each_scrape() -> None:
    registry, counts = make_registry(), {"queued": 2, "running": 1}
    asked: list[int] = []
    job_metrics(registry, lambda: asked.append(1) or counts, seconds_by_stage=lambda: {"bake": 12.5})  # type: ignore[func-returns-value]
    assert asked == []  # not when registered: the database may not be there yet
    assert registry.get_sample_value("lightwell_jobs", {"state": "queued"}) == 2
    counts["queued"] = 3
    assert registry.get_sample_value("lightwell_jobs", {"state": "queued"}) == 3
    assert registry.get_sample_value("lightwell_stage_seconds_total", {"stage": "bake"}) == 12.5


def test_a_job_source_that_fails_leaves_the_others() -> None:
    registry = make_registry()

    def fail() -> dict[str, float]:
        raise OSError("database is locked")

    job_metrics(registry, fail, units_by_stage=lambda: {"render": 4})
    found = samples(generate_latest(registry).decode())
    assert found['lightwell_units_total{stage="render"}'] == 4
    assert not any(name.startswith("lightwell_jobs") for name in found)
