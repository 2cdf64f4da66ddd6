"""The client for scripts and notebooks: the same classes without ``async``; an event loop runs on a thread.

with zbridge.blocking.connect(endpoints=["tcp/127.0.0.1:7447"]) as fleet:
    robot = fleet["r1"]
    with robot.control() as drive:
        drive.during(2.0, forward=0.3)
    for pose in robot.pose:
        ...
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import threading
from collections.abc import Callable, Coroutine, Iterator, Sequence
from pathlib import Path
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import zbridge.client
from zbridge.bus import Tls
from zbridge.client import driver, feed
from zbridge.client import fleet as fleets
from zbridge.client import robot as robots
from zbridge.errors import BusError, LeaseLost
from zbridge.fleet.messages import (
    Battery,
    Control,
    Devices,
    FleetMessage,
    Image,
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

P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T")
F = TypeVar("F", bound=FleetMessage)


class _Loop:
    """An event loop on a thread of its own."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="zbridge-client", daemon=True)
        self._thread.start()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine on the loop and wait for it; an interruption cancels it."""
        try:
            future = asyncio.run_coroutine_threadsafe(work, self._loop)
        except RuntimeError:
            work.close()
            raise BusError("this client was closed") from None
        try:
            return future.result()
        except concurrent.futures.CancelledError:
            raise BusError("this client was closed") from None
        except BaseException:
            future.cancel()
            raise

    async def _cancel_all(self) -> None:
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._loop.shutdown_asyncgens()

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._cancel_all(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


@contextlib.contextmanager
def connect(
    endpoints: Sequence[str] | str = (), *, realm: str = "fleet", tls: Tls | Path | str | None = None
) -> Iterator[Fleet]:
    """Join the bus for as long as the context lasts; see :func:`zbridge.client.connect`."""
    joining = zbridge.client.connect(endpoints, realm=realm, tls=tls)
    with contextlib.closing(_Loop()) as loop, _entered(loop, joining) as fleet:
        yield Fleet(loop, fleet)


class _Blocking(Generic[S]):
    """The like of an object of the client whose methods are awaited."""

    def __init__(self, loop: _Loop, source: S) -> None:
        self._loop = loop
        self._source = source

    def __repr__(self) -> str:
        return repr(self._source)


def _waits(method: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]) -> Callable[Concatenate[Any, P], T]:
    """Return a method that runs the source's method of this name on the loop's thread, and waits for it."""

    @functools.wraps(method)
    def run(self: _Blocking[Any], /, *args: P.args, **kwargs: P.kwargs) -> T:
        result: T = self._loop.run(getattr(self._source, method.__name__)(*args, **kwargs))
        return result

    return run


class Fleet(_Blocking[fleets.Fleet]):
    """All robots of one realm: ``fleet["r1"]``."""

    def __getitem__(self, name: str) -> Robot:
        """Return the robot of this name, whether or not it is on the bus."""
        return Robot(self._loop, self._source[name])

    robots = _waits(fleets.Fleet.robots)
    sessions = _waits(fleets.Fleet.sessions)
    processes = _waits(fleets.Fleet.processes)
    stop = _waits(fleets.Fleet.stop)
    latch = _waits(fleets.Fleet.latch)
    unlatch = _waits(fleets.Fleet.unlatch)
    send_stop = _waits(fleets.Fleet.send_stop)


class Feed(_Blocking[feed.Feed[T]]):
    """The messages of one key, or of several: ``for message in feed``."""

    @property
    def lost(self) -> int:
        """Messages that were dropped because the program was slower than the robot."""
        return self._source.lost

    @property
    def malformed(self) -> int:
        """Payloads that could not be decoded as their key's message, and were left out."""
        return self._source.malformed

    def __iter__(self) -> Iterator[T]:
        messages: Any = self._source.__aiter__()

        async def following() -> T:
            message: T = await anext(messages)
            return message

        while True:  # its own loop closes the asynchronous generator: this thread must not wait for it
            yield self._loop.run(following())


