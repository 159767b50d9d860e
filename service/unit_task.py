"""What runs on a Dask worker: one unit, watched by whoever wants it.

A unit goes on only while somebody wants its key. A client that releases the key, or goes away, makes the scheduler free
it; the worker then marks the task as cancelled, and the unit sees that between two passes. So nothing has to be sent to
stop a unit, and two services that want the same one do not stop it for each other.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from workers.errors import StoppedError
from workers.job_spec import JobSpec
from workers.progress import Advance, Progress
from workers.thread_policy import ThreadPolicy
from workers.units import Unit

if TYPE_CHECKING:
    from distributed import Worker

    from workers.evaluate import Evaluation

TOPIC = "lightwell-units"
SECONDS_BETWEEN_EVENTS = 0.5
_units_done = 0


class UnitError(Exception):
    """A unit failed. Holds text only: what workers raise cannot always be sent to another process."""


class Executor(Protocol):
    """Does one unit's work; see `workers.unit_execution.execute`. It is sent to the workers."""

    def __call__(self, unit: Unit, spec: JobSpec, store_url: str, progress: Progress) -> Any: ...


@dataclass(frozen=True)
class Recycling:
    """When a worker process is replaced by a fresh one, between two units.

    Attributes:
        units: after this many.
        memory_share: when it holds more than this share of its memory limit.
    """

    units: int = 500
    memory_share: float = 0.7


def execute_stages(unit: Unit, spec: JobSpec, store_url: str, progress: Progress) -> Any:
    """The executor of real runs."""
    from workers.unit_execution import execute

    policy = ThreadPolicy.from_environment()
    if policy is not None:
        policy.apply(unit.stage)
    return execute(unit, spec, store_url, progress, _report)


def _report(evaluation: "Evaluation") -> bytes:
    from service.report import render_report

    return render_report(evaluation).encode()


class UnitProgress(Progress):
    """Sends a unit's progress to whoever listens, and ends it when nobody wants it any more."""

    def __init__(self, worker: "Worker", key: str) -> None:
        self._worker, self._key = worker, key
        self._told = 0.0

    @contextmanager
    def track(self, description: str, total: float) -> Iterator[Advance]:
        done = 0.0

        def advance(amount: float = 1.0, note: str = "") -> None:
            nonlocal done
            done += amount
            now = time.monotonic()
            if now - self._told >= SECONDS_BETWEEN_EVENTS:
                self._told = now
                text = f"{description}: {note}" if note else description
                self.tell("progress", done=done, total=total, note=text)
            self.between_passes()

        yield advance

    def between_passes(self) -> None:
        state = self._worker.state.tasks.get(self._key)
        closing = self._worker.status.name in ("closing", "closed", "failed")
        if closing or state is None or state.state == "cancelled":
            raise StoppedError(f"unit {self._key} is not wanted any more; it goes on where it was when asked for again")

    def message(self, text: str) -> None:
        self.tell("message", text=text)

    def tell(self, kind: str, **values: Any) -> None:
        """Sends an event of this unit to every client that listens to `TOPIC`."""
        self._worker.log_event(TOPIC, {"key": self._key, "kind": kind, **values})


def run_unit(
    executor: Executor, unit: Unit, spec: JobSpec, store_url: str, key: str, recycling: Recycling
) -> Any:  # fmt: skip
    """Runs a unit on a Dask worker.

    Raises:
        StoppedError: nobody wants it any more.
        UnitError: it failed.
    """
    from distributed import get_worker

    worker = get_worker()
    progress = UnitProgress(worker, key)
    progress.tell("began", name=str(worker.name), address=worker.address)  # Dask itself sets "worker"
    try:
        return executor(unit, spec, store_url, progress)
    except StoppedError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or "no reason given"
        raise UnitError(f"{type(error).__name__}: {reason}") from None
    finally:
        progress.tell("ended")
        _recycle(worker, recycling)


def _recycle(worker: "Worker", recycling: Recycling) -> None:
    """Asks for a fresh process where this one has done its share; memory of Dr.Jit and torch is never given back."""
    global _units_done
    _units_done += 1
    limit_nbytes = worker.memory_manager.memory_limit
    full = limit_nbytes and worker.monitor.proc.memory_info().rss > recycling.memory_share * limit_nbytes
    if worker.nanny and (full or _units_done >= recycling.units) and worker.status.name == "running":
        worker.loop.add_callback(worker.close_gracefully, restart=True, reason="lightwell-recycled")
