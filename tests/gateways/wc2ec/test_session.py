"""Sessions of WC2EC in both roles and dialects: bytes from the protocol page, by hand; time is an argument."""

import numpy as np
import pytest

from gateways.wc2ec.messages import Error, RegisterSensor, SensorData, SetSensor, SetValue, Wc2EcMessage
from gateways.wc2ec.session import ControllerRole, ExternalRole, Wc2EcSession
from tests.gateways.rig import drained
from tests.gateways.wc2ec.golden import DEPLOYED, DRAFT, Wc2EcDialect
from zbridge.errors import EncodeError
from zbridge.protocol.session import Role, State

WHEEL = bytes.fromhex("00 35 00 06 77 68 65 65 6c 31")
DIST = bytes.fromhex("00 25 06 06 64 69 73 74 5f 63")
READING = bytes.fromhex("01 25 06 0000000000748740")
WHEEL_MESSAGE, READING_MESSAGE = RegisterSensor(53, 0, b"wheel1"), SensorData(37, 6, 750.5)
SAID = {
    "WHEEL": (WHEEL, WHEEL_MESSAGE),
    "DIST": (DIST, RegisterSensor(37, 6, b"dist_c")),
    "HALF": (DIST[:5], None),
    "READING": (READING, READING_MESSAGE),
    "ERROR": (bytes.fromhex("7f 25 09"), Error(37, 9)),
}
"""Bytes, and the message that they complete."""


def external(dialect: Wc2EcDialect = DEPLOYED) -> ExternalRole:
    session = ExternalRole(dialect)
    session.open(0.0)
    return session


def controller(dialect: Wc2EcDialect = DEPLOYED, values: int = 3) -> ControllerRole:
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
    "script",
    [
        "4.99 is handshaking; 5 is closed",
        "0 ERROR; 4.99 is handshaking; 5 is closed",
        "1 WHEEL; 1.05 HALF; 1.09 is handshaking; 1.11 is established",
        "1 WHEEL; 1.09 DIST; 1.18 is handshaking; 1.2 is established; 100 is established",
        "4.9 WHEEL; 4.99 WHEEL; 5.08 WHEEL; 5.17 is handshaking; 5.19 is established",
        "0.5 WHEEL READING; 0.5 is established",
        "0.5 READING; 0.5 is established; 60 DIST; 99 is established",
    ],
)
def test_deployed_is_established_by_its_registrations_or_data_and_left_where_none_come(script: str) -> None:
    session = external()
    for step in script.split("; "):
        at, *words = step.split()
        session.expire(float(at))
        if words[0] == "is":
            assert session.state.value == words[1]
            assert (session.deadline() is None) == (words[1] != "handshaking")
        else:
            said = [SAID[word] for word in words]
            heard = [message for _, message in said if message is not None]
            assert session.receive(b"".join(data for data, _ in said), float(at)) == heard
    assert session.reason in (None, "connected, but no device was registered within 5 s")
    session.close("gateway stopped", 100.0)
    assert drained(session, 100.0) == [], "there is no word for it"


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
    session.fail("closed by peer")
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
