"""A robot that nobody drives is kept at rest, and a link that takes nothing is not driven."""

from __future__ import annotations

import asyncio

import pytest

from tests.robot.test_device import NEUTRAL, Rig, established, serving
from zbridge.transport.link import STALLED_S

pytestmark = pytest.mark.jumping

STOP = bytes.fromhex("02000000 02 0d")
"""Packet 13 to client id 2 (tcpudp.md, "Framing"): length 2, id, packet id."""
MODE_NONE = bytes.fromhex("06000000 02 0a 01000000")
FORWARD = {"forward": 1.0}
NO_JOYSTICK = bytes.fromhex("0f000000 01 02 02 03000000 312e31 0000000000")
"""serverSettings of a 1.1 robot that announces nothing."""


def stops_at(rig: Rig) -> list[float]:
    return [at for at, frame in zip(rig.link.times, rig.link.written, strict=True) if frame == STOP]


def is_move(frame: bytes) -> bool:
    return frame[5] == 11


async def drive_for(rig: Rig, seconds: float) -> None:
    for _ in range(round(seconds / 0.1)):
        rig.command("drive", FORWARD)
        await asyncio.sleep(0.1)


async def test_a_robot_that_nobody_drives_gets_a_stop_a_second_for_ever() -> None:
    async with established(idle_stop_s=1.0) as rig:
        await asyncio.sleep(0.5)
        rig.forget_written()
        await asyncio.sleep(60.0)
        written = rig.written()
        assert set(written) == {STOP}
        assert 59 <= len(written) <= 61
        gaps = [later - sooner for sooner, later in zip(stops_at(rig)[-50:], stops_at(rig)[-49:], strict=False)]
        assert all(0.9 <= gap <= 1.1 for gap in gaps)


async def test_while_somebody_drives_no_stop_is_put_in_between() -> None:
    async with established(idle_stop_s=1.0) as rig:
        rig.hold()
        await drive_for(rig, 0.1)
        rig.forget_written()
        await drive_for(rig, 10.0)
        assert all(map(is_move, rig.written()))


async def test_after_neutral_and_the_deadman_stops_go_on_although_the_lease_is_held() -> None:
    for end in ("neutral", "deadman"):
        async with established(idle_stop_s=1.0, deadman_s=0.5) as rig:
            rig.hold()
            await drive_for(rig, 1.0)
            if end == "neutral":
                rig.command("drive", NEUTRAL)
            await asyncio.sleep(3.0)
            assert rig.control["state"] == "held"
            rig.forget_written()
            await asyncio.sleep(20.0)
            assert 19 <= rig.written().count(STOP) <= 21


async def test_a_robot_in_autonomous_mode_is_left_alone_until_another_mode() -> None:
    async with established(idle_stop_s=1.0) as rig:
        rig.hold()
        rig.command("mode", {"mode": "autonomous"})
        await asyncio.sleep(0.2)
        rig.forget_written()
        await asyncio.sleep(10.0)
        assert rig.written() == []
        rig.command("mode", {"mode": "manual"})
        await asyncio.sleep(10.0)
        assert 9 <= rig.written().count(STOP) <= 11


async def test_neutral_ends_autonomous_mode_and_the_stop_after_it_is_the_pair() -> None:
    """tcpudp.md, "Translation": once the gateway sent mode 3, every stop is 1, 13."""
    async with established(idle_stop_s=1.0) as rig:
        rig.hold()
        rig.command("mode", {"mode": "autonomous"})
        await asyncio.sleep(0.5)
        rig.command("drive", NEUTRAL)
        await asyncio.sleep(3.0)
        rig.forget_written()
        await asyncio.sleep(5.0)
        assert rig.written()[:4] == [MODE_NONE, STOP, MODE_NONE, STOP]


async def test_whoever_only_chats_does_not_drive() -> None:
    async with established(idle_stop_s=1.0) as rig:
        rig.hold()
        rig.command("raw/tcpudp", {"id": 40, "body": b"x"})
        await asyncio.sleep(0.2)
        rig.forget_written()
        await asyncio.sleep(10.0)
        assert rig.written().count(STOP) >= 9


async def test_a_stop_drops_the_raw_packets_that_wait() -> None:
    """Whatever they do to the robot: after its stop nothing of the lease that ended may come."""
    async with established(idle_stop_s=1.0) as rig:
        rig.hold()
        for number in range(30):
            rig.command("raw/tcpudp", {"id": 21, "body": bytes([number])})
        rig.command("stop", {})
        rig.forget_written()
        await asyncio.sleep(5.0)
        assert set(rig.written()) == {STOP}


async def test_a_gateway_that_ends_while_the_link_takes_nothing_leaves_the_stop_to_the_kernel() -> None:
    async with established(deadman_s=5.0) as rig:
        rig.hold()
        await drive_for(rig, 0.5)
        rig.link.unacknowledged_s = 1.0
        await drive_for(rig, 0.5)
        rig.forget_written()
    assert rig.written()[0] == STOP
    assert not any(map(is_move, rig.written()))


