"""A protocol is told when a lease begins and ends: after the stop, and with each new connection."""

from __future__ import annotations

import asyncio
import math

import pytest

from gateways.tcpudp import messages as packets
from gateways.tcpudp.translate import TcpUdpRobot
from tests.clock import scene_of
from tests.robot.scene import STOP, Rig, established
from zbridge.errors import NotReady

pytestmark = pytest.mark.jumping

rig = scene_of(lambda: established(hold=False))
ON, OFF = bytes.fromhex("06000000 02 32 01000000"), bytes.fromhex("06000000 02 32 02000000")
"""The lidar's switch plays the motors'."""


@pytest.fixture(autouse=True)
def _motors(monkeypatch: pytest.MonkeyPatch) -> None:
    def leased(self: TcpUdpRobot, on: bool, now: float) -> None:
        assert self.driving is not None
        frame = self.driving.encode(packets.ClientLidarMode(1 if on else 2))
        self.driving.outbox.set("motors", (frame,), -math.inf)

    monkeypatch.setattr(TcpUdpRobot, "leased", leased)


def switches(rig: Rig) -> list[bytes]:
    return [frame for frame in rig.written() if frame in (ON, OFF, STOP)]


async def test_motors_are_on_while_somebody_has_the_lease_and_off_after_the_stop(rig: Rig) -> None:
    rig.hold()
    await asyncio.sleep(0.5)
    assert switches(rig) == [ON]
    rig.driver.renew()
    rig.command("drive", {"left": 1.0})
    await asyncio.sleep(0.5)
    assert switches(rig) == []
    rig.driver.release()
    await asyncio.sleep(0.3)
    written = switches(rig)
    assert (written[0], written.count(OFF), written.count(ON)) == (STOP, 1, 0)


async def test_a_lease_that_passes_to_another_program_switches_nothing(rig: Rig) -> None:
    rig.hold()
    await asyncio.sleep(0.5)
    switches(rig)
    rig.other.acquire("takeover", force=True)
    await asyncio.sleep(0.5)
    assert set(switches(rig)) <= {STOP}


async def test_a_lease_that_ends_by_its_time_and_one_that_ends_while_the_robot_is_away_switch_off(rig: Rig) -> None:
    rig.driver.acquire(lease_s=1.0)
    await asyncio.sleep(0.5)
    assert switches(rig) == [ON]
    await asyncio.sleep(1.0)
    assert OFF in switches(rig)
    rig.driver.acquire(lease_s=1.0)
    await asyncio.sleep(0.3)
    rig.goes()
    await asyncio.sleep(3.0)
    rig.sends(rig.settings)
    await asyncio.sleep(1.0)
    assert [frame for frame in rig.link.written if frame in (ON, OFF)] == [OFF]


async def test_a_robot_that_returns_to_its_driver_is_switched_on_again(rig: Rig) -> None:
    rig.hold()
    await asyncio.sleep(0.3)
    rig.goes()
    await asyncio.sleep(3.0)
    rig.sends(rig.settings)
    await asyncio.sleep(1.0)
    assert [frame for frame in rig.link.written if frame in (ON, OFF)] == [ON]


@pytest.mark.parametrize("error", [ValueError("broken"), NotReady("full")])
async def test_a_protocol_that_raises_changes_nothing_of_the_lease(
    rig: Rig, monkeypatch, caplog, error: Exception
) -> None:
    def leased(self: TcpUdpRobot, on: bool, now: float) -> None:
        raise error

    monkeypatch.setattr(TcpUdpRobot, "leased", leased)
    rig.hold()
    await asyncio.sleep(0.3)
    assert rig.control["state"] == "held"
    rig.command("drive", {"left": 1.0})
    rig.driver.release()
    await asyncio.sleep(0.3)
    assert rig.control["state"] == "free"
    assert STOP in switches(rig)
    if isinstance(error, NotReady):
        assert ("leased", "full") in [(command, reason) for _, command, reason, _ in await rig.refused()]
    else:
        assert "r1: leased: a fault of the protocol: ValueError: broken in leased" in caplog.text


@pytest.mark.parametrize("stalled", [True, False], ids=["stalled", "gap between writes"])
async def test_motors_are_on_for_a_lease_that_follows_another_one_at_once(rig: Rig, stalled: bool) -> None:
    rig.hold()
    await asyncio.sleep(0.5)
    rig.command("drive", {"left": 1.0})
    await asyncio.sleep(0.2)
    switches(rig)
    if stalled:
        rig.link.unacknowledged_s = 1.0
        rig.conversations[-1].pump()
    rig.driver.release()
    assert rig.hold()["ok"]
    rig.link.unacknowledged_s = 0.0
    await asyncio.sleep(2.0)
    assert [each for each in switches(rig) if each != STOP][-1] == ON


async def test_a_gateway_that_steps_aside_switches_off_first_and_one_that_steps_in_does_too(rig: Rig) -> None:
    """Another gateway may have died meanwhile, while its program had the lease."""
    rig.hold()
    await asyncio.sleep(0.5)
    rig.command("drive", {"left": 1.0})
    await asyncio.sleep(0.2)
    switches(rig)
    await rig.device.step_aside()
    await asyncio.sleep(2.0)
    assert switches(rig) == [STOP, OFF]
    await rig.device.step_in()
    await asyncio.sleep(2.0)
    assert OFF in switches(rig)


async def test_a_gateway_that_ends_switches_off_though_the_robot_stands() -> None:
    async with established(hold=True) as rig:
        await asyncio.sleep(0.5)
        written = rig.link.written
    assert [frame for frame in written if frame in (ON, OFF)] == [ON, OFF]


async def test_what_the_robot_side_refuses_is_told_again_every_second(rig: Rig, monkeypatch) -> None:
    answers = [NotReady("full"), NotReady("full"), None]
    told = []

    def leased(self: TcpUdpRobot, on: bool, now: float) -> None:
        told.append(on)
        if (error := answers.pop(0)) is not None:
            raise error

    monkeypatch.setattr(TcpUdpRobot, "leased", leased)
    rig.hold()
    await asyncio.sleep(5.0)
    assert told == [True] * 3
