"""The history of a job: numbered events that a stream can be resumed from."""

from dataclasses import dataclass
from typing import Any

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from service.jobs.database import Database
from service.jobs.models import Job, JobEvent
from service.jobs.states import TERMINAL

KEPT_PROGRESS = 500
"""Older progress is dropped: every line is a whole statement, so the later ones say all that it said."""


def add_event(session: Session, job: Job, kind: str, data: dict[str, Any], now_s: float) -> None:
    """Appends to the history of a job that this transaction has locked."""
    job.last_seq += 1
    session.add(JobEvent(job_number=job.number, seq=job.last_seq, at_s=now_s, kind=kind, data=data))
    if kind == "progress" and job.last_seq > KEPT_PROGRESS:
        old = JobEvent.seq <= job.last_seq - KEPT_PROGRESS
        session.execute(delete(JobEvent).where(JobEvent.job_number == job.number, JobEvent.kind == "progress", old))


@dataclass(frozen=True)
class History:
    """A part of a job's events.

    Attributes:
        events: in order, all after the number that was asked for, or the first of them.
        ended: the job is in a terminal state and nothing follows.
    """

    events: list[JobEvent]
    ended: bool


def history(database: Database, job_number: int, after: int, limit: int = 200) -> History:
    """Events of a job after number `after`, at most `limit`."""
    query = select(JobEvent).where(JobEvent.job_number == job_number, JobEvent.seq > after)
    with database.reading() as session:
        # The state first: on PostgreSQL each statement sees its own moment, and events come with the state.
        state = session.scalar(select(Job.state).where(Job.number == job_number))
        events = list(session.scalars(query.order_by(JobEvent.seq).limit(limit)))
    return History(events, ended=state in TERMINAL and len(events) < limit)
