"""Sessions of WC2EC in both roles and dialects: bytes from the protocol page, by hand; time is an argument."""

import random

import numpy as np
import pytest

from gateways.wc2ec.messages import (
    ChangeSensor,
    Dialect,
    DisableSensor,
    EnableSensor,
    Error,
    RegisterSensor,
    SensorData,
    SetSensor,
    SetValue,
    Wc2EcMessage,
)
from gateways.wc2ec.session import ControllerRole, ExternalRole, Wc2EcSession
from tests.gateways.rig import drained, exchange
from zbridge.errors import EncodeError
from zbridge.protocol.session import Role, State

DRAFT, DEPLOYED = Dialect.DRAFT, Dialect.DEPLOYED
WHEEL = bytes.fromhex("00 35 00 06 77 68 65 65 6c 31")
DIST = bytes.fromhex("00 25 06 06 64 69 73 74 5f 63")
READING = bytes.fromhex("01 25 06 0000000000748740")
WHEEL_MESSAGE, DIST_MESSAGE = RegisterSensor(53, 0, b"wheel1"), RegisterSensor(37, 6, b"dist_c")
READING_MESSAGE = SensorData(37, 6, 750.5)


def external(dialect: Dialect = DEPLOYED) -> ExternalRole:
    session = ExternalRole(dialect)
    session.open(0.0)
    return session


def controller(dialect: Dialect = DEPLOYED, values: int = 3) -> ControllerRole:
    session = ControllerRole(dialect, values=values)
    session.open(0.0)
    return session


def state(session: Wc2EcSession) -> State:
    return session.state


# Handshake


@pytest.mark.parametrize(
    ("session", "role"),
    [(controller(DEPLOYED), Role.ROBOT), (controller(DRAFT), Role.ROBOT), (external(DRAFT), Role.HQ)],
)
def test_a_controller_and_both_sides_of_the_draft_are_established_at_once_and_stay_so_in_silence(
    session: Wc2EcSession, role: Role
) -> None:
    assert (session.role, session.state, session.deadline()) == (role, State.ESTABLISHED, None)
    session.expire(3600.0)
    assert state(session) is State.ESTABLISHED
    assert drained(session) == []


@pytest.mark.parametrize(("said", "heard"), [(b"", []), (bytes.fromhex("7f 25 09"), [Error(37, 9)])])
def test_deployed_waits_for_the_registrations_and_leaves_a_controller_that_registers_nothing(said, heard) -> None:
    session = external()
    assert session.receive(said, 0.0) == heard
    assert (state(session), drained(session)) == (State.HANDSHAKING, [])
    assert session.deadline() == pytest.approx(5.0)
    session.expire(4.99)
    assert state(session) is State.HANDSHAKING
    session.expire(5.0)
    assert (state(session), session.reason) == (
        State.CLOSED,
        "connected, but no device was registered within 5 s",
    )


def test_a_tenth_of_a_second_after_the_last_registration_it_is_established() -> None:
    session = external()
    assert session.receive(WHEEL, 1.0) == [WHEEL_MESSAGE]
    assert state(session) is State.HANDSHAKING
    assert session.deadline() == pytest.approx(1.1)
    session.receive(DIST[:5], 1.05)
    session.expire(1.09)
    assert state(session) is State.HANDSHAKING
    assert session.receive(DIST[5:], 1.09) == [DIST_MESSAGE]
    assert session.deadline() == pytest.approx(1.19)
    session.expire(1.15)
    assert state(session) is State.HANDSHAKING
    session.expire(1.1901)
    assert state(session) is State.ESTABLISHED
    assert session.deadline() is None
    session.expire(100.0)
    assert state(session) is State.ESTABLISHED


@pytest.mark.parametrize(
    ("said", "heard"),
    [
        (WHEEL + DIST + READING + READING, [WHEEL_MESSAGE, DIST_MESSAGE, READING_MESSAGE, READING_MESSAGE]),
        (READING, [READING_MESSAGE]),
    ],
)
def test_the_first_data_establishes_it_at_once_also_in_the_same_read_or_without_any_registration(said, heard) -> None:
    session = external()
    assert session.receive(said, 0.5) == heard
    assert (state(session), session.deadline()) == (State.ESTABLISHED, None)
    assert session.receive(WHEEL, 60.0) == [WHEEL_MESSAGE], "a device that is registered later"
    session.close("gateway stopped", 61.0)
    assert drained(session, 61.0) == [], "there is no word for it"
    assert (session.state, session.reason) == (State.CLOSED, "gateway stopped")


def test_registrations_that_take_longer_than_the_handshake_may_take_do_not_end_it() -> None:
    session = external()
    for number in range(100):
        session.receive(bytes((0, 37, number, 1, 65)), 4.9 + number * 0.09)
        session.expire(4.9 + number * 0.09)
        assert state(session) is State.HANDSHAKING
    session.expire(4.9 + 99 * 0.09 + 0.11)
    assert state(session) is State.ESTABLISHED


