"""A robot that nobody drives is kept at rest, and a link that takes nothing is not driven."""

from __future__ import annotations

import asyncio
import itertools

import pytest

from tests.robot.test_device import NEUTRAL, Rig, established, serving

pytestmark = pytest.mark.jumping

STOP = bytes.fromhex("02000000 02 0d")
"""Packet 13 to client id 2 ("Versions and dialects" in ``tcpudp.md``): length 2, id, packet id."""
MODE_NONE = bytes.fromhex("06000000 02 0a 01000000")
MODE_MANUAL = bytes.fromhex("06000000 02 0a 02000000")
FORWARD = {"forward": 1.0}
NO_JOYSTICK = bytes.fromhex("0f000000 01 02 02 03000000 312e31 0000000000")
"""serverSettings of a 1.1 robot that announces nothing."""
STALLED = "the robot's link is stalled"


async def play(rig: Rig, course: str) -> None:
    """Let things happen one after the other: ``drive`` and ``wait`` take seconds, ``stall`` is how long a link lags."""
    for step in filter(None, course.split("; ")):
        name, _, rest = step.partition(" ")
        match name:
            case "drive":
                for _ in range(round(float(rest) / 0.1)):
                    rig.command("drive", FORWARD)
                    await asyncio.sleep(0.1)
            case "wait":
                await asyncio.sleep(float(rest))
            case "stall":
                rig.link.unacknowledged_s = float(rest)
            case "mode":
                rig.command("mode", {"mode": rest})
            case "raw":
                rig.command("raw/tcpudp", {"id": int(rest), "body": b"x"})
            case "neutral" | "once":
                rig.command("drive", NEUTRAL if name == "neutral" else FORWARD)
            case "stop":
                rig.command("stop", {})
            case _:
                raise ValueError(step)


def kind(frame: bytes) -> str:
    names = {STOP: "stop", MODE_NONE: "mode none", MODE_MANUAL: "mode manual"}
    return "move" if frame[5] == 11 else names.get(frame, frame.hex())


PAIR, MANUAL_PAIR = {"mode none", "stop"}, {"mode manual", "stop"}
COURSES = {
    # what happens, then what happens while the robot is watched; what it is sent meanwhile, at least and at most
    "nobody drives": ("wait 0.5", "wait 60", {"stop"}, 59, 61),
    "somebody drives": ("drive 0.1", "drive 10", {"move"}, 50, 200),
    "somebody sent neutral, and holds the lease": ("drive 1; neutral; wait 3", "wait 20", {"stop"}, 19, 21),
    "the deadman came, and the lease is held": ("drive 1; wait 8", "wait 20", {"stop"}, 19, 21),
    "a robot drives itself": ("mode autonomous; wait 0.2", "wait 10", set(), 0, 0),
    "it drives itself no more": ("mode autonomous; wait 0.2; mode manual; wait 0.2", "wait 10", MANUAL_PAIR, 18, 22),
    "a stop after mode 3 is the pair": ("mode autonomous; wait 0.5; neutral; wait 3", "wait 5", PAIR, 9, 11),
    "somebody only chats": ("raw 40; wait 0.2", "wait 10", {"stop"}, 9, 11),
    "a stop drops raw packets that wait": ("raw 21; " * 30 + "stop", "wait 5", {"stop"}, 9, 100),
    "a link is slow but not silent": ("stall 0.3", "drive 2", {"move"}, 15, 100),
    "a link takes nothing": ("drive 1; stall 0.31; drive 0.1", "drive 2", set(), 0, 0),
    "it takes again": ("drive 1; stall 0.31; drive 2", "stall 0; drive 1", {"stop"}, 1, 100),
    "a drive finds it open again": ("drive 1; stall 1; wait 0.01; once", "stall 0; once; wait 3", {"stop"}, 3, 100),
    "then neutral comes first": ("stall 1; drive 1; stall 0; drive 1; neutral; wait 2", "drive 1", {"move"}, 5, 100),
}


@pytest.mark.parametrize(("before", "watched", "kinds", "least", "most"), COURSES.values(), ids=COURSES)
async def test_a_robot_is_sent_stops_while_nobody_drives_it(before, watched, kinds, least, most) -> None:
    async with established(idle_stop_s=1.0, deadman_s=5.0) as rig:
        await play(rig, before)
        rig.forget_written()
        await play(rig, watched)
        written = rig.written()
        assert set(map(kind, written)) == kinds
        assert least <= len(written) <= most
        assert rig.control["state"] == ("stopped" if "stop" in before.split("; ") else "held")


