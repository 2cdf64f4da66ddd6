"""A robot that is told to move by itself: that is written down before, and whoever serves it next stops it for good.

``scene`` explains the scripts. Expected bytes: "Stops after mode 3" in ``tcpudp.md``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from gateways.tcpudp.options import TcpUdpOptions
from gateways.tcpudp.translate import TcpUdpRobot
from tests.robot.scene import SETTINGS, STOP, Rig, established, serving
from zbridge.control.latch import Latches, LatchRecord
from zbridge.robot.commands import WRITE_S

pytestmark = pytest.mark.jumping

NONE = bytes.fromhex("06000000 02 0a 01000000")
AUTONOMOUS = bytes.fromhex("06000000 02 0a 03000000")


class Disk:
    """Writes when the test says so."""

    def __init__(self) -> None:
        self.record: LatchRecord | None = None
        self.writing: asyncio.Future[None] | None = None

    def keep(self, latches: Latches) -> asyncio.Future[None] | None:
        if latches.record != (self.record or LatchRecord()):
            self.record = latches.record
            self.writing = asyncio.get_running_loop().create_future()
        return self.writing

    def written(self) -> None:
        assert self.writing is not None
        writing, self.writing = self.writing, None
        writing.set_result(None)


def latches(**record: Any) -> Latches:
    return Latches(LatchRecord(**record))


async def test_mode_autonomous_reaches_the_robot_when_it_is_written_down_and_not_before() -> None:
    disk = Disk()
    async with established(save=disk.keep) as rig:
        rig.command("mode", {"mode": "autonomous"})
        await asyncio.sleep(WRITE_S / 2)
        assert (rig.written(), disk.record) == ([], LatchRecord(autonomous=True))
        assert not rig.device.observed.driven
        disk.written()
        await rig.settle()
        assert rig.written() == [AUTONOMOUS]
        assert rig.device.observed.driven
        rig.command("mode", {"mode": "autonomous"})
        await asyncio.sleep(0.05)
        assert rig.written() == [AUTONOMOUS], "it stands on the disk already"


@pytest.mark.parametrize(
    ("then", "expected"),
    [
        (lambda rig: rig.command("stop"), [STOP]),
        (lambda rig: rig.command("drive"), [STOP]),
        (lambda rig: rig.command("mode", {"mode": "manual"}), [bytes.fromhex("06000000 02 0a 02000000")]),
        (lambda rig: rig.driver.release(), []),
        (lambda rig: rig.other.acquire("takeover"), []),
    ],
    ids=["a stop", "neutral", "another mode", "a release", "a takeover"],
)
async def test_what_comes_while_mode_autonomous_is_written_down_takes_its_place(
    then: Callable[[Rig], object], expected: list[bytes]
) -> None:
    disk = Disk()
    async with established(save=disk.keep) as rig:
        rig.command("mode", {"mode": "autonomous"})
        then(rig)
        disk.written()
        await asyncio.sleep(0.05)
        written = rig.written()
        assert written[:1] == expected
        assert AUTONOMOUS not in written
        assert NONE not in written, "the robot was never sent a 3"


async def test_motion_while_mode_autonomous_is_written_down_goes_first() -> None:
    disk = Disk()
    async with established(save=disk.keep) as rig:
        rig.command("mode", {"mode": "autonomous"})
        await rig.play("left > left")
        disk.written()
        await asyncio.sleep(0.05)
        assert rig.written() == [AUTONOMOUS]


async def test_a_disk_that_is_too_slow_refuses_the_mode_and_the_next_attempt_finds_it_written() -> None:
    disk = Disk()
    async with established(save=disk.keep) as rig:
        rig.command("mode", {"mode": "autonomous"})
        await asyncio.sleep(WRITE_S + 0.1)
        disk.written()
        await rig.play("refused driver mode: the disk took 0.5 s")
        assert rig.written() == []
        rig.command("mode", {"mode": "autonomous"})
        await asyncio.sleep(0.05)
        assert rig.written() == [AUTONOMOUS]


async def test_a_gateway_that_ends_while_the_mode_is_written_down_sends_none() -> None:
    disk = Disk()
    async with established(save=disk.keep) as rig:
        rig.command("mode", {"mode": "autonomous"})
        await rig.device.prepare("gateway restarted", 1.0)
        disk.written()
        await asyncio.sleep(1.0)
        assert AUTONOMOUS not in rig.written()


async def test_a_gateway_that_reads_that_the_robot_was_told_to_move_by_itself_stops_it_by_the_pair() -> None:
    for restored in (False, True):
        async with established() as rig:
            if restored:
                rig.device.enforcer.restore(latches(autonomous=True))
            await rig.play("acquire left > left")
            rig.command("stop")
            await asyncio.sleep(0.05)
            assert rig.written()[:2] == ([NONE, STOP] if restored else [STOP])


async def test_another_gateway_says_so_the_robot_is_stopped_at_once_unless_it_is_driven() -> None:
    for driven in (False, True):
        disk = Disk()
        async with established(save=disk.keep) as rig:
            if driven:
                await rig.play("left > left")
            rig.device.enforcer.merge(LatchRecord(autonomous=True))
            assert disk.record == LatchRecord(autonomous=True)
            assert rig.device.standing.record.autonomous
            await asyncio.sleep(0.05)
            assert (rig.written() == []) is driven
            rig.command("stop")
            await asyncio.sleep(0.05)
            assert rig.written()[:2] == [NONE, STOP]
            await asyncio.sleep(2.0)
            rig.forget_written()
            rig.device.enforcer.merge(LatchRecord(autonomous=True))
            assert rig.written() == [], "it is no news"


def test_a_robot_that_may_move_by_itself_is_stopped_so_from_its_first_connection_on() -> None:
    robot = TcpUdpRobot(TcpUdpOptions())
    assert not robot.session("robot", "peer").sent_autonomous
    robot.was_autonomous()
    assert robot.session("robot", "peer").sent_autonomous
    fresh = TcpUdpRobot(TcpUdpOptions())
    fresh.was_autonomous()
    assert fresh.session("robot", "peer").sent_autonomous


async def test_a_gateway_that_starts_with_such_a_file_greets_the_robot_with_the_pair() -> None:
    for known in (False, True):
        async with serving(latches=latches(autonomous=known)) as rig:
            await rig.settle()
            rig.sends(SETTINGS)
            rig.forget_written()
            await asyncio.sleep(0.05)
            assert rig.written()[-2:] == ([NONE, STOP] if known else [STOP])
