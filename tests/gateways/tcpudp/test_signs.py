"""Signs of a connection that is not the robot's first ("One usable connection" of the protocol page)."""

from __future__ import annotations

import asyncio

import pytest

from gateways.tcpudp.session import HqRole, limits
from gateways.tcpudp.translate import Options, TcpUdpRobot
from tests.gateways.tcpudp.frames import (
    ANSWER_FALSE,
    ANSWER_TRUE,
    LISTED,
    POSITION,
    SIZE_100_10,
    START,
    Timed,
    counted,
    framed,
    server_settings,
)
from tests.robot.test_device import Rig, serving
from zbridge.fleet import topics

pytestmark = pytest.mark.jumping

MALFORMED = framed(1, 51, b"\x01")
TEXT = framed(1, 1, counted(b"hello"))
LATER = "client id 3: another program is connected, or the one usable connection is used up"
GARBLED = "malformed packets"
UNANSWERED = "no telemetry and no answer to the probe within 5 s"
MUTE = "no telemetry within 5 s, unlike on the connection before"


def settings(client_id: int = 2, *, udp: bool = False, versions: bytes = LISTED) -> bytes:
    flags = ("01" if udp else "00") + "010101010101"
    blocks = {b"1.1": flags[:10], b"1.2": flags[:12], LISTED: flags + SIZE_100_10}
    return server_settings(versions, blocks[versions], client_id)


class Link:
    """Connections of one robot, one after the other, each established at second 0.1 of its own time."""

    def __init__(self) -> None:
        self.robot = TcpUdpRobot(Options())

    def connect(self, client_id: int = 2, *, versions: bytes = LISTED) -> Timed:
        timed = Timed(self.robot.session("robot", "tcp://robot.test:1"))
        timed.stream(settings(client_id, versions=versions), 0.1)
        return timed

    def talk(self, *, asked: bool = False) -> None:
        """Make a first connection on which telemetry comes, unasked or not, and lose it."""
        timed = self.connect(2)
        for second in range(1, 10):
            if asked:
                self.robot.ask(topics.POSE)
            timed.stream(POSITION, float(second))
        timed.session.lost("closed by peer")


def doubts(timed: Timed, until: float) -> tuple[str, ...]:
    """The doubts at a time; only a client id above 2 together with another sign is a reason not to drive."""
    timed.until(until)
    named = timed.session.doubts
    reason = f"connection in doubt: {'; '.join(named)}" if len(named) > 1 and LATER in named else None
    assert timed.session.doubtful == reason
    return named


# A client id above 2 is only a hint


@pytest.mark.parametrize("client_id", [0, 1, 2, 3, 4, 255])
@pytest.mark.parametrize("versions", [b"1.1", b"1.2", LISTED])
def test_a_client_id_above_2_is_named_and_alone_no_reason_not_to_drive(client_id: int, versions: bytes) -> None:
    """A robot without datagrams may be silent until it is asked."""
    timed = Link().connect(client_id, versions=versions)
    timed.until(100.0)
    assert timed.session.doubts == ((LATER.replace("3", str(client_id)),) if client_id > 2 else ())
    assert timed.session.doubtful is None


# Malformed packets


def test_a_few_malformed_packets_are_no_sign() -> None:
    timed = Link().connect(3)
    timed.stream(MALFORMED * 2, 1.0)
    assert doubts(timed, 10.0) == (LATER,)
    timed.stream(POSITION * 1000, 11.0)
    timed.stream(MALFORMED * 20, 12.0)
    assert doubts(timed, 12.0) == (LATER,)


def test_three_malformed_packets_and_more_than_a_twentieth_are_one() -> None:
    timed = Link().connect(3)
    timed.stream(POSITION * 5 + MALFORMED * 3, 1.0)
    assert doubts(timed, 1.0) == (LATER, GARBLED)
    timed.stream(POSITION * 100, 2.0)
    assert doubts(timed, 8.0) == (LATER,), "most of what came could be read after all"


def test_malformed_datagrams_count_too() -> None:
    timed = Link().connect(3)
    for _ in range(3):
        timed.datagram(POSITION[:-1], 1.0)
    assert doubts(timed, 1.0) == (LATER, GARBLED)


