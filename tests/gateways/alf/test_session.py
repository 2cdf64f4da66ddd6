"""Sessions of ALF in both roles and dialects: texts and bytes from the protocol page, by hand; time is an argument."""

from typing import Any

import pytest

from gateways.alf.messages import AlfDialect, DriveCommand
from gateways.alf.session import AlfHqRole, AlfSession, VehicleRole
from tests.gateways.alf.golden import BINARY, DRIVE, DRIVES, END, INFO, MOVES, NEUTRAL, STANDS, TEXT, session
from tests.gateways.rig import drained
from zbridge.errors import Refused
from zbridge.protocol.session import Role, State


def hq(dialect: AlfDialect = TEXT, **options: Any) -> Any:
    """The session of a link that drives."""
    made = session(AlfHqRole, dialect, **options)
    made.drive(STANDS[dialect], 0.0)
    return made


def until(session: Any, end: float, *driven: tuple[float, DriveCommand]) -> list[tuple[float, bytes]]:
    """What leaves up to but not at ``end``, with its time, by the session's own deadlines."""
    sent, now, commands = [], 0.0, list(driven)
    while now < end:
        while commands and commands[0][0] <= now:
            session.drive(commands.pop(0)[1], now)
            assert session.deadline() == pytest.approx(now), "a new command goes out at once"
        sent += [(now, frame) for frame in drained(session, now)]
        due = min(session.deadline() or end, commands[0][0] if commands else end)
        assert due > now, "a timer that is due at once again"
        now = due
        session.expire(now)
    return sent


@pytest.mark.parametrize("dialect", AlfDialect)
@pytest.mark.parametrize(("kind", "role"), [(AlfHqRole, Role.HQ), (VehicleRole, Role.ROBOT)])
def test_who_is_connected_is_established_and_no_handshake_is_ever_overdue(kind, role, dialect) -> None:
    made = session(kind, dialect)
    made.expire(3600.0)
    assert (made.role, made.state, made.reason) == (role, State.ESTABLISHED, None)
    assert (drained(made), made.deadline()) == ([], None)


# The drive command


@pytest.mark.parametrize(
    ("driven", "sent_ms"),
    [
        ([], [(0, NEUTRAL), (20, NEUTRAL), (40, NEUTRAL)]),
        ([(0.007, DRIVES)], [(0, NEUTRAL), (7, DRIVE), (27, DRIVE), (47, DRIVE)]),
        ([(0.007, DRIVES), (0.015, STANDS)], [(0, NEUTRAL), (7, DRIVE), (15, NEUTRAL), (35, NEUTRAL)]),
    ],
    ids=["none", "one", "two"],
)
@pytest.mark.parametrize("dialect", AlfDialect)
def test_a_drive_link_says_speed_0_at_once_a_new_command_at_once_and_the_last_every_20_ms(
    dialect, driven, sent_ms
) -> None:
    sent = until(hq(dialect), 0.05, *((at, command[dialect]) for at, command in driven))
    assert [(round(at * 1000), frame) for at, frame in sent] == [(at, frame[dialect]) for at, frame in sent_ms]


def test_two_messages_keep_the_gap_that_is_configured() -> None:
    link = hq(gap_s=0.005)
    assert drained(link, 0.0) == [NEUTRAL[TEXT]]
    link.drive(DRIVES[TEXT], 0.001)
    assert drained(link, 0.001) == []
    assert link.deadline() == pytest.approx(0.005)
    assert drained(link, 0.005) == [DRIVE[TEXT]]


# END

SIDES = [
    pytest.param(hq, [], id="drive link"),
    pytest.param(lambda dialect: session(AlfHqRole, dialect), [], id="laser link"),
    pytest.param(lambda dialect: session(VehicleRole, dialect), [INFO], id="vehicle"),
]


