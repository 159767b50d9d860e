"""`lightwell jobs` against a real server, and the client's reconnection."""

import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from rich.console import Console
from typer.testing import CliRunner, Result

from service.app import create_app
from service.cli import app as cli
from service.errors import OptionError, RequestRefusedError, UnreachableTargetError
from service.jobs.service import Jobs
from service.jobs.submission import Desk
from service.jobs_client import JobsClient, StreamEvent, parse_events
from service.jobs_watch import watch
from service.scene_sources import SceneSources
from workers.scene_request import SceneRequest

Make = Callable[..., Any]


@pytest.fixture
def url(tmp_path: Path, runner: Any, backend: Any, serve_app: Make, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    wish = SceneRequest(name="tiny", width=8, height=8)
    desk = Desk(resolve_scene_source=SceneSources().resolve_scene_source, read_scene=lambda _: wish)
    options = {"poll_s": 0.02}
    jobs = Jobs(f"sqlite:///{tmp_path / 'jobs.sqlite'}", runner, desk, dispatcher_options=options)
    with serve_app(create_app("unused", make_backend=lambda: backend, jobs=jobs)) as address:
        monkeypatch.setenv("LIGHTWELL_URL", address)
        yield address


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["jobs", *arguments])


def submitted(*arguments: str) -> str:
    result = invoke("submit", "tiny", "--preset", "tiny", *arguments)
    assert result.exit_code == 0, result.output
    return result.stdout.split()[0]


def test_submit_watch_and_show_a_job(url: str) -> None:
    job_id = submitted("--set", "cache.polar=3", "--resolution", "16x8", "--priority", "2", "--until", "render")
    watched = invoke("watch", job_id)
    assert watched.exit_code == 0, watched.output
    lines = watched.stderr.splitlines()
    assert lines[0] == "queued" and lines[-1] == "complete" and "bake: done" in lines
    shown = invoke("show", job_id).stdout
    assert "units  3 computed, 0 set aside" in shown and "complete" in shown
    job = json.loads(invoke("show", job_id, "--json").stdout)
    assert job["settings"] == {"width": 16, "height": 8, "cache.polar": "3"}
    assert (job["stages"], job["priority"], job["result"]["units"]) == (["bake", "render"], 2, 3)


def test_submit_with_watch_stays_to_the_end(url: str) -> None:
    result = invoke("submit", "tiny", "--preset", "tiny", "--watch")
    assert result.exit_code == 0 and result.stderr.splitlines()[-1] == "complete"


def test_a_key_makes_a_repeat_the_same_job(url: str) -> None:
    assert submitted("--idempotency-key", "k") == submitted("--idempotency-key", "k")


def test_jobs_are_steered_and_listed(url: str, runner: Any, wait_until: Make) -> None:
    runner.may_end.clear()
    job_id = submitted()
    wait_until(lambda: runner.busy == 1)
    assert invoke("pause", job_id).stdout.strip() == "pausing"
    wait_until(lambda: "paused" in invoke("list").stdout)
    assert invoke("resume", job_id).stdout.strip() == "queued"
    wait_until(lambda: runner.busy == 1)
    assert invoke("cancel", job_id).stdout.strip() == "cancelling"
    wait_until(lambda: json.loads(invoke("list", "--json").stdout)[0]["state"] == "cancelled")
    assert invoke("watch", job_id).exit_code == 1
    assert invoke("list", "--state", "complete", "--json").stdout.strip() == "[]"
    runner.may_end.set()
    assert invoke("retry", job_id).stdout.strip() == "queued"
    assert invoke("watch", job_id).exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("submit", "attic"), "the service refused (404): scene must be one of tabletop, tiny"),
        (("submit", "tiny", "--set", "cache.colour=1"), "cache.colour"),
        (("submit", "tiny", "--until", "paint"), "--until must be one of"),
        (("show", "0123"), "(404): job must be one"),
        (("watch", "0123"), "(404): job must be one"),
        (("list", "--url", "ftp://x"), "--url must be a service's address"),
        (("list", "--url", "http://127.0.0.1:9"), "lightwell serve"),
    ],
)
def test_mistakes_are_one_line(url: str, arguments: tuple[str, ...], words: str) -> None:
    result = invoke(*arguments)
    assert result.exit_code == 2, result.output
    assert words in result.stderr and result.stderr.count("\n") == 1 and "Traceback" not in result.output


