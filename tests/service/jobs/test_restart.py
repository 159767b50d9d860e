"""A service that is killed and started again: every unfinished job goes on by itself, and the start is quick."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import insert

from service.jobs.database import Database
from service.jobs.models import Job
from service.jobs.states import State
from service.serving import bind

PROCESS = Path(__file__).parent / "service_process.py"
ROOT = Path(__file__).parents[3]
NUM_UNITS = 12
NUM_FINISHED = 10_000
MAX_START_S = 3.0


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[[], tuple[subprocess.Popen, httpx.Client]]]:
    """Starts the service in a process of its own, always on the same folder; answers when it is ready."""
    with bind("127.0.0.1", 0) as probe:
        port = probe.getsockname()[1]
    running: list[subprocess.Popen] = []
    client = httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False, timeout=10)

    def make() -> tuple[subprocess.Popen, httpx.Client]:
        command = [sys.executable, str(PROCESS), str(tmp_path), str(port), str(NUM_UNITS)]
        running.append(subprocess.Popen(command, cwd=ROOT, env=_environment()))
        deadline_s = time.monotonic() + 60
        while True:
            assert running[-1].poll() is None, "the service ended"
            assert time.monotonic() < deadline_s, "the service did not start"
            try:
                client.get("/healthz")
                return running[-1], client
            except httpx.TransportError:
                time.sleep(0.02)

    yield make
    client.close()
    for process in running:
        process.kill()
        process.wait(10)


def _environment() -> dict[str, str]:
    import os

    return {**os.environ, "PYTHONPATH": str(ROOT)}


def submit(client: httpx.Client, polar: int) -> str:
    body = {"scene": "tiny", "preset": "tiny", "settings": {"cache.polar": polar}}
    return client.post("/v1/jobs", json=body).raise_for_status().json()["id"]


def test_a_killed_service_resumes_its_jobs_and_loses_at_most_a_unit(
    start: Callable[[], Any], tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    process, client = start()
    running, waiting = submit(client, 3), submit(client, 4)
    computed = tmp_path / "computed"
    for number in (1, 2):
        wait_until(lambda n=number: computed.exists() and len(computed.read_text().split()) >= 4 * n)
        process.send_signal(signal.SIGKILL)
        process.wait(10)
        process, client = start()
    wait_until(lambda: client.get(f"/v1/jobs/{waiting}").json()["state"] == "complete")
    jobs = {job["id"]: job for job in client.get("/v1/jobs").json()["jobs"]}
    assert jobs[running]["state"] == "complete" and jobs[running]["attempts"] == 3
    units = computed.read_text().split()
    assert set(units) == {f"{polar}-{index}" for polar in (3, 4) for index in range(NUM_UNITS)}
    # A kill between a unit's commit and its line loses the line, one between sleep and commit the unit.
    assert len(units) - len(set(units)) <= 2
    notes = client.get(f"/v1/jobs/{running}/events").text
    assert notes.count("the process that ran this job is gone") == 2


@pytest.mark.slow
def test_a_terminated_service_releases_its_job_and_the_next_one_ends_it(
    start: Callable[[], Any], tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    process, client = start()
    job_id = submit(client, 3)
    wait_until(lambda: (tmp_path / "computed").exists())
    process.send_signal(signal.SIGTERM)
    process.wait(20)
    database = Database(f"sqlite:///{tmp_path / 'jobs.sqlite'}")
    with database.reading() as session:
        assert [row[0] for row in session.execute(Job.__table__.select().with_only_columns(Job.state))] == ["queued"]
    database.close()
    _, client = start()
    wait_until(lambda: client.get(f"/v1/jobs/{job_id}").json()["state"] == "complete")
    units = (tmp_path / "computed").read_text().split()
    assert len(units) == len(set(units)) == NUM_UNITS


def test_a_service_with_ten_thousand_finished_jobs_starts_in_three_seconds(
    start: Callable[[], Any], tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    database = Database(f"sqlite:///{tmp_path / 'jobs.sqlite'}")
    request = {"scene": "tiny", "preset": "tiny", "settings": {}, "stages": ["bake"], "priority": 0}
    rows = [
        {"id": f"{index:016x}", "request": request, "spec": {**request, "settings": {"cache": {}}}, "state": "complete",
         "spec_digest": f"{index:064x}", "request_digest": "r", "submitted_s": 1.0, "changed_s": 1.0, "ended_s": 2.0,
         "result": {"evaluation": {"rows": ["x" * 2000]}, "units": 1, "set_aside": []}, "priority": 0, "attempts": 1,
         "last_seq": 3}
        for index in range(NUM_FINISHED)
    ]  # fmt: skip
    unfinished = {"id": "f" * 16, "state": State.RUNNING, "lease_owner": "elsewhere/1/0/x", "lease_expires_s": 1.0}
    spec = {"scene": "tiny", "settings": {"cache": {"polar": 3}}, "stages": ["bake"]}
    with database.writing() as session:
        session.execute(insert(Job), rows)
        session.execute(insert(Job), [{**rows[0], **unfinished, "spec": spec, "spec_digest": "u", "result": None}])
    database.close()
    tries: list[float] = []
    process = None
    while not tries or (min(tries) >= MAX_START_S and len(tries) < 3):  # what else runs here costs time too
        if process is not None:
            process.kill()
            process.wait(10)
        begin_s = time.monotonic()
        process, client = start()
        page = client.get("/v1/jobs").json()
        tries.append(time.monotonic() - begin_s)
        assert len(page["jobs"]) == 50 and page["jobs"][0]["id"] == "f" * 16
    print(f"start with {NUM_FINISHED} finished jobs, imports included: {min(tries):.2f} s")
    assert min(tries) < MAX_START_S
    wait_until(lambda: client.get(f"/v1/jobs/{'f' * 16}").json()["state"] == "complete")
