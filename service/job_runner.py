"""What runs a job's stages, as the dispatcher sees it, and the two ways in which a run ends early."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, Protocol

from service.errors import ServiceError

if TYPE_CHECKING:
    from workers.job_spec import JobSpec

Stop = Literal["cancel", "pause"]
Event = dict[str, Any]


class JobStopped(ServiceError):
    """The run ended between two passes because `should_stop` asked for it.

    Attributes:
        stop: what was asked.
    """

    def __init__(self, stop: Stop) -> None:
        super().__init__(f"the job was asked to {stop}")
        self.stop: Stop = stop


class JobFailed(ServiceError):
    """The run cannot go on; the message is the reason that the job keeps."""


class JobRunner(Protocol):
    """Runs jobs. Thread-safe: the dispatcher calls `run` from several threads."""

    def run(
        self,
        job_id: str,
        spec: "JobSpec",
        on_event: Callable[[Event], None],
        should_stop: Callable[[], Stop | None],
    ) -> dict[str, Any]:
        """Blocks until the job has ended.

        Args:
            job_id: names the job in logs.
            spec: what to do; what the store holds already is not done again.
            on_event: told about the run, from any thread:
                {"kind": "progress", "stage": str, "done": float, "total": float, "eta_s": float | None, "note": str},
                {"kind": "message", "text": str}, {"kind": "preview", "png": bytes},
                {"kind": "report", "html": str} (the page with pictures, once),
                {"kind": "set_aside", "unit": str, "reason": str, "attempts": int}, {"kind": "retry", ...}.
            should_stop: asked between passes, cheap; not None: raise `JobStopped` with it within 10 s.

        Returns:
            {"evaluation": dict | None, "units": int, "set_aside": [{"unit", "reason", "attempts"}]}; units that were
            computed, not those that the store had.

        Raises:
            JobStopped: it was asked to stop.
            JobFailed: it cannot go on.
        """
        ...

    def close(self) -> None:
        """Gives up what the runner holds; no call of `run` is in progress any more."""
        ...
