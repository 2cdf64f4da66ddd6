"""Sessions of ALF in both roles and dialects: texts and bytes from the protocol page, by hand; time is an argument."""

import contextlib
import random
from itertools import pairwise

import numpy as np
import pytest

from gateways.alf.messages import AlfMessage, Dialect, DriveCommand, DriveInfo, Measurement, ScannerInit
from gateways.alf.session import AlfSession, HqRole, VehicleRole
from tests.gateways.rig import drained, exchange
from zbridge.errors import Refused
from zbridge.protocol.session import Role, State

TEXT, BINARY = Dialect.TEXT, Dialect.BINARY
NEUTRAL, AHEAD, BACK = (DriveCommand(0, 0, 0, False), DriveCommand(80, 0, -30, True), DriveCommand(50, 1, 30, False))
NEUTRAL_TEXT, AHEAD_TEXT, BACK_TEXT = b"3|0|0|0|0;", b"3|80|0|-30|1;", b"3|50|1|30|0;"
END = {TEXT: b"255|1;", BINARY: bytes.fromhex("ff 01")}
INFO = {
    TEXT: b"4|10|0.250000|-0.500000|1.000000|1.500000|-2.700000|123.400000|36.500000;",
    BINARY: bytes.fromhex("04 0a fa00 0cfe e803 0f00 e5ff d204 00001242"),
}
INFO_MESSAGE = {
    TEXT: DriveInfo(10, 0.25, -0.5, 1.0, 1.5, -2.7, 123.4, 36.5),
    BINARY: DriveInfo(10, 250, -500, 1000, 15, -27, 1234, 36.5),
}
COMMAND = {TEXT: AHEAD_TEXT, BINARY: bytes.fromhex("03 50 00 3c 01")}
COMMAND_MESSAGE = {TEXT: AHEAD, BINARY: DriveCommand(80, 0, 60, True)}


def hq(dialect: Dialect = TEXT, drives: DriveCommand | None = NEUTRAL, *, points: int = 3) -> HqRole:
    session = HqRole(dialect, points=points, drives=drives)
    session.open(0.0)
    return session


def vehicle(dialect: Dialect = TEXT) -> VehicleRole:
    session = VehicleRole(dialect, points=3)
    session.open(0.0)
    return session


def until(
    session: AlfSession, start: float, end: float, *driven: tuple[float, DriveCommand]
) -> list[tuple[float, bytes]]:
    """What leaves from ``start`` up to but not at ``end``, with its time, by the session's own deadlines."""
    sent, now, commands = [], start, list(driven)
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


# Who is connected is established


@pytest.mark.parametrize("dialect", Dialect)
@pytest.mark.parametrize(("kind", "role"), [(HqRole, Role.HQ), (VehicleRole, Role.ROBOT)])
def test_who_is_connected_is_established_and_no_handshake_is_ever_overdue(kind, role, dialect) -> None:
    session = kind(dialect)
    before = session.state
    session.open(0.0)
    assert before is State.CONNECTING
    assert (session.role, session.state, session.reason) == (role, State.ESTABLISHED, None)
    assert drained(session, 0.0) == []
    session.expire(3600.0)
    assert session.state is State.ESTABLISHED
    assert session.deadline() is None


# The drive command


@pytest.mark.parametrize(
    ("driven", "end", "sent_ms"),
    [
        ([], 0.05, [(0, NEUTRAL_TEXT), (20, NEUTRAL_TEXT), (40, NEUTRAL_TEXT)]),
        ([(0.0, AHEAD)], 0.03, [(0, AHEAD_TEXT), (20, AHEAD_TEXT)]),
        ([(0.007, AHEAD)], 0.03, [(0, NEUTRAL_TEXT), (7, AHEAD_TEXT), (27, AHEAD_TEXT)]),
        ([(0.007, AHEAD), (0.015, BACK)], 0.03, [(0, NEUTRAL_TEXT), (7, AHEAD_TEXT), (15, BACK_TEXT)]),
    ],
)
def test_a_drive_link_says_speed_0_at_once_a_new_command_at_once_and_the_last_every_20_ms(
    driven: list[tuple[float, DriveCommand]], end: float, sent_ms: list[tuple[int, bytes]]
) -> None:
    assert [(round(at * 1000), frame) for at, frame in until(hq(), 0.0, end, *driven)] == sent_ms


