"""A client of a running service's jobs: requests, and the event stream with reconnection."""

import ipaddress
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from json import loads
from typing import Any
from urllib.parse import urlsplit

import httpx

from service.errors import OptionError, RequestRefusedError, UnreachableTargetError

DEFAULT_URL = "http://127.0.0.1:8000"
TIMEOUT_S = 30.0
SILENCE_S = 45.0
"""The service sends a heartbeat every 10 s: after so long without one the connection is dead."""
MAX_FAILURES = 10


@dataclass(frozen=True)
class StreamEvent:
    """One server-sent event."""

    number: int
    kind: str
    data: dict[str, Any]


def parse_events(lines: Iterator[str]) -> Iterator[StreamEvent]:
    """The events of a text/event-stream; comments and events without data are left out."""
    number, kind = 0, "message"
    data: list[str] = []
    for line in lines:
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if not line:
            if data:
                yield StreamEvent(number, kind, loads("\n".join(data)))
            kind, data = "message", []
        elif name == "id" and value.isdecimal():
            number = int(value)
        elif name == "event":
            kind = value
        elif name == "data":
            data.append(value)


class JobsClient:
    """Talks to one service.

    Args:
        url: of the service.
        token: sent as a bearer token where it is given.

    Raises:
        OptionError: the URL is no http or https URL.
    """

    def __init__(self, url: str, token: str | None = None) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise OptionError(f"--url must be a service's address such as {DEFAULT_URL}, got {url!r}")
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        # A proxy for the outside world does not reach this machine's loopback.
        self._http = httpx.Client(
            base_url=url.rstrip("/"), headers=headers, timeout=TIMEOUT_S, trust_env=not _is_local(parts.hostname)
        )

    def __enter__(self) -> "JobsClient":
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """A request's answer.

        Raises:
            UnreachableTargetError: nothing answers there.
            RequestRefusedError: the service says no, with its reason.
        """
        try:
            response = self._http.request(method, path, **options)
        except httpx.TransportError as error:
            raise UnreachableTargetError(
                f"service must answer at {self._http.base_url}, got {error or type(error).__name__}; start it with "
                "'lightwell serve --store DIR', or give --url or LIGHTWELL_URL"
            ) from error
        if not response.is_success:
            raise RequestRefusedError(refusal(response))
        return response

    def events(
        self, job_id: str, *, after: int = 0, wait: Callable[[float], None] = time.sleep
    ) -> Iterator[StreamEvent]:
        """Every event of a job until it has ended; goes on by itself where the connection breaks.

        Raises:
            UnreachableTargetError: the service stays away.
            RequestRefusedError: there is no such job, or it may not be seen.
        """
        failures = 0
        while True:
            try:
                headers = {"Accept": "text/event-stream", "Last-Event-ID": str(after)}
                timeout = httpx.Timeout(TIMEOUT_S, read=SILENCE_S)
                path = f"/v1/jobs/{job_id}/events"
                with self._http.stream("GET", path, headers=headers, timeout=timeout) as response:
                    if response.status_code == httpx.codes.NO_CONTENT:
                        return
                    if not response.is_success:
                        response.read()
                        raise RequestRefusedError(refusal(response))
                    for event in parse_events(response.iter_lines()):
                        after, failures = event.number, 0
                        yield event
            except httpx.TransportError as error:
                failures += 1
                if failures > MAX_FAILURES:
                    raise UnreachableTargetError(
                        f"service must answer at {self._http.base_url}, got {error or type(error).__name__}; "
                        f"'lightwell jobs watch {job_id}' goes on when it does"
                    ) from error
            wait(min(0.25 * 2**failures, 5.0))


def refusal(response: httpx.Response) -> str:
    """Why a service said no: its problem document's detail."""
    try:
        detail = response.json()["detail"]
    except (ValueError, KeyError, TypeError):
        detail = response.reason_phrase or "no reason given"
    return f"the service refused ({response.status_code}): {detail}"


def _is_local(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