def test_malformed_packets_on_the_first_connection_are_named_and_alone_no_reason() -> None:
    timed = Link().connect(2)
    timed.stream(MALFORMED * 10, 1.0)
    assert doubts(timed, 1.0) == (GARBLED,)


# No telemetry, and no answer to the probe


@pytest.mark.parametrize(
    ("client_id", "coming", "until", "expected"),
    [
        pytest.param(3, [], 7.59, (LATER,), id="not yet five seconds"),
        pytest.param(3, [], 7.61, (LATER, UNANSWERED), id="neither within five seconds"),
        pytest.param(3, [(9.0, "tcp", POSITION)], 10.1, (LATER,), id="it has answered a question"),
        pytest.param(
            3, [(float(at), "tcp", TEXT) for at in range(3, 8)], 8.0, (LATER, UNANSWERED), id="texts, that all get"
        ),
        pytest.param(3, [(1.0, "tcp", ANSWER_FALSE)], 8.0, (LATER, UNANSWERED), id="a probe that did not arrive"),
        pytest.param(3, [(4.0, "udp", ANSWER_TRUE)], 8.0, (LATER,), id="an answer that came late"),
        pytest.param(3, [(0.2, "udp", ANSWER_TRUE)], 100.0, (LATER,), id="silent until it is asked"),
        pytest.param(2, [], 100.0, (UNANSWERED,), id="a first connection, which is driven"),
    ],
)
def test_neither_telemetry_nor_an_answer_to_the_probe_within_five_seconds_is_a_sign(
    client_id: int, coming: list[tuple[float, str, bytes]], until: float, expected: tuple[str, ...]
) -> None:
    timed = Timed(HqRole(limits(0.01)))
    timed.stream(settings(client_id, udp=True) + START, 0.1)  # established at second 2.6
    for at, by, data in coming:
        (timed.stream if by == "tcp" else timed.datagram)(data, at)
    assert doubts(timed, until) == expected


def test_no_answer_to_a_probe_that_was_never_sent_is_no_sign() -> None:
    """The robot sends 4 although nobody offered it datagrams: it gets its 7, and no 5."""
    timed = Link().connect(3)
    timed.stream(START, 0.2)
    assert doubts(timed, 100.0) == (LATER,)
    assert timed.frames("udp") == []


# No telemetry, unlike before


def test_a_robot_that_sent_telemetry_before_and_sends_none_now_is_named() -> None:
    link = Link()
    link.talk()
    timed = link.connect(3)
    assert doubts(timed, 5.09) == (LATER,)
    assert doubts(timed, 5.11) == (LATER, MUTE)
    timed.session.lost("closed by peer")
    assert timed.session.doubts == ()
    timed = link.connect(4)
    timed.until(5.11)
    assert len(timed.session.doubts) == 2, "what was before is not forgotten"
    timed.stream(POSITION, 6.0)
    timed.until(7.2)
    assert len(timed.session.doubts) == 1


def test_answers_and_texts_are_no_telemetry_of_its_own() -> None:
    link = Link()
    link.talk()
    timed = link.connect(3)
    timed.stream(TEXT * 5, 1.0)
    link.robot.ask(topics.POSE)
    timed.stream(POSITION, 2.0)
    assert doubts(timed, 6.0) == (LATER, MUTE)


def test_a_robot_that_only_ever_answered_or_falls_silent_later_is_not_named() -> None:
    link = Link()
    link.talk(asked=True)
    assert doubts(link.connect(3), 100.0) == (LATER,)
    link = Link()
    link.talk()
    timed = link.connect(3)
    timed.stream(POSITION, 1.0)
    for second in range(10, 50):
        link.robot.ask(topics.POSE)
        timed.until(float(second))
    assert doubts(timed, 50.0) == (LATER,)


# The device

DRIVE_LEFT = {"left": 1.0}
STOP_3 = bytes.fromhex("02000000 03 0d")
MOVE_3 = bytes.fromhex("0e000000 03 0b 000080bf 00000000 0000803f")


