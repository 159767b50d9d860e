"""One run of one job on one thread: what the runner reports becomes events, how it ends becomes a transition."""

import logging
import threading
import time
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from service.errors import JobStateError, LeaseLostError
from service.failures import known_errors, one_line
from service.job_runner import JobFailed, JobRunner, JobStopped, Stop
from service.jobs.leases import Leases
from service.jobs.models import Job
from service.jobs.states import Event, State
from service.jobs.table import JobTable, Lease
from workers.job_spec import JobSpec

PREVIEW, REPORT = "preview.png", "report.html"
PROGRESS_EVERY_S = 0.5
PREVIEW_EVERY_S = 2.0
WRITE_ATTEMPTS = 6
_STOP_OF_STATE: dict[State, Stop] = {State.CANCELLING: "cancel", State.PAUSING: "pause"}
log = logging.getLogger("lightwell.jobs")


class Run:
    """A claimed job, from its first unit to its last transition.

    Args:
        table, leases: where it is written down.
        job: as `Leases.claim` returned it.
    """

    def __init__(self, table: JobTable, leases: Leases, job: Job) -> None:
        self._table, self._leases, self.job = table, leases, job
        self._lease = Lease(leases.owner, job.attempts)
        self._stop: Stop | None = None
        self._shutting_down = self._is_lost = self.has_ended = False
        self._lock = threading.Lock()
        self._told_s: dict[str, float] = {}
        self._stage = ""

    def see(self, state: State | None) -> None:
        """Learns the job's state; None: this process no longer holds it, which is final."""
        self._is_lost |= state is None
        if not self._shutting_down:
            self._stop = "pause" if self._is_lost or state is None else _STOP_OF_STATE.get(state)

    def shut_down(self) -> None:
        """Asks the runner to stop because the service does: the job is released, not paused."""
        self._shutting_down, self._stop = True, "pause"

    def should_stop(self) -> Stop | None:
        """What the runner is asked to do; cheap."""
        return self._stop

    def execute(self, runner: JobRunner) -> None:
        """Runs the job and reports how it ended. Nothing but a bug of this class is raised."""
        spec = JobSpec(**{**self.job.spec, "stages": tuple(self.job.spec["stages"])})
        try:
            result = runner.run(self.job.id, spec, self.on_event, self.should_stop)
            self._end(Event.FINISH, result=result)
        except JobStopped as stopped:
            if self._shutting_down:
                self._end(Event.RELEASE, note="the service shut down")
            else:
                self._end(Event.STOPPED, note=str(stopped))
        except LeaseLostError as lost:
            log.warning("%s", lost)
        except (JobFailed, *known_errors()) as error:  # type: ignore[misc]  # a tuple of classes, made at run time
            log.warning("job %s failed: %s", self.job.id, one_line(error))
            self._end(Event.FAIL, error=one_line(error))
        except Exception as error:
            log.exception("job %s failed by a defect", self.job.id)
            self._end(Event.FAIL, error=f"the runner failed ({type(error).__name__}); the service's log has more")

    def on_event(self, event: dict[str, Any]) -> None:
        """Takes what the runner tells; frequent kinds are thinned out, and a database that is away costs no job."""
        kind = str(event.get("kind"))
        data = {key: value for key, value in event.items() if key != "kind"}
        with self._lock:
            if not self._is_due(kind, data):
                return
        try:
            if kind == "preview":
                self._table.put_file(self.job, PREVIEW, data["png"])
                data = {"url": f"/v1/jobs/{self.job.id}/preview.png"}
            elif kind == "report":
                self._table.put_file(self.job, REPORT, data["html"].encode())
                data = {"url": f"/v1/jobs/{self.job.id}/report"}
            self._leases.record(self.job.id, self._lease, kind, data)
        except LeaseLostError:
            self.see(None)
        except SQLAlchemyError as error:
            log.warning("job %s: an event was not written: %s", self.job.id, one_line(error))

    def _is_due(self, kind: str, data: dict[str, Any]) -> bool:
        every_s = {"progress": PROGRESS_EVERY_S, "preview": PREVIEW_EVERY_S}.get(kind)
        if every_s is None:
            return True
        is_edge = kind == "progress" and (data["stage"] != self._stage or data["done"] >= data["total"])
        if kind == "progress":
            self._stage = data["stage"]
        now_s = time.monotonic()
        if not is_edge and now_s - self._told_s.get(kind, -every_s) < every_s:
            return False
        self._told_s[kind] = now_s
        return True

    def _end(self, event: Event, **details: Any) -> None:
        """Writes the last transition, patiently: where the database stays away, the lease runs out instead."""
        for attempt in range(WRITE_ATTEMPTS):
            try:
                self._table.change(self.job.id, event, lease=self._lease, **details)
                return
            except LeaseLostError as lost:
                log.warning("%s", lost)
                return
            except JobStateError as wrong:
                log.error("%s", wrong)
                return
            except SQLAlchemyError as error:
                log.warning("job %s: %s was not written: %s", self.job.id, event, one_line(error))
                time.sleep(0.2 * 2**attempt)
