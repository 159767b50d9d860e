"""The engine: jobs on Dask workers, on this machine or many."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from service.job_runner import Event, Stop
from service.unit_task import Executor, Recycling, execute_stages
from workers.thread_policy import ThreadPolicy

if TYPE_CHECKING:
    from service.unit_request import UnitTotals
    from workers.job_spec import JobSpec


class DaskRunner:
    """Runs jobs; see `service.job_runner.JobRunner`. Its methods may be called from any thread.

    Args:
        store_url: where everything goes; every worker must reach it by this URL.
        scheduler: address of a Dask scheduler ("tcp://host:8786"); None starts a cluster of processes here.
        num_workers: processes of the own cluster.
        threads: threads of each of its processes; by default they share the cores, and training takes all.
        recycling: when worker processes are replaced by fresh ones.
        executor: what does a unit's work; the stages unless a test says otherwise.

    Raises:
        SchedulerError: no scheduler answers at the address.
    """

    def __init__(
        self, store_url: str, scheduler: str | None = None, num_workers: int = 1, *,
        threads: ThreadPolicy | None = None, recycling: Recycling | None = None, executor: Executor = execute_stages,
    ) -> None:  # fmt: skip
        from service.unit_board import UnitBoard

        self._store_url, self._closed = store_url, False
        self._board = UnitBoard(
            store_url, executor, scheduler=scheduler, num_workers=num_workers, threads=threads,
            recycling=recycling or Recycling(),
        )  # fmt: skip

    @property
    def slots(self) -> int:
        """Units that the connected workers run at once."""
        return self._board.slots

    @property
    def totals(self) -> "UnitTotals":
        """Units that ended since the start, by stage."""
        return self._board.totals

    def run(
        self, job_id: str, spec: "JobSpec", on_event: Callable[[Event], None], should_stop: Callable[[], Stop | None]
    ) -> dict[str, Any]:
        """See `service.job_runner.JobRunner.run`."""
        from service.job_run import JobRun
        from storage.store import Store

        del job_id  # units are known by what they are, not by who asked
        store = Store.open(self._store_url, create=True)
        return JobRun(self._board, store, spec, on_event, lambda: "pause" if self._closed else should_stop()).run()

    def close(self) -> None:
        """Pauses the jobs that run and ends the own cluster; a scheduler that was there already goes on."""
        self._closed = True
        self._board.close()

    def __enter__(self) -> "DaskRunner":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
