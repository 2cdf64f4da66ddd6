"""The client without ``async``: the same robots from plain programs, threads and notebooks, over a fake bus."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import inspect
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any
from unittest import mock

import numpy as np
import pytest

import tests.client
import zbridge
import zbridge.client
from tests.client import at, subscriptions, tokens
from tests.fake_bus import FakeBus
from zbridge.bus import BusSettings
from zbridge.client import blocking
from zbridge.client.driver import Driver
from zbridge.client.feed import WAITING
from zbridge.errors import BusError, Held, LeaseLost, NotReady, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Map, Pose

ME = "ann@here"
POSE = Pose(x=1.0, y=2.0, heading=0.5)
MAP = Map(rows=2, columns=1, cell=0.1, origin=(0.0, 0.0), cells=np.array([[1], [2]], np.uint8))
SOON_S = 5.0
"""Longest time a test waits for what is to happen at once."""


class World(tests.client.World):
    """The bus on the client's thread, with a robot on it; ``on_bus`` does things there."""

    def __init__(self) -> None:
        super().__init__()
        self.bus.answer("fleet/r1/@rpc/pose", lambda question: question.answer(payloads.encode(POSE)))
        self.bus.answer("fleet/r1/@rpc/map", lambda question: question.refuse(NotReady("offline")))
        self.closed = False

    def on_bus(self, work: Callable[[], Any]) -> Any:
        """Do something on the client's thread, and wait for it."""

        async def do() -> Any:
            return work()

        return asyncio.run_coroutine_threadsafe(do(), self.loop).result(SOON_S)

    def publish(self, *xs: float) -> None:
        """Have the robot publish poses."""
        self.on_bus(lambda: self.pose(*xs))

    def soon(self, *xs: float) -> None:
        """Have the robot publish poses when somebody iterates them."""
        if subscriptions(self.bus, "fleet/r1/pose"):
            self.pose(*xs)
        else:
            self.loop.call_soon_threadsafe(self.loop.call_later, 0.001, self.soon, *xs)

    @property
    def listeners(self) -> int:
        return int(self.on_bus(lambda: subscriptions(self.bus, "fleet/r1/pose")))


class Bus(FakeBus):
    """Remembers that it was left."""

    def __init__(self, world: World) -> None:
        super().__init__("mine", world.bus.network)
        self._world = world

    async def close(self) -> bool:
        self._world.closed = True
        return await super().close()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[tuple[World, BusSettings]]:
    """Have every client find a fake bus of its own; give what was made."""
    worlds: list[tuple[World, BusSettings]] = []

    async def open_bus(settings: BusSettings, metrics: Any, *, wait_for_peers: bool = False, realm: str) -> FakeBus:
        worlds.append((World(), settings))
        return Bus(worlds[-1][0])

    monkeypatch.setattr(zbridge.client, "open_bus", open_bus)
    return worlds


@pytest.fixture
def fleet(opened: list[tuple[World, BusSettings]]) -> Iterator[blocking.Fleet]:
    before = set(threading.enumerate())
    with zbridge.blocking.connect() as fleet:
        yield fleet
    assert set(threading.enumerate()) <= before, "no thread is left"


@pytest.fixture
def world(opened: list[tuple[World, BusSettings]], fleet: blocking.Fleet) -> World:
    return opened[-1][0]


def until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.005)


def lease(robot: blocking.Robot, who: str = ME, **wishes: Any) -> None:
    """Hold the lease for nothing."""
    with robot.control(who, **wishes):
        pass


# The bus and its thread


def test_the_bus_and_its_thread_live_as_long_as_the_context(opened: list[tuple[World, BusSettings]]) -> None:
    before = set(threading.enumerate())
    with zbridge.blocking.connect(["tcp/h:1"], realm="fleet") as fleet:
        ((world, settings),) = opened
        assert settings.connect == ("tcp/h:1",)
        assert not world.closed
        (thread,) = set(threading.enumerate()) - before
        assert thread.daemon, "a program that dies does not wait for it"
        with zbridge.blocking.connect() as other:
            assert fleet["r1"].ask_pose() == other["r1"].ask_pose() == POSE
    assert world.closed
    with pytest.raises(BusError, match=r"^this client was closed$"):
        fleet["r1"].ask_pose()
    gc.collect()  # a coroutine that was never awaited would be an error
    with contextlib.suppress(KeyError), zbridge.blocking.connect():
        raise KeyError
    assert [world.closed for world, _ in opened] == [True] * 3
    assert set(threading.enumerate()) <= before


