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

import numpy as np
import pytest

import zbridge
import zbridge.client
from tests.client import Gateway, subscriptions, tokens
from zbridge.bus import BusSettings
from zbridge.bus.fake import FakeBus
from zbridge.client import blocking
from zbridge.client.driver import Driver
from zbridge.client.feed import WAITING
from zbridge.errors import BusError, Held, LeaseLost, NotReady, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Drive,
    FleetMessage,
    Map,
    Mode,
    Motor,
    Pose,
    Raw,
    Reading,
    Scan,
    SensorSetting,
    Status,
    Switch,
    Text,
)
from zbridge.fleet.topics import Topic

ME = "ann@here"
POSE = Pose(x=1.0, y=2.0, heading=0.5)
MAP = Map(rows=2, columns=1, cell=0.1, origin=(0.0, 0.0), cells=np.array([[1], [2]], np.uint8))
SOON_S = 5.0
"""Longest time a test waits for what is to happen at once."""


class World:
    """The bus on the client's thread, with a robot on it; ``on_bus`` does things there."""

    def __init__(self) -> None:
        self.bus = FakeBus()
        self.gateway = Gateway(self.bus)
        self.gateway.serve()
        self.bus.answer("fleet/r1/@rpc/pose", lambda question: question.answer(payloads.encode(POSE)))
        self.bus.answer("fleet/r1/@rpc/map", lambda question: question.refuse(NotReady("offline")))
        self.closed = False
        self._loop = asyncio.get_running_loop()

    def on_bus(self, work: Callable[[], Any]) -> Any:
        """Do something on the client's thread, and wait for it."""

        async def do() -> Any:
            return work()

        return asyncio.run_coroutine_threadsafe(do(), self._loop).result(SOON_S)

    def publish(self, *poses: float) -> None:
        """Have the robot publish poses."""
        for x in poses:
            self.on_bus(lambda x=x: self.gateway.publish(topics.POSE, Pose(x=x, y=0.0, heading=0.0)))

    def soon(self, topic: Topic, *messages: FleetMessage, key: str = "") -> None:
        """Have the robot publish messages when somebody iterates them."""

        def wait() -> None:
            if not subscriptions(self.bus, f"fleet/r1/{key or topic.path}"):
                self._loop.call_later(0.001, wait)
                return
            for message in messages:
                self.gateway.publish(topic, message)

        self._loop.call_soon_threadsafe(wait)

    @property
    def listeners(self) -> int:
        return int(self.on_bus(lambda: subscriptions(self.bus, "fleet/r1/pose")))


class Bus(FakeBus):
    """Remembers that it was left."""

    def __init__(self, world: World) -> None:
        super().__init__("mine", world.bus._shared)
        self._world = world

    async def close(self) -> bool:
        self._world.closed = True
        return await super().close()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[tuple[World, BusSettings]]:
    """Have every client find a fake bus of its own; give what was made."""
    worlds: list[tuple[World, BusSettings]] = []

    async def open_bus(settings: BusSettings, metrics: Any, *, wait_for_peers: bool = False) -> FakeBus:
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


def fails(error: type[BaseException]) -> Any:
    raise error


def until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.001)


def lease(robot: blocking.Robot, **wishes: Any) -> None:
    """Get the lease, and give it back."""
    with robot.control(**wishes):
        pass


# Being on the bus


def test_the_bus_is_left_with_the_context(opened: list[tuple[World, BusSettings]]) -> None:
    before = set(threading.enumerate())
    with zbridge.blocking.connect(["tcp/h:1"], realm="fleet") as fleet:
        ((world, settings),) = opened
        assert settings.connect == ("tcp/h:1",)
        assert repr(fleet) == "<Fleet fleet>"
        assert not world.closed
        (thread,) = set(threading.enumerate()) - before
        assert thread.daemon, "a program that dies does not wait for it"
    assert world.closed
    assert not thread.is_alive()


def test_the_bus_is_left_when_the_program_raises(opened: list[tuple[World, BusSettings]]) -> None:
    before = set(threading.enumerate())
    with pytest.raises(KeyError), zbridge.blocking.connect():
        fails(KeyError)
    assert opened[0][0].closed
    assert set(threading.enumerate()) <= before


def test_a_bus_that_cannot_be_opened_is_an_error_and_leaves_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    async def open_bus(*_: Any, **__: Any) -> FakeBus:
        raise BusError("no router")

    monkeypatch.setattr(zbridge.client, "open_bus", open_bus)
    before = set(threading.enumerate())
    with pytest.raises(BusError, match="no router"), zbridge.blocking.connect():
        pass
    assert set(threading.enumerate()) <= before


