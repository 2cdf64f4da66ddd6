"""Signs of a connection that is not the robot's first ("Signs of a poor connection" of the protocol page)."""

from __future__ import annotations

import asyncio

import pytest

from gateways.tcpudp.session import limits
from gateways.tcpudp.session.hq_role import HqRole
from tests.gateways.tcpudp import frames as f
from tests.robot.test_device import Rig, serving
from zbridge.fleet import topics

pytestmark = pytest.mark.jumping

MALFORMED = f.framed(1, 51, b"\x01")
TEXT = f.framed(1, 1, f.counted(b"hello"))
LATER = "client id 3: another program is connected, or the one usable connection is used up"
GARBLED = "malformed packets"
UNANSWERED = "no telemetry and no answer to the probe within 5 s"
MUTE = "no telemetry within 5 s, unlike on the connection before"


def settings(client_id: int = 2, flags: str = "00", versions: bytes = f.LISTED) -> bytes:
    flags += "010101010101"
    blocks = {b"1.1": flags[:10], b"1.2": flags[:12], f.LISTED: flags}
    return f.server_settings(versions, blocks[versions], client_id)


PROBED = settings(3, "01") + f.START


def doubts(timed: f.Timed, until: float) -> tuple[str, ...]:
    """The doubts at a time: a client id above 2 is one only together with another sign, and then both forbid motion."""
    timed.until(until)
    named = timed.session.doubts
    reason = f"connection in doubt: {'; '.join(named)}" if len(named) > 1 and LATER in named else None
    assert timed.session.doubtful == reason
    return named


@pytest.mark.parametrize("versions", [b"1.1", b"1.2", f.LISTED])
def test_a_client_id_above_2_alone_is_no_sign(versions: bytes) -> None:
    """A legacy robot gave its first client the id 35. A robot without datagrams may be silent until it is asked."""
    for client_id in (0, 1, 2, 3, 4, 35, 255):
        timed = f.Timed(HqRole(limits(0.01))).come((0.1, "tcp", settings(client_id, versions=versions)))
        timed.until(100.0)
        assert timed.session.doubts == ()
        assert timed.session.doubtful is None


FEW_OF_MANY = [(11.0, "tcp", f.POSITION * 1000), (12.0, "tcp", MALFORMED * 20)]
GARBLED_FIRST = (1.0, "tcp", f.POSITION * 5 + MALFORMED * 3)


@pytest.mark.parametrize(
    ("greeting", "coming", "until", "expected"),
    [
        # three malformed packets and more than a twentieth
        pytest.param(settings(3), [(1.0, "tcp", MALFORMED * 2)], 10.0, (), id="a few malformed packets"),
        pytest.param(settings(3), FEW_OF_MANY, 12.0, (), id="a few of many"),
        pytest.param(settings(3), [GARBLED_FIRST], 1.0, (LATER, GARBLED), id="many"),
        pytest.param(settings(3), [GARBLED_FIRST, (2.0, "tcp", f.POSITION * 100)], 8.0, (), id="read after all"),
        pytest.param(settings(3), [(1.0, "udp", f.POSITION[:-1])] * 3, 1.0, (LATER, GARBLED), id="malformed datagrams"),
        pytest.param(settings(2), [(1.0, "tcp", MALFORMED * 10)], 1.0, (GARBLED,), id="many on a first connection"),
        # neither telemetry nor an answer to the probe within five seconds from 2.6 on
        pytest.param(PROBED, [], 7.59, (), id="not yet five seconds"),
        pytest.param(PROBED, [], 7.61, (LATER, UNANSWERED), id="neither within five seconds"),
        pytest.param(PROBED, [(9.0, "tcp", f.POSITION)], 10.1, (), id="it has answered a question"),
        pytest.param(PROBED, [(3.0, "tcp", TEXT * 5)], 8.0, (LATER, UNANSWERED), id="texts, that all get"),
        pytest.param(PROBED, [(1.0, "tcp", f.ANSWER_FALSE)], 8.0, (LATER, UNANSWERED), id="a probe that was lost"),
        pytest.param(PROBED, [(4.0, "udp", f.ANSWER_TRUE)], 8.0, (), id="an answer that came late"),
        pytest.param(PROBED, [(0.2, "udp", f.ANSWER_TRUE)], 100.0, (), id="silent until it is asked"),
        pytest.param(settings(2, "01") + f.START, [], 100.0, (UNANSWERED,), id="a first connection, which is driven"),
        pytest.param(settings(3) + f.START, [], 100.0, (), id="no probe was sent, for nobody offered it"),
    ],
)
def test_a_connection_is_doubted_for_what_comes_and_for_what_does_not(greeting, coming, until: float, expected) -> None:
    timed = f.Timed(HqRole(limits(0.01))).come((0.1, "tcp", greeting), *coming)
    assert doubts(timed, until) == expected


