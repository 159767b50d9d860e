"""A job on `tiny` through a real server and its workers: submitted, watched, fetched, repeated for nothing, cancelled,
served.
"""

import time
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
import uvicorn

from service.app import create_app
from service.engine import DaskRunner
from service.jobs.service import Jobs
from service.jobs.submission import Desk
from service.jobs_client import JobsClient
from service.scene_sources import SceneSources
from service.serving import bind
from storage.store import Store

pytestmark = pytest.mark.slow
STORED = {"bake diffuse", "render train"}
BODY: dict[str, Any] = {"scene": "tiny", "preset": "tiny", "settings": {"width": 64, "height": 64}}


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    import threading

    store = str(tmp_path_factory.mktemp("jobs") / "store")
    Store.open(store, create=True)
    jobs = Jobs.of_store(store, DaskRunner(store), Desk(resolve_scene_source=SceneSources().resolve_scene_source))
    with bind("127.0.0.1", 0) as listener:
        config = uvicorn.Config(create_app(store, jobs=jobs), log_level="error", timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        while not server.started and thread.is_alive():
            time.sleep(0.05)
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        server.should_exit = True
        thread.join(60)


def run(client: JobsClient, **values: Any) -> tuple[dict[str, Any], list[Any]]:
    job = client.request("POST", "/v1/jobs", json={**BODY, **values}).json()
    events = list(client.events(job["id"]))
    return client.request("GET", f"/v1/jobs/{job['id']}").json(), events


def stages_computed(events: list[Any]) -> set[str]:
    """Stages that did something; what is found in the store is told as done at once."""
    told = [event.data for event in events if event.kind == "progress"]
    return {progress["stage"] for progress in told if progress["done"] < progress["total"]}


def test_a_job_runs_to_its_end_and_its_twin_computes_nothing(url: str) -> None:
    with JobsClient(url) as client:
        job, events = run(client)
        assert job["state"] == "complete", job["error"]
        computed = stages_computed(events)
        assert {"bake diffuse", "render train", "train", "evaluate"} <= computed
        assert "preview" in {event.kind for event in events}
        assert client.request("GET", f"/v1/jobs/{job['id']}/preview.png").content.startswith(b"\x89PNG")
        assert "data:image" in client.request("GET", f"/v1/jobs/{job['id']}/report").text
        rows = client.request("GET", f"/v1/jobs/{job['id']}/result").json()["evaluation"]["rows"]
        assert {"ours", "ir"} <= {row["name"] for row in rows}
        twin, events = run(client)
        assert twin["state"] == "complete" and not STORED & stages_computed(events)
        assert [scene["name"] for scene in client.request("GET", "/v1/scenes").json()["scenes"]] == ["tiny"]
        plan = client.request("POST", "/v1/plan", json=BODY).json()
        assert plan["cost"]["paths"] > 0


def test_a_running_job_is_cancelled_in_less_than_ten_seconds(url: str) -> None:
    with JobsClient(url) as client:
        settings = {**BODY["settings"], "frames.num_train": 200, "frames.train_spp": 64}
        job = client.request("POST", "/v1/jobs", json={**BODY, "settings": settings}).json()
        for event in client.events(job["id"]):
            if event.kind == "progress" and event.data["stage"].startswith("render"):
                break
        start_s = time.monotonic()
        client.request("DELETE", f"/v1/jobs/{job['id']}")
        assert [event.data.get("state") for event in client.events(job["id"])][-1] == "cancelled"
        assert time.monotonic() - start_s < 10


def test_a_shorter_job_is_the_start_of_the_longer_one(url: str) -> None:
    settings = {**BODY["settings"], "cache.polar": 3}
    with JobsClient(url) as client:
        short, events = run(client, settings=settings, stages=["bake", "render"])
        assert short["state"] == "complete" and "train" not in {event.data.get("stage") for event in events}
        whole, events = run(client, settings=settings)
        computed = stages_computed(events)
        assert whole["state"] == "complete" and not STORED & computed and "train" in computed
        assert client.request("GET", f"/v1/jobs/{whole['id']}/report").status_code == httpx.codes.OK
