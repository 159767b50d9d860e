"""Which process runs which job: claim under a lease, renew it, take over what a dead process left.

Two replicas never claim the same job: the row is locked (PostgreSQL, SKIP LOCKED) or the whole database is (SQLite,
BEGIN IMMEDIATE) while it changes from queued to running. A process that loses its lease may go on for a moment until
its runner notices; what it reports then is refused, and units that both computed are the same bytes.
"""

from dataclasses import dataclass
from typing import Any

from sqlalchemy import exists, select
from sqlalchemy.orm import Session, aliased

from service.errors import LeaseLostError
from service.jobs.database import Database
from service.jobs.events import add_event
from service.jobs.models import Job
from service.jobs.owner import is_gone
from service.jobs.states import HELD, Event, State
from service.jobs.table import Lease, apply


@dataclass(frozen=True)
class Leases:
    """The leases of one dispatcher.

    Attributes:
        database: where the jobs are.
        owner: this dispatcher's name (`owner.this_owner`).
        lease_s: seconds that a lease lasts unless it is renewed.
    """

    database: Database
    owner: str
    lease_s: float

    def claim(self) -> Job | None:
        """Takes the queued job of the highest priority, the oldest of these; None where there is none.

        A job waits while another that computes the same units runs: afterwards it finds them in the store.
        """
        twin = aliased(Job)
        twin_runs = exists().where(twin.spec_digest == Job.spec_digest, twin.state.in_(HELD))
        query = select(Job).where(Job.state == State.QUEUED, ~twin_runs).order_by(Job.priority.desc(), Job.number)
        with self.database.writing() as session:
            job = session.scalar(query.limit(1).with_for_update(skip_locked=True, of=Job))
            if job is None:
                return None
            now_s = self.database.now_s(session)
            job.lease_owner, job.lease_expires_s = self.owner, now_s + self.lease_s
            return apply(session, job, Event.START, now_s)

    def renew(self) -> dict[str, State]:
        """Renews every lease of this dispatcher; returns its jobs' states, which is how wishes reach it."""
        query = select(Job).where(Job.lease_owner == self.owner, Job.state.in_(HELD)).with_for_update()
        with self.database.writing() as session:
            now_s = self.database.now_s(session)
            jobs = list(session.scalars(query))
            for job in jobs:
                job.lease_expires_s = now_s + self.lease_s
            return {job.id: State(job.state) for job in jobs}

    def held(self) -> dict[str, State]:
        """The states of this dispatcher's jobs, without renewing."""
        query = select(Job.id, Job.state).where(Job.lease_owner == self.owner, Job.state.in_(HELD))
        with self.database.reading() as session:
            return {row[0]: State(row[1]) for row in session.execute(query)}

    def take_over(self) -> list[str]:
        """Releases the jobs of processes that are gone or have not renewed their lease; returns their ids."""
        query = select(Job).where(Job.state.in_(HELD), Job.lease_owner.is_distinct_from(self.owner))
        with self.database.reading() as session:
            if not [job for job in session.scalars(query) if self._is_left(session, job)]:
                return []
        with self.database.writing() as session:
            left = list(session.scalars(query.with_for_update(skip_locked=True)))
            left = [job for job in left if self._is_left(session, job)]
            for job in left:
                note = "the process that ran this job is gone"
                apply(session, job, Event.RELEASE, self.database.now_s(session), note=note)
            return [job.id for job in left]

    def record(self, job_id: str, lease: Lease, kind: str, data: dict[str, Any]) -> None:
        """Writes an event of a run down; progress also becomes the job's own.

        Raises:
            LeaseLostError: another process runs the job now.
        """
        with self.database.writing() as session:
            job = session.scalar(select(Job).where(Job.id == job_id).with_for_update())
            if job is None or (job.lease_owner, job.attempts) != (lease.owner, lease.attempt):
                raise LeaseLostError(f"job {job_id} must be held by this process to be told about; it no longer is")
            if kind == "progress":
                job.progress = data
            add_event(session, job, kind, data, self.database.now_s(session))

    def _is_left(self, session: Session, job: Job) -> bool:
        if job.lease_owner is None or is_gone(job.lease_owner):
            return True
        return (job.lease_expires_s or 0.0) < self.database.now_s(session)