def talked(*, asked: bool = False) -> f.Stage:
    """A robot on its second connection, established a second ago; on the first one it sent telemetry, asked or not."""
    stage = f.Stage(settings())
    for _ in range(9):
        if asked:
            stage.robot.ask(topics.POSE)
            stage.after(0.1)
        stage.told(f.POSITION)
        stage.after(1.0)
    stage.connect(settings(3))
    return stage


def test_a_robot_that_sent_telemetry_before_and_sends_none_now_is_named_on_every_later_connection() -> None:
    stage = talked()
    for _ in range(2):
        start = stage.now
        assert doubts(stage.timed, start + 3.99) == ()
        assert doubts(stage.timed, start + 4.01) == (LATER, MUTE)
        lost = stage.session
        stage.connect(settings(3))
        assert lost.doubts == ()
    stage.after(5.0)
    stage.told(f.POSITION)
    assert doubts(stage.timed, stage.now + 1.1) == (), "it talks after all"


def test_answers_and_texts_are_no_telemetry_of_its_own_and_who_only_ever_answered_or_is_silent_later_is_fine() -> None:
    stage = talked()
    stage.told(TEXT, TEXT)
    stage.robot.ask(topics.POSE)
    stage.told(f.POSITION)
    assert doubts(stage.timed, stage.now + 5.0) == (LATER, MUTE)
    assert doubts(talked(asked=True).timed, 100.0) == ()
    stage = talked()
    stage.told(f.POSITION)
    for _ in range(40):
        stage.robot.ask(topics.POSE)
        stage.after(1.0)
    assert doubts(stage.timed, stage.now) == ()


# The device

DRIVE_LEFT = {"left": 1.0}
STOP_3 = bytes.fromhex("02000000 03 0d")
MOVE_3 = bytes.fromhex("0e000000 03 0b 000080bf 00000000 0000803f")


async def poor(rig: Rig) -> None:
    """A second connection with two signs in 5 s; the first one had telemetry."""
    await rig.establish(settings(2))
    for _ in range(6):
        rig.sends(f.POSITION)
        await asyncio.sleep(1.0)
    rig.goes()
    await asyncio.sleep(2.0)
    await rig.establish(settings(3))


async def test_a_robot_that_moves_is_stopped_when_the_second_sign_comes_and_motion_is_refused() -> None:
    async with serving() as rig:
        await poor(rig)
        assert rig.last("status")["reason"] is None
        rig.command("drive", {})
        for _ in range(8):
            rig.command("drive", DRIVE_LEFT)
            await asyncio.sleep(0.5)
        assert MOVE_3 in rig.written()
        assert rig.link.written[-1] == STOP_3
        status = rig.last("status")
        assert (status["state"], status["reason"]) == ("established", f"{LATER}; {MUTE}")
        assert rig.last("control")["state"] == "held"
        rig.command("drive", {})
        moving = {"drive": DRIVE_LEFT, "mode": {"mode": "autonomous"}, "raw/tcpudp": {"id": 21, "body": b"\x01"}}
        for name, fields in moving.items():
            rig.forget_written()
            rig.command(name, fields)
            await asyncio.sleep(0.06)
            assert set(rig.written()) <= {STOP_3}
            (refusal,) = [entry for entry in rig.last("control")["refusals"] if entry["command"] == name]
            assert (refusal["code"], refusal["reason"]) == ("not_ready", f"connection in doubt: {LATER}; {MUTE}")


async def test_what_does_not_move_the_robot_goes_out_on_a_poor_connection_and_when_a_sign_passes_it_is_driven() -> None:
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
        rig.command("drive", DRIVE_LEFT)
        rig.sends(f.POSITION * 2)  # one more than was asked for: the answer to the lidar mode
        await asyncio.sleep(1.1)
        assert rig.last("status")["reason"] is None
        rig.command("drive", DRIVE_LEFT)
        assert MOVE_3 not in rig.written(), "a neutral is owed"
        rig.command("drive", {})
        rig.command("drive", DRIVE_LEFT)
        await asyncio.sleep(0.05)
        assert rig.written()[-1] == MOVE_3


async def test_a_robot_that_gives_its_first_client_another_id_is_driven_without_a_warning(caplog) -> None:
    async with serving() as rig:
        await rig.settle()
        rig.sends(settings(3))
        await asyncio.sleep(10.0)
        rig.forget_written()
        rig.command("drive", DRIVE_LEFT)
        assert rig.written() == [MOVE_3]
        assert await rig.refusals() == []
        rig.unreachable = "no route"
        rig.goes()
        await rig.settle()
        shown = dict.fromkeys((status["state"], status["reason"]) for status in rig.values("status"))
        assert [*shown][-2:] == [("established", None), ("offline", "closed by peer")]
    assert "client id" not in caplog.text
