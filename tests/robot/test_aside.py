"""A robot that is left to another gateway while its connection is kept; ``scene`` explains the scripts."""

from __future__ import annotations

import asyncio
from typing import Any

import msgpack
import pytest

from gateways.tcpudp.translate import TcpUdpRobot
from tests.clock import scene_of
from tests.robot.scene import COMMANDS, SETTINGS, STOP, Rig, established, serving
from zbridge.control.latch import LatchRecord
from zbridge.fleet.messages import Latch
from zbridge.robot.device import HEARD_S
from zbridge.transport import Parcel

pytestmark = pytest.mark.jumping

POSITION = bytes.fromhex("0e000000 01 37 00001643 000048c2 0000b442")
MAP = bytes.fromhex("0f000000 01 35 09000000 000102 020200 010001")
ASIDE = "another gateway serves the robot"

rig = scene_of(established)


def counts(rig: Rig) -> int:
    """Count what was published on the robot's keys."""
    return len(rig.bus.values("fleet/r1/**"))


async def aside(rig: Rig) -> None:
    await rig.device.step_aside()
    rig.forget_written()


async def test_the_robot_is_stopped_once_the_lease_ended_and_nothing_is_written_or_published_any_more(rig: Rig) -> None:
    await rig.play("acquire ahead0.1 0.05 > ahead0.1")
    stepping = asyncio.create_task(rig.device.step_aside())
    await stepping
    assert rig.written() == [STOP]
    assert (rig.control["state"], rig.control["holder"]) == ("stopped", None)
    published = counts(rig)
    rig.sends(POSITION + MAP)
    await asyncio.sleep(30.0)
    assert rig.written() == []
    assert counts(rig) == published
    assert not rig.link.closed, "the connection is kept"


async def test_nobody_is_answered_and_no_command_is_taken_not_even_a_stop(rig: Rig) -> None:
    answered = set(rig.bus.answers)
    assert any("acquire" in key for key in answered)
    await aside(rig)
    for name in ("control/acquire/x", "control/takeover/x", "control/renew", "latch", "map", "pose"):
        assert await rig.hq.ask(f"fleet/r1/@rpc/{name}", b"") == [], name
    for command in ("text", "lidar", "stop", "autonomous"):
        rig.command(*COMMANDS[command][:2])
    await asyncio.sleep(2.0)
    assert rig.written() == []


async def test_it_steps_in_again_with_a_stop_and_with_what_it_read_meanwhile(rig: Rig) -> None:
    rig.sends(MAP)
    await aside(rig)
    published = counts(rig)
    rig.sends(bytes.fromhex("0f000000 01 35 09000000 020202 020202 020202"))
    assert counts(rig) == published
    await rig.device.step_in()
    assert rig.last("map")["cells"] == bytes([2] * 9)
    assert rig.last("status")["state"] == "established"
    await asyncio.sleep(0.2)
    assert STOP in rig.written()
    await asyncio.sleep(2.0)
    rig.sends(POSITION)
    assert rig.last("pose")["x"] == pytest.approx(1.5)
    rig.forget_written()
    await rig.play("acquire ahead0.1 0.05 > ahead0.1")


async def test_a_link_that_is_lost_meanwhile_is_not_connected_again_and_need_not_be_kept(rig: Rig) -> None:
    await aside(rig)
    assert rig.device.must_stay
    rig.goes()
    await asyncio.sleep(30.0)
    assert len(rig.links) == 1
    assert not rig.device.must_stay
    await rig.device.step_in()
    await asyncio.sleep(10.0)
    assert len(rig.links) >= 2


async def test_a_connection_whose_end_does_no_harm_need_not_be_kept(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TcpUdpRobot, "closing_harmless", True)
    assert not rig.device.must_stay


async def test_nothing_is_connected_while_another_process_may_get_the_link_also_when_served_again(rig: Rig) -> None:
    await aside(rig)
    rig.goes()
    rig.device.suspend()
    await rig.device.step_in()
    await asyncio.sleep(10.0)
    assert len(rig.links) == 1
    await rig.device.resume()
    await asyncio.sleep(10.0)
    assert len(rig.links) >= 2


async def test_a_robot_is_healthy_while_it_is_established_and_was_heard_of(rig: Rig) -> None:
    rig.sends(POSITION)
    standing = rig.device.standing
    assert (standing.healthy, standing.record.latches) == (True, ())
    assert standing.connected_s == pytest.approx(1.15, abs=0.01)
    await asyncio.sleep(HEARD_S - 0.1)
    assert rig.device.standing.healthy
    await asyncio.sleep(0.2)
    assert not rig.device.standing.healthy
    rig.sends(POSITION)
    assert rig.device.standing.healthy
    rig.goes()
    assert (rig.device.standing.healthy, rig.device.standing.connected_s) == (False, 0.0)


async def test_a_robot_that_has_not_agreed_is_not_healthy() -> None:
    async with serving() as rig:
        await asyncio.sleep(1.0)
        assert not rig.device.standing.healthy
        rig.sends(SETTINGS)
        assert rig.device.standing.healthy


async def test_latched_stops_of_the_other_gateway_are_in_force_from_the_first_moment(rig: Rig) -> None:
    await aside(rig)
    rig.device.enforcer.merge(LatchRecord((Latch(b"\x07" * 16, "ann", "wet floor"),)))
    await rig.device.step_in()
    assert rig.control["state"] == "latched"
    assert [latch.who for latch in rig.device.standing.record.latches] == ["ann"]


async def test_nobody_else_stops_the_robot_if_this_process_dies_meanwhile(rig: Rig) -> None:
    assert [frame.data for frame in rig.device.observed.last_stop().frames] == [STOP]
    await aside(rig)
    assert rig.device.observed.last_stop().frames == ()
    await rig.device.step_in()
    assert [frame.data for frame in rig.device.observed.last_stop().frames] == [STOP]


async def test_a_successor_of_a_gateway_that_stands_aside_stands_aside_too(rig: Rig) -> None:
    rig.sends(MAP)
    await aside(rig)
    await rig.device.prepare("gateway restarted", 1.0)
    rig.device.suspend()
    given = msgpack.unpackb(msgpack.packb(rig.device.export(Parcel())))
    assert given["aside"] is True
    assert given["links"][0]["connected_at"] == pytest.approx(rig.loop.time() - rig.device.standing.connected_s)
    later = Rig(bus=rig.bus)
    await later.device.restore(given, Parcel())
    assert later.device.observed.last_stop().frames == ()
    before: Any = counts(rig)
    begun = asyncio.Event()

    async def begin() -> None:
        begun.set()

    running = asyncio.create_task(later.device.run(begin))
    await begun.wait()
    await asyncio.sleep(5.0)
    assert counts(rig) == before
    running.cancel()
    await asyncio.wait([running])


async def test_who_has_left_the_commands_to_the_next_process_says_nothing_any_more(rig: Rig) -> None:
    await rig.device.withdraw()
    published = counts(rig)
    await asyncio.sleep(3.0)
    assert counts(rig) == published, "it may be frozen before it learns that it has handed over"
    await rig.device.resume()
    await asyncio.sleep(3.0)
    assert counts(rig) > published
