"""Requests made from the OpenAPI document, valid and not: no 5xx, and every answer is as the document says."""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.specs.openapi.checks import positive_data_acceptance

from service.app import create_app
from service.config import ServiceConfig
from service.errors import UnknownSceneError
from service.job_runner import JobStopped
from service.jobs.planner import Planner
from service.jobs.schemas import JobRequest
from service.jobs.service import Jobs
from service.jobs.submission import Desk
from storage.store import Store
from workers.errors import NoOperatingPointsError
from workers.scene_request import SceneRequest

EXAMPLES = int(os.environ.get("LIGHTWELL_FUZZ_EXAMPLES", "10"))
"""Per operation; thousands for a long search."""


class QuickRunner:
    """Ends at once, or where it is asked to."""

    def run(self, job_id: str, spec: Any, on_event: Any, should_stop: Any) -> dict[str, Any]:
        on_event({"kind": "progress", "stage": "bake", "done": 1.0, "total": 1.0, "eta_s": None, "note": ""})
        on_event({"kind": "preview", "png": b"\x89PNG\r\n\x1a\n"})
        stop = should_stop()
        if stop is not None:
            raise JobStopped(stop)
        return {"evaluation": None, "units": 1, "set_aside": []}

    def close(self) -> None: ...


def resolve(name: str) -> str:
    if name not in ("tiny", "tabletop"):
        raise UnknownSceneError(f"scene must be tiny or tabletop, got {name!r}")
    return name


def make_plan(source: str, wanted: Any) -> dict[str, Any]:
    return {"rows": [{"item": "elements", "choice": "1", "reason": source}],
            "cost": {"paths": 1, "seconds": 1.0, "nbytes": 1}}  # fmt: skip


def pack(store_url: str, spec: dict[str, Any], archive: Path) -> None:
    archive.write_bytes(b"PK")


class Scenes:
    """One scene with frames of one colour, whose trade was never measured."""

    nbytes = 1000

    def scenes(self) -> list[dict[str, Any]]:
        facts = {"network": "n1", "width": 64, "height": 64, "preset": "draft", "psnr": None}
        return [{"name": "tabletop", "digest": "d1", **facts}]

    def choose(self, digest: str, demand: Any, width: int, height: int, slowdown: float = 1.0) -> Any:
        raise NoOperatingPointsError(f"scene {digest} must have measured operating points, got none")

    def warm_up(self) -> None: ...

    def trim(self) -> None: ...

    def open(self, digest: str) -> "Scenes":
        return self

    def render(self, camera: Any, point: Any = None) -> Any:
        radiance = np.full((camera.height, camera.width, 3), 0.25, np.float32)
        return SimpleNamespace(radiance=radiance, seconds={}, coverage=1.0, exposure=1.0, non_finite=0)


@pytest.fixture(scope="module")
def jobs(tmp_path_factory: pytest.TempPathFactory) -> Jobs:
    folder: Path = tmp_path_factory.mktemp("fuzz")
    desk = Desk(resolve_scene_source=resolve, read_scene=lambda _: SceneRequest(name="tiny", width=8, height=8))
    return Jobs(f"sqlite:///{folder / 'jobs.sqlite'}", QuickRunner(), desk, planner=Planner(make_plan), pack=pack)


@pytest.fixture(scope="module")
def url(jobs: Jobs, serve_app: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A real server with stand-ins for what renders and what runs jobs."""
    store = Store.open(tmp_path_factory.mktemp("fuzz") / "store", create=True)
    config = ServiceConfig(store_url=store.url, max_pixels=10_000)
    with (
        pytest.MonkeyPatch.context() as patch,
        serve_app(create_app(store.url, make_backend=Scenes, jobs=jobs, config=config)) as address,
    ):
        patch.setenv("NO_PROXY", "127.0.0.1")
        deadline_s = time.monotonic() + 10
        while httpx.get(f"{address}/readyz", trust_env=False).status_code != 200:  # until then, 503 is its right answer
            assert time.monotonic() < deadline_s
            time.sleep(0.02)
        yield address


@pytest.fixture(scope="module")
def ended(jobs: Jobs, url: str) -> dict[str, str]:
    """Ids of two jobs that are complete: one to look at, one to steer."""
    found = {}
    for use in ("look", "steer"):
        job = jobs.table.submit(jobs.desk.submission(JobRequest(scene="tiny", preset="tiny")))
        jobs.dispatcher.wake()
        deadline_s = time.monotonic() + 10
        while jobs.table.get(job.id).state != "complete":
            assert time.monotonic() < deadline_s
            time.sleep(0.02)
        found[use] = job.id
    return found


@pytest.fixture(scope="module")
def document(url: str) -> Any:
    """The app's OpenAPI document."""
    return schemathesis.openapi.from_url(f"{url}/openapi.json")


def exist(case: Any, ended: dict[str, str]) -> None:
    """Makes a valid request ask for a job and a scene that exist, and for a frame that can be."""
    if "job_id" in case.path_parameters:
        case.path_parameters["job_id"] = ended["look" if case.method.upper() == "GET" else "steer"]
    if "scene" in case.path_parameters:
        case.path_parameters["scene"] = "tabletop"
    if isinstance(case.body, dict) and "scene" in case.body:
        case.body["scene"] = "tiny"
    if isinstance(case.body, dict) and "camera" in case.body:
        look_at = {"origin": [0.0, 1.0, 5.0], "target": [0.0, 1.0, 0.0], "up": [0.0, 1.0, 0.0]}
        case.body |= {"camera": {"look_at": look_at}, "fov_deg": 45.0, "width": 32, "height": 20}
        case.headers = {"Accept": "image/png"}


@pytest.mark.parametrize("mode", [GenerationMode.POSITIVE, GenerationMode.NEGATIVE], ids=lambda mode: mode.value)
def test_every_answer_is_as_the_document_says(document: Any, ended: dict[str, str], mode: GenerationMode) -> None:
    """Not by schemathesis' pytest plugin: it does not know this pytest."""
    num_cases = 0
    answers: dict[str, set[int]] = {}
    for found in document.get_all_operations():
        operation = found.ok()

        @given(case=operation.as_strategy(generation_mode=mode))
        @settings(
            max_examples=EXAMPLES, deadline=None, derandomize=True, database=None, phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        def check(case: Any) -> None:
            nonlocal num_cases
            num_cases += 1
            if mode is GenerationMode.POSITIVE and num_cases % 2:
                exist(case, ended)
            # Not every value of the right type makes sense: a setting that there is not is refused with 422.
            response = case.call_and_validate(excluded_checks=[positive_data_acceptance], timeout=20)
            answers.setdefault(operation.label, set()).add(response.status_code)  # noqa: B023  # called in this round

        try:
            check()
        except Unsatisfiable:
            assert mode is GenerationMode.NEGATIVE, f"{operation.label} can be asked"
    assert num_cases >= 8 * EXAMPLES
    if mode is GenerationMode.POSITIVE:
        assert {200, 413} <= answers["POST /v1/scenes/{scene}/frame"], "frames are asked for that can be answered"


def test_the_document_has_every_route(document: Any) -> None:
    operations = {f"{o.ok().method.upper()} {o.ok().path}" for o in document.get_all_operations()}
    assert {"POST /v1/jobs", "GET /v1/jobs/{job_id}/events", "DELETE /v1/jobs/{job_id}", "POST /v1/plan"} <= operations
    assert {"POST /v1/bundles", "DELETE /v1/bundles/{bundle_id}", "POST /v1/scenes/{scene}/frame"} <= operations
    assert len(operations) >= 18
