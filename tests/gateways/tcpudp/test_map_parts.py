"""Map parts of "1.4" robots: a robot that takes nothing meanwhile, and the map they make."""

import asyncio
from collections.abc import Iterable

import numpy as np
import pytest

from gateways.tcpudp.messages import ServerSLAMMapPart
from gateways.tcpudp.session import HqSession, limits
from gateways.tcpudp.translate import Options, TcpUdpRobot
from tests.clock import jumping
from tests.gateways.tcpudp.frames import POSITION, STOP, Timed, framed, server_settings
from tests.test_device import Rig, serving
from zbridge.errors import ProtocolError
from zbridge.fleet import topics
from zbridge.fleet.messages import Map
from zbridge.session.session import State

LISTED_14 = b"1.1,1.2,1.3,1.4"
SIZE_30_10 = "1e000000 0a000000"
SETTINGS = server_settings(LISTED_14, "00010101010101" + SIZE_30_10)  # nine cells
UNSIZED = server_settings(LISTED_14, "00010101010101" + "00000000 00000000")
NO_JOYSTICK = server_settings(LISTED_14, "00000000000001" + SIZE_30_10)
DRIVE_LEFT = {"left": 1.0}


def part(start: int, cells: Iterable[int], end: int | None = None) -> bytes:
    values = bytes(cells)
    end = start + len(values) if end is None else end
    return framed(1, 56, start.to_bytes(4, "little", signed=True) + end.to_bytes(4, "little", signed=True) + values)


FIRST, SECOND, LAST = part(0, (0, 0, 1)), part(3, (0, 2, 2)), part(6, (0, 0, 1))


# The session


def hq(settings: bytes = SETTINGS) -> Timed:
    timed = Timed(HqSession(limits(0.01)))
    timed.stream(settings, 0.1)
    return timed


@pytest.mark.parametrize("by", ["tcp", "udp"])
def test_a_robot_is_busy_from_the_first_part_to_one_and_a_half_seconds_of_silence(by: str) -> None:
    timed = hq()
    take = timed.stream if by == "tcp" else timed.datagram
    assert timed.session.busy is None
    assert take(FIRST, 1.0) == [ServerSLAMMapPart(0, 3, b"\x00\x00\x01")]
    assert timed.session.busy == "busy: map"
    assert timed.session.state is State.ESTABLISHED
    take(SECOND, 2.0)
    timed.until(3.49)
    assert timed.session.busy == "busy: map"
    timed.until(3.51)
    assert timed.session.busy is None


def test_other_packets_do_not_lengthen_the_silence() -> None:
    timed = hq()
    timed.stream(FIRST, 1.0)
    timed.stream(POSITION, 2.0)
    timed.until(2.51)
    assert timed.session.busy is None


def test_a_part_after_the_silence_makes_the_robot_busy_again() -> None:
    timed = hq()
    timed.stream(FIRST, 1.0)
    timed.until(3.0)
    timed.stream(SECOND, 3.1)
    assert timed.session.busy == "busy: map"


@pytest.mark.parametrize(
    "malformed",
    [
        part(0, (1, 1), end=3),
        part(0, (1, 1), end=1),
        part(5, (1,), end=4),
        part(-1, (1,), end=0),
        framed(1, 56, bytes(7)),
    ],
)
def test_a_malformed_part_is_counted_and_makes_nobody_busy(malformed: bytes) -> None:
    timed = hq()
    assert timed.stream(malformed, 1.0) == []
    assert timed.session.traffic.malformed == 1
    assert timed.session.busy is None


def test_a_lost_robot_is_not_waited_for() -> None:
    timed = hq()
    timed.stream(FIRST, 1.0)
    timed.session.lost("closed by peer")
    assert timed.session.deadline() is None


# The map


class Drawn:
    """What the translation makes of parts."""

    def __init__(self, settings: bytes = SETTINGS) -> None:
        self.robot = TcpUdpRobot(Options())
        self.session = self.robot.session(0, "tcp://robot.test:1")
        self.session.open(0.0)
        self.session.receive(settings, 0.1)

    def take(self, frame: bytes) -> Map | None:
        (message,) = self.session.receive(frame, 1.0)
        for topic, shown in self.robot.telemetry(message, 7):
            assert topic is topics.MAP
            assert isinstance(shown, Map)
            assert shown.stamp_ns == 7
            return shown
        return None


