"""Jobs over HTTP with a runner that computes nothing: submission, wishes, files, and the event stream of a real
server."""

import contextlib
import io
import json
import re
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.app import create_app
from service.jobs.planner import MAX_WAITING, Planner
from service.jobs.run import REPORT
from service.jobs.service import Jobs
from service.jobs.submission import Desk
from service.jobs_client import StreamEvent, parse_events
from service.scene_sources import SceneSources
from workers.errors import SceneError
from workers.scene_request import SceneRequest
from workers.units import Unit

Make = Callable[..., Any]
BODY = {"scene": "tiny", "preset": "tiny"}


def resolve(name: str) -> str:
    return name if name == "broken.xml" else SceneSources().resolve_scene_source(name)


def read_scene(source: str) -> SceneRequest:
    if source == "broken.xml":
        raise SceneError("scene must hold a sensor, got none")
    return SceneRequest(name="tiny", width=48, height=32, settings={"cache.polar": 5, "cache.azimuth": 6})


@pytest.fixture
def make_plan() -> Make:
    def make(source: str, settings: Any) -> dict[str, Any]:
        row = {"item": "size", "choice": f"{settings.width}x{settings.height}", "reason": source}
        return {"rows": [row], "cost": {"paths": 10, "seconds": 2.0, "nbytes": 3}}

    return make


@pytest.fixture
def jobs(tmp_path: Path, runner: Any, make_plan: Make) -> Jobs:
    desk = Desk(resolve_scene_source=resolve, read_scene=read_scene, max_pixels=100_000, max_spp=5000)
    planner = Planner(lambda source, settings: make_plan(source, settings))
    url = f"sqlite:///{tmp_path / 'jobs.sqlite'}"
    return Jobs(url, runner, desk, planner=planner, pack=pack, dispatcher_options={"poll_s": 0.02}, heartbeat_s=0.05)


def pack(store_url: str, spec: dict[str, Any], archive: Path) -> None:
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("manifest.json", json.dumps([store_url, spec["scene"]]))


@pytest.fixture
def client(jobs: Jobs, backend: Any, serve_app: Make) -> Iterator[httpx.Client]:
    with contextlib.ExitStack() as stack:
        url = stack.enter_context(serve_app(create_app("unused", make_backend=lambda: backend, jobs=jobs)))
        yield stack.enter_context(httpx.Client(base_url=url, trust_env=False, timeout=10))


def test_dataset_of_a_job_is_a_zip_once_its_frames_are_rendered(
    client: httpx.Client, runner: Any, wait_until: Make
) -> None:
    runner.may_end.clear()
    job_id = submit(client).json()["id"]
    assert_problem(client.get(f"/v1/jobs/{job_id}/dataset"), 409, "must have rendered its frames")
    runner.may_end.set()
    wait_until(lambda: client.get(f"/v1/jobs/{job_id}").json()["state"] == "complete")
    left = lambda: set(Path(tempfile.gettempdir()).glob("lightwell-dataset-*"))  # noqa: E731
    before = left()
    response = client.get(f"/v1/jobs/{job_id}/dataset")
    assert response.status_code == 200 and response.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(response.content)) as file:
        assert json.loads(file.read("manifest.json"))[0] == "unused"
    wait_until(lambda: left() == before)
    baked = submit(client, stages=["bake"]).json()["id"]
    wait_until(lambda: client.get(f"/v1/jobs/{baked}").json()["state"] == "complete")
    assert_problem(client.get(f"/v1/jobs/{baked}/dataset"), 409, "complete with bake")
    assert client.get("/v1/jobs/none/dataset").status_code == 404


def test_metrics_tell_units_and_seconds_by_stage(client: httpx.Client, runner: Any) -> None:
    runner.totals.add(Unit("bake", "diffuse", count=7), 2.5, done=True)
    runner.totals.add(Unit("render", "train"), 4.0, done=False)
    told = client.get("/metrics").text
    assert 'lightwell_units_total{stage="bake"} 7.0' in told
    assert 'lightwell_stage_seconds_total{stage="render"} 4.0' in told
    assert 'lightwell_units_set_aside_total{stage="render"} 1.0' in told


