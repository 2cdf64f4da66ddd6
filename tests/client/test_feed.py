"""What a robot publishes, as a program gets it: typed, numpy arrays, the last state first, losses counted."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import numpy as np
import pytest

from tests.client import Gateway, World, at, settle, subscriptions
from zbridge.client import Feed
from zbridge.client.feed import WAITING, WAITING_IMAGES
from zbridge.errors import NotReady
from zbridge.fleet import messages as fleet
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, Pose, Raw, Reading, Status, Switch, Text
from zbridge.fleet.topics import Topic

pytestmark = pytest.mark.jumping

RANGES, CELLS = np.array([1.5, math.nan, 3.25], np.float32), np.array([[0, 1, 2], [2, 1, 0]], np.uint8)
SCAN = fleet.Scan(angle_min=-0.5, angle_increment=0.5, range_min=0.1, range_max=4.0, ranges=RANGES)
MAP = fleet.Map(rows=2, columns=3, cell=0.1, origin=(-1.0, 2.0), cells=CELLS)
IMAGE = fleet.Image(format="jpeg", data=b"\xff\xd8\xff", width=640, height=480, stamp_ns=7)
STREAMS: list[tuple[Topic, FleetMessage]] = [
    (topics.SCAN, SCAN),
    (topics.MOTION, fleet.Motion(speed=0.5, acceleration=(1.0, 2.0, 3.0))),
    (topics.POSE, Pose(x=1.0, y=2.0, heading=0.5, stamp_ns=7)),
    (topics.TEXT, Text(text="hello", kind="debug")),
    (topics.IMAGE, IMAGE),
]
STATES: list[tuple[Topic, FleetMessage]] = [
    (topics.STATUS, Status(state="established", features=("cam",))),
    (topics.CONTROL, fleet.Control(state="held", holder="ann@here", priority=0, expires_in_s=2.5)),
    (topics.SCANNER, fleet.Scanner(0.0, 1.0, 0.1, 0.0, 0.1, 4.0, 11)),
    (topics.MAP, MAP),
    (topics.LIDAR, Switch(on=True)),
    (topics.CAMERA, Switch(on=False)),
    (topics.DEVICES, fleet.Devices(devices=(fleet.Device("arm", 1, "motor"),))),
]
NAMES = [topic.path for topic, _ in STREAMS + STATES]


@pytest.fixture
async def world() -> World:
    return World(served=False)


def subscribed(world: World) -> int:
    return subscriptions(world.bus, world.robot.pose.key_expr)


def same(message: FleetMessage, other: FleetMessage) -> bool:
    return type(message) is type(other) and payloads.encode(message) == payloads.encode(other)


@contextlib.asynccontextmanager
async def reading(feed: Feed[Any]) -> AsyncIterator[Callable[[int], Coroutine[Any, Any, list[Any]]]]:
    """Iterate; give a function that takes so many messages."""
    messages: Any = aiter(feed)
    waiting = [asyncio.ensure_future(anext(messages))]
    await settle()

    async def take(count: int) -> list[Any]:
        return [await (waiting.pop() if waiting else anext(messages)) for _ in range(count)]

    async with contextlib.aclosing(messages):
        yield take


@pytest.mark.parametrize(("topic", "message"), STREAMS + STATES, ids=NAMES)
async def test_every_feed_gives_the_message_of_its_key(world: World, topic: Topic, message: FleetMessage) -> None:
    async with reading(getattr(world.robot, topic.path)) as messages:
        world.gateway.publish(topic, message)
        (got,) = await messages(1)
    assert same(got, message)
    if isinstance(got, fleet.Scan):
        assert got.ranges.dtype == np.float32
        np.testing.assert_array_equal(got.ranges, RANGES)


@pytest.mark.parametrize(("topic", "message"), STATES, ids=NAMES[len(STREAMS) :])
async def test_last_is_the_value_of_a_state_and_none_before_and_when_the_gateway_is_gone(world, topic, message) -> None:
    feed = getattr(world.robot, topic.path)
    assert await feed.last() is None
    world.gateway.publish(topic, message)
    last = await feed.last()
    assert same(last, message)
    if isinstance(last, fleet.Map):
        assert last.cells.dtype == np.uint8
        np.testing.assert_array_equal(last.cells, CELLS)
    assert subscriptions(world.bus, feed.key_expr) == 0
    await world.gateway.vanish()
    assert await feed.last() is None


async def test_last_is_none_where_the_question_is_refused_and_only_states_have_one(world: World) -> None:
    world.bus.answer("fleet/r1/map", lambda question: question.refuse(NotReady("no map")))
    assert await world.robot.map.last() is None
    assert {name for name in NAMES if hasattr(getattr(world.robot, name), "last")} == {
        topic.path for topic, _ in STATES
    }


async def test_one_sensor_all_sensors_and_raw_messages_of_this_robot_in_order(world: World) -> None:
    other, reads = Gateway(world.bus, "r2"), Reading(value=2.0, kind="range")
    robot = world.robot
    async with (
        reading(robot.sensor("front left")) as one,
        reading(robot.sensors) as every,
        reading(robot.raw("x")) as raw,
    ):
        for topic, message in (
            (topics.SENSOR("other"), Reading(value=1.0)),
            (topics.SENSOR("front left"), reads),
            (topics.RAW("other"), Raw(id=1)),
            (topics.RAW("x"), Raw(id=9, body=b"abc")),
        ):
            other.publish(topic, Reading(value=7.0) if isinstance(message, Reading) else Raw(id=7))
            world.gateway.publish(topic, message)
        assert await one(1) == [reads]
        assert await every(2) == [("other", Reading(value=1.0)), ("front left", reads)]
        assert await raw(1) == [Raw(id=9, body=b"abc")]


async def test_a_state_gives_its_last_value_first_and_a_stream_nothing_of_what_was_before(world: World) -> None:
    world.gateway.publish(topics.LIDAR, Switch(on=False))
    world.gateway.publish(topics.LIDAR, Switch(on=True))
    world.pose(1)
    async with reading(world.robot.lidar) as states, reading(world.robot.pose) as stream:
        world.gateway.publish(topics.LIDAR, Switch(on=False))
        world.pose(2)
        assert await states(2) == [Switch(on=True), Switch(on=False)]
        assert await stream(1) == [at(2)]


async def test_a_slow_program_gets_the_newest_and_is_told_how_many_it_lost(world: World) -> None:
    async with reading(world.robot.pose) as messages:
        world.pose(0)
        assert await messages(1) == [at(0)]
        world.pose(*range(1, WAITING + 4))
        assert await messages(WAITING) == [at(number) for number in range(4, WAITING + 4)], "the oldest make room"
        assert (world.robot.pose.lost, world.robot.pose.malformed) == (3, 0)


async def test_of_images_only_the_newest_wait_for_they_are_large(world: World) -> None:
    async with reading(world.robot.image) as messages:
        await settle()
        publisher = world.bus.publisher(world.robot.image.key_expr, topics.IMAGE)
        for number in range(5):
            publisher.put(payloads.encode(fleet.Image(format="jpeg", data=bytes([number]))))
        assert [image.data for image in await messages(WAITING_IMAGES)] == [b"\3", b"\4"]
        assert world.robot.image.lost == 3


async def test_every_iteration_has_a_queue_of_its_own(world: World) -> None:
    assert subscribed(world) == 0, "before somebody iterates"
    async with reading(world.robot.pose) as slow:
        async with reading(world.robot.pose) as quick:
            assert subscribed(world) == 2
            world.pose(1, 2)
            assert await quick(2) == [at(1), at(2)]
        world.pose(3)
        assert await slow(3) == [at(1), at(2), at(3)]


SHORT_MAP = fleet.Map(rows=2, columns=3, cell=0.1, origin=(0.0, 0.0), cells=np.zeros(5, np.uint8))


@pytest.mark.parametrize(
    ("topic", "payload", "message"),
    [
        (topics.POSE, b"\xc1", at(1)),
        (topics.POSE, b"\x80", at(1)),
        (topics.POSE, payloads.encode(Text(text="no pose")), at(1)),
        (topics.MAP, payloads.encode(SHORT_MAP), MAP),
    ],
    ids=["no message", "empty", "another message", "cells that do not fill the map"],
)
async def test_what_is_malformed_is_left_out_and_counted(world: World, topic, payload: bytes, message) -> None:
    feed = getattr(world.robot, topic.path)
    async with reading(feed) as messages:
        for _ in range(2):
            world.gateway.put(topic, payload)
            world.gateway.publish(topic, message)
        assert all(same(got, message) for got in await messages(2))
    assert (feed.malformed, feed.lost) == (2, 0)


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


@pytest.mark.parametrize("how", ["break", "return", "exception", "cancelled", "cancelled before a message"])
async def test_the_subscription_ends_with_the_iteration_and_can_begin_again(world: World, how: str) -> None:
    for _ in range(2):
        task = asyncio.create_task(iterate(world.robot.pose, how))
        await settle()
        assert subscribed(world) == 1
        if how != "cancelled before a message":
            world.pose(1)
        await settle()
        task.cancel()
        with contextlib.suppress(KeyError, asyncio.CancelledError):
            await task
        del task
        await settle()
        assert subscribed(world) == 0