SETTINGS = {
    version: bytes.fromhex(f"{7 + len(listed) + len(flags):02x}000000 01 02 02 {len(listed):02x}000000")
    + listed
    + flags
    for version, listed, flags in (
        ("1.1", b"1.1", bytes.fromhex("0001010101")),
        ("1.2", b"1.2", bytes.fromhex("000101010101")),
        ("1.3", b"1.1,1.2,1.3", bytes.fromhex("00010101010101 e8030000 0a000000")),
    )
}
"""serverSettings with Joystick of robots of three versions ("Versions and dialects" in ``tcpudp.md``)."""


@pytest.mark.parametrize(("version", "apart_s"), [("1.1", 0.25), ("1.2", 0.25), ("1.3", 1.0)])
async def test_idle_stops_come_evenly_and_can_be_turned_off(version: str, apart_s: float) -> None:
    async with serving(idle_stop_s=1.0) as rig:
        await rig.establish(SETTINGS[version])
        await play(rig, "wait 60")
        times = rig.link.times[-50:]
        assert all(later - sooner == pytest.approx(apart_s, rel=0.1) for sooner, later in itertools.pairwise(times))
        assert {kind(frame) for frame in rig.link.written[-50:]} == {"stop"}
    async with serving(idle_stop_s=0.0) as rig:
        await rig.establish(SETTINGS[version])
        await play(rig, "wait 60")
        rig.forget_written()
        await play(rig, "wait 60")
        assert rig.written() == []


async def test_idle_stops_are_as_frequent_as_configured_where_that_is_more() -> None:
    async with serving(idle_stop_s=0.125) as rig:
        await rig.establish(SETTINGS["1.1"])
        await play(rig, "wait 10")
        assert rig.link.times[-1] - rig.link.times[-9] == pytest.approx(1.0, rel=0.1)


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


async def test_a_robot_that_cannot_be_sent_its_stop_is_said_to_be_so() -> None:
    async with serving(idle_stop_s=1.0) as rig:
        await rig.establish(NO_JOYSTICK)
        await asyncio.sleep(5.0)
        assert rig.written() == []
        status = rig.last("status")
        assert status["state"] == "established"
        assert status["reason"] == "cannot be stopped: clientJoystickStop: the robot does not announce joystick"
        assert await rig.refusals() == []  # nobody asked for it: nothing was refused


# A link that takes nothing


async def test_a_link_that_takes_nothing_is_said_to_be_so_and_all_but_stops_is_refused_until_it_takes_again() -> None:
    async with established(deadman_s=5.0) as rig:
        await play(rig, "drive 1; stall 0.31; drive 2")
        assert rig.last("status")["reason"] == f"{STALLED}: it is not driven"
        assert rig.last("status")["stalled"] is True
        assert rig.metrics.total("link_stalls") == 1
        assert rig.metrics.total("drives_unwritten") >= 19
        (answer,) = rig.ask("pose").replies
        assert str(answer.error) == STALLED
        await play(rig, "mode autonomous; stall 0; drive 0.1")
        reasons = {command: reason for command, reason, _ in await rig.refusals()}
        neutral_first = "the robot's link stalled: send a neutral drive first"
        assert reasons == {"mode": STALLED, "drive": neutral_first}
        assert rig.last("status")["reason"] is None


async def test_a_link_is_looked_at_again_without_anything_to_write() -> None:
    """What was written last is not acknowledged: nothing wakes the gateway but its own look."""
    async with established() as rig:
        await play(rig, "drive 0.2; neutral; wait 2; stall 0.1")
        rig.command("lidar", {"on": True})
        await play(rig, "stall 0.4; wait 0.5")
        assert rig.last("status")["reason"] == f"{STALLED}: it is not driven"
        rig.forget_written()
        await play(rig, "stall 0; wait 0.1")
        assert rig.written()[:1] == [STOP]


async def test_a_gateway_that_ends_while_the_link_takes_nothing_leaves_the_stop_to_the_kernel() -> None:
    async with established(deadman_s=5.0) as rig:
        await play(rig, "drive 0.5; stall 1; drive 0.5")
        rig.forget_written()
    written = rig.written()
    assert written[0] == STOP
    assert "move" not in map(kind, written)


async def test_a_link_that_is_lost_while_it_takes_nothing_leaves_no_trace() -> None:
    async with established(deadman_s=5.0) as rig:
        await play(rig, "stall 1; drive 0.2")
        rig.goes("connection lost: [Errno 110]")
        await rig.settle()
        assert rig.last("status")["reason"] == "connection lost: [Errno 110]"
        await asyncio.sleep(1.0)
        await rig.establish()
        assert rig.last("status")["reason"] is None
