"""Map parts of "1.4" robots, which send them all the time and read meanwhile: the map they make, and queries for it."""

import asyncio
from collections.abc import Iterable

import msgpack
import numpy as np
import pytest

from gateways.tcpudp.messages import ClientControllMode, ServerSLAMMapPart
from gateways.tcpudp.session import HqRole, limits
from gateways.tcpudp.translate import Options, TcpUdpRobot
from tests.gateways.tcpudp.frames import STOP, Timed, framed, server_settings
from tests.robot.test_device import serving
from zbridge.errors import ProtocolError
from zbridge.fleet import topics
from zbridge.fleet.messages import Map
from zbridge.fleet.topics import Topic
from zbridge.protocol.session import State

pytestmark = pytest.mark.jumping

LISTED_14 = b"1.1,1.2,1.3,1.4"
SIZE_30_10 = "1e000000 0a000000"
SETTINGS = server_settings(LISTED_14, "00010101010101" + SIZE_30_10)  # nine cells
UNSIZED = server_settings(LISTED_14, "00010101010101" + "00000000 00000000")
DRIVE_LEFT = {"left": 1.0}


def part(start: int, cells: Iterable[int], end: int | None = None) -> bytes:
    values = bytes(cells)
    end = start + len(values) if end is None else end
    return framed(1, 56, start.to_bytes(4, "little", signed=True) + end.to_bytes(4, "little", signed=True) + values)


FIRST, SECOND, LAST = part(0, (0, 0, 1)), part(3, (0, 2, 2)), part(6, (0, 0, 1))


# The session


def hq(settings: bytes = SETTINGS) -> Timed:
    timed = Timed(HqRole(limits(0.01)))
    timed.stream(settings, 0.1)
    return timed


@pytest.mark.parametrize("by", ["tcp", "udp"])
def test_parts_never_make_a_robot_busy(by: str) -> None:
    timed = hq()
    take = timed.stream if by == "tcp" else timed.datagram
    assert take(FIRST, 1.0) == [ServerSLAMMapPart(0, 3, b"\x00\x00\x01")]
    for second in range(2, 20):
        take(SECOND, float(second))
        timed.session.send(ClientControllMode(2))
        timed.until(second + 0.5)
        assert timed.frames("tcp", second, second + 0.1) == [bytes.fromhex("06000000 05 0a 02000000")]
        assert timed.session.busy is None
        assert timed.session.state is State.ESTABLISHED


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
def test_a_malformed_part_is_counted(malformed: bytes) -> None:
    timed = hq()
    assert timed.stream(malformed, 1.0) == []
    assert timed.session.traffic.malformed == 1


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
        self.connect(settings)

    def connect(self, settings: bytes = SETTINGS) -> None:
        self.session = self.robot.session("robot", "tcp://robot.test:1")
        self.session.open(0.0)
        self.session.receive(settings, 0.1)
        self.session.outgoing(0.1)

    def take(self, *frames: bytes) -> Map | None:
        """Take parts; give the map that the last of them makes."""
        drawn = None
        for frame in frames:
            (message,) = self.session.receive(frame, 1.0)
            drawn = None
            for topic, shown in self.robot.telemetry(message, 7):
                assert topic is topics.MAP
                assert isinstance(shown, Map)
                assert shown.stamp_ns == 7
                drawn = shown
        return drawn

    def known(self) -> Map | None:
        shown = self.robot.known(topics.MAP)
        assert shown is None or isinstance(shown, Map)
        return shown

    def asked(self, *questions: Topic) -> list[bytes | None]:
        """What leaves because of questions, and the nothing behind it."""
        for topic in questions:
            self.robot.ask(topic)
        frames = [self.session.outgoing(now) for now in (2.0, 3.0, 4.0)]
        return frames[: frames.index(None) + 1]


def rows(shown: Map | None) -> list[list[int]]:
    assert shown is not None
    assert (shown.rows, shown.columns) == (3, 3)
    return [[int(value) for value in row] for row in np.asarray(shown.cells).reshape(3, 3)]


WHOLE = [[0, 0, 0], [0, 2, 0], [1, 2, 1]]
FIRST_ONLY = [[0, 0, 0], [0, 0, 0], [1, 0, 0]]


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        pytest.param([FIRST, SECOND, LAST], WHOLE, id="index x times side plus y"),
        pytest.param([SECOND, FIRST, LAST], WHOLE, id="in any order"),
        pytest.param([FIRST, LAST], [[0, 0, 0], [0, 0, 0], [1, 0, 1]], id="one did not come"),
        pytest.param([FIRST, part(3, ()), LAST], [[0, 0, 0], [0, 0, 0], [1, 0, 1]], id="one is empty"),
        pytest.param([part(7, (1, 2, 1, 1, 1, 1))], [[0, 0, 0], [0, 0, 1], [0, 0, 2]], id="it runs past the end"),
        pytest.param([part(0, [0, 0, 1, 0, 2, 2, 0, 0, 1] + [2] * 100)], WHOLE, id="the whole map and more"),
        *(
            pytest.param([FIRST, part(start, (2, 2))], FIRST_ONLY, id=f"behind the map: {start}")
            for start in (9, 10, 1000, 2**31 - 3)
        ),
        pytest.param([part(0, (3, 255, 1, 0, 4, 0, 0, 0, 128))], FIRST_ONLY, id="cells that are none"),
    ],
)
def test_the_last_part_makes_a_map_of_what_came(parts: list[bytes], expected: list[list[int]]) -> None:
    drawn = Drawn()
    for frame in parts[:-1]:
        assert drawn.take(frame) is None
    shown = drawn.take(parts[-1])
    assert rows(shown) == expected
    assert shown is not None
    assert shown.cell == pytest.approx(0.1)


