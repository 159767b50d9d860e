"""The table of jobs on both databases: submission, pages, leases, histories."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from sqlalchemy import text, update

from service.errors import (
    IdempotencyError,
    JobDatabaseError,
    JobStateError,
    LeaseLostError,
    OptionError,
    UnknownJobError,
)
from service.jobs import owner
from service.jobs.database import Database, default_url
from service.jobs.events import history
from service.jobs.leases import Leases
from service.jobs.models import Job, Schema
from service.jobs.states import Event, State
from service.jobs.table import JobTable, Lease

Make = Callable[..., Any]
PROGRESS = {"stage": "bake", "done": 1.0, "total": 2.0, "eta_s": None, "note": ""}


def leases(table: JobTable, name: str = "elsewhere/1/0/x", lease_s: float = 60.0) -> Leases:
    """Leases of a process on another machine: only its lease tells whether it lives."""
    return Leases(table.database, name, lease_s)


def run_out(table: JobTable) -> None:
    with table.database.writing() as session:
        session.execute(update(Job).values(lease_expires_s=1.0))


def test_a_submitted_job_is_queued_and_found(table: JobTable, submission: Make) -> None:
    job = table.submit(submission("a", priority=3))
    found = table.get(job.id)
    assert (found.state, found.priority, found.attempts) == (State.QUEUED, 3, 0)
    assert found.request["scene"] == "a" and found.submitted_s > 1e9
    with pytest.raises(UnknownJobError, match="'nothing'"):
        table.get("nothing")


def test_a_key_makes_one_job_of_a_repeated_request(table: JobTable, submission: Make) -> None:
    first = table.submit(submission("a"), "key")
    assert table.submit(submission("a"), "key").id == first.id
    with pytest.raises(IdempotencyError, match=first.id):
        table.submit(submission("b"), "key")
    assert table.submit(submission("a"), "other").id != first.id
    assert len(table.page()) == 2


def test_a_key_makes_one_job_of_requests_at_once(table: JobTable, submission: Make) -> None:
    barrier = threading.Barrier(8)

    def submit(_: int) -> str:
        barrier.wait()
        return table.submit(submission("a"), "key").id

    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(submit, range(8)))) == 1
    assert len(table.page()) == 1


def test_pages_hold_every_job_once_the_latest_first(table: JobTable, submission: Make) -> None:
    made = [table.submit(submission(str(index))).id for index in range(7)]
    table.change(made[3], Event.CANCEL)
    seen, before = [], None
    while page := table.page(limit=3, before=before):
        seen += [job.id for job in page]
        before = page[-1].number
    assert seen == made[::-1]
    assert [job.id for job in table.page(states=[State.CANCELLED])] == [made[3]]
    assert table.counts() == {state: {State.QUEUED: 6, State.CANCELLED: 1}.get(state, 0) for state in State}


def test_jobs_are_claimed_by_priority_then_age(table: JobTable, submission: Make) -> None:
    for name, priority in (("low", -1), ("first", 0), ("second", 0), ("high", 9)):
        table.submit(submission(name, priority))
    held = leases(table)
    order = []
    while job := held.claim():
        order.append(job.request["scene"])
        assert (job.state, job.attempts, job.lease_owner) == (State.RUNNING, 1, held.owner)
    assert order == ["high", "first", "second", "low"]


def test_no_job_is_claimed_twice_by_many_replicas(table: JobTable, database_url: str, submission: Make) -> None:
    made = {table.submit(submission(str(index))).id for index in range(24)}
    barrier = threading.Barrier(6)

    def claim_all(number: int) -> list[str]:
        replica = Database(database_url)  # connections of its own, as another process would have
        held, claimed = Leases(replica, f"elsewhere/{number}/0/x", 60.0), []
        barrier.wait()
        misses = 0
        while misses < 3:  # SKIP LOCKED may find nothing while others hold the rows
            job = held.claim()
            misses = misses + 1 if job is None else 0
            claimed += [] if job is None else [job.id]
        replica.close()
        return claimed

    with ThreadPoolExecutor(6) as pool:
        claimed = [job_id for part in pool.map(claim_all, range(6)) for job_id in part]
    assert len(claimed) == len(set(claimed)) and set(claimed) == made


def test_a_job_waits_while_its_twin_runs(table: JobTable, submission: Make) -> None:
    first, second = table.submit(submission("a")), table.submit(submission("a"))
    held = leases(table)
    assert (claimed := held.claim()) is not None and claimed.id == first.id
    assert held.claim() is None
    table.change(first.id, Event.FINISH, lease=Lease(held.owner, 1), result={})
    assert (claimed := held.claim()) is not None and claimed.id == second.id


def test_only_the_attempt_that_holds_a_job_reports_on_it(table: JobTable, submission: Make) -> None:
    job = table.submit(submission())
    ours, theirs = leases(table), leases(table, "elsewhere/2/0/x")
    assert ours.claim() is not None
    run_out(table)
    assert theirs.take_over() == [job.id] and theirs.claim() is not None
    stale = Lease(ours.owner, 1)
    with pytest.raises(LeaseLostError):
        table.change(job.id, Event.FINISH, lease=stale, result={})
    with pytest.raises(LeaseLostError):
        ours.record(job.id, stale, "progress", PROGRESS)
    assert ours.renew() == {} and theirs.renew() == {job.id: State.RUNNING}
    assert table.change(job.id, Event.FINISH, lease=Lease(theirs.owner, 2), result={"units": 1}).state == State.COMPLETE
    assert table.get(job.id, with_result=True).result == {"units": 1}


@pytest.mark.parametrize(
    ("wish", "after"),
    [(None, State.QUEUED), (Event.PAUSE, State.PAUSED), (Event.CANCEL, State.CANCELLED)],
)
def test_what_a_dead_process_ran_goes_where_its_owner_wished(
    table: JobTable, submission: Make, wish: Event | None, after: State
) -> None:
    job = table.submit(submission())
    leases(table).claim()
    if wish is not None:
        table.change(job.id, wish)
    other = leases(table, "elsewhere/2/0/x")
    assert other.take_over() == []  # the lease has not run out
    run_out(table)
    assert other.take_over() == [job.id]
    assert table.get(job.id).state == after and table.get(job.id).lease_owner is None


def test_a_renewed_lease_is_kept(table: JobTable, submission: Make) -> None:
    job = table.submit(submission())
    held = leases(table)
    held.claim()
    run_out(table)
    assert held.renew() == {job.id: State.RUNNING} == held.held()
    assert leases(table, "elsewhere/2/0/x").take_over() == []


def test_an_owner_is_gone_when_its_process_is() -> None:
    here = owner.this_owner()
    machine, pid, created, part = here.split("/")
    assert not owner.is_gone(here)
    assert owner.is_gone(f"{machine}/{pid}/{float(created) - 1000}/{part}")  # the number was given again
    assert owner.is_gone(f"{machine}/{2**22 + 7}/{created}/{part}")
    assert not owner.is_gone(f"other-machine/{2**22 + 7}/{created}/{part}")


def test_history_is_numbered_and_resumed(table: JobTable, submission: Make) -> None:
    job = table.submit(submission())
    held = leases(table)
    held.claim()
    held.record(job.id, Lease(held.owner, 1), "progress", PROGRESS)
    part = history(table.database, job.number, 0)
    assert [(event.seq, event.kind) for event in part.events] == [(1, "state"), (2, "state"), (3, "progress")]
    assert not part.ended and table.get(job.id).progress == PROGRESS
    assert [event.seq for event in history(table.database, job.number, 0, limit=2).events] == [1, 2]
    table.change(job.id, Event.FAIL, lease=Lease(held.owner, 1), error="no light")
    last = history(table.database, job.number, 3)
    assert last.ended and [event.data["state"] for event in last.events] == ["failed"]
    assert last.events[0].data["error"] == "no light" == table.get(job.id).error


def test_a_refused_or_idle_wish_writes_nothing(table: JobTable, submission: Make) -> None:
    job = table.submit(submission())
    table.change(job.id, Event.RESUME)
    table.change(job.id, Event.CANCEL)
    table.change(job.id, Event.CANCEL)
    with pytest.raises(JobStateError, match=f"job {job.id}: .* for pause, got cancelled"):
        table.change(job.id, Event.PAUSE)
    assert [event.data["state"] for event in history(table.database, job.number, 0).events] == ["queued", "cancelled"]


def test_a_retry_forgets_how_it_ended(table: JobTable, submission: Make) -> None:
    job = table.submit(submission())
    held = leases(table)
    held.claim()
    table.change(job.id, Event.FAIL, lease=Lease(held.owner, 1), error="no light")
    again = table.change(job.id, Event.RETRY)
    assert (again.state, again.error, again.ended_s) == (State.QUEUED, None, None)
    assert (claimed := held.claim()) is not None and claimed.attempts == 2


def test_old_progress_is_pruned_and_nothing_else(
    sqlite_table: JobTable, submission: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.jobs.events.KEPT_PROGRESS", 10)
    job = sqlite_table.submit(submission())
    held = leases(sqlite_table)
    held.claim()
    with sqlite_table.database.writing() as session:
        session.execute(update(Job).values(last_seq=10_000))
    held.record(job.id, Lease(held.owner, 1), "message", {"text": "kept"})
    for _ in range(30):
        held.record(job.id, Lease(held.owner, 1), "progress", PROGRESS)
    kinds = [event.kind for event in history(sqlite_table.database, job.number, 0, limit=10_000).events]
    assert kinds.count("progress") == 10 and kinds.count("state") == 2 and kinds.count("message") == 1


def test_files_keep_their_latest_content(table: JobTable, submission: Make) -> None:
    job = table.submit(submission())
    assert table.file(job, "preview.png") is None
    table.put_file(job, "preview.png", b"one")
    table.put_file(job, "preview.png", b"two\x00\xff")
    assert table.file(job, "preview.png") == b"two\x00\xff"


def test_sqlite_writes_ahead_and_survives_a_power_cut(sqlite_table: JobTable) -> None:
    with sqlite_table.database.reading() as session:
        assert session.scalar(text("PRAGMA journal_mode")) == "wal"
        assert session.scalar(text("PRAGMA synchronous")) == 2


def test_tables_of_another_version_are_refused(database: Database, database_url: str) -> None:
    with database.writing() as session:
        session.execute(update(Schema).values(version=99))
    with pytest.raises(JobDatabaseError, match=r"schema version 1, got \[99\]"):
        Database(database_url)


@pytest.mark.parametrize("url", ["mysql://host/name", "nonsense"])
def test_other_databases_are_refused(url: str) -> None:
    with pytest.raises(OptionError, match="database must be"):
        Database(url)


def test_a_database_that_is_away_is_said_without_its_password() -> None:
    with pytest.raises(JobDatabaseError, match="must be reachable") as caught:
        Database("postgresql://user:hunter2@127.0.0.1:1/none")
    assert "hunter2" not in str(caught.value)


def test_the_default_database_lies_beside_a_local_store() -> None:
    assert default_url("/data/store") == "sqlite:////data/store/jobs.sqlite"
    with pytest.raises(OptionError, match="LIGHTWELL_DATABASE_URL"):
        default_url("s3://bucket/store")
