"""What a robot says as fleet messages, by hand from the protocol page; maps that come in parts; questions."""

import asyncio
import math
import struct
from collections.abc import Iterable

import msgpack
import numpy as np
import pytest

from gateways.tcpudp.options import TcpUdpOptions
from tests.gateways.tcpudp.frames import LISTED, LISTED_14, Stage, counted, framed, server_settings
from tests.robot.test_device import serving
from zbridge.errors import ProtocolError
from zbridge.fleet import topics
from zbridge.fleet.messages import Map, Pose, Raw, Switch, Text
from zbridge.fleet.topics import Topic

STAMP = 1_700_000_000_000_000_000
RAW = topics.RAW("tcpudp")
GET_MAP, GET_POSE = bytes.fromhex("02000000 02 34"), bytes.fromhex("02000000 02 36")


def settings(size: int = 0, interval: int = 0, flags: str = "00010101010101", listed: bytes = LISTED) -> bytes:
    return server_settings(listed, flags + struct.pack("<ii", size, interval).hex(), 2)


def shown(stage: Stage, *frames: bytes) -> Map | None:
    """The map that the last of what a robot sends makes."""
    for topic, message in stage.told(*frames):
        assert topic is topics.MAP
        assert isinstance(message, Map)
        return message
    return None


def rows(grid: object) -> list[list[int]]:
    assert isinstance(grid, Map)
    return np.asarray(grid.cells).reshape(grid.rows, grid.columns).tolist()


def a_map(cells: bytes) -> bytes:
    return framed(1, 53, counted(cells))


@pytest.mark.parametrize(
    ("options", "position", "x", "y", "heading"),
    [
        (TcpUdpOptions(), (150.0, -50.0, 0.0), 1.5, -0.5, math.pi / 2),
        (TcpUdpOptions(), (0.0, 0.0, 90.0), 0.0, 0.0, math.pi),
        (TcpUdpOptions(), (1.0, 2.0, -90.0), 0.01, 0.02, 0.0),
        (TcpUdpOptions(length_unit_m=0.001, heading_offset=0.0), (150.0, -50.0, 180.0), 0.15, -0.05, math.pi),
    ],
)
def test_a_pose_is_in_metres_with_x_and_y_kept_and_its_heading_turned_by_a_quarter(options, position, x, y, heading):
    frame = framed(1, 55, struct.pack("<3f", *position))
    ((topic, pose),) = Stage(settings(), options).told(frame, stamp_ns=STAMP)
    assert topic is topics.POSE
    assert isinstance(pose, Pose)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((x, y, heading))
    assert pose.stamp_ns == STAMP


def test_a_map_is_transposed_from_x_major_to_rows_of_y_and_unknown_values_are_unknown_cells() -> None:
    grid = shown(Stage(settings(30, 10)), a_map(bytes([0, 1, 2, 2, 2, 0, 1, 0, 1])))
    assert rows(grid) == [[0, 2, 1], [1, 2, 0], [2, 0, 1]]
    assert grid is not None
    assert (grid.cell, grid.stamp_ns, *grid.origin) == pytest.approx((0.1, 7, -0.15, -0.15))
    grid = shown(
        Stage(settings(), TcpUdpOptions(map_cell_m=0.25, map_origin=(-1.0, 2.0))), a_map(bytes([3, 1, 2, 255]))
    )
    assert rows(grid) == [[0, 2], [1, 0]]
    assert grid is not None
    assert (grid.cell, grid.origin) == (0.25, (-1.0, 2.0))


@pytest.mark.parametrize(
    ("size", "interval", "cell"),
    [
        (40, 10, 0.1),
        (45, 10, 0.1),
        (1000, 10, 0.1),  # does not fit the body: the square root
        (0, 0, 0.01),  # nothing announced
        (40, 0, 0.01),
        (0, 5, 0.05),
        (-1000, -10, 0.01),
        (2**31 - 1, 1, 0.01),
    ],
)
def test_the_side_of_a_map_is_what_was_announced_where_it_fits_else_the_square_root(size, interval, cell) -> None:
    stage = Stage(settings(size, interval))
    grid = shown(stage, a_map(bytes(16)))
    assert grid is not None
    assert (grid.rows, grid.columns) == (4, 4)
    assert grid.cell == pytest.approx(cell)
    for empty in (a_map(b""), framed(1, 53)):
        grid = shown(stage, empty)
        assert grid is not None
        assert (grid.rows, grid.columns, grid.cells.shape, grid.origin) == (0, 0, (0, 0), (0.0, 0.0))


@pytest.mark.parametrize(
    ("frame", "topic", "message"),
    [
        ("06000000 01 33 01000000", topics.LIDAR, Switch(on=True, stamp_ns=STAMP)),
        ("06000000 01 33 02000000", topics.LIDAR, Switch(on=False, stamp_ns=STAMP)),
        ("06000000 01 1f 01000000", topics.CAMERA, Switch(on=True, stamp_ns=STAMP)),
        ("06000000 01 1f 02000000", topics.CAMERA, Switch(on=False, stamp_ns=STAMP)),
        ("08000000 01 01 02000000 6869", topics.TEXT, Text(text="hi", kind="debug", stamp_ns=STAMP)),
        ("02000000 01 3c", topics.TEXT, Text("simulated lidar data", "request", stamp_ns=STAMP)),
        ("03000000 01 28 01", RAW, Raw(id=40, body=b"\x01", stamp_ns=STAMP)),
        ("03000000 01 46 02", RAW, Raw(id=70, body=b"\x02", stamp_ns=STAMP)),
    ],
)
def test_a_packet_becomes_its_telemetry(frame: str, topic: Topic, message: object) -> None:
    assert Stage(settings()).told(bytes.fromhex(frame), stamp_ns=STAMP) == [(topic, message)]


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        *((framed(1, 51, struct.pack("<i", mode)), f"mode {mode}") for mode in (0, 3, -1, 2**31 - 1)),
        (framed(1, 31, bytes(4)), "mode 0"),
        *((a_map(bytes(count)), f"map of {count} cells is not square") for count in (2, 3, 5, 10_001)),
        (framed(1, 56, bytes.fromhex("00000000 01000000 01")), "announces no map size"),
    ],
)
def test_what_has_no_meaning_is_refused(frame: bytes, reason: str) -> None:
    with pytest.raises(ProtocolError, match=reason):
        Stage(settings()).told(frame)