@pytest.mark.parametrize("by_peer", [False, True])
@pytest.mark.parametrize("dialect", AlfDialect)
@pytest.mark.parametrize(("side", "said"), SIDES)
def test_whoever_says_end_first_each_side_says_it_once_and_nothing_follows(side, said, dialect, by_peer: bool) -> None:
    made = side(dialect)
    drained(made)
    if said:
        made.send(MOVES[dialect])
    if by_peer:
        assert made.receive(END[dialect] * 3, 0.1) == []
        made.close("gateway stopped", 0.1)
    else:
        made.close("gateway stopped", 0.1)
        assert made.receive(END[dialect], 0.1) == []
    assert made.state is State.CLOSING
    with pytest.raises(Refused, match="closing"):
        made.send(MOVES[dialect])
    assert drained(made, 0.1) == [*(frame[dialect] for frame in said), END[dialect]]
    assert (made.state, made.reason) == (State.CLOSED, "ended" if by_peer else "gateway stopped")
    assert made.receive(END[dialect] + INFO[dialect] + DRIVE[dialect], 0.2) == []
    assert (drained(made, 3600.0), made.deadline()) == ([], None)
    assert made.traffic.malformed == 0


@pytest.mark.parametrize("dialect", AlfDialect)
def test_what_came_before_end_is_delivered_and_nothing_behind_it_and_it_may_come_in_pieces(dialect: AlfDialect) -> None:
    link = hq(dialect)
    assert link.receive(INFO[dialect] * 2 + END[dialect][:1], 0.1) == [MOVES[dialect]] * 2
    assert link.state is State.ESTABLISHED
    assert link.receive(END[dialect][1:] + INFO[dialect], 0.1) == []
    assert link.state is State.CLOSING


def test_a_stop_that_waits_goes_before_end_and_the_command_that_stood_does_not() -> None:
    link = hq()
    link.drive(DRIVES[TEXT], 0.0)
    link.drive(STANDS[TEXT], 0.0, urgent=True)
    link.close("gateway stopped", 0.0)
    assert drained(link, 0.0) == [NEUTRAL[TEXT], END[TEXT]]


@pytest.mark.parametrize("written_first", [False, True])
def test_no_command_goes_behind_end_neither_the_newest_nor_one_that_comes_while_the_session_ends(written_first) -> None:
    link = hq()
    drained(link, 0.0)
    link.drive(DRIVES[TEXT], 0.0)
    link.receive(END[TEXT], 0.1)
    sent = [link.outgoing(0.1)] if written_first else []
    for urgent in (False, True):
        with pytest.raises(Refused, match="closing"):
            link.drive(DRIVES[TEXT], 0.1, urgent=urgent)
    assert sent + drained(link, 0.1) + drained(link, 0.2) == [END[TEXT]]


def test_a_session_that_was_closed_before_its_link_was_up_says_nothing() -> None:
    link = AlfHqRole(TEXT)
    link.at_first = STANDS[TEXT]
    link.close("gateway stopped", 0.0)
    link.open(0.0)
    assert drained(link, 0.0) == []


# Malformed


@pytest.mark.parametrize(
    "bad",
    [
        *(b"7|1;", DRIVE[TEXT], b"4|10|0.25;", b"1|7|5000|1|2|3|4|0|2;", b"1|7|5000|1|2|0|2;", b"255|2;"),
        *(b"\x00", bytes.fromhex("ff 00"), bytes.fromhex("02" + "00" * 24), DRIVE[BINARY][:-1] + b"\x00"),
    ],
)
def test_a_malformed_message_is_counted_shown_and_the_session_kept(bad: bytes) -> None:
    dialect = TEXT if bad.endswith(b";") else BINARY
    link: AlfSession = hq(dialect)
    for count in (1, 2):
        assert link.receive(INFO[dialect] + bad + INFO[dialect], 0.1) == [MOVES[dialect]] * 2
        assert link.traffic.malformed == count
    assert link.last_malformed
    assert len(link.last_malformed) < 300
    assert link.state is State.ESTABLISHED
    assert drained(link, 0.1) == [NEUTRAL[dialect]]