def test_clients_can_follow_each_other_and_live_beside_each_other(opened: list[tuple[World, BusSettings]]) -> None:
    with zbridge.blocking.connect() as one, zbridge.blocking.connect() as two:
        assert one["r1"].ask_pose() == two["r1"].ask_pose() == POSE
    with zbridge.blocking.connect() as three:
        assert three["r1"].ask_pose() == POSE
    assert [world.closed for world, _ in opened] == [True] * 3


def test_a_client_that_was_closed_says_so(opened: list[tuple[World, BusSettings]]) -> None:
    with zbridge.blocking.connect() as fleet:
        robot = fleet["r1"]
    with pytest.raises(BusError, match=r"^this client was closed$"):
        robot.ask_pose()
    gc.collect()  # a coroutine that was never awaited would be an error


# Looking


def test_robots_status_and_questions(fleet: blocking.Fleet) -> None:
    assert fleet.robots() == {"r1": Status(state="established")}
    robot = fleet["r1"]
    assert (robot.name, repr(robot)) == ("r1", "<Robot fleet/r1>")
    assert robot.status.last() == Status(state="established")
    assert robot.map.last() is None
    assert robot.ask_pose() == POSE
    with pytest.raises(Refused, match=r"^r1: offline$"):
        robot.ask_map()
    with pytest.raises(BusError, match=r"^r2: no gateway answered"):
        fleet["r2"].ask_pose()


def test_iterating_gives_message_after_message(fleet: blocking.Fleet, world: World) -> None:
    robot = fleet["r1"]
    world.soon(topics.POSE, *(Pose(x=x, y=0.0, heading=0.0) for x in (1.0, 2.0, 3.0)))
    seen = []
    for pose in robot.pose:
        seen.append(pose.x)
        if len(seen) == 3:
            break
    assert seen == [1.0, 2.0, 3.0]
    until(lambda: world.listeners == 0, "the subscription ends with the loop")
    assert repr(robot.pose) == "<Feed fleet/r1/pose>"


def test_what_comes_between_two_steps_waits(fleet: blocking.Fleet, world: World) -> None:
    poses = iter(fleet["r1"].pose)
    world.soon(topics.POSE, POSE)
    assert next(poses) == POSE
    world.publish(5.0, 6.0)
    assert [next(poses).x, next(poses).x] == [5.0, 6.0]
    poses.close()  # type: ignore[attr-defined]
    assert world.listeners == 0


def test_a_feed_counts_what_was_lost_and_malformed(fleet: blocking.Fleet, world: World) -> None:
    feed = fleet["r1"].pose
    assert (feed.lost, feed.malformed) == (0, 0)
    poses = iter(feed)
    world.soon(topics.POSE, POSE)
    next(poses)
    world.on_bus(lambda: world.gateway.put(topics.POSE, b"\xc1"))
    world.publish(*map(float, range(WAITING)))
    assert next(poses).x == 0.0
    assert (feed.lost, feed.malformed) == (1, 0), "the malformed one was the oldest"


def test_states_give_their_last_value_first_and_arrays_are_numpys(fleet: blocking.Fleet, world: World) -> None:
    robot = fleet["r1"]
    world.on_bus(lambda: world.gateway.publish(topics.MAP, MAP))
    for seen in robot.map:
        np.testing.assert_array_equal(seen.cells, MAP.cells)
        break
    last = robot.map.last()
    assert last is not None
    assert (last.cells.dtype, last.cells.shape) == (np.uint8, (2, 1))


def test_sensors_and_raw_messages(fleet: blocking.Fleet, world: World) -> None:
    robot = fleet["r1"]
    reading = Reading(value=1.0)
    left = topics.SENSOR("front left")
    world.soon(left, reading)
    assert next(iter(robot.sensor("front left"))) == reading
    world.soon(left, reading, key="sensor/*")
    assert next(iter(robot.sensors)) == ("front left", reading)
    world.soon(topics.RAW("tcpudp"), Raw(id=1))
    assert next(iter(robot.raw("tcpudp"))) == Raw(id=1)


class Interrupted(BaseException):
    """What Ctrl-C raises, for a test that is to live on."""


@contextlib.contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Have a signal come to whatever the main thread waits for."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Interrupted

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_an_interrupted_iteration_ends_its_subscription(fleet: blocking.Fleet, world: World) -> None:
    began = time.monotonic()
    with interrupted_after(0.1), pytest.raises(Interrupted):
        list(fleet["r1"].pose)
    assert time.monotonic() - began < SOON_S
    until(lambda: world.listeners == 0, "the subscription ends")
    assert fleet["r1"].ask_pose() == POSE, "and the client is as good as before"


