"""The table of jobs: submit, look up, change the state. Every method is one transaction and may run on any thread."""

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, undefer

from service.errors import IdempotencyError, JobStateError, LeaseLostError, UnknownJobError
from service.jobs.database import Database
from service.jobs.events import add_event
from service.jobs.models import Job, JobFile
from service.jobs.states import HELD, TERMINAL, Event, State, next_state

ID_NBYTES = 8


@dataclass(frozen=True, kw_only=True)
class Submission:
    """A job to be: what was asked, what will be run, and digests of both.

    Attributes:
        request_digest: tells whether a repeated Idempotency-Key came with the same request.
        spec_digest: equal for jobs that compute the same units.
    """

    request: dict[str, Any]
    spec: dict[str, Any]
    request_digest: str
    spec_digest: str
    priority: int = 0


@dataclass(frozen=True)
class Lease:
    """The right to report on one attempt of one job."""

    owner: str
    attempt: int


class JobTable:
    """All jobs of one database."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def submit(self, submission: Submission, idempotency_key: str | None = None) -> Job:
        """Queues a job; the one that the same key and request made before is returned instead.

        Raises:
            IdempotencyError: the key came with another request before.
        """
        try:
            with self.database.writing() as session:
                known = self._with_key(session, idempotency_key)
                if known is None:
                    return self._insert(session, submission, idempotency_key)
        except IntegrityError:  # another replica inserted the same key in between
            with self.database.reading() as session:
                known = self._with_key(session, idempotency_key)
            if known is None:
                raise
        if known.request_digest != submission.request_digest:
            raise IdempotencyError(
                f"Idempotency-Key must come with one request only, got another one than that of job {known.id}; "
                "choose a new key"
            )
        return known

    def get(self, job_id: str, *, with_result: bool = False) -> Job:
        """A job.

        Raises:
            UnknownJobError: there is none of that id.
        """
        with self.database.reading() as session:
            return self._find(session, job_id, with_result=with_result)

    def page(self, *, states: Sequence[State] = (), limit: int = 50, before: int | None = None) -> list[Job]:
        """The latest jobs first, `limit` of them, older than number `before`; of these states where any is given."""
        query = select(Job).order_by(Job.number.desc()).limit(limit)
        if states:
            query = query.where(Job.state.in_(states))
        if before is not None:
            query = query.where(Job.number < before)
        with self.database.reading() as session:
            return list(session.scalars(query))

    def counts(self) -> dict[State, int]:
        """How many jobs are in each state."""
        with self.database.reading() as session:
            found = {row[0]: row[1] for row in session.execute(select(Job.state, func.count()).group_by(Job.state))}
        return {state: int(found.get(state, 0)) for state in State}

    def change(
        self,
        job_id: str,
        event: Event,
        *,
        lease: Lease | None = None,
        error: str | None = None,
        result: dict[str, Any] | None = None,
        note: str | None = None,
    ) -> Job:
        """Lets an event happen to a job.

        Args:
            job_id: the job.
            event: what happened, or what its owner wishes.
            lease: of the dispatcher that reports; None for wishes.
            error: why it failed.
            result: what it computed.
            note: told with the change of state.

        Raises:
            UnknownJobError: there is no such job.
            JobStateError: the event cannot happen in its state.
            LeaseLostError: another attempt holds the job.
        """
        with self.database.writing() as session:
            job = self._find(session, job_id, lock=True)
            if lease is not None and (job.lease_owner, job.attempts) != (lease.owner, lease.attempt):
                raise LeaseLostError(f"job {job_id} must be held by this process to be changed by it; it no longer is")
            return apply(session, job, event, self.database.now_s(session), error=error, result=result, note=note)

    def put_file(self, job: Job, name: str, content: bytes) -> None:
        """Keeps the latest content of one of a job's files."""
        with self.database.writing() as session:
            now_s = self.database.now_s(session)
            session.merge(JobFile(job_number=job.number, name=name, at_s=now_s, content=content))

    def file(self, job: Job, name: str) -> bytes | None:
        """One of a job's files; None where there is none."""
        with self.database.reading() as session:
            return session.scalar(select(JobFile.content).where(JobFile.job_number == job.number, JobFile.name == name))

    def _insert(self, session: Session, submission: Submission, key: str | None) -> Job:
        now_s = self.database.now_s(session)
        job = Job(
            id=secrets.token_hex(ID_NBYTES), request=submission.request, spec=submission.spec, attempts=0,
            request_digest=submission.request_digest, spec_digest=submission.spec_digest, last_seq=0,
            priority=submission.priority, state=State.QUEUED, submitted_s=now_s, changed_s=now_s, idempotency_key=key,
        )  # fmt: skip
        session.add(job)
        session.flush()
        add_event(session, job, "state", {"state": State.QUEUED}, now_s)
        return job

    @staticmethod
    def _with_key(session: Session, key: str | None) -> Job | None:
        return None if key is None else session.scalar(select(Job).where(Job.idempotency_key == key))

    @staticmethod
    def _find(session: Session, job_id: str, *, lock: bool = False, with_result: bool = False) -> Job:
        query = select(Job).where(Job.id == job_id)
        query = query.with_for_update() if lock else query
        query = query.options(undefer(Job.result)) if with_result else query
        job = session.scalar(query)
        if job is None:
            raise UnknownJobError(f"job must be one of this service, got {job_id!r}; GET /v1/jobs lists them")
        return job


def apply(
    session: Session,
    job: Job,
    event: Event,
    now_s: float,
    *,
    error: str | None = None,
    result: dict[str, Any] | None = None,
    note: str | None = None,
) -> Job:
    """Changes a locked job by the transition table, and writes the event down.

    Raises:
        JobStateError: the event cannot happen in the job's state.
    """
    before = State(job.state)
    try:
        after = next_state(before, event)
    except JobStateError as wrong:
        raise JobStateError(f"job {job.id}: {wrong}") from None
    if event is Event.START:
        job.attempts += 1
        job.started_s = job.started_s or now_s
    if after == before:
        return job
    job.state, job.changed_s = after, now_s
    job.ended_s = now_s if after in TERMINAL else None
    if event is Event.RETRY:
        job.error = job.result = job.progress = None
    if after not in HELD:
        job.lease_owner = job.lease_expires_s = None
    if error is not None:
        job.error = error
    if result is not None:
        job.result = result
    details = {"state": after, "event": event, "attempt": job.attempts, "error": error, "note": note}
    add_event(session, job, "state", {key: value for key, value in details.items() if value is not None}, now_s)
    return job