@pytest.mark.parametrize(
    ("dialect", "neutral"), [(TEXT, NEUTRAL_TEXT), (BINARY, bytes.fromhex("03 00 00 5a 00"))], ids=["text", "binary"]
)
def test_a_command_is_repeated_for_as_long_as_the_link_stands(dialect: Dialect, neutral: bytes) -> None:
    sent = until(hq(dialect, drives_of(dialect)), 0.0, 120.0)
    assert {frame for _, frame in sent} == {neutral}
    assert 5990 <= len(sent) <= 6010
    assert max(later - earlier for (earlier, _), (later, _) in pairwise(sent)) < 0.0201


def test_an_urgent_command_replaces_what_stands_and_goes_first() -> None:
    session = hq()
    session.drive(AHEAD, 0.0)
    session.drive(NEUTRAL, 0.0, urgent=True)
    assert [frame for _, frame in until(session, 0.0, 0.05)] == [NEUTRAL_TEXT] * 3


def test_a_link_that_took_nothing_for_long_gets_the_newest_command_alone_and_no_burst() -> None:
    session = hq()
    until(session, 0.0, 0.1)
    for speed in range(100):
        session.drive(DriveCommand(speed, 0, 0, False), 0.1 + speed / 1e6)
    assert drained(session, 0.11) == [b"3|99|0|0|0;"]
    assert drained(session, 10.0) == [b"3|99|0|0|0;"]
    assert session.deadline() == pytest.approx(10.02)


def test_two_messages_keep_the_gap_that_is_configured() -> None:
    session = HqRole(TEXT, drives=NEUTRAL, gap_s=0.005)
    session.open(0.0)
    assert drained(session, 0.0) == [NEUTRAL_TEXT]
    session.drive(AHEAD, 0.001)
    assert drained(session, 0.001) == []
    assert session.deadline() == pytest.approx(0.005)
    assert drained(session, 0.005) == [AHEAD_TEXT]


@pytest.mark.parametrize("dialect", Dialect)
def test_a_laser_link_says_nothing_but_end_and_a_vehicle_what_it_is_told_to_and_repeats_nothing(
    dialect,
) -> None:
    laser, robot = hq(dialect, None), vehicle(dialect)
    robot.send(INFO_MESSAGE[dialect])
    assert robot.receive(COMMAND[dialect], 0.0) == [COMMAND_MESSAGE[dialect]]
    assert laser.receive(INFO[dialect], 0.0) == [INFO_MESSAGE[dialect]]
    assert drained(robot, 0.0) == [INFO[dialect]]
    for session in (laser, robot):
        assert session.deadline() is None
        assert drained(session, 3600.0) == []
        session.close("done", 3600.0)
        assert drained(session, 3600.0) == [END[dialect]]


# END

SIDES = [
    pytest.param(lambda dialect: hq(dialect, drives_of(dialect)), id="drive link"),
    pytest.param(lambda dialect: hq(dialect, None), id="laser link"),
    pytest.param(vehicle, id="vehicle"),
]


def drives_of(dialect: Dialect) -> DriveCommand:
    return NEUTRAL if dialect is TEXT else DriveCommand(0, 0, 90, False)


@pytest.mark.parametrize("dialect", Dialect)
@pytest.mark.parametrize("side", SIDES)
def test_end_is_answered_once_and_nothing_follows(side, dialect: Dialect) -> None:  # type: ignore[no-untyped-def]
    session = side(dialect)
    drained(session, 0.0)
    assert session.receive(END[dialect] * 3, 0.1) == []
    assert (session.state, session.reason) == (State.CLOSING, "ended")
    assert drained(session, 0.1) == [END[dialect]]
    assert (session.state, session.reason) == (State.CLOSED, "ended")
    assert session.receive(END[dialect], 0.2) == []
    assert until(session, 0.2, 3600.0) == []
    assert session.deadline() is None
    assert session.traffic.malformed == 0
    session.lost("closed by peer")
    assert session.reason == "ended"