def submit(client: httpx.Client, **values: Any) -> httpx.Response:
    key = values.pop("key", None)
    headers = {} if key is None else {"Idempotency-Key": key}
    return client.post("/v1/jobs", json={**BODY, **values}, headers=headers)


def assert_problem(response: httpx.Response, status: int, words: str) -> None:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    assert re.search(words, response.json()["detail"]), response.text


def events(client: httpx.Client, path: str, after: int | None = None) -> list[StreamEvent]:
    headers = {} if after is None else {"Last-Event-ID": str(after)}
    with client.stream("GET", f"{path}/events", headers=headers) as response:
        assert response.status_code == 200
        assert response.headers["content-type"].startswith("text/event-stream")
        return list(parse_events(response.iter_lines()))


def test_a_submitted_job_is_run_and_told_about_to_its_end(client: httpx.Client) -> None:
    response = submit(client, priority=4, settings={"frames.train_spp": "64"})
    assert response.status_code == 202
    path = response.headers["location"]
    assert path == response.json()["links"]["self"] == f"/v1/jobs/{response.json()['id']}"
    seen = events(client, path)
    assert [event.data["state"] for event in seen if event.kind == "state"] == ["queued", "running", "complete"]
    assert [event.number for event in seen] == list(range(1, len(seen) + 1))
    done = [event.data for event in seen if event.kind == "progress"][-1]
    assert (done["stage"], done["done"], done["total"]) == ("bake", 3, 3)
    job = client.get(path).json()
    assert (job["state"], job["priority"], job["attempts"]) == ("complete", 4, 1)
    assert job["submitted"] <= job["started"] <= job["ended"] and job["ended"].endswith("Z")
    assert client.get(f"{path}/result").json() == {"evaluation": None, "units": 3, "set_aside": []}
    preview = client.get(f"{path}/preview.png")
    assert preview.headers["content-type"] == "image/png" and preview.content == b"\x89PNG fake"


def test_a_job_gets_the_scenes_wishes_and_the_clients_win(client: httpx.Client, jobs: Jobs) -> None:
    job_id = submit(client, settings={"cache.polar": 7, "train.widths": [8, 8, 8]}).json()["id"]
    settings = jobs.table.get(job_id).spec["settings"]
    assert (settings["width"], settings["height"], settings["cache"]["azimuth"]) == (48, 32, 6)
    assert settings["cache"]["polar"] == 7 and settings["train"]["widths"] == [8, 8, 8]
    assert jobs.table.get(job_id).spec["scene"] == "tiny"


@pytest.mark.parametrize(
    ("values", "status", "words"),
    [
        ({"scene": "attic"}, 404, "tabletop, tiny.*got 'attic'"),
        ({"scene": "broken.xml"}, 422, "scene must hold a sensor"),
        ({"preset": "best"}, 422, "preset must be one of draft"),
        ({"settings": {"cache.colour": 1}}, 422, "cache.colour"),
        ({"settings": {"frames.train_spp": "many"}}, 422, "frames.train_spp"),
        ({"settings": {"frames.train_spp": 0}}, 422, "must be 1 to 16,777,216"),
        ({"settings": {"preset": "draft"}}, 422, "beside settings"),
        ({"settings": {"width": 4000}}, 422, "at most 100000 pixels, got 4000x32"),
        ({"settings": {"frames.test_spp": 5001}}, 422, "at most 5000 paths"),
        ({"stages": ["render"]}, 422, r"bake, render, train, evaluate, in that order, got \['render'\]"),
        ({"stages": []}, 422, "stages: "),
        ({"stages": ["paint"]}, 422, "stages.0: "),
        ({"priority": 101}, 422, "priority: "),
        ({"colour": "red"}, 422, "colour: "),
        ({"scene": "a\x00b"}, 422, "scene: "),
        ({"key": "with space"}, 422, "idempotency-key"),
    ],
)
def test_what_no_job_can_do_is_refused_with_the_reason(
    client: httpx.Client, jobs: Jobs, values: dict[str, Any], status: int, words: str
) -> None:
    assert_problem(submit(client, **values), status, words)
    assert jobs.table.page() == []


def test_a_key_makes_repeats_harmless(client: httpx.Client) -> None:
    first, again = submit(client, key="k-1"), submit(client, key="k-1")
    assert again.status_code == 202 and again.headers["location"] == first.headers["location"]
    assert_problem(submit(client, key="k-1", priority=1), 422, "Idempotency-Key must come with one request only")
    assert len(client.get("/v1/jobs").json()["jobs"]) == 1