def rows(shown: Map | None) -> list[list[int]]:
    assert shown is not None
    assert (shown.rows, shown.columns) == (3, 3)
    return [[int(value) for value in row] for row in np.asarray(shown.cells).reshape(3, 3)]


WHOLE = [[0, 0, 0], [0, 2, 0], [1, 2, 1]]


def test_the_last_part_makes_a_map_index_x_times_side_plus_y() -> None:
    drawn = Drawn()
    assert drawn.take(FIRST) is None
    assert drawn.take(SECOND) is None
    assert drawn.session.busy == "busy: map"
    shown = drawn.take(LAST)
    assert rows(shown) == WHOLE
    assert shown is not None
    assert shown.cell == pytest.approx(0.1)
    assert drawn.session.busy is None, "the last part ends it"


def test_a_part_that_did_not_come_is_unknown() -> None:
    drawn = Drawn()
    drawn.take(FIRST)
    assert rows(drawn.take(LAST)) == [[0, 0, 0], [0, 0, 0], [1, 0, 1]]


def test_parts_before_the_last_may_come_in_any_order() -> None:
    drawn = Drawn()
    drawn.take(SECOND)
    drawn.take(FIRST)
    assert rows(drawn.take(LAST)) == WHOLE


def test_a_part_that_runs_past_the_end_is_cut() -> None:
    drawn = Drawn()
    assert rows(drawn.take(part(7, (1, 2, 1, 1, 1, 1)))) == [[0, 0, 0], [0, 0, 1], [0, 0, 2]]
    assert drawn.session.busy is None


def test_one_part_may_be_the_whole_map_and_more() -> None:
    assert rows(Drawn().take(part(0, [0, 0, 1, 0, 2, 2, 0, 0, 1] + [2] * 100))) == WHOLE


@pytest.mark.parametrize("start", [9, 10, 1000, 2**31 - 3])
def test_a_part_that_begins_behind_the_map_changes_nothing_in_it(start: int) -> None:
    drawn = Drawn()
    drawn.take(FIRST)
    assert rows(drawn.take(part(start, (2, 2)))) == [[0, 0, 0], [0, 0, 0], [1, 0, 0]]
    assert drawn.session.busy is None


def test_an_empty_part_changes_nothing() -> None:
    drawn = Drawn()
    drawn.take(FIRST)
    assert drawn.take(part(3, ())) is None
    assert drawn.session.busy == "busy: map"
    assert rows(drawn.take(LAST)) == [[0, 0, 0], [0, 0, 0], [1, 0, 1]]


def test_cells_that_are_none_are_unknown() -> None:
    assert rows(Drawn().take(part(0, (3, 255, 1, 0, 4, 0, 0, 0, 128)))) == [[0, 0, 0], [0, 0, 0], [1, 0, 0]]


def test_parts_of_a_robot_that_announces_no_size_have_no_place_and_end_by_silence() -> None:
    drawn = Drawn(UNSIZED)
    with pytest.raises(ProtocolError, match="announces no map size"):
        drawn.take(FIRST)
    assert drawn.session.busy == "busy: map"
    drawn.session.expire(2.51)
    assert drawn.session.busy is None


def test_a_shown_map_does_not_change_with_later_parts() -> None:
    drawn = Drawn()
    drawn.take(FIRST)
    drawn.take(SECOND)
    shown = drawn.take(LAST)
    drawn.take(part(0, (2, 2, 2)))
    assert rows(shown) == WHOLE
    assert rows(drawn.take(LAST)) == [[2, 0, 0], [2, 2, 0], [2, 2, 1]]


def test_a_new_connection_begins_with_an_empty_map() -> None:
    drawn = Drawn()
    drawn.take(FIRST)
    drawn.session = drawn.robot.session(0, "tcp://robot.test:1")
    drawn.session.open(0.0)
    drawn.session.receive(SETTINGS, 0.1)
    assert rows(drawn.take(LAST)) == [[0, 0, 0], [0, 0, 0], [0, 0, 1]]


# The device: a stop at both ends, and no motion in between

STOP_2 = STOP[:4] + b"\x02" + STOP[5:]


def for_2(settings: bytes) -> bytes:
    """The same settings with client id 2."""
    return settings[:6] + b"\x02" + settings[7:]