async def poor(rig: Rig) -> None:
    """A second connection with two signs; the first one had telemetry."""
    await rig.establish(settings(2))
    for _ in range(6):
        rig.sends(POSITION)
        await asyncio.sleep(1.0)
    rig.goes()
    await asyncio.sleep(2.0)
    await rig.establish(settings(3))


async def test_a_second_connection_with_two_signs_is_named_stopped_and_not_driven() -> None:
    async with serving() as rig:
        await poor(rig)
        assert rig.last("status")["reason"] == LATER
        rig.command("drive", {})
        rig.command("drive", DRIVE_LEFT)
        await asyncio.sleep(2.5)
        assert MOVE_3 in rig.written()
        await asyncio.sleep(1.5)
        status = rig.last("status")
        assert (status["state"], status["reason"]) == ("established", f"{LATER}; {MUTE}")
        rig.command("drive", {})
        for name, fields in (
            ("drive", DRIVE_LEFT),
            ("mode", {"mode": "autonomous"}),
            ("raw/tcpudp", {"id": 21, "body": b"\x01"}),
        ):
            rig.forget_written()
            rig.command(name, fields)
            await asyncio.sleep(0.06)
            assert set(rig.written()) <= {STOP_3}
            (refusal,) = [entry for entry in rig.last("control")["refusals"] if entry["command"] == name]
            assert refusal["code"] == "not_ready"
            assert refusal["reason"] == f"connection in doubt: {LATER}; {MUTE}"


async def test_a_robot_that_moves_is_stopped_when_the_second_sign_comes() -> None:
    async with serving() as rig:
        await poor(rig)
        rig.command("drive", {})
        for _ in range(8):
            rig.command("drive", DRIVE_LEFT)
            await asyncio.sleep(0.5)
        assert rig.written()[-1] == STOP_3
        assert rig.last("control")["state"] == "held"


async def test_stops_neutral_and_what_does_not_move_the_robot_go_out_on_a_poor_connection() -> None:
    async with serving() as rig:
        await poor(rig)
        await asyncio.sleep(5.0)
        for name, fields, packet_id in (
            ("stop", {}, 13),
            ("drive", {}, 13),
            ("mode", {"mode": "manual"}, 10),
            ("lidar", {"on": True}, 50),
            ("text", {"text": "hi"}, 1),
        ):
            rig.hold()
            await asyncio.sleep(1.5)
            rig.forget_written()
            rig.command(name, fields)
            await asyncio.sleep(0.05)
            assert packet_id in {frame[5] for frame in rig.written()}


async def test_when_a_sign_passes_the_robot_is_driven_after_a_neutral() -> None:
    async with serving() as rig:
        await poor(rig)
        await asyncio.sleep(5.0)
        rig.sends(POSITION)
        await asyncio.sleep(1.1)
        assert rig.last("status")["reason"] == LATER
        rig.command("drive", DRIVE_LEFT)
        assert MOVE_3 not in rig.written()
        rig.command("drive", {})
        rig.command("drive", DRIVE_LEFT)
        await asyncio.sleep(0.05)
        assert rig.written()[-1] == MOVE_3


async def test_a_healthy_second_hq_is_named_once_and_driven() -> None:
    async with serving() as rig:
        await rig.settle()
        shown = len(rig.values("status"))
        rig.sends(settings(3))
        states = [(status["state"], status["reason"]) for status in rig.values("status")[shown:]]
        assert states == [("established", LATER)]
        await asyncio.sleep(10.0)
        assert rig.last("status")["reason"] == LATER
        rig.forget_written()
        rig.command("drive", DRIVE_LEFT)
        assert rig.written() == [MOVE_3]
        assert await rig.refusals() == []


async def test_a_lost_robot_shows_why_it_was_lost_and_no_doubts() -> None:
    async with serving() as rig:
        await poor(rig)
        shown = len(rig.values("status"))
        rig.unreachable = "no route"
        rig.goes()
        await rig.settle()
        (lost,) = rig.values("status")[shown:]
        assert (lost["state"], lost["reason"]) == ("offline", "closed by peer")
