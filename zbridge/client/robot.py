"""One robot on the bus: feeds, queries, commands that need no lease, and the lease."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

from zbridge.bus import Bus, Sample
from zbridge.client import stops
from zbridge.client.driver import Driver, default_who
from zbridge.client.feed import WAITING, WAITING_IMAGES, Feed, StateFeed, reader
from zbridge.clocks import raw_ms
from zbridge.errors import BusError, Malformed, NotReady, Refused, Unsupported, refusal
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Acquire
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
    Query,
    Raw,
    Reading,
    Scan,
    Scanner,
    SensorSetting,
    Status,
    Switch,
    Text,
)
from zbridge.fleet.topics import KeySpace, Topic, escape, unescape

ANSWER_S = 5.0
"""Longest wait for a robot's answer, seconds."""
attempts_of_process = itertools.count(1)
"""Numbers the requests for a lease. Each has its own liveliness token: a gateway may learn that an earlier one's token
is gone only after it has granted a later request, whose lease must not end for that."""


class ControlFeed(StateFeed[Control]):
    """The messages of ``control``; calling the feed acquires the right to drive."""

    def __init__(
        self,
        bus: Bus,
        keys: KeySpace,
        own: str | None = None,
        clock_ms: Callable[[], float] = raw_ms,
        attempts: Iterator[int] = attempts_of_process,
    ) -> None:
        super().__init__(bus, keys, topics.CONTROL)
        self._clock_ms = clock_ms
        self._attempts = attempts
        self._keys = keys
        self._own = own

    @contextlib.asynccontextmanager
    async def __call__(
        self,
        who: str | None = None,
        *,
        name: str | None = None,
        priority: int = 0,
        lease_s: float | None = None,
        deadman_s: float = 0.5,
        takeover: bool = False,
        wait_s: float = 5.0,
    ) -> AsyncIterator[Driver]:
        """Hold the lease while the context lasts: ``async with robot.control() as drive: await drive(forward=0.3)``.

        who: the holder's name that others are shown, ``user@host`` by default. name: the first part of ``who``
        (``op1`` of ``op1.laptop``) if access rules know this program by that part only. On a secure bus both are by
        default what the certificate says, and Malformed is raised for another name.
        priority: a program with a higher priority is given the robot of one with a lower priority.
        deadman_s: motion that is not repeated within this time ends; the robot's configuration caps it.
        takeover: take the robot from its holder. wait_s: longest wait for the robot's gateway, seconds.
        Raises Held with the holder's name, BusError if nobody answers or the role is missing, or Refused as the gateway
        did.
        """
        who, name = _lease_identity(who, name, self._own)
        request = Acquire(
            who=who,
            priority=priority,
            lease_s=lease_s,
            deadman_s=deadman_s,
            alive=f"operator.{escape(name)}.{self._bus.zid}.{next(self._attempts)}",
        )
        clock_ms = self._clock_ms
        driver = Driver(self._bus, self._keys, request, name, takeover=takeover, wait_s=wait_s, clock_ms=clock_ms)
        try:
            await driver.acquire()
            with contextlib.closing(self._bus.subscribe(self.key_expr, driver.read_control)):
                yield driver
        finally:
            await asyncio.shield(driver.release())


def _lease_identity(who: str | None, name: str | None, certified: str | None) -> tuple[str, str]:
    """Return the name that is shown to people, and the one in the keys of the lease.

    certified: the name in the certificate, if there is one. Raises Malformed if it does not allow the others.
    """
    if certified is None:
        who = who or default_who()
        return who, name or who
    who, wrong = who or certified, ""
    if name not in (None, certified):
        wrong = f"name = {name!r}"
    elif not topics.speaks_for(who, escape(certified)):
        wrong = f"who = {who!r}"
    if wrong:
        expected = f"expected that, or {f'{certified}.suffix'!r}"
        raise Malformed(f"{wrong}: the certificate of this program says {certified!r}: {expected}")
    return who, certified