def test_an_interrupted_drive_gives_the_lease_back(fleet: blocking.Fleet, world: World) -> None:
    robot = fleet["r1"]

    def program() -> None:
        with robot.control(ME) as drive:
            drive.during(60.0, forward=0.5)

    began = time.monotonic()
    with interrupted_after(0.2), pytest.raises(Interrupted):
        program()
    assert time.monotonic() - began < SOON_S
    assert world.gateway.control.state == "free"
    assert world.gateway.machine.stops == 1
    assert tokens(world.bus) == []
    driven = len(world.gateway.driven)
    time.sleep(0.15)
    assert len(world.gateway.driven) == driven, "nobody drives on"


def test_an_interrupted_wait_for_the_gateway_leaves_nothing_behind(fleet: blocking.Fleet, world: World) -> None:
    with interrupted_after(0.1), pytest.raises(Interrupted):
        lease(fleet["nobody"])
    until(lambda: world.on_bus(lambda: tokens(world.bus, "nobody")) == [], "the token is withdrawn")


# Driving


def test_the_lease_is_held_while_the_context_lasts(fleet: blocking.Fleet, world: World) -> None:
    robot = fleet["r1"]
    with robot.control(ME, priority=2, deadman_s=0.4) as drive:
        assert robot.control.last().holder == ME  # type: ignore[union-attr]
        assert drive.loss is None
        assert repr(drive) == "<Driver of r1 holding>"
        drive(forward=0.5, left=-0.25, turn=1.0, light=True)
        drive.motor("arm", 1.0)
        drive.mode("manual")
        drive.raw("tcpudp", 7, b"abc")
        drive.during(0.12, forward=0.25, left=0.5, turn=-0.5)
    assert robot.control.last().state == "free"  # type: ignore[union-attr]
    first, motor, mode, raw, *driven, last = world.gateway.machine.commands
    assert [first, motor, mode, raw] == [
        ("drive", Drive(forward=0.5, left=-0.25, turn=1.0, light=True)),
        ("motor/arm", Motor(1.0)),
        ("mode", Mode("manual")),
        ("raw/tcpudp", Raw(id=7, body=b"abc")),
    ]
    assert set(driven) == {("drive", Drive(forward=0.25, left=0.5, turn=-0.5))}
    assert last == ("drive", Drive())
    assert [shown.seq for shown in world.gateway.attachments] == list(range(1, len(world.gateway.attachments) + 1))


def test_held_bad_wishes_and_no_gateway_come_through(fleet: blocking.Fleet) -> None:
    robot = fleet["r1"]
    with robot.control(ME):
        with pytest.raises(Held, match=r"^r1 is held by ann@here \(priority 0\)") as held:
            lease(robot, who="bob@there")
        assert held.value.holder == ME
    with pytest.raises(Refused, match="lease_s"):
        lease(robot, lease_s=0.0)
    with pytest.raises(BusError, match=r"^nobody: no gateway answered within 0\.1 s$"):
        lease(fleet["nobody"], wait_s=0.1)
    with pytest.raises(TypeError, match="speed"):
        lease(robot, speed=1.0)


def test_refusals_range_errors_and_losses_come_through(fleet: blocking.Fleet, world: World) -> None:
    robot = fleet["r1"]
    with robot.control(ME) as drive:
        with pytest.raises(ValueError, match=r"^forward = 2\.0: expected -1 to 1$"):
            drive(forward=2.0)
        with pytest.raises(ValueError, match=r"^mode = 'fast'"):
            drive.mode("fast")
        world.gateway.machine.refusal = "no legs"
        with pytest.raises(Refused, match=r"^r1: drive: no legs$"):
            drive.during(SOON_S, forward=0.5)
        world.gateway.machine.refusal = None
        robot.stop()
        with pytest.raises(LeaseLost, match=r"^r1: the lease has ended \(stop\)$"):
            drive.during(SOON_S, forward=0.5)
        assert str(drive.loss) == "r1: the lease has ended (stop)"


def test_stops_come_through(fleet: blocking.Fleet, world: World) -> None:
    fleet["r1"].stop()
    assert fleet.stop(["r1"]) == fleet.stop() == {"r1": None}
    assert world.gateway.machine.stops >= 3
    world.gateway.machine.unstoppable = "no"
    with pytest.raises(Refused, match=r"^r1: cannot be stopped: no$"):
        fleet["r1"].stop()
    assert str(fleet.stop()["r1"]) == "r1: cannot be stopped: no"


def test_commands_that_need_no_lease(fleet: blocking.Fleet, world: World) -> None:
    robot = fleet["r1"]
    scan = Scan(angle_min=0.0, angle_increment=0.1, range_min=0.1, range_max=4.0, ranges=np.ones(3, np.float32))
    setting = SensorSetting(enable=True)
    robot.set_light(True)
    robot.set_lidar(False)
    robot.set_camera(True)
    robot.say("hello")
    robot.feed_scan(scan)
    robot.set_sensor("front left", setting)
    taken = dict(world.gateway.machine.commands)
    assert isinstance(taken.pop("scan"), Scan)
    assert taken == {
        "light": Switch(on=True),
        "lidar": Switch(on=False),
        "camera": Switch(on=True),
        "text": Text(text="hello"),
        "sensor/front%20left": setting,
    }


