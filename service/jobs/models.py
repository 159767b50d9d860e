"""The tables of the job database. Times are seconds since 1970, by the database's own clock."""

from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey, Index, Integer, LargeBinary, String, Text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

SCHEMA_VERSION = 1

BigNumber = BigInteger().with_variant(Integer, "sqlite")  # SQLite counts up "INTEGER PRIMARY KEY" alone


class Base(DeclarativeBase):
    """Root of the tables."""


class Schema(Base):
    """One row: which version of these tables the database has."""

    __tablename__ = "lightwell_schema"

    version: Mapped[int] = mapped_column(primary_key=True)


class Job(Base):
    """One job. `state` is a `states.State`; only `JobTable` writes it, through the transition table.

    Attributes:
        number: the order of submission; pages of the list go by it.
        id: what its owner calls it.
        request: what was submitted, as JSON.
        spec: the `workers.job_spec.JobSpec` made of it, as JSON.
        spec_digest: equal for jobs that compute the same units.
        attempts: how often it was started; with `lease_owner`, who may report on it.
        last_seq: number of its latest event.
    """

    __tablename__ = "jobs"

    number: Mapped[int] = mapped_column(BigNumber, primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(32), unique=True)
    request: Mapped[dict[str, Any]] = mapped_column(JSON)
    spec: Mapped[dict[str, Any]] = mapped_column(JSON)
    spec_digest: Mapped[str] = mapped_column(String(64))
    priority: Mapped[int] = mapped_column(default=0)
    state: Mapped[str] = mapped_column(String(16))
    progress: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    # Read alone: a page of the list would otherwise read every evaluation.
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True), deferred=True)
    error: Mapped[str | None] = mapped_column(Text)
    attempts: Mapped[int] = mapped_column(default=0)
    submitted_s: Mapped[float]
    changed_s: Mapped[float]
    started_s: Mapped[float | None]
    ended_s: Mapped[float | None]
    idempotency_key: Mapped[str | None] = mapped_column(String(255), unique=True)
    request_digest: Mapped[str] = mapped_column(String(64))
    lease_owner: Mapped[str | None] = mapped_column(String(255))
    lease_expires_s: Mapped[float | None]
    last_seq: Mapped[int] = mapped_column(BigNumber, default=0)

    __table_args__ = (
        Index("jobs_by_state", "state", "priority", "number"),
        Index("jobs_by_spec", "spec_digest", "state"),
    )


class JobEvent(Base):
    """One line of a job's history; `seq` counts from 1 without gaps until old progress is pruned."""

    __tablename__ = "job_events"

    job_number: Mapped[int] = mapped_column(ForeignKey("jobs.number", ondelete="CASCADE"), primary_key=True)
    seq: Mapped[int] = mapped_column(BigNumber, primary_key=True, autoincrement=False)
    at_s: Mapped[float]
    kind: Mapped[str] = mapped_column(String(32))
    data: Mapped[dict[str, Any]] = mapped_column(JSON)


class JobFile(Base):
    """The latest preview and the report of a job: here and not on a disk, so that every replica can answer."""

    __tablename__ = "job_files"

    job_number: Mapped[int] = mapped_column(ForeignKey("jobs.number", ondelete="CASCADE"), primary_key=True)
    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    at_s: Mapped[float]
    content: Mapped[bytes] = mapped_column(LargeBinary)
