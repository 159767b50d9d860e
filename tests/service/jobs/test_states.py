"""The transition table, exhaustively: what is in it, what it promises, what it refuses."""

import itertools

import networkx as nx
import pytest

from service.errors import JobStateError
from service.jobs.states import HELD, TERMINAL, TRANSITIONS, WISHES, Event, State, next_state

# Written down a second time, by state, so that a slip in the table is seen.
EXPECTED: dict[State, dict[Event, State]] = {
    State.QUEUED: {
        Event.START: State.RUNNING, Event.CANCEL: State.CANCELLED, Event.PAUSE: State.PAUSED,
        Event.RESUME: State.QUEUED, Event.RETRY: State.QUEUED,
    },
    State.RUNNING: {
        Event.CANCEL: State.CANCELLING, Event.PAUSE: State.PAUSING, Event.RESUME: State.RUNNING,
        Event.STOPPED: State.QUEUED, Event.FINISH: State.COMPLETE, Event.FAIL: State.FAILED,
        Event.RELEASE: State.QUEUED,
    },
    State.PAUSING: {
        Event.CANCEL: State.CANCELLING, Event.PAUSE: State.PAUSING, Event.RESUME: State.RUNNING,
        Event.STOPPED: State.PAUSED, Event.FINISH: State.COMPLETE, Event.FAIL: State.FAILED,
        Event.RELEASE: State.PAUSED,
    },
    State.PAUSED: {Event.CANCEL: State.CANCELLED, Event.PAUSE: State.PAUSED, Event.RESUME: State.QUEUED},
    State.CANCELLING: {
        Event.CANCEL: State.CANCELLING, Event.STOPPED: State.CANCELLED, Event.FINISH: State.COMPLETE,
        Event.FAIL: State.CANCELLED, Event.RELEASE: State.CANCELLED,
    },
    State.CANCELLED: {Event.CANCEL: State.CANCELLED, Event.RETRY: State.QUEUED},
    State.FAILED: {Event.RETRY: State.QUEUED},
    State.COMPLETE: {Event.RETRY: State.QUEUED},
}  # fmt: skip
ALL = list(itertools.product(State, Event))


@pytest.mark.parametrize(("state", "event"), ALL, ids=[f"{s}-{e}" for s, e in ALL])
def test_every_pair_goes_where_it_should_or_is_refused(state: State, event: Event) -> None:
    if event in EXPECTED[state]:
        assert next_state(state, event) is EXPECTED[state][event]
    else:
        with pytest.raises(JobStateError, match=f"for {event}, got {state}"):
            next_state(state, event)


def graph() -> nx.MultiDiGraph:
    found = nx.MultiDiGraph()
    found.add_edges_from((before, after, {"event": event}) for (before, event), after in TRANSITIONS.items())
    return found


def test_every_state_is_reached_and_every_job_can_end_and_complete() -> None:
    assert nx.descendants(graph(), State.QUEUED) | {State.QUEUED} == set(State)
    for state in State:
        assert State.COMPLETE in nx.descendants(graph(), state) | {state}


def test_terminal_states_are_left_by_a_retry_only() -> None:
    leaving = {event for (before, event), after in TRANSITIONS.items() if before in TERMINAL and after != before}
    assert leaving == {Event.RETRY}


def test_whoever_holds_a_job_can_always_report_on_it() -> None:
    for state in HELD:
        for event in (Event.STOPPED, Event.FINISH, Event.FAIL, Event.RELEASE):
            assert (state, event) in TRANSITIONS and TRANSITIONS[state, event] not in HELD


def test_jobs_become_held_by_a_start_and_stay_held_by_wishes() -> None:
    entering = {event for (before, event), after in TRANSITIONS.items() if before not in HELD and after in HELD}
    staying = {event for (before, event), after in TRANSITIONS.items() if before in HELD and after in HELD}
    assert entering == {Event.START} and staying <= WISHES


@pytest.mark.parametrize("wish", [Event.CANCEL, Event.PAUSE, Event.RESUME])
def test_a_wish_may_be_repeated(wish: Event) -> None:
    for state in State:
        if (state, wish) in TRANSITIONS:
            once = next_state(state, wish)
            assert next_state(once, wish) is once
