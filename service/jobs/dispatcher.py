"""The dispatcher: claims queued jobs by priority, runs each on a thread, keeps its leases, hears of wishes.

Nothing is kept here that matters: a dispatcher that starts finds in the table which jobs were left unfinished, takes
over those of dead processes and runs them again; what they had computed is in the store.
"""

import logging
import threading
import time

from sqlalchemy.exc import SQLAlchemyError

from service.failures import one_line
from service.job_runner import JobRunner
from service.jobs.leases import Leases
from service.jobs.owner import this_owner
from service.jobs.run import Run
from service.jobs.table import JobTable

LEASE_S = 20.0
POLL_S = 0.5
CLOSE_S = 20.0
log = logging.getLogger("lightwell.jobs")


class Dispatcher:
    """Runs the jobs of a table in this process.

    Args:
        table: the jobs.
        runner: what runs one; called on several threads.
        num_threads: jobs that run at once.
        lease_s: seconds after which another replica takes the jobs of this one, had it hung.
        poll_s: seconds between two looks at the table; wishes that come by another replica wait that long.
    """

    def __init__(
        self,
        table: JobTable,
        runner: JobRunner,
        *,
        num_threads: int = 1,
        lease_s: float = LEASE_S,
        poll_s: float = POLL_S,
    ) -> None:
        self._table, self._runner, self._num_threads, self._poll_s = table, runner, num_threads, poll_s
        self._leases = Leases(table.database, this_owner(), lease_s)
        self._runs: dict[str, tuple[Run, threading.Thread]] = {}
        self._renewed_s = self._looked_s = time.monotonic()
        self._wakeup, self._closing = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._loop, name="lightwell-dispatcher", daemon=True)

    def start(self) -> None:
        """Begins; the jobs that an earlier process left are queued again before this returns."""
        for job_id in self._leases.take_over():
            log.info("job %s was left unfinished and is resumed", job_id)
        self._thread.start()

    def wake(self) -> None:
        """Looks at the table now: a job came, or somebody wished something."""
        self._wakeup.set()

    @property
    def num_running(self) -> int:
        """Jobs that this process runs now."""
        return len(self._runs)

    @property
    def is_alive(self) -> bool:
        """Whether jobs are still dispatched."""
        return self._thread.is_alive()

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """Stops the runs between two passes and releases their jobs; they go on when a service starts again.

        A run that does not stop in time keeps its lease until it runs out, or until this process is seen to be gone.
        """
        self._closing.set()
        self.wake()
        if self._thread.ident is not None:
            self._thread.join()
        deadline_s = time.monotonic() + timeout_s
        runs = list(self._runs.values())
        for run, _ in runs:
            run.shut_down()
        for run, thread in runs:
            thread.join(max(0.0, deadline_s - time.monotonic()))
            if thread.is_alive():
                log.warning("job %s did not stop in %.0f s; it is resumed at the next start", run.job.id, timeout_s)
        if not any(thread.is_alive() for _, thread in runs):
            self._runner.close()

    def _loop(self) -> None:
        while not self._closing.is_set():
            try:
                self._turn()
            except SQLAlchemyError as error:
                log.warning("the job database does not answer: %s", one_line(error))
            except Exception:
                log.exception("the dispatcher failed on this turn")
            self._wakeup.wait(self._poll_s)
            self._wakeup.clear()

    def _turn(self) -> None:
        self._runs = {job_id: pair for job_id, pair in self._runs.items() if not pair[0].has_ended}
        self._hear()
        if time.monotonic() - self._looked_s > self._leases.lease_s / 4:
            self._looked_s = time.monotonic()
            for job_id in self._leases.take_over():
                log.info("job %s was left by another process and is queued again", job_id)
        while len(self._runs) < self._num_threads and not self._closing.is_set():
            job = self._leases.claim()
            if job is None:
                break
            if job.id in self._runs:  # lost to another replica, which gave it back before our run noticed
                self._runs[job.id][0].see(None)
            run = Run(self._table, self._leases, job)
            thread = threading.Thread(target=self._execute, args=(run,), name=f"lightwell-job-{job.id}", daemon=True)
            self._runs[job.id] = (run, thread)
            thread.start()

    def _hear(self) -> None:
        """Renews the leases when it is time, and tells the runs what their owners wish."""
        if not self._runs:
            self._renewed_s = time.monotonic()
            return
        try:
            now_s = time.monotonic()
            if now_s - self._renewed_s > self._leases.lease_s / 4:
                states = self._leases.renew()
                self._renewed_s = now_s
            else:
                states = self._leases.held()
        except SQLAlchemyError:
            if time.monotonic() - self._renewed_s > self._leases.lease_s:
                for run, _ in self._runs.values():
                    run.see(None)  # by now another replica may have taken it
            raise
        for job_id, (run, _) in self._runs.items():
            if not run.has_ended:
                run.see(states.get(job_id))

    def _execute(self, run: Run) -> None:
        try:
            run.execute(self._runner)
        finally:
            run.has_ended = True
            self.wake()