def test_a_bus_that_cannot_be_opened_is_an_error_and_leaves_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    async def open_bus(*_: Any, **__: Any) -> FakeBus:
        raise BusError("no router")

    monkeypatch.setattr(zbridge.client, "open_bus", open_bus)
    before = set(threading.enumerate())
    with pytest.raises(BusError, match="no router"), zbridge.blocking.connect():
        pass
    assert set(threading.enumerate()) <= before


# Looking


def test_iterating_gives_message_after_message_and_what_comes_between_two_steps_waits(fleet, world: World) -> None:
    robot, seen = fleet["r1"], list[float]()
    world.soon(1.0, 2.0)
    for pose in robot.pose:
        seen.append(pose.x)
        if len(seen) == 2:
            world.publish(5.0, 6.0)
        elif len(seen) == 4:
            break
    assert seen == [1.0, 2.0, 5.0, 6.0]
    until(lambda: world.listeners == 0, "the subscription ends with the loop")


def test_a_feed_counts_what_was_lost_and_malformed(fleet: blocking.Fleet, world: World) -> None:
    feed = fleet["r1"].pose
    assert (feed.lost, feed.malformed) == (0, 0)
    poses = iter(feed)
    world.soon(1.0)
    next(poses)
    world.publish(*map(float, range(WAITING + 1)))
    world.on_bus(lambda: world.gateway.put(topics.POSE, b"\xc1"))
    assert next(poses).x == 2.0
    world.publish(500.0)
    while next(poses).x != 500.0:
        pass
    assert (feed.lost, feed.malformed) == (2, 1)


# Ctrl-C


class Interrupted(BaseException):
    """What Ctrl-C raises, for a test that is to live on."""


@contextlib.contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Have a signal come to whatever the main thread waits for, and expect that it ends soon."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Interrupted

    before, began = signal.signal(signal.SIGALRM, interrupt), time.monotonic()
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        with pytest.raises(Interrupted):
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert time.monotonic() - began < SOON_S


def test_an_interrupted_drive_gives_the_lease_back(fleet: blocking.Fleet, world: World) -> None:
    with interrupted_after(0.2), fleet["r1"].control(ME) as drive:
        drive.during(60.0, forward=0.5)
    assert (world.gateway.control.state, world.machine.stops) == ("free", 1)
    assert tokens(world.bus) == []
    driven = len(world.gateway.driven)
    time.sleep(0.15)
    assert len(world.gateway.driven) == driven, "nobody drives on"


def test_an_interrupted_iteration_or_wait_for_the_gateway_leaves_nothing_behind(fleet, world: World) -> None:
    with interrupted_after(0.1):
        list(fleet["r1"].pose)
    until(lambda: world.listeners == 0, "the subscription ends")
    with interrupted_after(0.1):
        lease(fleet["nobody"])
    until(lambda: world.on_bus(lambda: tokens(world.bus, "nobody")) == [], "the token is withdrawn")
    assert fleet["r1"].ask_pose() == POSE, "and the client is as good as before"


# Driving


def test_the_lease_is_held_while_the_context_lasts(fleet: blocking.Fleet, world: World) -> None:
    robot = fleet["r1"]
    with robot.control(ME, priority=2, deadman_s=0.4) as drive:
        shown = robot.control.last()
        assert shown is not None
        assert (shown.holder, shown.priority, drive.loss) == (ME, 2, None)
        drive.during(0.12, forward=0.25, left=0.5, turn=-0.5)
    assert world.gateway.control.state == "free"
    *driven, last = world.gateway.driven
    assert set(driven) == {Drive(forward=0.25, left=0.5, turn=-0.5)}
    assert last == Drive()


def test_states_errors_refusals_and_losses_come_through(fleet: blocking.Fleet, world: World) -> None:
    robot = fleet["r1"]
    with robot.control(ME) as drive:
        with pytest.raises(Held, match=r"^r1 is held by ann@here \(priority 0\)") as held:
            lease(robot, who="bob@there")
        assert held.value.holder == ME
        with pytest.raises(ValueError, match=r"^forward = 2\.0: expected -1 to 1$"):
            drive(forward=2.0)
        world.machine.refusal = "no legs"
        with pytest.raises(Refused, match=r"^r1: drive: no legs$"):
            drive.during(SOON_S, forward=0.5)
        world.machine.refusal = None
        robot.stop()
        with pytest.raises(LeaseLost, match=r"^r1: the lease has ended \(stop\)$"):
            drive.during(SOON_S, forward=0.5)
        assert str(drive.loss) == "r1: the lease has ended (stop)"
    world.on_bus(lambda: world.gateway.publish(topics.MAP, MAP))
    np.testing.assert_array_equal(next(iter(robot.map)).cells, MAP.cells)
    with pytest.raises(Refused, match=r"^r1: offline$"):
        robot.ask_map()
    with pytest.raises(BusError, match=r"^nobody: no gateway answered within 0\.1 s$"):
        lease(fleet["nobody"], wait_s=0.1)
    with pytest.raises(TypeError, match="speed"):
        lease(robot, speed=1.0)