def test_the_list_is_paged_and_filtered(client: httpx.Client, runner: Any, wait_until: Make) -> None:
    runner.may_end.clear()
    made = [submit(client, settings={"cache.polar": n}).json()["id"] for n in range(1, 6)]
    wait_until(lambda: runner.busy == 1)
    first = client.get("/v1/jobs", params={"limit": 3}).json()
    rest = client.get("/v1/jobs", params={"limit": 3, "before": first["next"]}).json()
    assert [job["id"] for job in first["jobs"] + rest["jobs"]] == made[::-1] and rest["next"] is None
    running = client.get("/v1/jobs", params={"state": ["running", "paused"]}).json()["jobs"]
    assert [job["id"] for job in running] == [made[0]]
    assert_problem(client.get("/v1/jobs", params={"state": "lost"}), 422, "state")
    runner.may_end.set()


def test_wishes_steer_a_job(client: httpx.Client, runner: Any, wait_until: Make) -> None:
    runner.may_end.clear()
    path = submit(client).headers["location"]

    def state() -> str:
        return client.get(path).json()["state"]

    wait_until(lambda: runner.busy == 1)
    assert client.post(f"{path}/pause").json()["state"] == "pausing"
    wait_until(lambda: state() == "paused")
    assert_problem(client.get(f"{path}/result"), 409, "must be complete for a result, it is paused")
    assert client.post(f"{path}/resume").json()["state"] == "queued"
    wait_until(lambda: runner.busy == 1)
    cancelled = client.delete(path)
    assert (cancelled.status_code, cancelled.json()["state"]) == (202, "cancelling")
    wait_until(lambda: state() == "cancelled")
    assert client.delete(path).status_code == 202
    assert_problem(client.post(f"{path}/pause"), 409, "for pause, got cancelled")
    runner.may_end.set()
    assert client.post(f"{path}/retry").json()["state"] == "queued"
    wait_until(lambda: state() == "complete")
    assert_problem(client.delete(path), 409, "for cancel, got complete")


@pytest.mark.parametrize("path", ["", "/events", "/result", "/report", "/preview.png"])
def test_unknown_jobs_are_404(client: httpx.Client, path: str) -> None:
    assert_problem(client.get(f"/v1/jobs/0123{path}"), 404, "job must be one of this service, got '0123'")


def test_a_stream_is_resumed_where_it_was_left(client: httpx.Client) -> None:
    path = submit(client).headers["location"]
    seen = events(client, path)
    assert [event.number for event in events(client, path, after=seen[1].number)] == [e.number for e in seen[2:]]
    assert client.get(f"{path}/events", headers={"Last-Event-ID": str(seen[-1].number)}).status_code == 204
    assert len(events(client, path, after=None)) == len(seen)
    with client.stream("GET", f"{path}/events", headers={"Last-Event-ID": "nonsense"}) as response:
        assert len(list(parse_events(response.iter_lines()))) == len(seen)


def test_a_silent_stream_has_heartbeats_and_lives_while_the_job_does(client: httpx.Client, runner: Any) -> None:
    runner.may_end.clear()
    path = submit(client).headers["location"]
    lines: list[tuple[float, str]] = []
    with client.stream("GET", f"{path}/events") as response:
        for line in response.iter_lines():
            lines.append((time.monotonic(), line))
            if line == ": still there":
                runner.may_end.set()
    texts = [line for _, line in lines]
    assert texts[0].startswith(": events of job") and "retry: 2000" in texts
    assert ": still there" in texts and texts.index(": still there") < max(
        index for index, text in enumerate(texts) if '"complete"' in text
    )


def test_a_client_that_leaves_a_stream_costs_nothing(client: httpx.Client, runner: Any, wait_until: Make) -> None:
    runner.may_end.clear()
    path = submit(client).headers["location"]
    for _ in range(8):
        with client.stream("GET", f"{path}/events") as response:
            next(response.iter_lines())
    runner.may_end.set()
    wait_until(lambda: client.get(path).json()["state"] == "complete")
    assert events(client, path)[-1].data["state"] == "complete"


