"""The dispatcher with a runner that computes nothing: order, wishes, failures, shutdown, two replicas."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from service.jobs.dispatcher import Dispatcher
from service.jobs.events import history
from service.jobs.leases import Leases
from service.jobs.run import Run
from service.jobs.states import Event, State
from service.jobs.table import JobTable
from storage.store import Store, UnitRef
from workers.errors import WorkerError

Make = Callable[..., Any]


@pytest.fixture
def start(sqlite_table: JobTable) -> Iterator[Callable[..., Dispatcher]]:
    """Starts dispatchers of one table, and closes them."""
    started: list[Dispatcher] = []

    def make(runner: Any, table: JobTable = sqlite_table, **options: Any) -> Dispatcher:
        started.append(Dispatcher(table, runner, **{"poll_s": 0.02, **options}))
        started[-1].start()
        return started[-1]

    yield make
    for dispatcher in started:
        dispatcher.close(5)


def states(table: JobTable) -> list[str]:
    return [job.state for job in table.page()[::-1]]


def told(table: JobTable, number: int) -> list[str]:
    return [event.data["state"] for event in history(table.database, number, 0).events if event.kind == "state"]


def test_jobs_run_by_priority_one_at_a_time(
    sqlite_table: JobTable, submission: Make, runner: Any, start: Make, wait_until: Make
) -> None:
    for name, priority in (("low", -5), ("middle", 0), ("high", 5)):
        sqlite_table.submit(submission(name, priority))
    start(runner)
    wait_until(lambda: states(sqlite_table) == ["complete"] * 3)
    assert runner.ran == ["high", "middle", "low"] and runner.most_busy == 1
    job = sqlite_table.page()[0]
    assert told(sqlite_table, job.number) == ["queued", "running", "complete"]
    assert sqlite_table.file(job, "preview.png") == b"\x89PNG fake"
    assert sqlite_table.get(job.id, with_result=True).result == {"evaluation": None, "units": 3, "set_aside": []}


def test_as_many_jobs_run_at_once_as_there_are_threads(
    sqlite_table: JobTable, submission: Make, runner: Any, start: Make, wait_until: Make
) -> None:
    runner.may_end.clear()
    for name in "abcde":
        sqlite_table.submit(submission(name))
    start(runner, num_threads=3)
    wait_until(lambda: runner.busy == 3)
    time.sleep(0.1)
    runner.may_end.set()
    wait_until(lambda: states(sqlite_table) == ["complete"] * 5)
    assert runner.most_busy == 3


@pytest.mark.parametrize(("wish", "after"), [(Event.CANCEL, "cancelled"), (Event.PAUSE, "paused")])
def test_a_wish_reaches_the_run_and_can_be_undone(
    sqlite_table: JobTable, submission: Make, runner: Any, start: Make, wait_until: Make, wish: Event, after: str
) -> None:
    runner.may_end.clear()
    job = sqlite_table.submit(submission())
    dispatcher = start(runner)
    wait_until(lambda: runner.busy == 1)
    asked_s = time.monotonic()
    assert sqlite_table.change(job.id, wish).state in (State.CANCELLING, State.PAUSING)
    dispatcher.wake()
    wait_until(lambda: states(sqlite_table) == [after])
    assert time.monotonic() - asked_s < 1.0
    runner.may_end.set()
    sqlite_table.change(job.id, Event.RETRY if after == "cancelled" else Event.RESUME)
    wait_until(lambda: states(sqlite_table) == ["complete"])
    assert sqlite_table.get(job.id).attempts == 2


@pytest.mark.parametrize(
    ("failure", "words"),
    [
        (WorkerError("light must shine,\ngot none"), "light must shine, got none"),
        (MemoryError(), "not enough memory"),
        (ZeroDivisionError("secret detail"), r"the runner failed \(ZeroDivisionError\)"),
    ],
)
def test_failures_are_kept_with_their_reason_and_the_next_job_runs(
    sqlite_table: JobTable, submission: Make, runner: Any, start: Make, wait_until: Make, failure: Any, words: str
) -> None:
    runner.failure = failure
    job = sqlite_table.submit(submission("a"))
    start(runner)
    wait_until(lambda: states(sqlite_table) == ["failed"])
    error = sqlite_table.get(job.id).error
    assert error is not None and error.startswith(words.replace("\\", "")) and "secret" not in error
    runner.failure = None
    sqlite_table.submit(submission("b"))
    wait_until(lambda: states(sqlite_table) == ["failed", "complete"])


def test_a_reason_given_by_the_runner_is_the_jobs(
    sqlite_table: JobTable, submission: Make, runner: Any, start: Make, wait_until: Make, job_failed: Any
) -> None:
    runner.failure = job_failed("every worker is gone")
    job = sqlite_table.submit(submission())
    start(runner)
    wait_until(lambda: states(sqlite_table) == ["failed"])
    assert sqlite_table.get(job.id).error == "every worker is gone"


def test_a_shutdown_releases_jobs_and_the_next_start_runs_them(
    sqlite_table: JobTable, submission: Make, runner: Any, start: Make, wait_until: Make
) -> None:
    runner.may_end.clear()
    job = sqlite_table.submit(submission())
    first = start(runner)
    wait_until(lambda: runner.busy == 1)
    first.close(5)
    assert states(sqlite_table) == ["queued"] and runner.closed
    runner.may_end.set()
    start(runner)
    wait_until(lambda: states(sqlite_table) == ["complete"])
    assert told(sqlite_table, job.number) == ["queued", "running", "queued", "running", "complete"]


def test_a_start_resumes_what_a_dead_process_left(
    sqlite_table: JobTable, submission: Make, runner: Any, start: Make, wait_until: Make
) -> None:
    job = sqlite_table.submit(submission())
    Leases(sqlite_table.database, "elsewhere/1/0/x", -1.0).claim()
    assert states(sqlite_table) == ["running"]
    start(runner)
    wait_until(lambda: states(sqlite_table) == ["complete"])
    assert sqlite_table.get(job.id).attempts == 2


def test_two_replicas_share_the_queue_and_run_each_job_once(
    table: JobTable, submission: Make, runner: Any, start: Make, wait_until: Make
) -> None:
    runner.step_s = 0.002
    for index in range(12):
        table.submit(submission(str(index)))
    start(runner, table, num_threads=2)
    start(runner, table, num_threads=2)
    wait_until(lambda: states(table) == ["complete"] * 12)
    assert sorted(runner.started, key=int) == [str(index) for index in range(12)]


def test_a_job_taken_by_another_replica_is_stopped_here(
    sqlite_table: JobTable, submission: Make, runner: Any, wait_until: Make
) -> None:
    runner.may_end.clear()
    job = sqlite_table.submit(submission())
    held = Leases(sqlite_table.database, "elsewhere/1/0/x", -1.0)
    claimed = held.claim()
    assert claimed is not None
    run = Run(sqlite_table, held, claimed)
    thread = threading.Thread(target=run.execute, args=(runner,))
    thread.start()
    wait_until(lambda: runner.busy == 1)
    other = Leases(sqlite_table.database, "elsewhere/2/0/x", 60.0)
    assert other.take_over() == [job.id] and other.claim() is not None
    run.see(held.held().get(job.id))  # what the dispatcher does on every turn
    thread.join(5)
    assert not thread.is_alive() and states(sqlite_table) == ["running"]
    assert sqlite_table.get(job.id).lease_owner == other.owner


def test_frequent_progress_is_thinned_but_its_ends_are_kept(
    sqlite_table: JobTable, submission: Make, runner: Any, start: Make, wait_until: Make
) -> None:
    runner.num_steps = 300
    job = sqlite_table.submit(submission())
    start(runner)
    wait_until(lambda: states(sqlite_table) == ["complete"])
    events = history(sqlite_table.database, job.number, 0).events
    done = [event.data["done"] for event in events if event.kind == "progress"]
    assert done[0] == 1 and done[-1] == 300 and len(done) < 30


class UnitRunner:
    """Computes what a store lacks, as the engine does: a unit is its key."""

    def __init__(self, folder: Path, num_units: int) -> None:
        self.folder, self.num_units = folder, num_units
        self.computed: list[str] = []

    def run(self, job_id: str, spec: Any, on_event: Any, should_stop: Any) -> dict[str, Any]:
        store, num_new = Store.open(self.folder, create=True), 0
        for index in range(self.num_units):
            ref = UnitRef("d1", "bake", f"{spec.scene}{index}")
            if store.committed(ref) is None:
                time.sleep(0.002)
                self.computed.append(ref.key)
                store.commit(ref, {"unit": b"x"}, {})
                num_new += 1
        return {"evaluation": None, "units": num_new, "set_aside": []}

    def close(self) -> None: ...


def test_identical_jobs_share_their_units(
    sqlite_table: JobTable, submission: Make, start: Make, wait_until: Make, tmp_path: Path
) -> None:
    units = UnitRunner(tmp_path / "store", 8)
    for name in ("same", "same", "same", "other"):
        sqlite_table.submit(submission(name))
    start(units, num_threads=4)
    wait_until(lambda: states(sqlite_table) == ["complete"] * 4)
    assert len(units.computed) == len(set(units.computed)) == 16
    results = [sqlite_table.get(job.id, with_result=True).result for job in sqlite_table.page()]
    assert sorted(result["units"] for result in results if result) == [0, 0, 8, 8]