def client_of(answers: list[Any]) -> JobsClient:
    """A client whose server gives these answers, one a request; notes the requests in `client.seen`."""
    client = JobsClient("http://127.0.0.1:8000", "secret")
    client.seen = []  # type: ignore[attr-defined]

    def answer(request: httpx.Request) -> httpx.Response:
        client.seen.append(request)  # type: ignore[attr-defined]
        given = answers.pop(0) if answers else httpx.ConnectError("refused")
        if isinstance(given, Exception):
            raise given
        return given

    headers = client._http.headers
    client._http = httpx.Client(base_url="http://x", headers=headers, transport=httpx.MockTransport(answer))
    return client


def test_a_broken_stream_goes_on_after_the_last_event() -> None:
    first = httpx.Response(200, text='id: 7\nevent: state\ndata: {"state": "running"}\n\nid: 8\ndata: {"half')
    last = httpx.Response(200, text=': hello\n\nid: 8\nevent: progress\ndata: {"done":\ndata: 1}\n\n')
    waits: list[float] = []
    client = client_of([first, httpx.ReadTimeout("silence"), last, httpx.Response(204)])
    events = list(client.events("abc", wait=waits.append))
    assert events == [StreamEvent(7, "state", {"state": "running"}), StreamEvent(8, "progress", {"done": 1})]
    assert [request.headers["last-event-id"] for request in client.seen] == ["0", "7", "7", "8"]  # type: ignore[attr-defined]
    assert client.seen[0].headers["authorization"] == "Bearer secret"  # type: ignore[attr-defined]
    assert len(waits) == 3 and waits[1] > waits[0]


def test_a_service_that_stays_away_ends_the_watch() -> None:
    with pytest.raises(UnreachableTargetError, match="lightwell jobs watch abc"):
        list(client_of([]).events("abc", wait=lambda _: None))


def test_a_refusal_without_a_problem_document_is_still_told() -> None:
    with pytest.raises(RequestRefusedError, match=r"\(502\): Bad Gateway"):
        client_of([httpx.Response(502, text="<html>")]).request("GET", "/v1/jobs")


def test_a_url_that_is_none_is_refused() -> None:
    with pytest.raises(OptionError):
        JobsClient("127.0.0.1:8000")


def test_parse_events_skips_comments_and_empty_events() -> None:
    lines = [": ping", "", "retry: 5", "", "event: x", "", "id: 3", 'data: {"a": 1}', ""]
    assert list(parse_events(iter(lines))) == [StreamEvent(3, "message", {"a": 1})]


@pytest.mark.parametrize("terminal", [True, False])
def test_watch_shows_progress_and_what_is_said(terminal: bool) -> None:
    def progress(done: float) -> StreamEvent:
        data = {"stage": "bake [1]", "done": done, "total": 4.0, "eta_s": 90.0, "note": "loss [2]"}
        return StreamEvent(1, "progress", data)

    events = [
        StreamEvent(1, "state", {"state": "running"}), progress(1), progress(2), progress(4),
        StreamEvent(2, "set_aside", {"unit": "u1", "reason": "NaN", "attempts": 3}),
        StreamEvent(3, "retry", {"at": 1, "unit": "u2", "attempt": 2}),
        StreamEvent(4, "message", {"text": "note: [x]"}),
        StreamEvent(5, "state", {"state": "failed", "error": "no light"}),
    ]  # fmt: skip
    console = Console(file=io.StringIO(), force_terminal=terminal, width=140, color_system=None)
    assert watch(events, console)["state"] == "failed"
    text = console.file.getvalue()  # type: ignore[attr-defined]
    for words in ("bake [1]", "set aside after 3 attempts: u1: NaN", "retry: unit u2", "note: [x]", "failed: no light"):
        assert words in text
    assert ("100%" in text and "loss [2]" in text) is terminal
    assert ("bake [1]: …" in text and text.count("bake [1]: done") == 1) is not terminal