@pytest.mark.parametrize("dialect", Dialect)
@pytest.mark.parametrize("side", SIDES)
def test_end_is_said_once_when_we_close_and_its_answer_is_not_answered(  # type: ignore[no-untyped-def]
    side, dialect: Dialect
) -> None:
    session = side(dialect)
    drained(session, 0.0)
    session.close("gateway stopped", 0.1)
    session.close("and again", 0.1)
    assert session.receive(END[dialect], 0.1) == []
    assert drained(session, 0.1) == [END[dialect]]
    assert (session.state, session.reason) == (State.CLOSED, "gateway stopped")
    assert session.receive(END[dialect], 0.2) == []
    assert until(session, 0.2, 3600.0) == []


@pytest.mark.parametrize("dialect", Dialect)
def test_what_came_before_end_is_delivered_and_nothing_behind_it_and_it_may_come_in_pieces(dialect: Dialect) -> None:
    session = hq(dialect)
    assert session.receive(INFO[dialect] * 2 + END[dialect][:1], 0.1) == [INFO_MESSAGE[dialect]] * 2
    assert session.state is State.ESTABLISHED
    assert session.receive(END[dialect][1:] + INFO[dialect], 0.1) == []
    assert (session.state, session.reason) == (State.CLOSING, "ended")
    assert session.receive(INFO[dialect], 0.1) == []


def test_a_stop_that_waits_goes_before_end_and_the_command_that_stood_does_not() -> None:
    session = hq()
    session.drive(AHEAD, 0.0)
    session.drive(NEUTRAL, 0.0, urgent=True)
    session.close("gateway stopped", 0.0)
    assert drained(session, 0.0) == [NEUTRAL_TEXT, END[TEXT]]


@pytest.mark.parametrize("written_first", [False, True])
def test_no_command_goes_behind_end_neither_the_newest_nor_one_that_comes_while_the_session_ends(written_first) -> None:
    session = hq()
    drained(session, 0.0)
    session.drive(AHEAD, 0.0)
    session.receive(END[TEXT], 0.1)
    sent = [session.outgoing(0.1)] if written_first else []
    for urgent in (False, True):
        with contextlib.suppress(Refused):
            session.drive(AHEAD, 0.1, urgent=urgent)
    assert sent + drained(session, 0.1) + drained(session, 0.2) == [END[TEXT]]
    assert session.state is State.CLOSED


def test_a_vehicle_sends_nothing_behind_end_whatever_it_still_measures() -> None:
    session = vehicle()
    session.send(INFO_MESSAGE[TEXT])
    session.close("vehicle stopped", 0.1)
    with contextlib.suppress(Refused):
        session.send(INFO_MESSAGE[TEXT])
    assert drained(session, 0.1) == [INFO[TEXT], END[TEXT]]
    assert session.state is State.CLOSED


def test_a_peer_that_takes_no_end_is_left_after_half_a_second() -> None:
    session = hq()
    session.close("gateway stopped", 1.0)
    assert session.deadline(writing=False) == pytest.approx(1.5)
    session.expire(1.5)
    assert session.state is State.CLOSED


@pytest.mark.parametrize("dialect", Dialect)
def test_a_connection_that_breaks_is_lost_at_once_and_nothing_is_written_or_waited_for(dialect: Dialect) -> None:
    session = hq(dialect, drives_of(dialect))
    session.lost("closed by peer")
    assert (session.state, session.reason) == (State.CLOSED, "closed by peer")
    assert (drained(session, 0.0), session.deadline()) == ([], None)
    session = HqRole(dialect, drives=NEUTRAL)
    session.close("gateway stopped", 0.0)  # before it was connected
    session.open(0.0)
    assert drained(session, 0.0) == []


# Malformed