@jumping
async def test_the_first_part_stops_the_robot_and_commands_are_refused_until_the_last() -> None:
    async with serving() as rig:
        await rig.establish(for_2(SETTINGS))
        rig.command("drive", DRIVE_LEFT)
        await asyncio.sleep(0.1)
        rig.forget_written()
        rig.sends(FIRST)
        assert rig.written() == [STOP_2]
        status = rig.last("status")
        assert (status["state"], status["reason"]) == ("established", "busy: map")
        assert rig.last("control")["state"] == "held"
        for name, fields in (("drive", {}), ("mode", {"mode": "manual"}), ("drive", DRIVE_LEFT)):
            rig.command(name, fields)
        refusals = await rig.refusals()
        assert ("drive", "busy: map", 2) in refusals
        assert ("mode", "busy: map", 1) in refusals
        question = rig.ask("pose")
        assert [str(answer.error) for answer in question.replies] == ["busy: map"]
        await asyncio.sleep(1.2)
        assert set(rig.written()) == {STOP_2}


@jumping
async def test_the_stop_is_repeated_after_the_last_part_and_motion_needs_neutral() -> None:
    async with serving() as rig:
        await rig.establish(for_2(SETTINGS))
        rig.sends(FIRST)
        await asyncio.sleep(1.2)
        rig.sends(SECOND)
        await asyncio.sleep(1.2)
        rig.forget_written()
        rig.sends(LAST)
        assert rig.written() == [STOP_2]
        assert rig.last("status")["reason"] is None
        await assert_motion_needs_neutral(rig)
        assert [shown["columns"] for shown in rig.values("map")] == [3]


@jumping
async def test_the_stop_is_repeated_after_one_and_a_half_seconds_of_silence() -> None:
    async with serving() as rig:
        await rig.establish(for_2(SETTINGS))
        rig.sends(FIRST)
        await asyncio.sleep(1.45)
        rig.forget_written()
        assert rig.last("status")["reason"] == "busy: map"
        await asyncio.sleep(0.1)
        assert rig.written() == [STOP_2]
        assert rig.last("status")["reason"] is None
        await assert_motion_needs_neutral(rig)


async def assert_motion_needs_neutral(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    assert {frame[5] for frame in rig.written()} <= {13}
    assert rig.last("control")["state"] == "held"
    rig.command("drive", {})
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    assert rig.written()[-1][5] == 11


@jumping
async def test_a_map_in_one_part_stops_the_robot_too() -> None:
    async with serving() as rig:
        await rig.establish(for_2(SETTINGS))
        rig.command("drive", DRIVE_LEFT)
        await asyncio.sleep(0.1)
        rig.forget_written()
        rig.sends(part(0, [1] * 9))
        await asyncio.sleep(0.1)
        assert set(rig.written()) == {STOP_2}
        assert rig.last("status")["reason"] is None


@jumping
async def test_a_robot_that_cannot_be_stopped_is_not_lost_for_its_map() -> None:
    """Many robots announce no joystick: the stop is refused, the map is shown all the same."""
    async with serving() as rig:
        await rig.establish(for_2(NO_JOYSTICK))
        rig.sends(FIRST)
        assert rig.written() == []
        assert rig.last("status")["state"] == "established"
        rig.sends(LAST)
        assert len(rig.values("map")) == 1
        rig.sends(FIRST)
        await asyncio.sleep(2.0)
        assert (
            rig.last("status")["reason"]
            == "cannot be stopped: clientJoystickStop: the robot does not announce joystick"
        )


@jumping
async def test_a_robot_that_is_lost_while_its_map_comes_is_offline_and_not_busy() -> None:
    async with serving() as rig:
        await rig.establish(for_2(SETTINGS))
        rig.sends(FIRST)
        rig.goes("closed by peer")
        await rig.settle()
        offline = [status["reason"] for status in rig.values("status") if status["state"] == "offline"]
        assert offline[1:] == ["closed by peer"]
        rig.command("drive", DRIVE_LEFT)
        assert ("drive", "offline", 1) in await rig.refusals()
        await asyncio.sleep(2.0)
        await rig.establish(for_2(SETTINGS))
        await asyncio.sleep(0.1)
        assert rig.written() == []
        assert rig.last("status")["reason"] is None