class Robot:
    """One robot: a feed for each key it publishes, queries, commands that need no lease, and the lease."""

    def __init__(
        self,
        bus: Bus,
        keys: KeySpace,
        own: str | None = None,
        clock_ms: Callable[[], float] = raw_ms,
        attempts: Iterator[int] = attempts_of_process,
        secret: Callable[[int], bytes] = os.urandom,
    ) -> None:
        self.name = keys.robot
        self._secret = secret
        self._own = own or default_who()
        self._bus = bus
        self._keys = keys
        self.scan: Feed[Scan] = self._feed(topics.SCAN)
        self.motion: Feed[Motion] = self._feed(topics.MOTION)
        self.pose: Feed[Pose] = self._feed(topics.POSE)
        self.text: Feed[Text] = self._feed(topics.TEXT)
        self.image: Feed[Image] = self._feed(topics.IMAGE)
        self.battery: Feed[Battery] = self._feed(topics.BATTERY)
        self.status: StateFeed[Status] = StateFeed(bus, keys, topics.STATUS)
        self.scanner: StateFeed[Scanner] = StateFeed(bus, keys, topics.SCANNER)
        self.map: StateFeed[Map] = StateFeed(bus, keys, topics.MAP)
        self.lidar: StateFeed[Switch] = StateFeed(bus, keys, topics.LIDAR)
        self.camera: StateFeed[Switch] = StateFeed(bus, keys, topics.CAMERA)
        self.devices: StateFeed[Devices] = StateFeed(bus, keys, topics.DEVICES)
        self.control = ControlFeed(bus, keys, own, clock_ms, attempts)

    def __repr__(self) -> str:
        return f"<Robot {self._keys.realm}/{self.name}>"

    def sensor(self, name: str) -> Feed[Reading]:
        """Return the feed of one sensor."""
        return self._feed(topics.SENSOR(name))

    @property
    def sensors(self) -> Feed[tuple[str, Reading]]:
        """All sensors: pairs of name and reading."""

        def read(sample: Sample) -> tuple[str, Reading]:
            return unescape(sample.key.rpartition("/")[2]), payloads.decode(Reading, sample.payload)

        return Feed(self._bus, self._keys.key("sensor/*"), read)

    def raw(self, protocol: str) -> Feed[Raw]:
        """Return the feed of legacy messages that no fleet message represents."""
        return self._feed(topics.RAW(protocol))

    # Queries

    async def ask_pose(self) -> Pose:
        """Ask the robot for its pose now; raise Refused with the gateway's reason, BusError if no gateway answers."""
        pose: Pose = await self._ask(topics.RPC_POSE, Pose)
        return pose

    async def ask_map(self) -> Map:
        """Ask the robot for its map now; raise Refused with the gateway's reason, BusError if no gateway answers."""
        answer: Map = await self._ask(topics.RPC_MAP, Map)
        return answer

    # Commands that need no lease

    async def stop(self, reason: str | None = None) -> None:
        """Stop the robot and end any lease; return when its gateway has confirmed the stop.

        Raises BusError if no gateway does within 3 s, Refused if the robot cannot be stopped or reached.
        """
        await self._stop(reason, latch=False)

    async def latch(self, reason: str | None = None) -> None:
        """Stop the robot as :meth:`stop` does, and prevent driving until :meth:`unlatch`."""
        await self._stop(reason, latch=True)

    async def _stop(self, reason: str | None, *, latch: bool) -> None:
        stop = stops.new_stop(self._own, reason, latch=latch, secret=self._secret)
        await stops.stop_robot(self._bus, self._keys, stop)

    async def unlatch(self) -> tuple[Latch, ...]:
        """Release the latched stops of this robot; return those that were in force.

        Raises BusError if no gateway answers, Refused as the gateway did; Unsupported if the whole fleet is latched.
        """
        return await stops.unlatch_robot(self._bus, self._keys, self._own)

    # The next ones raise Unsupported if the robot does not accept the command, NotReady if it accepts none now, and
    # BusError if it has no gateway, as far as ``status`` tells.

    async def set_light(self, on: bool) -> None:
        """Turn the light on or off."""
        await self._command(topics.CMD_LIGHT, Switch(on))

    async def set_lidar(self, on: bool) -> None:
        """Turn the lidar on or off."""
        await self._command(topics.CMD_LIDAR, Switch(on))

    async def set_camera(self, on: bool) -> None:
        """Turn the camera on or off."""
        await self._command(topics.CMD_CAMERA, Switch(on))

    async def say(self, text: str) -> None:
        """Send the robot a text."""
        await self._command(topics.CMD_TEXT, Text(text))

    async def set_sensor(self, name: str, setting: SensorSetting) -> None:
        """Change the settings of a sensor."""
        await self._command(topics.CMD_SENSOR(name), setting)

    async def feed_scan(self, scan: Scan) -> None:
        """Send the robot simulated lidar data. Scans are repeated, so ``status`` is not read for each."""
        await self._put(topics.CMD_SCAN, scan)

    async def _command(self, topic: Topic, message: FleetMessage) -> None:
        """Send a command if the robot accepts it now: a gateway's refusal is shown on ``control``, to all."""
        name = topic.path.split("/")[1]
        status = await self.status.last()
        if status is None:
            raise BusError(f"{self.name}: {name} was not sent: no gateway answers for this robot")
        if status.state != "established":
            why = f": {status.reason}" if status.reason else ""
            raise NotReady(f"{self.name}: {name} was not sent: the robot is {status.state}{why}")
        if status.commands and name not in status.commands:  # a busy robot lists none; its gateway says why it refuses
            raise Unsupported(f"{self.name} does not accept {name}; it accepts {', '.join(status.commands)}")
        await self._put(topic, message)

    def _feed(self, topic: Topic) -> Feed[Any]:
        most_waiting = WAITING_IMAGES if topic.qos.newest else WAITING
        return Feed(self._bus, self._keys.key(topic.path), reader(topic), most_waiting=most_waiting)

    async def _put(self, topic: Topic, message: FleetMessage) -> None:
        with contextlib.closing(self._bus.publisher(self._keys.key(topic.path), topic)) as publisher:
            publisher.put(payloads.encode(message))
            await self._bus.flush()

    async def _ask(self, topic: Topic, message: Any) -> Any:
        question = payloads.encode(Query())
        for answer in await self._bus.ask(self._keys.key(topic.path), question, timeout_s=ANSWER_S):
            if isinstance(answer.error, Refused):
                raise refusal(answer.error.code, f"{self.name}: {answer.error}")
            if answer.error is not None:
                raise BusError(f"{self.name}: {answer.error}")
            return payloads.decode(message, answer.payload)
        raise BusError(f"{self.name}: no gateway answered within {ANSWER_S:g} s")
