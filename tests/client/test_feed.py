"""What a robot publishes, as a program gets it: typed, numpy arrays, the last state first, losses counted."""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import Any

import numpy as np
import pytest

from tests.client import Gateway, settle, subscriptions
from zbridge.bus.fake import FakeBus
from zbridge.client import Feed, Fleet, Robot
from zbridge.client.feed import WAITING
from zbridge.errors import NotReady
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Control,
    Device,
    Devices,
    FleetMessage,
    Map,
    Motion,
    Pose,
    Raw,
    Reading,
    Scan,
    Scanner,
    Status,
    Switch,
    Text,
)
from zbridge.fleet.topics import Topic

pytestmark = pytest.mark.jumping

SCAN = Scan(
    angle_min=-0.5,
    angle_increment=0.5,
    range_min=0.1,
    range_max=4.0,
    ranges=np.array([1.5, math.nan, 3.25], np.float32),
)
MAP = Map(rows=2, columns=3, cell=0.1, origin=(-1.0, 2.0), cells=np.array([[0, 1, 2], [2, 1, 0]], np.uint8))
SCANNER = Scanner(
    angle_min=0.0, angle_max=1.0, angle_increment=0.1, time_increment_s=0.0, range_min=0.1, range_max=4.0, points=11
)
STREAMS: list[tuple[Topic, FleetMessage]] = [
    (topics.SCAN, SCAN),
    (topics.MOTION, Motion(speed=0.5, acceleration=(1.0, 2.0, 3.0))),
    (topics.POSE, Pose(x=1.0, y=2.0, heading=0.5, stamp_ns=7)),
    (topics.TEXT, Text(text="hello", kind="debug")),
]
STATES: list[tuple[Topic, FleetMessage]] = [
    (topics.STATUS, Status(state="established", features=("cam",))),
    (topics.CONTROL, Control(state="held", holder="ann@here", priority=0, expires_in_s=2.5)),
    (topics.SCANNER, SCANNER),
    (topics.MAP, MAP),
    (topics.LIDAR, Switch(on=True)),
    (topics.CAMERA, Switch(on=False)),
    (topics.DEVICES, Devices(devices=(Device("arm", 1, "motor"),))),
]
NAMES = [topic.path for topic, _ in STREAMS + STATES]


def at(number: int) -> Pose:
    return Pose(x=float(number), y=0.0, heading=0.0)


class World:
    """A robot that publishes what the test says, and a program that looks at it."""

    def __init__(self) -> None:
        self.bus = FakeBus()
        self.gateway = Gateway(self.bus)
        self.robot: Robot = Fleet(self.bus.join("program"))["r1"]

    def feed(self, topic: Topic) -> Any:
        """The robot's feed of a topic; called as the topic is."""
        return getattr(self.robot, topic.path)


def same(message: FleetMessage, other: FleetMessage) -> bool:
    return payloads.encode(message) == payloads.encode(other)


async def reading(feed: Feed[Any]) -> tuple[Any, asyncio.Task[Any]]:
    """Begin to iterate; give the iterator, and the task that waits for the first message."""
    messages = aiter(feed)
    task = asyncio.ensure_future(anext(messages))
    await settle()
    return messages, task


@pytest.mark.parametrize(("topic", "message"), STREAMS + STATES, ids=NAMES)
async def test_every_feed_gives_the_message_of_its_key(topic: Topic, message: FleetMessage) -> None:
    world = World()
    messages, first = await reading(world.feed(topic))
    world.gateway.publish(topic, message)
    got = await first
    assert type(got) is topic.message
    assert same(got, message)
    await messages.aclose()


async def test_ranges_are_a_float32_array_with_nan_for_the_invalid() -> None:
    world = World()
    messages, first = await reading(world.robot.scan)
    world.gateway.publish(topics.SCAN, SCAN)
    ranges = (await first).ranges
    assert (type(ranges), ranges.dtype, ranges.shape) == (np.ndarray, np.float32, (3,))
    np.testing.assert_array_equal(ranges, np.array([1.5, math.nan, 3.25], np.float32))
    await messages.aclose()