# Threads, notebooks, and being the same as the client with async


def test_one_thread_drives_while_another_looks_and_that_one_ends_with_the_client(opened) -> None:
    seen: list[float] = []
    ended: list[str] = []

    def look() -> None:
        try:
            seen.extend(pose.x for pose in robot.pose)
        except BusError as error:
            ended.append(str(error))

    looking = threading.Thread(target=look, daemon=True)
    with zbridge.blocking.connect() as fleet:
        world, robot = opened[-1][0], fleet["r1"]
        looking.start()
        with robot.control(ME) as drive:
            until(lambda: world.listeners == 1, "the other thread looks")
            for x in (1.0, 2.0, 3.0):
                drive(forward=0.5)
                world.publish(x)
            until(lambda: len(seen) == 3, "the other thread sees")
    looking.join(SOON_S)
    assert not looking.is_alive()
    assert (seen, ended, len(world.gateway.driven)) == ([1.0, 2.0, 3.0], ["this client was closed"], 3)


async def test_it_works_inside_a_running_loop(opened: list[tuple[World, BusSettings]]) -> None:
    """As in a notebook, whose cells run in one."""
    with zbridge.blocking.connect() as fleet:
        with fleet["r1"].control(ME) as drive:
            drive.during(0.1, forward=0.5)
        opened[-1][0].soon(1.0)
        assert next(iter(fleet["r1"].pose)) == at(1.0)
    assert opened[-1][0].gateway.control.state == "free"
    await asyncio.sleep(0)


@pytest.mark.parametrize("where", ["dropped", "on the client's thread", "after the client"])
def test_an_iterator_that_is_collected_ends_its_subscription_and_hangs_nothing(opened, where: str) -> None:
    with zbridge.blocking.connect() as fleet:
        world = opened[-1][0]
        poses = iter(fleet["r1"].pose)
        world.soon(1.0)
        assert next(poses) == at(1.0)
        assert world.listeners == 1
        cycle: list[Any] = [poses]
        cycle.append(cycle)
        if where != "after the client":
            del poses, cycle
            world.on_bus(gc.collect) if where == "on the client's thread" else gc.collect()
            until(lambda: world.listeners == 0, "the subscription ends")
    poses = cycle = None  # type: ignore[assignment]
    gc.collect()


PAIRS: list[tuple[type, type]] = [
    (zbridge.client.Fleet, blocking.Fleet),
    (zbridge.client.Robot, blocking.Robot),
    (Driver, blocking.Driver),
    (zbridge.client.StateFeed, blocking.StateFeed),
]
INSIDE = {"now", "acquire", "read_control", "release", "statuses", "watch"}
"""What the driver's own context and callbacks use, and the models of health and fleet."""


@pytest.mark.parametrize(("awaited", "blocks"), PAIRS, ids=[pair[0].__name__ for pair in PAIRS])
def test_every_method_has_its_like_with_the_same_arguments_and_calls_it_with_them(awaited: type, blocks: type) -> None:
    for name, method in vars(awaited).items():
        if (name.startswith("_") and name != "__call__") or name in INSIDE or not inspect.isfunction(method):
            continue
        signature = inspect.signature(getattr(blocks, name))
        assert str(signature) == str(inspect.signature(method)), name
        if inspect.iscoroutinefunction(method):
            its, more = mock.AsyncMock(), {"light": True} if "light" in signature.parameters else {}
            given = [object() for parameter in list(signature.parameters)[1:] if parameter not in more]
            with contextlib.closing(blocking._Loop()) as loop:
                result = getattr(blocks(loop, its), name)(*given, **more)
            called = its if name == "__call__" else getattr(its, name)
            called.assert_awaited_once_with(*given, **more)
            assert result is called.return_value


def test_every_feed_has_its_like(fleet: blocking.Fleet) -> None:
    robot, like = zbridge.client.Fleet(FakeBus())["r1"], fleet["r1"]
    feeds = {name: feed for name, feed in vars(robot).items() if isinstance(feed, zbridge.client.Feed)}
    assert {name for name, feed in vars(like).items() if isinstance(feed, blocking.Feed)} == set(feeds)
    for name, feed in feeds.items():
        assert hasattr(feed, "last") == hasattr(getattr(like, name), "last"), name
        assert repr(feed) == repr(getattr(like, name)), "it has the same key"
    assert repr(like.sensor("front left")) == repr(robot.sensor("front left"))
    assert repr(like.sensors) == repr(robot.sensors)
    assert repr(like.raw("tcpudp")) == repr(robot.raw("tcpudp"))