@pytest.mark.parametrize(
    "bad",
    [
        b"7|1;",
        b"3|80|0|30|1;",
        b"4|10|0.25;",
        b"4|10|0.250000|-0.500000|1.000000|1.500000|-2.700000|123.400000|1" + b"0" * 400 + b";",
        b"4|10|nan|-0.500000|1.000000|1.500000|-2.700000|123.400000|36.500000;",
        b"1|7|5000|1|2|3|4|0|2;",
        b"1|7|5000|1|2|0|2;",
        b"1|1" + b"0" * 400 + b"|5000|1|2|3|0|2;",
        b"1|7|1" + b"0" * 400 + b"|1|2|3|0|2;",
        b"1|7|5000|1|2|1" + b"0" * 400 + b"|0|2;",
        b"255|2;",
        b";",
        b"\xff\xfe\x00;",
        b"\x00",
        b"\x05",
        bytes.fromhex("ff 00"),
        bytes.fromhex("04 0a fa00 0cfe e803 0f00 e5ff d204 0000c07f"),
        bytes.fromhex("02" + "00" * 24),
        bytes.fromhex("03 50 00 78 00"),
    ],
)
def test_a_malformed_message_is_counted_shown_and_the_session_kept(bad: bytes) -> None:
    dialect = TEXT if bad.endswith(b";") else BINARY
    session = hq(dialect, drives_of(dialect))
    for count in (1, 2):
        assert session.receive(INFO[dialect] + bad + INFO[dialect], 0.1) == [INFO_MESSAGE[dialect]] * 2
        assert session.traffic.malformed == count
    assert session.last_malformed
    assert len(session.last_malformed) < 300
    assert session.state is State.ESTABLISHED
    assert len(drained(session, 0.1)) == 1


def test_a_measurement_with_another_number_of_points_says_so() -> None:
    session = HqRole(TEXT)
    session.open(0.0)
    session.receive(b"1|7|5000|" + b"1000|" * 768 + b"44|725;", 0.1)
    assert session.last_malformed == "measurement of 768 points, expected 769"
    session.receive(b"1|7|5000|" + b"1000|" * 770 + b"44|725;", 0.1)
    assert session.last_malformed == "measurement of 770 points, expected 769"
    assert len(session.receive(b"1|7|5000|" + b"1000|" * 769 + b"44|725;", 0.1)) == 1


# Both roles back to back


@pytest.mark.parametrize("dialect", Dialect)
@pytest.mark.parametrize("ends", ["hq", "vehicle", "both"])
def test_an_hq_and_a_vehicle_understand_each_other_to_the_end(dialect: Dialect, ends: str) -> None:
    ours, theirs, rng = hq(dialect, drives_of(dialect)), vehicle(dialect), random.Random(1)
    init = ScannerInit(-135.0, 119.875, 0.25, 100, 20, 5600)
    commands: list[AlfMessage] = []
    telemetry: list[AlfMessage] = []
    theirs.send(init)
    for cycle in range(100):
        now = cycle * 0.0201
        if cycle == 50:
            ours.drive(COMMAND_MESSAGE[dialect], now)
        if cycle % 5 == 0:
            theirs.send(Measurement(cycle // 5, 20 * cycle, np.array([cycle, 0, 5600]), 0, 2))
        if cycle % 50 == 0:
            theirs.send(INFO_MESSAGE[dialect])
        commands += exchange(ours, theirs, now, rng)
        telemetry += exchange(theirs, ours, now, rng)
    assert commands == [drives_of(dialect)] * 50 + [COMMAND_MESSAGE[dialect]] * 50
    scans = [message for message in telemetry if isinstance(message, Measurement)]
    assert telemetry[0] == init
    assert [(scan.sequence, scan.timestamp_ms, scan.points.tolist()) for scan in scans] == [
        (number, 100 * number, [5 * number, 0, 5600]) for number in range(20)
    ]
    assert telemetry.count(INFO_MESSAGE[dialect]) == 2
    if ends in ("hq", "both"):
        ours.close("gateway stopped", 3.0)
    if ends in ("vehicle", "both"):
        theirs.close("vehicle stopped", 3.0)
    out: dict[AlfSession, list[bytes]] = {ours: [], theirs: []}
    for session, frames in out.items():
        session.tap = lambda direction, frame, frames=frames: frames.append(frame) if direction == "out" else None
    for _ in range(3):
        assert exchange(ours, theirs, 3.0, rng) == []
        assert exchange(theirs, ours, 3.0, rng) == []
    for frames in out.values():
        assert (frames.count(END[dialect]), frames[-1]) == (1, END[dialect])
    assert ours.state is theirs.state is State.CLOSED
    assert (ours.reason, theirs.reason) == (
        "gateway stopped" if ends != "vehicle" else "ended",
        "vehicle stopped" if ends != "hq" else "ended",
    )
    assert ours.traffic.malformed == theirs.traffic.malformed == 0
