"""The table of a session's states, and that a session does what it says."""

from collections.abc import Callable

import pytest

from tests.protocol.test_session import LIMITS, Toy, play
from zbridge.protocol.session import State
from zbridge.protocol.session_states import TRANSITIONS, SessionEvent

ORDER = list(State)
EVENTS: dict[SessionEvent, Callable[[Toy], object]] = {
    SessionEvent.OPEN: lambda session: session.open(1.0),
    SessionEvent.AGREED: lambda session: session.establish("2.0", ()),
    SessionEvent.CLOSE: lambda session: session.close("closed by us", 1.0),
    SessionEvent.WRITTEN: lambda session: session.outgoing(1.0),
    SessionEvent.OVERDUE: lambda session: session.expire(1.0 + LIMITS.handshake_s),
    SessionEvent.LOST: lambda session: session.fail("closed by peer"),
}


TO = {
    State.CONNECTING: "",
    State.HANDSHAKING: "open; out = hello",
    State.ESTABLISHED: "open; out = hello; hear welcome =",
    State.CLOSING: "open; out = hello; close over",
    State.CLOSED: "lost over",
}


@pytest.mark.parametrize("event", SessionEvent)
@pytest.mark.parametrize("state", State)
def test_a_session_obeys_the_table_and_ignores_what_it_does_not_name(state: State, event: SessionEvent) -> None:
    session = Toy(LIMITS)
    play(session, TO[state])
    assert session.state is state
    wanted = TRANSITIONS[state].get(event, state)
    EVENTS[event](session)
    assert session.state is wanted


def test_every_state_has_a_row_and_every_event_a_place_and_a_session_only_moves_down() -> None:
    steps = [(state, event, wanted) for state, row in TRANSITIONS.items() for event, wanted in row.items()]
    assert list(TRANSITIONS) == ORDER
    assert {event for _, event, _ in steps} == set(SessionEvent)
    for state, event, wanted in steps:
        again = (state, event) == (State.ESTABLISHED, SessionEvent.AGREED)
        assert ORDER.index(wanted) >= ORDER.index(state) + (not again)
