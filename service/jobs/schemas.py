"""What clients send and get: pydantic models with their limits and examples."""

from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from service.jobs.models import Job
from service.jobs.states import State
from workers.job_spec import STAGES
from workers.settings import PRESETS

Stage = Literal["bake", "render", "train", "evaluate"]
MAX_PRIORITY = 100
MAX_TEXT = 256

Text = Annotated[str, StringConstraints(min_length=1, max_length=MAX_TEXT, pattern=r"^[^\x00-\x1f\x7f]+$")]
Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
Integer = Annotated[int, Field(strict=True, ge=-(10**12), le=10**12)]
Scalar = Annotated[bool, Field(strict=True)] | Integer | Number | Text
SettingValue = Scalar | Annotated[list[Scalar], Field(max_length=64)]

EXAMPLE_REQUEST: dict[str, Any] = {"scene": "tiny", "preset": "tiny", "settings": {"frames.test_spp": 128}}
EXAMPLE_JOB: dict[str, Any] = {
    "id": "9f2c4b7a01d35e68", "scene": "tiny", "preset": "tiny", "stages": list(STAGES),
    "settings": {"frames.test_spp": 128}, "priority": 0, "state": "running", "attempts": 1, "error": None,
    "progress": {"stage": "bake diffuse", "done": 12, "total": 40, "eta_s": 71.5, "note": ""},
    "submitted": "2026-01-31T09:00:00Z", "started": "2026-01-31T09:00:01Z", "ended": None,
    "links": {"self": "/v1/jobs/9f2c4b7a01d35e68", "events": "/v1/jobs/9f2c4b7a01d35e68/events",
              "preview": "/v1/jobs/9f2c4b7a01d35e68/preview.png", "result": "/v1/jobs/9f2c4b7a01d35e68/result",
              "report": "/v1/jobs/9f2c4b7a01d35e68/report"},
}  # fmt: skip


class PlanRequest(BaseModel):
    """What a plan is made for."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [EXAMPLE_REQUEST]})

    scene: Text = Field(description="a scene or bundle that this service has, or tabletop or tiny")
    preset: str = Field(
        default="balanced", max_length=MAX_TEXT, json_schema_extra={"enum": list(PRESETS)},
        description="where the settings start",
    )  # fmt: skip
    settings: dict[Text, SettingValue] = Field(
        default_factory=dict, max_length=256,
        description='changes of single settings by dotted key, such as "cache.diffuse_spp": 256; '
        "they win over what the scene's file asks for",
    )  # fmt: skip


class JobRequest(PlanRequest):
    """A job to be."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [EXAMPLE_REQUEST | {"priority": 5}]})

    stages: list[Stage] = Field(
        default=["bake", "render", "train", "evaluate"], min_length=1, max_length=len(STAGES),
        description="how far to go: the first of bake, render, train, evaluate, in that order",
    )  # fmt: skip
    priority: int = Field(
        default=0, ge=-MAX_PRIORITY, le=MAX_PRIORITY, strict=True, description="higher ones start first"
    )


class JobProgress(BaseModel):
    """How far a job is in its present stage."""

    stage: str
    done: float
    total: float
    eta_s: float | None = Field(default=None, description="seconds that this stage still needs, where it is known")
    note: str = ""


class JobLinks(BaseModel):
    """Where a job's parts are."""

    self: str
    events: str
    preview: str
    result: str
    report: str


class JobView(BaseModel):
    """A job as clients see it."""

    model_config = ConfigDict(json_schema_extra={"examples": [EXAMPLE_JOB]})

    id: str
    scene: str
    preset: str
    stages: list[str]
    settings: dict[str, Any]
    priority: int
    state: State
    attempts: int = Field(description="how often it was started")
    progress: JobProgress | None
    error: str | None = Field(description="why it failed")
    submitted: datetime
    started: datetime | None
    ended: datetime | None
    links: JobLinks

    @classmethod
    def of(cls, job: Job) -> "JobView":
        """The view of a row."""
        base = f"/v1/jobs/{job.id}"
        links = JobLinks(self=base, events=f"{base}/events", preview=f"{base}/preview.png",
                         result=f"{base}/result", report=f"{base}/report")  # fmt: skip
        return cls(
            id=job.id, **job.request, state=State(job.state), attempts=job.attempts, error=job.error,
            progress=None if job.progress is None else JobProgress(**job.progress), links=links,
            submitted=_time(job.submitted_s), started=_time(job.started_s), ended=_time(job.ended_s),
        )  # fmt: skip


class JobPage(BaseModel):
    """A page of jobs, the latest first."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"jobs": [EXAMPLE_JOB], "next": 417}]})

    jobs: list[JobView]
    next: int | None = Field(description="give it as `before` for the next page; null on the last")


class SetAside(BaseModel):
    """A unit that was given up."""

    unit: str
    reason: str
    attempts: int


class JobResult(BaseModel):
    """What a job computed."""

    evaluation: dict[str, Any] | None = Field(description="scores, times and sizes; null where it was not evaluated")
    units: int = Field(description="units that this run computed; the others were in the store")
    set_aside: list[SetAside]


class PlanRow(BaseModel):
    """One choice and its reason."""

    item: str
    choice: str
    reason: str
    settings: list[str] = Field(default=[], description="settings that override it")
    by: Literal["plan", "you"] = Field(default="plan", description="whether such a setting was given")


class PlanCost(BaseModel):
    """What a run would cost on this machine."""

    paths: int
    seconds: float
    nbytes: int


class PlanView(BaseModel):
    """What a job would do."""

    model_config = ConfigDict(extra="allow")

    rows: list[PlanRow]
    cost: PlanCost = Field(description="of a job with these settings")
    planned_cost: PlanCost | None = Field(default=None, description="with the setting plan.mode = adaptive")
    overrides: dict[str, Any] = Field(default={}, description="settings that an adaptive plan changes")
    network_needed: bool = Field(default=True, description="false where the caches alone are predicted to do")


def _time(seconds: float | None) -> Any:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)
