"""A job's history as server-sent events: resumable by number, kept alive, ended with the job."""

import asyncio
import json
import re
import time
from collections.abc import AsyncIterator

from fastapi.sse import format_sse_event

from service.jobs.database import Database
from service.jobs.events import history
from service.jobs.models import Job

RECONNECT_MS = 2000
HEARTBEAT_S = 10.0
POLL_S = 0.25


def event_number(last_event_id: str | None) -> int:
    """The number that a client has seen last; what is no number of ours starts from the beginning."""
    found = re.fullmatch(r"[0-9]{1,18}", last_event_id or "")
    return int(found[0]) if found else 0


async def stream_events(
    database: Database, job: Job, after: int, *, heartbeat_s: float = HEARTBEAT_S, poll_s: float = POLL_S
) -> AsyncIterator[bytes]:
    """Events after number `after`, as they are written, whichever replica runs the job; ends with the job.

    Args:
        database: where the events are.
        job: whose.
        after: the last number that the client has.
        heartbeat_s: a comment after so many seconds without an event, so that proxies keep the connection.
        poll_s: seconds between two looks at the table.
    """
    yield format_sse_event(retry=RECONNECT_MS, comment=f"events of job {job.id}")
    spoken_s = time.monotonic()
    while True:
        part = await asyncio.to_thread(history, database, job.number, after)
        for line in part.events:
            after = line.seq
            data = json.dumps({"at": line.at_s, **line.data})
            yield format_sse_event(event=line.kind, id=str(line.seq), data_str=data)
            spoken_s = time.monotonic()
        if part.ended:
            return
        if not part.events:
            if time.monotonic() - spoken_s >= heartbeat_s:
                yield format_sse_event(comment="still there")
                spoken_s = time.monotonic()
            await asyncio.sleep(poll_s)
