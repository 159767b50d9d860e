"""The life of a job as data: one table of (state, event) -> state, and nothing else changes a state.

queued -> running -> complete | failed
  |         |-> pausing -> paused -> queued (resume)
  |         '-> cancelling -> cancelled
  '-> paused, cancelled          a retry queues what ended: the store still has what was computed
"""

from enum import StrEnum

from service.errors import JobStateError


class State(StrEnum):
    """Where a job stands."""

    QUEUED = "queued"
    RUNNING = "running"
    PAUSING = "pausing"
    PAUSED = "paused"
    CANCELLING = "cancelling"
    CANCELLED = "cancelled"
    FAILED = "failed"
    COMPLETE = "complete"


class Event(StrEnum):
    """What can happen to a job: four wishes of its owner, five reports of whoever runs it."""

    CANCEL = "cancel"
    PAUSE = "pause"
    RESUME = "resume"
    RETRY = "retry"

    START = "start"  # a dispatcher took the job
    STOPPED = "stopped"  # the runner stopped between two passes, as it was asked
    FINISH = "finish"
    FAIL = "fail"
    RELEASE = "release"  # the process that ran it shuts down or is gone


WISHES = frozenset({Event.CANCEL, Event.PAUSE, Event.RESUME, Event.RETRY})
HELD = frozenset({State.RUNNING, State.PAUSING, State.CANCELLING})
"""States in which one process has the job, under a lease."""
TERMINAL = frozenset({State.CANCELLED, State.FAILED, State.COMPLETE})
"""States that a job leaves by a retry only."""

TRANSITIONS: dict[tuple[State, Event], State] = {
    (State.QUEUED, Event.START): State.RUNNING,
    (State.QUEUED, Event.CANCEL): State.CANCELLED,
    (State.QUEUED, Event.PAUSE): State.PAUSED,
    (State.QUEUED, Event.RESUME): State.QUEUED,
    (State.QUEUED, Event.RETRY): State.QUEUED,
    (State.RUNNING, Event.CANCEL): State.CANCELLING,
    (State.RUNNING, Event.PAUSE): State.PAUSING,
    (State.RUNNING, Event.RESUME): State.RUNNING,
    # Resumed after the runner had seen the pause: it starts again.
    (State.RUNNING, Event.STOPPED): State.QUEUED,
    (State.RUNNING, Event.FINISH): State.COMPLETE,
    (State.RUNNING, Event.FAIL): State.FAILED,
    (State.RUNNING, Event.RELEASE): State.QUEUED,
    (State.PAUSING, Event.CANCEL): State.CANCELLING,
    (State.PAUSING, Event.PAUSE): State.PAUSING,
    (State.PAUSING, Event.RESUME): State.RUNNING,
    (State.PAUSING, Event.STOPPED): State.PAUSED,
    (State.PAUSING, Event.FINISH): State.COMPLETE,
    (State.PAUSING, Event.FAIL): State.FAILED,
    (State.PAUSING, Event.RELEASE): State.PAUSED,
    (State.PAUSED, Event.CANCEL): State.CANCELLED,
    (State.PAUSED, Event.PAUSE): State.PAUSED,
    (State.PAUSED, Event.RESUME): State.QUEUED,
    (State.CANCELLING, Event.CANCEL): State.CANCELLING,
    (State.CANCELLING, Event.STOPPED): State.CANCELLED,
    # The last pass ended before the wish was seen: everything is there, and saying otherwise would be wrong.
    (State.CANCELLING, Event.FINISH): State.COMPLETE,
    (State.CANCELLING, Event.FAIL): State.CANCELLED,
    (State.CANCELLING, Event.RELEASE): State.CANCELLED,
    (State.CANCELLED, Event.CANCEL): State.CANCELLED,
    (State.CANCELLED, Event.RETRY): State.QUEUED,
    (State.FAILED, Event.RETRY): State.QUEUED,
    # Computes what the store lacks: units that were set aside, or were damaged since.
    (State.COMPLETE, Event.RETRY): State.QUEUED,
}
"""What is not listed cannot happen. A wish for what is already so keeps the state, so that it may be repeated."""


def next_state(state: State, event: Event) -> State:
    """The state after an event.

    Raises:
        JobStateError: the event cannot happen in that state.
    """
    try:
        return TRANSITIONS[state, event]
    except KeyError:
        allowed = ", ".join(before for (before, what) in TRANSITIONS if what == event)
        raise JobStateError(f"job must be {allowed} for {event}, got {state}") from None