# What breaks it


LIGHT = bytes.fromhex("00 00 03 000000000000d03f")


@pytest.mark.parametrize(
    ("session", "first", "bad"),
    [
        (external(DEPLOYED), WHEEL + READING, "02 25 06 0011"),
        (external(DEPLOYED), WHEEL + READING, "7e 25 06 0011"),
        (external(DEPLOYED), WHEEL + READING, "82 35 00 000000000000f83f"),
        (external(DEPLOYED), WHEEL, "ff 25 06"),
        (external(DEPLOYED), b"", "80 00 00"),
        (external(DRAFT), b"", "01 00 03 0000"),
        (external(DRAFT), LIGHT, "7f 00 03"),
        (external(DRAFT), b"", "82 00 03 00 0000"),
        (controller(DEPLOYED), b"", "80 00 01"),
        (controller(DEPLOYED), b"", "01 25 06 0000000000748740"),
        (controller(DRAFT), b"", "84 00 00"),
        (controller(DRAFT), b"", "00 00 03"),
    ],
)
def test_an_unknown_command_ends_the_session_with_its_bytes_in_the_reason(session, first: bytes, bad: str) -> None:
    wrong = bytes.fromhex(bad)
    assert len(session.receive(first + wrong, 0.1)) == {b"": 0, WHEEL: 1, WHEEL + READING: 2, LIGHT: 1}[first]
    assert state(session) is State.CLOSED
    assert session.reason is not None
    assert wrong.hex(" ") in session.reason
    assert f"command {wrong[0]}" in session.reason
    assert session.traffic.malformed == 1
    assert session.receive(WHEEL, 0.2) == []
    assert (drained(session, 0.2), session.deadline()) == ([], None)


def test_an_end_within_a_message_delivers_nothing_of_it() -> None:
    session = external()
    session.receive(WHEEL + READING, 0.0)
    assert session.receive(READING[:10], 0.1) == []
    session.lost("closed by peer")
    assert state(session) is State.CLOSED
    assert (session.reason or "").startswith("closed by peer")
    assert (drained(session, 0.1), session.deadline()) == ([], None)


@pytest.mark.parametrize(
    ("session", "message"),
    [
        (external(DRAFT), SetValue(0, 0, 1.0)),
        (external(DEPLOYED), EnableSensor(0, 0)),
        (external(DEPLOYED), SetSensor(0, 0, np.zeros(3))),
        (controller(DRAFT), RegisterSensor(0, 0, b"a")),
    ],
)
def test_a_message_of_the_other_dialect_cannot_be_sent(session: Wc2EcSession, message: Wc2EcMessage) -> None:
    with pytest.raises(EncodeError, match=type(message).__name__):
        session.send(message)
    assert drained(session) == []


# Both roles back to back


def test_both_roles_of_deployed_understand_each_other() -> None:
    ours, theirs, rng = external(), controller(), random.Random(1)
    registrations = [RegisterSensor(53, number, b"n" * number) for number in range(60)]
    for registration in registrations:
        theirs.send(registration)
    assert exchange(theirs, ours, 0.0, rng) == registrations
    assert state(ours) is State.HANDSHAKING
    for step in range(50):
        now = 0.02 * (step + 1)
        readings = [SensorData(37, number, step + number / 4) for number in range(54)]
        for reading in readings:
            theirs.send(reading)
        assert exchange(theirs, ours, now, rng) == readings
        assert state(ours) is State.ESTABLISHED
        command = SetValue(53, step % 60, step / 8)
        ours.send(command)
        assert exchange(ours, theirs, now, rng) == [command]
    assert ours.traffic.malformed == theirs.traffic.malformed == 0


@pytest.mark.parametrize("values", [0, 1, 3, 9])
def test_both_roles_of_the_draft_understand_each_other(values: int) -> None:
    ours, theirs, rng = external(DRAFT), controller(DRAFT, values), random.Random(2)
    wanted = [float(number) for number in range(values)]
    commands = [EnableSensor(0, 1), ChangeSensor(0, 1, 2, -0.5), DisableSensor(0, 1), EnableSensor(0, 255)]
    for command in (*commands, SetSensor(0, 1, np.array(wanted)), *commands):
        ours.send(command)
    heard = exchange(ours, theirs, 0.0, rng)
    assert [*heard[:4], *heard[5:]] == commands * 2
    assert isinstance(heard[4], SetSensor)
    assert (heard[4].kind, heard[4].number, heard[4].values.tolist()) == (0, 1, wanted)
    theirs.send(SensorData(0, 1, 12.5))
    assert exchange(theirs, ours, 0.0, rng) == [SensorData(0, 1, 12.5)]
    assert ours.traffic.malformed == theirs.traffic.malformed == 0
