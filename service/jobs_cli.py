"""`lightwell jobs`: submit, list, show, watch and steer the jobs of a running service."""

import json
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.failures import EXIT_INTERRUPTED, reported
from service.options import parse_overrides, parse_size

if TYPE_CHECKING:
    from service.jobs_client import JobsClient

EXIT_UNFINISHED = 1
STAGES = ("bake", "render", "train", "evaluate")

jobs_app = typer.Typer(help="Jobs of a running service.", no_args_is_help=True)

UrlOption = Annotated[str, typer.Option("--url", envvar="LIGHTWELL_URL", help="address of the service")]
TokenOption = Annotated[
    str | None,
    typer.Option("--token", envvar="LIGHTWELL_TOKEN", help="bearer token; better in the environment", show_envvar=True),
]
JsonFlag = Annotated[bool, typer.Option("--json", help="print JSON")]
JobArgument = Annotated[str, typer.Argument(help="a job's id, as submit and list print it")]
URL = "http://127.0.0.1:8000"


def _client(url: str, token: str | None) -> "JobsClient":
    from service.jobs_client import JobsClient

    return JobsClient(url, token)


@jobs_app.command()
def submit(
    scene: Annotated[str, typer.Argument(help="a scene or bundle that the service has, or tabletop or tiny")],
    preset: Annotated[str, typer.Option("--preset", help="draft, balanced or reference")] = "balanced",
    until: Annotated[str, typer.Option("--until", help="the last stage: bake, render, train or evaluate")] = STAGES[-1],
    resolution: Annotated[str | None, typer.Option("--resolution", help="WIDTHxHEIGHT; default: the scene's")] = None,
    assignments: Annotated[list[str] | None, typer.Option("--set", help="key=value; may be given again")] = None,
    priority: Annotated[int, typer.Option("--priority", min=-100, max=100, help="higher ones start first")] = 0,
    key: Annotated[str | None, typer.Option("--idempotency-key", help="repeats with the same key are one job")] = None,
    watch_it: Annotated[bool, typer.Option("--watch", help="stay and show its progress")] = False,
    url: UrlOption = URL,
    token: TokenOption = None,
) -> None:
    """Queue a job and print its id."""
    with reported():
        from service.errors import OptionError

        if until not in STAGES:
            raise OptionError(f"--until must be one of {', '.join(STAGES)}, got {until!r}")
        width, height = parse_size(resolution, "--resolution") if resolution else (None, None)
        size = {"width": width, "height": height} if resolution else {}
        body = {"scene": scene, "preset": preset, "stages": STAGES[: STAGES.index(until) + 1], "priority": priority,
                "settings": {**size, **parse_overrides(assignments or [])}}  # fmt: skip
        with _client(url, token) as client:
            headers = {"Idempotency-Key": key} if key else {}
            job = client.request("POST", "/v1/jobs", json=body, headers=headers).json()
            print(job["id"])
            if watch_it:
                _watch(client, job["id"])


@jobs_app.command("list")
def list_jobs(
    states: Annotated[list[str] | None, typer.Option("--state", help="only these; may be given again")] = None,
    limit: Annotated[int, typer.Option("--limit", min=1, max=500, help="the latest so many")] = 20,
    as_json: JsonFlag = False,
    url: UrlOption = URL,
    token: TokenOption = None,
) -> None:
    """The latest jobs."""
    with reported():
        query: dict[str, Any] = {"limit": limit, "state": states or []}
        with _client(url, token) as client:
            jobs = client.request("GET", "/v1/jobs", params=query).json()["jobs"]
        if as_json:
            print(json.dumps(jobs, indent=2))
            return
        from rich.console import Console
        from rich.table import Table

        table = Table("id", "scene", "preset", "state", "progress", "priority", "submitted", box=None)
        for job in jobs:
            table.add_row(job["id"], job["scene"], job["preset"], job["state"], _progress(job), str(job["priority"]),
                          job["submitted"][:19].replace("T", " "))  # fmt: skip
        Console().print(table)


@jobs_app.command()
def show(job_id: JobArgument, as_json: JsonFlag = False, url: UrlOption = URL, token: TokenOption = None) -> None:
    """One job, with its result where it has one."""
    with reported(), _client(url, token) as client:
        job = client.request("GET", f"/v1/jobs/{job_id}").json()
        if job["state"] == "complete":
            job["result"] = client.request("GET", f"/v1/jobs/{job_id}/result").json()
        if as_json:
            print(json.dumps(job, indent=2))
            return
        for name in ("id", "scene", "preset", "stages", "settings", "priority", "state", "attempts", "error",
                     "submitted", "started", "ended"):  # fmt: skip
            if job[name] not in (None, {}):
                print(f"{name:>10}  {job[name]}")
        print(f"{'progress':>10}  {_progress(job)}")
        if "result" in job:
            _show_result(job["result"], f"{url}{job['links']['report']}")


@jobs_app.command()
def watch(job_id: JobArgument, url: UrlOption = URL, token: TokenOption = None) -> None:
    """Show a job's progress until it ends; exit code 0 where it is complete, else 1."""
    with reported(), _client(url, token) as client:
        _watch(client, job_id)


def _steer(job_id: str, method: str, path: str, url: str, token: str | None) -> None:
    with reported(), _client(url, token) as client:
        print(client.request(method, f"/v1/jobs/{job_id}{path}").json()["state"])


@jobs_app.command()
def cancel(job_id: JobArgument, url: UrlOption = URL, token: TokenOption = None) -> None:
    """Stop a job for good; what it computed is kept."""
    _steer(job_id, "DELETE", "", url, token)


@jobs_app.command()
def pause(job_id: JobArgument, url: UrlOption = URL, token: TokenOption = None) -> None:
    """Stop a job until it is resumed."""
    _steer(job_id, "POST", "/pause", url, token)


@jobs_app.command()
def resume(job_id: JobArgument, url: UrlOption = URL, token: TokenOption = None) -> None:
    """Queue a paused job again."""
    _steer(job_id, "POST", "/resume", url, token)


@jobs_app.command()
def retry(job_id: JobArgument, url: UrlOption = URL, token: TokenOption = None) -> None:
    """Queue a job again that has ended; it computes what is missing."""
    _steer(job_id, "POST", "/retry", url, token)


def _watch(client: "JobsClient", job_id: str) -> None:
    from rich.console import Console

    from service.jobs_watch import watch as show_events

    try:
        show_events(client.events(job_id), Console(stderr=True))
    except KeyboardInterrupt:
        print(f"lightwell: the job goes on; 'lightwell jobs watch {job_id}' shows it again", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    state = client.request("GET", f"/v1/jobs/{job_id}").json()["state"]
    if state != "complete":
        raise typer.Exit(EXIT_UNFINISHED)


def _progress(job: dict[str, Any]) -> str:
    progress = job["progress"]
    if progress is None or job["state"] == "complete":
        return "-"
    return f"{progress['stage']} {progress['done']:g}/{progress['total']:g}"


def _show_result(result: dict[str, Any], report_url: str) -> None:
    print(f"{'units':>10}  {result['units']} computed, {len(result['set_aside'])} set aside")
    for unit in result["set_aside"]:
        print(f"{'set aside':>10}  {unit['unit']}: {unit['reason']}")
    if result["evaluation"] is not None:
        from service.table import score_table
        from service.table import show as show_table

        show_table(score_table(result["evaluation"]))
        print(f"report: {report_url}")