def test_parts_of_a_robot_that_announces_no_size_have_no_place() -> None:
    drawn = Drawn(UNSIZED)
    with pytest.raises(ProtocolError, match="announces no map size"):
        drawn.take(FIRST)
    assert drawn.known() is None


def test_a_shown_map_does_not_change_with_later_parts() -> None:
    drawn = Drawn()
    shown = drawn.take(FIRST, SECOND, LAST)
    later = drawn.take(part(0, (2, 2, 2)), LAST)
    assert rows(shown) == WHOLE
    assert rows(later) == [[2, 0, 0], [2, 2, 0], [2, 2, 1]]


def test_a_new_connection_begins_with_an_empty_map() -> None:
    drawn = Drawn()
    drawn.take(FIRST)
    drawn.connect()
    assert rows(drawn.take(LAST)) == [[0, 0, 0], [0, 0, 0], [0, 0, 1]]


# Queries: a robot that sends parts is never asked

GET_MAP, GET_POSE = bytes.fromhex("02000000 05 34"), bytes.fromhex("02000000 05 36")


def test_nothing_is_known_before_the_first_part_and_the_robot_is_asked_and_the_part_answers() -> None:
    drawn = Drawn()
    assert drawn.known() is None
    assert drawn.asked(topics.MAP) == [GET_MAP, None]
    assert rows(drawn.take(FIRST)) == FIRST_ONLY
    assert drawn.take(SECOND) is None


def test_a_map_is_known_as_far_as_its_parts_have_come() -> None:
    drawn = Drawn()
    drawn.take(FIRST)
    assert rows(drawn.known()) == FIRST_ONLY
    drawn.take(SECOND, LAST)
    assert rows(drawn.known()) == WHOLE
    drawn.take(part(0, (2, 2, 2)))
    assert rows(drawn.known()) == [[2, 0, 0], [2, 2, 0], [2, 2, 1]], "what was seen later replaces what was before"
    assert drawn.robot.known(topics.POSE) is None


def test_a_robot_that_sends_parts_is_never_asked_for_its_map_on_no_later_connection_either() -> None:
    drawn = Drawn()
    drawn.take(FIRST)
    assert drawn.asked(topics.MAP, topics.POSE) == [GET_POSE, None]
    drawn.connect()
    assert drawn.known() is None, "the map of a new connection is another one"
    assert drawn.asked(topics.MAP, topics.POSE) == [GET_POSE, None]
    assert rows(drawn.take(SECOND)) == [[0, 0, 0], [0, 2, 0], [0, 2, 0]]


def test_a_robot_that_is_another_one_after_a_reconnection_is_asked() -> None:
    drawn = Drawn()
    drawn.take(FIRST)
    drawn.connect(server_settings(b"1.1,1.2,1.3", "00010101010101" + SIZE_30_10))
    assert drawn.asked(topics.MAP) == [GET_MAP, None]


# The device: a robot that sends parts all the time is driven like any other

STOP_2 = STOP[:4] + b"\x02" + STOP[5:]
MOVE_2 = bytes.fromhex("0e000000 02 0b 000080bf 00000000 0000803f")


def for_2(settings: bytes) -> bytes:
    """The same settings with client id 2."""
    return settings[:6] + b"\x02" + settings[7:]


async def test_a_robot_is_driven_stopped_and_asked_while_its_parts_come() -> None:
    async with serving() as rig:
        await rig.establish(for_2(SETTINGS))
        for number in range(20):
            rig.sends((FIRST, SECOND, LAST)[number % 3])
            rig.command("drive", DRIVE_LEFT)
            await asyncio.sleep(0.5)
            assert set(rig.written()) == {MOVE_2}
            assert rig.last("status")["reason"] is None
            rig.command("drive", {})
            await asyncio.sleep(0.5)
            assert set(rig.written()) == {STOP_2}
            (answer,) = rig.ask("map").replies
            assert answer.payload is not None
        assert await rig.refusals() == []
        assert [shown["columns"] for shown in rig.values("map")] == [3] * 6


async def test_a_question_before_the_first_part_is_answered_by_it() -> None:
    async with serving() as rig:
        await rig.establish(for_2(SETTINGS))
        question = rig.ask("map")
        await asyncio.sleep(0.1)
        assert rig.written() == [bytes.fromhex("02000000 02 34")]
        rig.sends(FIRST)
        ((payload, error),) = [(reply.payload, reply.error) for reply in question.replies]
        assert error is None
        assert msgpack.unpackb(payload)["cells"] == bytes([0, 0, 0, 0, 0, 0, 1, 0, 0])
        later = rig.ask("map")
        assert len(later.replies) == 1
        assert rig.written() == []


async def test_a_question_that_no_part_answers_is_refused() -> None:
    async with serving() as rig:
        await rig.establish(for_2(SETTINGS))
        question = rig.ask("map")
        await asyncio.sleep(2.1)
        assert [str(reply.error) for reply in question.replies] == ["the robot did not answer within 2 s"]
