"""What runs a job, as the jobs' table sees it: one blocking call with events, and two ways in which it ends early."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, Protocol

from service.errors import ServiceError

if TYPE_CHECKING:
    from workers.job_spec import JobSpec

Stop = Literal["cancel", "pause"]
Event = dict[str, Any]


class JobStopped(ServiceError):
    """A job ended because somebody asked for it; what was computed is kept."""

    def __init__(self, stop: Stop) -> None:
        super().__init__(f"job was asked to {stop}")
        self.stop = stop


class JobFailed(ServiceError):
    """A job cannot go on; the message says which unit and why."""


class JobRunner(Protocol):
    """Runs jobs, several at once from several threads."""

    def run(
        self, job_id: str, spec: "JobSpec", on_event: Callable[[Event], None], should_stop: Callable[[], Stop | None]
    ) -> dict[str, Any]:
        """Blocks until the job ended.

        Args:
            job_id: for logs.
            spec: what to run.
            on_event: told, on the calling thread, of {"kind": "progress", "stage", "done", "total", "eta_s", "note"},
                {"kind": "message", "text"}, {"kind": "preview", "png"}, {"kind": "retry", "unit", "reason", "attempt"}
                and {"kind": "set_aside", "unit", "reason", "attempts"}.
            should_stop: asked several times a second.

        Returns:
            {"evaluation": scores or None, "units": int, "set_aside": [{"unit", "reason", "attempts"}], ...}.

        Raises:
            JobStopped: `should_stop` said so, within 10 s.
            JobFailed: it cannot go on.
        """

    def close(self) -> None:
        """Ends what the runner started; runs in progress end with JobStopped("pause")."""