class StateFeed(Feed[F]):
    """The messages of a key that keeps its last value."""

    _source: feed.StateFeed[F]

    def last(self, timeout_s: float = 1.0) -> F | None:
        """Return the last value; None if there is none."""
        return self._loop.run(self._source.last(timeout_s))


class ControlFeed(StateFeed[Control]):
    """The messages of ``control``; calling the feed acquires the right to drive."""

    _source: robots.ControlFeed

    @contextlib.contextmanager
    def __call__(self, who: str | None = None, **request: Any) -> Iterator[Driver]:
        """Hold the lease while the context lasts; see :meth:`zbridge.client.robot.ControlFeed.__call__`."""
        with _entered(self._loop, self._source(who, **request)) as holder:
            yield Driver(self._loop, holder)


class Robot(_Blocking[robots.Robot]):
    """One robot: a feed for each key it publishes, queries, commands that need no lease, and the lease."""

    def __init__(self, loop: _Loop, robot: robots.Robot) -> None:
        super().__init__(loop, robot)
        self.name = robot.name
        self.scan: Feed[Scan] = Feed(loop, robot.scan)
        self.motion: Feed[Motion] = Feed(loop, robot.motion)
        self.pose: Feed[Pose] = Feed(loop, robot.pose)
        self.text: Feed[Text] = Feed(loop, robot.text)
        self.image: Feed[Image] = Feed(loop, robot.image)
        self.battery: Feed[Battery] = Feed(loop, robot.battery)
        self.status: StateFeed[Status] = StateFeed(loop, robot.status)
        self.scanner: StateFeed[Scanner] = StateFeed(loop, robot.scanner)
        self.map: StateFeed[Map] = StateFeed(loop, robot.map)
        self.lidar: StateFeed[Switch] = StateFeed(loop, robot.lidar)
        self.camera: StateFeed[Switch] = StateFeed(loop, robot.camera)
        self.devices: StateFeed[Devices] = StateFeed(loop, robot.devices)
        self.control = ControlFeed(loop, robot.control)

    def sensor(self, name: str) -> Feed[Reading]:
        """Return the feed of one sensor."""
        return Feed(self._loop, self._source.sensor(name))

    @property
    def sensors(self) -> Feed[tuple[str, Reading]]:
        """All sensors: pairs of name and reading."""
        return Feed(self._loop, self._source.sensors)

    def raw(self, protocol: str) -> Feed[Raw]:
        """Return the feed of the legacy messages that no fleet message can hold."""
        return Feed(self._loop, self._source.raw(protocol))

    ask_pose = _waits(robots.Robot.ask_pose)
    ask_map = _waits(robots.Robot.ask_map)
    stop = _waits(robots.Robot.stop)
    latch = _waits(robots.Robot.latch)
    unlatch = _waits(robots.Robot.unlatch)
    set_light = _waits(robots.Robot.set_light)
    set_lidar = _waits(robots.Robot.set_lidar)
    set_camera = _waits(robots.Robot.set_camera)
    say = _waits(robots.Robot.say)
    feed_scan = _waits(robots.Robot.feed_scan)
    set_sensor = _waits(robots.Robot.set_sensor)


class Driver(_Blocking[driver.Driver]):
    """The lease of one robot: ``drive(forward=0.3)``, again and again, for motion lasts only ``deadman_s``."""

    @property
    def loss(self) -> LeaseLost | None:
        """Why the lease was lost, None while it is held."""
        return self._source.loss

    __call__ = _waits(driver.Driver.__call__)
    during = _waits(driver.Driver.during)
    neutral = _waits(driver.Driver.neutral)
    motor = _waits(driver.Driver.motor)
    mode = _waits(driver.Driver.mode)
    raw = _waits(driver.Driver.raw)


@contextlib.contextmanager
def _entered(loop: _Loop, context: contextlib.AbstractAsyncContextManager[T]) -> Iterator[T]:
    """Enter and leave an asynchronous context on the loop's thread."""

    async def enter() -> T:
        return await context.__aenter__()

    async def leave() -> None:
        await context.__aexit__(None, None, None)

    entered = loop.run(enter())
    try:
        yield entered
    finally:
        loop.run(leave())