def test_a_report_is_the_runners_page_or_made_of_the_scores(
    client: httpx.Client, jobs: Jobs, runner: Any, evaluation: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = submit(client).headers["location"]
    events(client, path)
    assert_problem(client.get(f"{path}/report"), 409, "stage evaluate")
    result = {"evaluation": json.loads(json.dumps(evaluation.result)), "units": 1, "set_aside": []}
    monkeypatch.setattr(runner, "run", lambda *_: result)
    path = submit(client, settings={"cache.polar": 3}).headers["location"]
    events(client, path)
    page = client.get(f"{path}/report")
    assert page.headers["content-type"].startswith("text/html") and "34.25" in page.text
    jobs.table.put_file(jobs.table.get(path.rpartition("/")[2]), REPORT, b"<p>with pictures</p>")
    assert client.get(f"{path}/report").text == "<p>with pictures</p>"


def test_a_preview_before_any_pass_is_409(client: httpx.Client, runner: Any) -> None:
    runner.may_end.clear()
    path = submit(client).headers["location"]
    assert_problem(client.get(f"{path}/preview.png"), 409, "must have rendered something")
    runner.may_end.set()


def test_a_plan_says_what_a_job_would_do_and_makes_none(client: httpx.Client, jobs: Jobs) -> None:
    answer = client.post("/v1/plan", json=BODY)
    assert answer.status_code == 200, answer.text
    row = {"item": "size", "choice": "48x32", "reason": "tiny", "settings": [], "by": "plan"}
    assert answer.json()["rows"] == [row]
    assert answer.json()["cost"]["paths"] == 10 and jobs.table.page() == []
    assert_problem(client.post("/v1/plan", json={**BODY, "preset": "best"}), 422, "preset must be one of")


def test_too_many_plans_at_once_are_503_with_retry_after(
    backend: Any, tmp_path: Path, runner: Any, serve_app: Make, wait_until: Make
) -> None:
    gate = threading.Event()

    def slow_plan(source: str, settings: Any) -> dict[str, Any]:
        gate.wait(10)
        return {"rows": [], "cost": {"paths": 0, "seconds": 0.0, "nbytes": 0}}

    desk = Desk(resolve_scene_source=resolve, read_scene=read_scene)
    planner = Planner(slow_plan)
    jobs = Jobs(f"sqlite:///{tmp_path / 'jobs.sqlite'}", runner, desk, planner=planner)
    with contextlib.ExitStack() as stack:
        url = stack.enter_context(serve_app(create_app("unused", make_backend=lambda: backend, jobs=jobs)))
        client = stack.enter_context(httpx.Client(base_url=url, trust_env=False, timeout=20))
        codes: list[int] = []
        threads = [
            threading.Thread(target=lambda: codes.append(client.post("/v1/plan", json=BODY).status_code))
            for _ in range(MAX_WAITING)
        ]
        for thread in threads:
            thread.start()
        wait_until(lambda: planner.num_waiting == MAX_WAITING)
        refused = client.post("/v1/plan", json=BODY)
        gate.set()
        for thread in threads:
            thread.join(20)
    assert_problem(refused, 503, "ask again later")
    assert int(refused.headers["retry-after"]) > 0 and codes == [200] * MAX_WAITING


def test_a_database_that_fails_is_503_and_shows_no_statement(
    client: httpx.Client, jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sqlalchemy.exc import OperationalError

    def fail(*_: Any, **__: Any) -> None:
        raise OperationalError("SELECT secret", {}, Exception("gone"))

    monkeypatch.setattr(jobs.table, "page", fail)
    response = client.get("/v1/jobs")
    assert_problem(response, 503, "the job database does not answer")
    assert "secret" not in response.text


def test_openapi_has_examples_and_problems(client: httpx.Client) -> None:
    document = client.get("/openapi.json").json()
    operation = document["paths"]["/v1/jobs"]["post"]
    assert operation["responses"]["202"]["headers"]["Location"]
    for status in ("404", "422"):
        assert list(operation["responses"][status]["content"]) == ["application/problem+json"]
    schemas = document["components"]["schemas"]
    assert schemas["JobRequest"]["examples"] and schemas["JobView"]["examples"]
    assert "HTTPValidationError" not in json.dumps(document["paths"]["/v1/jobs"])