async def test_the_drive_that_finds_the_link_open_again_is_no_motion_but_refused() -> None:
    async with established(deadman_s=5.0, idle_stop_s=1.0) as rig:
        rig.hold()
        await drive_for(rig, 0.5)
        rig.link.unacknowledged_s = 1.0
        await asyncio.sleep(0.01)
        rig.command("drive", FORWARD)
        rig.forget_written()
        rig.link.unacknowledged_s = 0.0
        rig.command("drive", FORWARD)
        await asyncio.sleep(3.0)
        assert set(rig.written()) == {STOP}
        reasons = [reason for _, reason, _ in await rig.refusals()]
        assert "the robot's link took nothing: send a neutral drive first" in reasons


async def test_nothing_is_asked_of_a_robot_whose_link_takes_nothing() -> None:
    async with established() as rig:
        rig.hold()
        await drive_for(rig, 0.2)
        rig.link.unacknowledged_s = 1.0
        rig.command("drive", NEUTRAL)
        (answer,) = rig.ask("pose").replies
        assert str(answer.error) == "the robot's link takes nothing"


async def test_idle_stops_can_be_turned_off() -> None:
    async with established(idle_stop_s=0.0) as rig:
        await asyncio.sleep(60.0)
        assert rig.written() == []


async def test_a_robot_that_cannot_be_sent_its_stop_is_said_to_be_so() -> None:
    async with serving(idle_stop_s=1.0) as rig:
        await rig.establish(NO_JOYSTICK)
        await asyncio.sleep(5.0)
        assert rig.written() == []
        status = rig.last("status")
        assert status["state"] == "established"
        assert status["reason"] == "cannot be stopped: clientJoystickStop: the robot does not announce joystick"
        assert await rig.refusals() == []  # nobody asked for it: nothing was refused


async def test_before_the_robot_is_established_and_after_it_is_lost_nothing_is_sent() -> None:
    async with serving(idle_stop_s=1.0) as rig:
        await asyncio.sleep(3.0)
        assert rig.link.written == []
        await rig.establish()
        rig.goes()
        rig.unreachable = "gone"
        rig.forget_written()
        await asyncio.sleep(5.0)
        assert rig.written() == []


# A link that takes nothing


async def test_nothing_is_driven_while_the_link_takes_nothing_and_the_stop_goes_first_when_it_does() -> None:
    async with established(deadman_s=5.0, idle_stop_s=1.0) as rig:
        rig.hold()
        await drive_for(rig, 1.0)
        rig.link.unacknowledged_s = STALLED_S + 0.01
        rig.command("drive", {"forward": 0.5})
        await drive_for(rig, 0.1)
        rig.forget_written()
        await drive_for(rig, 2.0)
        assert rig.written() == []
        assert rig.last("status")["reason"] == "the robot's link takes nothing: it is not driven"
        assert rig.metrics.total("link_stalls") == 1
        assert rig.metrics.total("drives_unwritten") >= 20
        rig.link.unacknowledged_s = 0.0
        await drive_for(rig, 1.0)
        written = rig.written()
        assert written[0] == STOP
        assert not any(map(is_move, written))
        assert rig.last("status")["reason"] is None
        assert "the robot's link took nothing: send a neutral drive first" in [
            why for _, why, _ in await rig.refusals()
        ]
        rig.command("drive", NEUTRAL)
        rig.command("drive", FORWARD)
        await asyncio.sleep(0.2)
        assert any(map(is_move, rig.written()))


async def test_a_link_that_is_slow_but_not_silent_is_driven() -> None:
    async with established(deadman_s=5.0) as rig:
        rig.hold()
        rig.link.unacknowledged_s = STALLED_S
        await drive_for(rig, 2.0)
        assert len(rig.written()) >= 15
        assert rig.last("status")["reason"] is None


async def test_a_link_is_looked_at_again_without_anything_to_write() -> None:
    """What was written last is not acknowledged: nothing wakes the gateway but its own look."""
    async with established() as rig:
        rig.hold()
        await drive_for(rig, 0.2)
        rig.command("drive", NEUTRAL)
        await asyncio.sleep(2.0)
        rig.link.unacknowledged_s = 0.1
        rig.command("lidar", {"on": True})
        rig.link.unacknowledged_s = STALLED_S + 0.1
        await asyncio.sleep(0.5)
        assert rig.last("status")["reason"] == "the robot's link takes nothing: it is not driven"
        rig.forget_written()
        rig.link.unacknowledged_s = 0.0
        await asyncio.sleep(0.1)
        assert rig.written()[:1] == [STOP]


async def test_what_is_no_drive_is_refused_while_the_link_takes_nothing() -> None:
    async with established() as rig:
        rig.hold()
        rig.link.unacknowledged_s = 1.0
        rig.command("lidar", {"on": True})
        await asyncio.sleep(0.1)
        rig.command("mode", {"mode": "autonomous"})
        assert ("mode", "the robot's link takes nothing", 1) in await rig.refusals()


async def test_a_link_that_is_lost_while_it_takes_nothing_leaves_no_trace() -> None:
    async with established(deadman_s=5.0) as rig:
        rig.hold()
        rig.link.unacknowledged_s = 1.0
        await drive_for(rig, 0.2)
        rig.goes("connection lost: [Errno 110]")
        await rig.settle()
        assert rig.last("status")["reason"] == "connection lost: [Errno 110]"
        await asyncio.sleep(1.0)
        await rig.establish()
        assert rig.last("status")["reason"] is None
