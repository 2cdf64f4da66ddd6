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


def probed(client_id: int, answer: bytes | None) -> Timed:
    """A connection with UDP, established at second 2.6; ``answer`` came by UDP, or never."""
    timed = Timed(HqRole(limits(0.01)))
    timed.stream(settings(client_id, udp=True) + START, 0.1)
    if answer is not None:
        timed.datagram(answer, 0.2)
    return timed


# A client id above 2 is only a hint


@pytest.mark.parametrize("client_id", [0, 1, 2])
def test_the_first_client_after_a_start_has_no_doubts(client_id: int) -> None:
    timed = Link().connect(client_id)
    timed.until(100.0)
    assert timed.session.doubts == ()


@pytest.mark.parametrize("client_id", [3, 4, 255])
@pytest.mark.parametrize("versions", [b"1.1", b"1.2", LISTED])
def test_a_client_id_above_2_is_named_and_alone_no_reason_not_to_drive(client_id: int, versions: bytes) -> None:
    timed = Link().connect(client_id, versions=versions)
    timed.until(100.0)
    (doubt,) = timed.session.doubts
    assert doubt == LATER.replace("3", str(client_id))
    assert timed.session.doubtful is None


# Malformed packets


def test_a_few_malformed_packets_are_no_sign() -> None:
    timed = Link().connect(3)
    timed.stream(MALFORMED * 2, 1.0)
    timed.until(10.0)
    assert timed.session.doubts == (LATER,)
    timed.stream(POSITION * 1000, 11.0)
    timed.stream(MALFORMED * 20, 12.0)
    assert timed.session.doubts == (LATER,)


def test_three_malformed_packets_and_more_than_a_twentieth_are_one() -> None:
    timed = Link().connect(3)
    timed.stream(POSITION * 5 + MALFORMED * 3, 1.0)
    assert timed.session.doubts == (LATER, GARBLED)
    assert timed.session.doubtful == f"connection in doubt: {LATER}; {GARBLED}"
    timed.stream(POSITION * 100, 2.0)
    timed.until(8.0)
    assert timed.session.doubts == (LATER,), "most of what came could be read after all"
    assert timed.session.doubtful is None


def test_malformed_datagrams_count_too() -> None:
    timed = Link().connect(3)
    for _ in range(3):
        timed.datagram(POSITION[:-1], 1.0)
    assert GARBLED in timed.session.doubts


def test_malformed_packets_on_the_first_connection_are_named_and_alone_no_reason() -> None:
    timed = Link().connect(2)
    timed.stream(MALFORMED * 10, 1.0)
    assert timed.session.doubts == (GARBLED,)
    assert timed.session.doubtful is None


# No telemetry, and no answer to the probe


def test_neither_telemetry_nor_an_answer_to_the_probe_within_five_seconds_is_a_sign() -> None:
    timed = probed(3, None)
    timed.until(7.59)
    assert timed.session.doubts == (LATER,)
    timed.until(7.61)
    assert timed.session.doubts == (LATER, UNANSWERED)
    assert timed.session.doubtful is not None
    timed.stream(POSITION, 9.0)
    timed.until(10.1)
    assert timed.session.doubts == (LATER,), "a robot that was asked has answered"


def test_texts_are_no_telemetry_every_client_gets_them() -> None:
    timed = probed(3, None)
    for second in range(3, 8):
        timed.stream(TEXT, float(second))
    timed.until(8.0)
    assert timed.session.doubts == (LATER, UNANSWERED)


def test_a_probe_that_did_not_arrive_was_not_answered() -> None:
    timed = probed(3, None)
    timed.stream(ANSWER_FALSE, 1.0)
    timed.until(8.0)
    assert timed.session.doubts == (LATER, UNANSWERED)


def test_an_answer_that_came_late_was_one() -> None:
    timed = probed(3, None)
    timed.datagram(ANSWER_TRUE, 4.0)
    timed.until(8.0)
    assert timed.session.doubts == (LATER,)


def test_a_robot_that_is_silent_until_it_is_asked_is_driven_if_it_answered_the_probe() -> None:
    timed = probed(3, ANSWER_TRUE)
    timed.until(100.0)
    assert timed.session.doubts == (LATER,)


def test_no_answer_to_a_probe_that_was_never_sent_is_no_sign() -> None:
    """The robot sends 4 although nobody offered it datagrams: it gets its 7, and no 5."""
    timed = Link().connect(3)
    timed.stream(START, 0.2)
    timed.until(100.0)
    assert timed.frames("udp") == []
    assert timed.session.doubts == (LATER,)


def test_a_silent_first_connection_is_named_and_driven() -> None:
    timed = probed(2, None)
    timed.until(100.0)
    assert timed.session.doubts == (UNANSWERED,)
    assert timed.session.doubtful is None


@pytest.mark.parametrize("versions", [b"1.1", b"1.2", LISTED])
def test_a_robot_without_datagrams_that_is_silent_until_it_is_asked_is_driven(versions: bytes) -> None:
    timed = Link().connect(3, versions=versions)
    timed.until(100.0)
    assert timed.session.doubts == (LATER,)


# No telemetry, unlike before


def talking(link: Link, *, asked: bool = False) -> None:
    """A first connection on which telemetry comes, unasked or not."""
    timed = link.connect(2)
    for second in range(1, 10):
        if asked:
            link.robot.ask(topics.POSE)
        timed.stream(POSITION, float(second))
    timed.session.lost("closed by peer")


def test_a_robot_that_sent_telemetry_before_and_sends_none_now_is_named() -> None:
    link = Link()
    talking(link)
    timed = link.connect(3)
    timed.until(5.09)
    assert timed.session.doubts == (LATER,)
    timed.until(5.11)
    assert timed.session.doubts == (LATER, MUTE)
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
    talking(link)
    timed = link.connect(3)
    timed.stream(TEXT * 5, 1.0)
    link.robot.ask(topics.POSE)
    timed.stream(POSITION, 2.0)
    timed.until(6.0)
    assert timed.session.doubts == (LATER, MUTE)


def test_a_robot_that_only_ever_answered_is_not_expected_to_do_more() -> None:
    link = Link()
    talking(link, asked=True)
    timed = link.connect(3)
    timed.until(100.0)
    assert timed.session.doubts == (LATER,)


def test_a_robot_that_falls_silent_later_is_not_named() -> None:
    link = Link()
    talking(link)
    timed = link.connect(3)
    timed.stream(POSITION, 1.0)
    for second in range(10, 50):
        link.robot.ask(topics.POSE)
        timed.until(float(second))
    assert timed.session.doubts == (LATER,)


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


async def test_a_healthy_second_hq_is_driven() -> None:
    async with serving() as rig:
        await rig.establish(settings(3))
        await asyncio.sleep(10.0)
        assert rig.last("status")["reason"] == LATER
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


async def test_the_states_of_a_connection_are_shown_once_each_though_it_has_a_sign() -> None:
    async with serving() as rig:
        await rig.settle()
        shown = len(rig.values("status"))
        rig.sends(settings(3))
        assert [(status["state"], status["reason"]) for status in rig.values("status")[shown:]] == [
            ("established", LATER)
        ]