# Parts of "1.4" robots, which send them all the time and read meanwhile


def part(start: int, cells: Iterable[int]) -> bytes:
    values = bytes(cells)
    return framed(1, 56, struct.pack("<ii", start, start + len(values)) + values)


NINE = settings(30, 10, listed=LISTED_14)
FIRST, SECOND, LAST = part(0, (0, 0, 1)), part(3, (0, 2, 2)), part(6, (0, 0, 1))
WHOLE = [[0, 0, 0], [0, 2, 0], [1, 2, 1]]
FIRST_ONLY = [[0, 0, 0], [0, 0, 0], [1, 0, 0]]


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        pytest.param([FIRST, SECOND, LAST], WHOLE, id="index x times side plus y"),
        pytest.param([SECOND, FIRST, LAST], WHOLE, id="in any order"),
        pytest.param(
            [FIRST, part(3, ()), LAST], [[0, 0, 0], [0, 0, 0], [1, 0, 1]], id="one is empty, one did not come"
        ),
        pytest.param([part(7, (1, 2, 1, 1, 1, 1))], [[0, 0, 0], [0, 0, 1], [0, 0, 2]], id="it runs past the end"),
        pytest.param([part(0, [0, 0, 1, 0, 2, 2, 0, 0, 1] + [2] * 100)], WHOLE, id="the whole map and more"),
        *(pytest.param([FIRST, part(at, (2, 2))], FIRST_ONLY, id=f"behind the map: {at}") for at in (9, 2**31 - 3)),
        pytest.param([part(0, (3, 255, 1, 0, 4, 0, 0, 0, 128))], FIRST_ONLY, id="cells that are none"),
    ],
)
def test_the_last_part_makes_a_map_of_what_came(parts: list[bytes], expected: list[list[int]]) -> None:
    stage = Stage(NINE)
    assert not any(shown(stage, frame) for frame in parts[:-1])
    grid = shown(stage, parts[-1])
    assert rows(grid) == rows(stage.robot.known(topics.MAP)) == expected
    assert grid is not None
    assert grid.cell == pytest.approx(0.1)


def test_a_map_is_known_as_far_as_its_parts_have_come_and_one_that_was_shown_does_not_change() -> None:
    stage = Stage(NINE)
    assert stage.robot.known(topics.MAP) is None
    stage.told(FIRST)
    assert rows(stage.robot.known(topics.MAP)) == FIRST_ONLY
    before = shown(stage, SECOND, LAST)
    stage.told(part(0, (2, 2, 2)))
    assert rows(stage.robot.known(topics.MAP)) == [[2, 0, 0], [2, 2, 0], [2, 2, 1]], "the later replaces the former"
    assert rows(before) == WHOLE
    assert stage.robot.known(topics.POSE) is None


def asked(stage: Stage, *questions: Topic) -> list[bytes]:
    """What leaves because of questions."""
    for topic in questions:
        stage.robot.ask(topic)
    return stage.after(0.1)


def test_a_robot_is_asked_for_its_map_until_it_sends_parts_and_never_again_while_it_is_that_robot() -> None:
    stage = Stage(NINE)
    assert asked(stage, topics.MAP, topics.POSE) == [GET_MAP, GET_POSE]
    assert rows(shown(stage, FIRST)) == FIRST_ONLY, "the next part is the answer"
    assert shown(stage, SECOND) is None
    assert asked(stage, topics.MAP, topics.POSE) == [GET_POSE]
    stage.connect(NINE)
    assert stage.robot.known(topics.MAP) is None, "the map of a new connection is another one"
    assert asked(stage, topics.MAP) == []
    assert rows(shown(stage, SECOND)) == [[0, 0, 0], [0, 2, 0], [0, 2, 0]]
    stage.connect(settings(30, 10))
    assert asked(stage, topics.MAP) == [GET_MAP]


# The device; that such a robot is driven all the while is shown in tests/e2e


@pytest.mark.jumping
async def test_a_question_is_answered_by_the_next_part_or_refused_and_later_ones_by_what_came() -> None:
    async with serving() as rig:
        await rig.establish(NINE)
        question = rig.ask("map")
        await asyncio.sleep(2.1)
        assert [str(reply.error) for reply in question.replies] == ["the robot did not answer within 2 s"]
        question = rig.ask("map")
        await asyncio.sleep(0.1)
        assert rig.written() == [GET_MAP] * 2
        rig.sends(FIRST)
        ((payload, error),) = [(reply.payload, reply.error) for reply in question.replies]
        assert error is None
        assert msgpack.unpackb(payload)["cells"] == bytes([0, 0, 0, 0, 0, 0, 1, 0, 0])
        assert [reply.error for reply in rig.ask("map").replies] == [None]
        assert rig.written() == []
        assert rig.last("status")["reason"] is None, "parts never make a robot busy"
