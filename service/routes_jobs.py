"""Jobs over HTTP: submit, look, steer, watch, fetch.

POST   /v1/jobs                     202 and Location; Idempotency-Key makes a repeat harmless
GET    /v1/jobs                     pages, the latest first, by state
GET    /v1/jobs/{id}                one job
DELETE /v1/jobs/{id}                cancel; also POST .../pause, .../resume, .../retry
GET    /v1/jobs/{id}/events         server-sent events, resumed by Last-Event-ID
GET    /v1/jobs/{id}/preview.png    the latest pass;  .../result  as JSON;  .../report  as a page
GET    /v1/jobs/{id}/dataset        its frames as a zip
POST   /v1/plan                     what a job would do and cost
"""

import asyncio
import pathlib
import shutil
import tempfile
from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, FastAPI, Header, Path, Query, Response
from fastapi.responses import FileResponse, HTMLResponse
from fastapi.sse import EventSourceResponse
from starlette.background import BackgroundTask

from service.errors import BusyError, NotReadyError
from service.jobs.models import Job
from service.jobs.report import job_report
from service.jobs.run import PREVIEW, REPORT
from service.jobs.schemas import EXAMPLE_JOB, JobPage, JobRequest, JobResult, JobView, PlanRequest, PlanView
from service.jobs.service import Jobs
from service.jobs.states import TERMINAL, Event, State
from service.jobs.stream import event_number, stream_events
from service.problems import problem_responses

MAX_PAGE = 500
MAX_NUMBER = 2**53
JobId = Annotated[str, Path(description="a job's id", examples=[EXAMPLE_JOB["id"]], max_length=64)]
IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1, max_length=255, pattern="^[!-~]+$", description="a key of the client's own choice for this "
        "submission: sent again with the same body it answers with the same job, with another body it is refused",
    ),
]  # fmt: skip
LOCATION = {"Location": {"description": "the job", "schema": {"type": "string"}}}
BINARY = {"schema": {"type": "string", "format": "binary"}}
EVENT_SCHEMA = {
    "type": "object",
    "required": ["id", "event", "data"],
    "properties": {
        "id": {"type": "string", "pattern": "^[0-9]+$"},
        "event": {"type": "string"},
        "data": {"type": "string", "contentMediaType": "application/json"},
        "retry": {"type": "integer", "minimum": 0},
    },
}
"""One event of the stream."""
STREAM_HEADERS = {"Cache-Control": "no-cache", "X-Accel-Buffering": "no"}


def add_job_routes(app: FastAPI, jobs: Jobs, store_url: str) -> None:
    """Adds jobs and plans to an app; whoever owns the app starts and closes `jobs`, whose units `store_url` holds."""
    router = APIRouter(prefix="/v1", tags=["jobs"])
    _add_submission(router, jobs)
    _add_views(router, jobs)
    _add_wishes(router, jobs)
    _add_files(router, jobs)
    _add_dataset(router, jobs, store_url)
    app.include_router(router)


def _add_submission(router: APIRouter, jobs: Jobs) -> None:
    responses = problem_responses(400, 404, 409, 422) | {202: {"description": "queued", "headers": LOCATION}}

    @router.post("/jobs", status_code=202, summary="Submit a job", responses=responses)
    def submit(request: JobRequest, response: Response, idempotency_key: IdempotencyKey = None) -> JobView:
        job = jobs.table.submit(jobs.desk.submission(request), idempotency_key)
        jobs.dispatcher.wake()
        response.headers["Location"] = f"/v1/jobs/{job.id}"
        return JobView.of(job)

    @router.post("/plan", summary="What a job would do, why, and what it costs",
                 responses=problem_responses(400, 404, 409, 422, 503))  # fmt: skip
    async def plan(request: PlanRequest) -> PlanView:
        source, settings = await asyncio.to_thread(jobs.desk.plan, request)
        return PlanView(**await jobs.planner.plan(source, settings))


def _add_views(router: APIRouter, jobs: Jobs) -> None:
    @router.get("/jobs", summary="Jobs, the latest first", responses=problem_responses(422))
    def list_jobs(
        state: Annotated[list[State] | None, Query(description="only of these states")] = None,
        limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 50,
        before: Annotated[int | None, Query(ge=1, le=MAX_NUMBER, description="`next` of the page before")] = None,
    ) -> JobPage:
        found = jobs.table.page(states=state or (), limit=limit + 1, before=before)
        page = found[:limit]
        return JobPage(jobs=[JobView.of(job) for job in page], next=page[-1].number if len(found) > limit else None)

    @router.get("/jobs/{job_id}", summary="One job", responses=problem_responses(404, 422))
    def show_job(job_id: JobId) -> JobView:
        return JobView.of(jobs.table.get(job_id))

    @router.get(
        "/jobs/{job_id}/events",
        summary="What happens to a job, as it happens",
        description="Server-sent events `state`, `progress`, `message`, `preview`, `report`, `set_aside` and `retry`, "
        "each with JSON data and a number; the stream ends when the job has. Last-Event-ID resumes it.",
        response_class=Response,
        responses=problem_responses(404, 422) | {
            200: {"description": "the stream", "content": {"text/event-stream": {"schema": EVENT_SCHEMA}}},
            204: {"description": "the job has ended and the client has seen everything"},
        },
    )  # fmt: skip
    def events(job_id: JobId, last_event_id: Annotated[str | None, Header()] = None) -> Response:
        job = jobs.table.get(job_id)
        after = event_number(last_event_id)
        if State(job.state) in TERMINAL and after >= job.last_seq:
            return Response(status_code=204)
        stream = stream_events(jobs.database, job, after, heartbeat_s=jobs.heartbeat_s)
        return EventSourceResponse(stream, headers=STREAM_HEADERS)


