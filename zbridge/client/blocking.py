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
import threading
from collections.abc import Coroutine, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import zbridge.client
from zbridge.bus import Tls
from zbridge.client import driver, feed
from zbridge.client import fleet as fleets
from zbridge.client.stops import Outcome
from zbridge.errors import BusError, LeaseLost
from zbridge.fleet.messages import (
    Battery,
    Control,
    Devices,
    FleetMessage,
    Image,
    Latch,
    Map,
    Motion,
    Pose,
    Raw,
    Reading,
    Scan,
    Scanner,
    SensorSetting,
    SessionEntry,
    Status,
    Switch,
    Text,
)

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


class Fleet:
    """All robots of one realm: ``fleet["r1"]``."""

    def __init__(self, loop: _Loop, fleet: fleets.Fleet) -> None:
        self._loop = loop
        self._fleet = fleet

    def __repr__(self) -> str:
        return repr(self._fleet)

    def __getitem__(self, name: str) -> Robot:
        """Return the robot of this name, whether or not it is on the bus."""
        return Robot(self._loop, self._fleet[name])

    def robots(self) -> dict[str, Status | None]:
        """Return the robots that have a gateway or a status, by name."""
        return self._loop.run(self._fleet.robots())

    def sessions(self) -> dict[tuple[str, str], tuple[SessionEntry, ...]]:
        """Return the session tables by robot and process; see :meth:`zbridge.client.fleet.Fleet.sessions`."""
        return self._loop.run(self._fleet.sessions())

    def stop(self, names: Iterable[str] | None = None, reason: str | None = None) -> dict[str, Outcome]:
        """Stop these robots, or all that have a gateway; return for each the error, None if the stop was confirmed."""
        return self._loop.run(self._fleet.stop(names, reason))

    def latch(self, names: Iterable[str] | None = None, reason: str | None = None) -> dict[str, Outcome]:
        """Stop them, and prevent driving until they are released."""
        return self._loop.run(self._fleet.latch(names, reason))

    def unlatch(self) -> dict[str, Outcome]:
        """Release the latched stops of the whole fleet; return for each robot the error, None if it was released."""
        return self._loop.run(self._fleet.unlatch())


class Feed(Generic[T]):
    """The messages of one key, or of several: ``for message in feed``."""

    def __init__(self, loop: _Loop, source: feed.Feed[T]) -> None:
        self._loop = loop
        self._feed = source

    def __repr__(self) -> str:
        return repr(self._feed)

    @property
    def lost(self) -> int:
        """Messages that were dropped because the program was slower than the robot."""
        return self._feed.lost

    @property
    def malformed(self) -> int:
        """Payloads that could not be decoded as their key's message, and were left out."""
        return self._feed.malformed

    def __iter__(self) -> Iterator[T]:
        messages: Any = self._feed.__aiter__()

        async def following() -> T:
            message: T = await anext(messages)
            return message

        while True:  # its own loop closes the asynchronous generator: this thread must not wait for it
            yield self._loop.run(following())


class StateFeed(Feed[F]):
    """The messages of a key that keeps its last value."""

    def __init__(self, loop: _Loop, source: feed.StateFeed[F]) -> None:
        super().__init__(loop, source)
        self._state = source

    def last(self, timeout_s: float = 1.0) -> F | None:
        """Return the last value; None if there is none."""
        return self._loop.run(self._state.last(timeout_s))


class ControlFeed(StateFeed[Control]):
    """The messages of ``control``; calling the feed acquires the right to drive."""

    def __init__(self, loop: _Loop, source: fleets.ControlFeed) -> None:
        super().__init__(loop, source)
        self._control = source

    @contextlib.contextmanager
    def __call__(self, who: str | None = None, **request: Any) -> Iterator[Driver]:
        """Hold the lease while the context lasts; see :meth:`zbridge.client.fleet.ControlFeed.__call__`."""
        with _entered(self._loop, self._control(who, **request)) as holder:
            yield Driver(self._loop, holder)