# Threads, notebooks, and being the same as the client with async


def test_one_thread_drives_while_another_looks(fleet: blocking.Fleet, world: World) -> None:
    robot, seen = fleet["r1"], list[float]()

    def look() -> None:
        for pose in robot.pose:
            seen.append(pose.x)
            if len(seen) == 3:
                break

    looking = threading.Thread(target=look)
    looking.start()
    with robot.control(ME) as drive:
        until(lambda: world.listeners == 1, "the other thread looks")
        for x in (1.0, 2.0, 3.0):
            drive(forward=0.5)
            world.publish(x)
    looking.join(SOON_S)
    assert not looking.is_alive()
    assert seen == [1.0, 2.0, 3.0]
    assert len(world.gateway.driven) == 3


async def test_it_works_inside_a_running_loop(opened: list[tuple[World, BusSettings]]) -> None:
    """As in a notebook, whose cells run in one."""
    assert asyncio.get_running_loop().is_running()
    with zbridge.blocking.connect() as fleet:
        world = opened[-1][0]
        robot = fleet["r1"]
        assert robot.ask_pose() == POSE
        with robot.control(ME) as drive:
            drive.during(0.1, forward=0.5)
        world.soon(topics.POSE, POSE)
        for pose in robot.pose:
            assert pose == POSE
            break
        with pytest.raises(Refused):
            robot.ask_map()
    assert world.gateway.control.state == "free"
    await asyncio.sleep(0)


def test_an_iterator_that_is_dropped_ends_its_subscription(fleet: blocking.Fleet, world: World) -> None:
    poses = iter(fleet["r1"].pose)
    world.soon(topics.POSE, POSE)
    next(poses)
    assert world.listeners == 1
    del poses
    gc.collect()
    until(lambda: world.listeners == 0, "the subscription ends")


def test_an_iterator_may_outlive_its_client(opened: list[tuple[World, BusSettings]]) -> None:
    with zbridge.blocking.connect() as fleet:
        poses = iter(fleet["r1"].pose)
        opened[-1][0].soon(topics.POSE, POSE)
        assert next(poses) == POSE
    del poses
    gc.collect()


def test_an_iterator_collected_on_the_clients_thread_does_not_hang_it(fleet: blocking.Fleet, world: World) -> None:
    poses = iter(fleet["r1"].pose)
    world.soon(topics.POSE, POSE)
    next(poses)
    cycle: list[Any] = [poses]
    cycle.append(cycle)
    del poses, cycle
    world.on_bus(gc.collect)
    until(lambda: world.listeners == 0, "the subscription ends")


def test_a_thread_that_iterates_ends_with_the_client(opened: list[tuple[World, BusSettings]]) -> None:
    ended: list[str] = []

    def look() -> None:
        try:
            for _ in robot.pose:
                pass
        except BusError as error:
            ended.append(str(error))

    looking = threading.Thread(target=look, daemon=True)
    with zbridge.blocking.connect() as fleet:
        robot = fleet["r1"]
        looking.start()
        until(lambda: opened[-1][0].listeners == 1, "the other thread looks")
    looking.join(SOON_S)
    assert not looking.is_alive()
    assert ended == ["this client was closed"]


PAIRS: list[tuple[type, type]] = [
    (zbridge.client.Fleet, blocking.Fleet),
    (zbridge.client.Robot, blocking.Robot),
    (Driver, blocking.Driver),
    (zbridge.client.StateFeed, blocking.StateFeed),
]
INSIDE = {"acquire", "look", "release"}
"""What the driver's own context uses."""


@pytest.mark.parametrize(("awaited", "blocks"), PAIRS, ids=[pair[0].__name__ for pair in PAIRS])
def test_every_method_has_its_like_with_the_same_arguments(awaited: type, blocks: type) -> None:
    for name, method in vars(awaited).items():
        if (name.startswith("_") and name != "__call__") or name in INSIDE or not inspect.isfunction(method):
            continue
        like = getattr(blocks, name)
        assert str(inspect.signature(like)) == str(inspect.signature(method)), name


def test_every_feed_has_its_like(fleet: blocking.Fleet) -> None:
    robot = zbridge.client.Fleet(FakeBus())["r1"]
    feeds = {name for name, value in vars(robot).items() if isinstance(value, zbridge.client.Feed)}
    like = {name for name, value in vars(fleet["r1"]).items() if isinstance(value, blocking.Feed)}
    assert feeds == like
    for name in feeds:
        assert hasattr(getattr(robot, name), "last") == hasattr(getattr(fleet["r1"], name), "last"), name
        assert repr(getattr(robot, name)) == repr(getattr(fleet["r1"], name))