def _add_wishes(router: APIRouter, jobs: Jobs) -> None:
    def wish(job_id: str, event: Event) -> JobView:
        job = jobs.table.change(job_id, event)
        jobs.dispatcher.wake()
        return JobView.of(job)

    def add(add_route: Callable[..., Any], path: str, summary: str, event: Event) -> None:
        @add_route(path, status_code=202, summary=summary, operation_id=f"{event}_job",
                   responses=problem_responses(404, 409, 422))  # fmt: skip
        def route(job_id: JobId) -> JobView:
            return wish(job_id, event)

    add(router.delete, "/jobs/{job_id}", "Cancel a job; what it computed is kept", Event.CANCEL)
    add(router.post, "/jobs/{job_id}/pause", "Stop a job until it is resumed", Event.PAUSE)
    add(router.post, "/jobs/{job_id}/resume", "Queue a paused job again", Event.RESUME)
    add(router.post, "/jobs/{job_id}/retry", "Queue a job that has ended; it computes what is missing", Event.RETRY)


def _add_files(router: APIRouter, jobs: Jobs) -> None:
    def answer(description: str, content: dict[str, Any]) -> dict[int | str, dict[str, Any]]:
        return problem_responses(404, 409, 422) | {200: {"description": description, "content": content}}

    @router.get("/jobs/{job_id}/preview.png", summary="The latest pass as a picture", response_class=Response,
                responses=answer("the picture", {"image/png": BINARY}))  # fmt: skip
    def preview(job_id: JobId) -> Response:
        job = jobs.table.get(job_id)
        content = jobs.table.file(job, PREVIEW)
        if content is None:
            raise NotReadyError(
                f"job {job_id} must have rendered something for a preview, it is {job.state}; ask later"
            )
        return Response(content, media_type="image/png", headers={"Cache-Control": "no-store"})

    @router.get("/jobs/{job_id}/result", summary="What a job computed", responses=problem_responses(404, 409, 422))
    def result(job_id: JobId) -> JobResult:
        return JobResult(**_result(jobs.table.get(job_id, with_result=True)))

    @router.get("/jobs/{job_id}/report", summary="The evaluation as a page", response_class=HTMLResponse,
                responses=answer("the page", {"text/html": {"schema": {"type": "string"}}}))  # fmt: skip
    def report(job_id: JobId) -> HTMLResponse:
        job = jobs.table.get(job_id, with_result=True)
        kept = jobs.table.file(job, REPORT)
        return HTMLResponse(kept.decode() if kept is not None else job_report(job.id, _result(job)))


def _add_dataset(router: APIRouter, jobs: Jobs, store_url: str) -> None:
    packing = asyncio.Lock()

    @router.get(
        "/jobs/{job_id}/dataset", summary="A job's frames as a dataset in one zip",
        description="References, albedo, normals and standard errors by camera path, with a manifest, as `lightwell "
        "dataset` writes them. One is packed at a time.",
        response_class=FileResponse,
        responses=problem_responses(404, 409, 422, 503)
        | {200: {"description": "the archive", "content": {"application/zip": BINARY}}},
    )  # fmt: skip
    async def dataset(job_id: JobId) -> FileResponse:
        job = await asyncio.to_thread(jobs.table.get, job_id)
        stages = job.spec.get("stages") or ()
        if job.state != State.COMPLETE or "render" not in stages:
            raise NotReadyError(
                f"job {job_id} must have rendered its frames for a dataset, it is {job.state} with {', '.join(stages)}"
            )
        if packing.locked():
            raise BusyError("one dataset is packed at a time; ask again later")
        async with packing:
            folder = pathlib.Path(await asyncio.to_thread(tempfile.mkdtemp, prefix="lightwell-dataset-"))
            try:
                await asyncio.to_thread(jobs.pack, store_url, job.spec, folder / "dataset.zip")
            except BaseException:
                shutil.rmtree(folder, ignore_errors=True)
                raise
        leave = BackgroundTask(shutil.rmtree, folder, ignore_errors=True)
        return FileResponse(
            folder / "dataset.zip", media_type="application/zip", filename=f"{job_id}.zip", background=leave
        )


def _result(job: Job) -> dict[str, Any]:
    if job.result is None:
        raise NotReadyError(f"job {job.id} must be complete for a result, it is {job.state}; watch its events")
    return job.result