async def test_cells_are_a_uint8_array_of_rows_and_columns() -> None:
    world = World()
    world.gateway.publish(topics.MAP, MAP)
    (seen,) = [await anext(aiter(world.robot.map))]
    for cells in (seen.cells, (await world.robot.map.last()).cells):  # type: ignore[union-attr]
        assert (cells.dtype, cells.shape) == (np.uint8, (2, 3))
        np.testing.assert_array_equal(cells, MAP.cells)


async def test_one_sensor_all_sensors_and_raw_messages() -> None:
    world = World()
    one, first = await reading(world.robot.sensor("front left"))
    every, pair = await reading(world.robot.sensors)
    raw, packet = await reading(world.robot.raw("tcpudp"))
    world.gateway.publish(topics.SENSOR("other"), Reading(value=1.0))
    world.gateway.publish(topics.SENSOR("front left"), Reading(value=2.0, kind="range"))
    world.gateway.publish(topics.RAW("other"), Raw(id=1))
    world.gateway.publish(topics.RAW("tcpudp"), Raw(id=9, body=b"abc"))
    assert await first == Reading(value=2.0, kind="range")
    assert [await pair, await anext(every)] == [
        ("other", Reading(value=1.0)),
        ("front left", Reading(value=2.0, kind="range")),
    ]
    assert await packet == Raw(id=9, body=b"abc")
    for messages in (one, every, raw):
        await messages.aclose()


async def test_messages_come_in_order_and_only_those_of_this_robot() -> None:
    world = World()
    other = Gateway(world.bus, "r2")
    messages, first = await reading(world.robot.pose)
    for number in range(3):
        other.publish(topics.POSE, at(100 + number))
        world.gateway.publish(topics.POSE, at(number))
    assert [await first, await anext(messages), await anext(messages)] == [at(0), at(1), at(2)]
    await messages.aclose()


async def test_a_state_gives_its_last_value_first_and_then_what_comes() -> None:
    world = World()
    world.gateway.publish(topics.LIDAR, Switch(on=False))
    world.gateway.publish(topics.LIDAR, Switch(on=True))
    messages, first = await reading(world.robot.lidar)
    assert await first == Switch(on=True)
    world.gateway.publish(topics.LIDAR, Switch(on=False))
    assert await anext(messages) == Switch(on=False)
    await messages.aclose()


async def test_a_stream_gives_nothing_of_what_was_before() -> None:
    world = World()
    world.gateway.publish(topics.POSE, at(1))
    messages, first = await reading(world.robot.pose)
    world.gateway.publish(topics.POSE, at(2))
    assert await first == at(2)
    await messages.aclose()


async def test_a_slow_program_gets_the_newest_and_is_told_how_many_it_lost() -> None:
    world = World()
    feed = world.robot.pose
    messages, first = await reading(feed)
    world.gateway.publish(topics.POSE, at(0))
    assert await first == at(0)
    for number in range(1, WAITING + 4):
        world.gateway.publish(topics.POSE, at(number))
    got = [await anext(messages) for _ in range(WAITING)]
    assert feed.lost == 3
    assert got == [at(number) for number in range(4, WAITING + 4)], "the oldest make room"
    assert feed.malformed == 0
    await messages.aclose()


async def test_every_iteration_has_a_queue_of_its_own() -> None:
    world = World()
    feed = world.robot.pose
    (slow, waits), (quick, first) = await reading(feed), await reading(feed)
    assert subscriptions(world.bus, feed.key_expr) == 2
    world.gateway.publish(topics.POSE, at(1))
    world.gateway.publish(topics.POSE, at(2))
    assert [await first, await anext(quick)] == [at(1), at(2)]
    await quick.aclose()
    world.gateway.publish(topics.POSE, at(3))
    assert [await waits, await anext(slow), await anext(slow)] == [at(1), at(2), at(3)]
    await slow.aclose()