class Robot:
    """One robot: a feed for each key it publishes, queries, commands that need no lease, and the lease."""

    def __init__(self, loop: _Loop, robot: fleets.Robot) -> None:
        self._loop = loop
        self._robot = robot
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

    def __repr__(self) -> str:
        return repr(self._robot)

    def sensor(self, name: str) -> Feed[Reading]:
        """Return the feed of one sensor."""
        return Feed(self._loop, self._robot.sensor(name))

    @property
    def sensors(self) -> Feed[tuple[str, Reading]]:
        """All sensors: pairs of name and reading."""
        return Feed(self._loop, self._robot.sensors)

    def raw(self, protocol: str) -> Feed[Raw]:
        """Return the feed of legacy messages that no fleet message represents."""
        return Feed(self._loop, self._robot.raw(protocol))

    def ask_pose(self) -> Pose:
        """Ask the robot for its pose now."""
        return self._loop.run(self._robot.ask_pose())

    def ask_map(self) -> Map:
        """Ask the robot for its map now."""
        return self._loop.run(self._robot.ask_map())

    def stop(self, reason: str | None = None) -> None:
        """Stop the robot and end any lease; return when its gateway has confirmed the stop."""
        self._loop.run(self._robot.stop(reason))

    def latch(self, reason: str | None = None) -> None:
        """Stop the robot, and prevent driving until it is released."""
        self._loop.run(self._robot.latch(reason))

    def unlatch(self) -> tuple[Latch, ...]:
        """Release the latched stops of this robot; return those that were in force."""
        return self._loop.run(self._robot.unlatch())

    def set_light(self, on: bool) -> None:
        """Turn the light on or off."""
        self._loop.run(self._robot.set_light(on))

    def set_lidar(self, on: bool) -> None:
        """Turn the lidar on or off."""
        self._loop.run(self._robot.set_lidar(on))

    def set_camera(self, on: bool) -> None:
        """Turn the camera on or off."""
        self._loop.run(self._robot.set_camera(on))

    def say(self, text: str) -> None:
        """Send the robot a text."""
        self._loop.run(self._robot.say(text))

    def feed_scan(self, scan: Scan) -> None:
        """Send the robot simulated lidar data."""
        self._loop.run(self._robot.feed_scan(scan))

    def set_sensor(self, name: str, setting: SensorSetting) -> None:
        """Change the settings of a sensor."""
        self._loop.run(self._robot.set_sensor(name, setting))


class Driver:
    """The lease of one robot: call ``drive(forward=0.3)`` repeatedly: motion lasts only ``deadman_s``."""

    def __init__(self, loop: _Loop, holder: driver.Driver) -> None:
        self._loop = loop
        self._driver = holder

    def __repr__(self) -> str:
        return repr(self._driver)

    @property
    def loss(self) -> LeaseLost | None:
        """Why the lease was lost, None while it is held."""
        return self._driver.loss

    def __call__(
        self, forward: float = 0.0, left: float = 0.0, turn: float = 0.0, *, light: bool | None = None
    ) -> None:
        """Drive: fractions of full scale, -1 to 1; all zero is neutral."""
        self._loop.run(self._driver(forward, left, turn, light=light))

    def during(self, seconds: float, forward: float = 0.0, left: float = 0.0, turn: float = 0.0) -> None:
        """Drive for ``seconds``, then send neutral."""
        self._loop.run(self._driver.during(seconds, forward, left, turn))

    def neutral(self) -> None:
        """Send neutral, which ends a NeutralFirst; see :meth:`zbridge.client.driver.Driver.neutral`."""
        self._loop.run(self._driver.neutral())

    def motor(self, name: str, value: float) -> None:
        """Move one motor: rad/s, or metres for a linear motor."""
        self._loop.run(self._driver.motor(name, value))

    def mode(self, mode: str) -> None:
        """Set who moves the robot: ``none``, ``manual`` or ``autonomous``."""
        self._loop.run(self._driver.mode(mode))

    def raw(self, protocol: str, message_id: int, body: bytes = b"") -> None:
        """Send a legacy message that no fleet message represents."""
        self._loop.run(self._driver.raw(protocol, message_id, body))


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
