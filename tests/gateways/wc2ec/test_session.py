"""Sessions of WC2EC in both roles and dialects: bytes from the protocol page, by hand; time is an argument."""

import random

import numpy as np
import pytest

from gateways.wc2ec.messages import Error, RegisterSensor, SensorData, SetSensor, SetValue, Wc2EcMessage
from gateways.wc2ec.session import ControllerRole, ExternalRole, Wc2EcSession
from tests.conformance.side import plain
from tests.gateways.rig import drained, exchange
from tests.gateways.wc2ec.golden import DEPLOYED, DRAFT, GOLDEN, WC, Dialect
from zbridge.errors import EncodeError
from zbridge.protocol.session import Role, State

WHEEL = bytes.fromhex("00 35 00 06 77 68 65 65 6c 31")
DIST = bytes.fromhex("00 25 06 06 64 69 73 74 5f 63")
READING = bytes.fromhex("01 25 06 0000000000748740")
WHEEL_MESSAGE, DIST_MESSAGE = RegisterSensor(53, 0, b"wheel1"), RegisterSensor(37, 6, b"dist_c")
READING_MESSAGE = SensorData(37, 6, 750.5)
ERROR = bytes.fromhex("7f 25 09")


def external(dialect: Dialect = DEPLOYED) -> ExternalRole:
    session = ExternalRole(dialect)
    session.open(0.0)
    return session


def controller(dialect: Dialect = DEPLOYED, values: int = 3) -> ControllerRole:
    session = ControllerRole(dialect, values=values)
    session.open(0.0)
    return session


# Handshake


@pytest.mark.parametrize(
    ("session", "role"),
    [(controller(DEPLOYED), Role.ROBOT), (controller(DRAFT), Role.ROBOT), (external(DRAFT), Role.HQ)],
)
def test_a_controller_and_both_sides_of_the_draft_are_established_at_once_and_stay_so_in_silence(session, role) -> None:
    session.expire(3600.0)
    assert (session.role, session.state, session.deadline()) == (role, State.ESTABLISHED, None)
    assert drained(session) == []


@pytest.mark.parametrize(
    ("said", "until_s", "state"),
    [
        # nothing is registered: five seconds
        ([(0.0, b"", [])], 4.99, State.HANDSHAKING),
        ([(0.0, ERROR, [Error(37, 9)])], 5.0, State.CLOSED),
        # a tenth of a second after the last registration
        ([(1.0, WHEEL, [WHEEL_MESSAGE]), (1.05, DIST[:5], [])], 1.09, State.HANDSHAKING),
        ([(1.0, WHEEL, [WHEEL_MESSAGE]), (1.05, DIST[:5], [])], 1.11, State.ESTABLISHED),
        ([(1.0, WHEEL, [WHEEL_MESSAGE]), (1.09, DIST, [DIST_MESSAGE])], 1.18, State.HANDSHAKING),
        ([(1.0, WHEEL, [WHEEL_MESSAGE]), (1.09, DIST, [DIST_MESSAGE])], 100.0, State.ESTABLISHED),
        # registrations may take longer than five seconds
        ([(4.9 + step * 0.09, WHEEL, [WHEEL_MESSAGE]) for step in range(100)], 13.88, State.HANDSHAKING),
        # the first data, in the same read or without any registration
        ([(0.5, WHEEL + READING, [WHEEL_MESSAGE, READING_MESSAGE])], 0.5, State.ESTABLISHED),
        ([(0.5, READING, [READING_MESSAGE]), (60.0, DIST, [DIST_MESSAGE])], 99.0, State.ESTABLISHED),
    ],
)
def test_deployed_is_established_by_its_registrations_or_data_and_left_where_none_come(said, until_s, state) -> None:
    session = external()
    for at, data, heard in said:
        session.expire(at)
        assert session.receive(data, at) == heard
    session.expire(until_s)
    assert session.state is state
    assert (session.deadline() is None) == (state is not State.HANDSHAKING)
    if state is State.CLOSED:
        assert session.reason == "connected, but no device was registered within 5 s"
    session.close("gateway stopped", until_s)
    assert drained(session, until_s) == [], "there is no word for it"


# What breaks it

LIGHT = bytes.fromhex("00 00 03 000000000000d03f")


@pytest.mark.parametrize(
    ("make", "dialect", "first", "bad"),
    [
        (external, DEPLOYED, [WHEEL, READING], "82 35 00 000000000000f83f"),
        (external, DEPLOYED, [WHEEL], "ff 25 06"),
        (external, DRAFT, [LIGHT], "7f 00 03"),
        (controller, DEPLOYED, [], "01 25 06 0000000000748740"),
        (controller, DRAFT, [], "84 00 00"),
    ],
)
def test_an_unknown_command_ends_the_session_with_its_bytes_in_the_reason(make, dialect, first, bad: str) -> None:
    session, wrong = make(dialect), bytes.fromhex(bad)
    assert len(session.receive(b"".join(first) + wrong, 0.1)) == len(first)
    assert (session.state, session.traffic.malformed) == (State.CLOSED, 1)
    assert wrong.hex(" ") in session.reason
    assert f"command {wrong[0]}" in session.reason
    assert session.receive(WHEEL, 0.2) == []
    assert (drained(session, 0.2), session.deadline()) == ([], None)


def test_an_end_within_a_message_delivers_nothing_of_it() -> None:
    session = external()
    assert session.receive(WHEEL + READING + READING[:10], 0.1) == [WHEEL_MESSAGE, READING_MESSAGE]
    session.lost("closed by peer")
    assert session.state is State.CLOSED
    assert (session.reason or "").startswith("closed by peer")


@pytest.mark.parametrize(
    ("session", "message"),
    [
        (external(DRAFT), SetValue(0, 0, 1.0)),
        (external(DEPLOYED), SetSensor(0, 0, np.zeros(3))),
        (controller(DRAFT), RegisterSensor(0, 0, b"a")),
    ],
)
def test_a_message_of_the_other_dialect_cannot_be_sent(session: Wc2EcSession, message: Wc2EcMessage) -> None:
    with pytest.raises(EncodeError, match=type(message).__name__):
        session.send(message)
    assert drained(session) == []


@pytest.mark.parametrize(("dialect", "sender"), GOLDEN)
def test_both_roles_understand_each_other_in_any_cut(dialect, sender) -> None:
    us, them = (controller(dialect), external(dialect))[:: 1 if sender is WC else -1]
    messages, rng = [message for message, _ in GOLDEN[dialect, sender]], random.Random(1)
    for _ in range(50):
        for message in messages:
            us.send(message)
        assert [plain(message) for message in exchange(us, them, 0.0, rng)] == list(map(plain, messages))
    assert (them.state, them.traffic.malformed) == (State.ESTABLISHED, 0)