@pytest.mark.parametrize("payload", [b"\xc1", b"\x80", payloads.encode(Text(text="no pose"))])
async def test_what_is_malformed_is_left_out_and_counted(payload: bytes) -> None:
    world = World()
    feed = world.robot.pose
    messages, first = await reading(feed)
    world.gateway.put(topics.POSE, payload)
    world.gateway.publish(topics.POSE, at(1))
    world.gateway.put(topics.POSE, payload)
    world.gateway.publish(topics.POSE, at(2))
    assert [await first, await anext(messages)] == [at(1), at(2)]
    assert (feed.malformed, feed.lost) == (2, 0)
    await messages.aclose()


async def test_a_map_whose_cells_do_not_fill_it_is_malformed() -> None:
    world = World()
    messages, first = await reading(world.robot.map)
    short = Map(rows=2, columns=3, cell=0.1, origin=(0.0, 0.0), cells=np.zeros(5, np.uint8))
    world.gateway.publish(topics.MAP, short)
    world.gateway.publish(topics.MAP, MAP)
    assert same(await first, MAP)
    assert world.robot.map.malformed == 1
    await messages.aclose()


async def iterate(feed: Feed[Any], how: str) -> None:
    """Take one message, then end in one of the ways programs do."""
    async for _ in feed:
        match how:
            case "break":
                break
            case "return":
                return
            case "exception":
                raise KeyError(how)
            case "cancelled":
                await asyncio.Event().wait()


@pytest.mark.parametrize("how", ["break", "return", "exception", "cancelled"])
async def test_the_subscription_ends_with_the_iteration(how: str) -> None:
    world = World()
    feed = world.robot.pose
    task = asyncio.create_task(iterate(feed, how))
    await settle()
    assert subscriptions(world.bus, feed.key_expr) == 1
    world.gateway.publish(topics.POSE, at(1))
    await settle()
    task.cancel()
    with contextlib.suppress(KeyError, asyncio.CancelledError):
        await task
    del task
    await settle()
    assert subscriptions(world.bus, feed.key_expr) == 0


async def test_the_subscription_ends_where_the_waiting_is_cancelled() -> None:
    world = World()
    feed = world.robot.pose
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(iterate(feed, "end"), 1.0)
    assert subscriptions(world.bus, feed.key_expr) == 0


async def test_a_feed_can_be_iterated_again() -> None:
    world = World()
    feed = world.robot.lidar
    world.gateway.publish(topics.LIDAR, Switch(on=True))
    for _ in range(3):
        async for switch in feed:
            assert switch == Switch(on=True)
            break
        await settle()
        assert subscriptions(world.bus, feed.key_expr) == 0


async def test_nothing_is_subscribed_before_somebody_iterates() -> None:
    world = World()
    assert repr(world.robot.pose) == "<Feed fleet/r1/pose>"
    assert subscriptions(world.bus, "fleet/r1/pose") == 0


@pytest.mark.parametrize(("topic", "message"), STATES, ids=NAMES[len(STREAMS) :])
async def test_last_is_none_before_a_state_was_published_and_then_its_value(topic, message) -> None:
    world = World()
    assert await world.feed(topic).last() is None
    world.gateway.publish(topic, message)
    assert same(await world.feed(topic).last(), message)
    assert subscriptions(world.bus, world.feed(topic).key_expr) == 0


async def test_last_is_none_where_the_question_is_refused() -> None:
    world = World()
    world.bus.answer("fleet/r1/map", lambda question: question.refuse(NotReady("no map")))
    assert await world.robot.map.last() is None


async def test_last_is_none_again_when_the_robots_gateway_is_gone() -> None:
    world = World()
    world.gateway.publish(topics.LIDAR, Switch(on=True))
    await world.gateway.vanish()
    assert await world.robot.lidar.last() is None


async def test_only_states_have_a_last_value() -> None:
    robot = World().robot
    assert {name for name in NAMES if hasattr(getattr(robot, name), "last")} == {topic.path for topic, _ in STATES}
