"""The parts that jobs need, put together: table, dispatcher, the desk that checks requests, the planner."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.job_runner import JobRunner
from service.jobs.database import Database, default_url
from service.jobs.dataset import pack_apart
from service.jobs.dispatcher import Dispatcher
from service.jobs.planner import Planner
from service.jobs.states import TERMINAL, State
from service.jobs.stream import HEARTBEAT_S
from service.jobs.submission import Desk
from service.jobs.table import JobTable
from service.unit_request import UnitTotals

MAX_UNFINISHED = 10_000  # jobs looked at for a bundle that is to be deleted


class Jobs:
    """Jobs of one service process.

    Args:
        database_url: sqlite:///PATH or postgresql://...
        runner: what runs a job.
        desk: what checks a request.
        planner: what makes plans.
        pack: writes a finished job's dataset: (store's URL, job's spec, zip file).
        dispatcher_options: `num_threads`, `lease_s` and `poll_s` of the dispatcher.
        heartbeat_s: of event streams.

    Raises:
        OptionError: the URL is of no database that we support.
        JobDatabaseError: it cannot be reached, or holds tables of another version.
    """

    def __init__(
        self,
        database_url: str,
        runner: JobRunner,
        desk: Desk,
        *,
        planner: Planner | None = None,
        pack: Callable[[str, dict[str, Any], Path], None] = pack_apart,
        dispatcher_options: dict[str, float] | None = None,
        heartbeat_s: float = HEARTBEAT_S,
    ) -> None:
        self.database = Database(database_url)
        self.table = JobTable(self.database)
        self.unit_totals: UnitTotals | None = getattr(runner, "totals", None)
        self.desk, self.planner, self.heartbeat_s = desk, planner or Planner(), heartbeat_s
        self.pack = pack
        self.dispatcher = Dispatcher(self.table, runner, **(dispatcher_options or {}))  # type: ignore[arg-type]

    @classmethod
    def of_store(cls, store_url: str, runner: JobRunner, desk: Desk, database_url: str | None = None) -> "Jobs":
        """The jobs of a store: in the database that is given, else in an SQLite file beside its units."""
        return cls(database_url or default_url(store_url), runner, desk)

    def uses(self, bundle_id: str) -> bool:
        """Whether a job that is not over names the bundle."""
        unfinished = [state for state in State if state not in TERMINAL]
        jobs = self.table.page(states=unfinished, limit=MAX_UNFINISHED)
        return any(str(job.request.get("scene", "")).startswith(f"bundle:{bundle_id}") for job in jobs)

    def start(self) -> None:
        """Resumes what was left unfinished, and runs what is queued."""
        self.dispatcher.start()

    def close(self) -> None:
        """Stops between two passes; the jobs go on at the next start."""
        self.dispatcher.close()
        self.planner.close()
        self.database.close()
