"""A Webots robot that registers new names on every connection: what its gateway keeps of the old ones."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator

import msgpack
import pytest

from gateways.wc2ec.settings import Options
from gateways.wc2ec.translate import Wc2EcRobot
from tests.clock import scene_of
from zbridge.bus import Publisher
from zbridge.bus.fake import FakeBus
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.session_table import SessionTable
from zbridge.robot.device import Device
from zbridge.robot.names import HOUR_S, NAMES
from zbridge.transport.conversation import Conversation
from zbridge.transport.fake import FakeLink

pytestmark = pytest.mark.jumping

SENSORS = 255
TEXT = "more than 1024 different names within an hour: the others are not published"


class CountingBus(FakeBus):
    """A bus that knows which keys are declared."""

    def __init__(self) -> None:
        super().__init__("1")
        self.declared: dict[str, int] = {}

    def publisher(self, key: str, topic: Topic) -> Publisher:
        publisher = super().publisher(key, topic)
        self.declared[key] = self.declared.get(key, 0) + 1
        close = publisher.close

        def closed() -> None:
            close()
            self.declared.pop(key, None)

        publisher.close = closed  # type: ignore[method-assign]
        return publisher

    @property
    def sensors(self) -> set[str]:
        """Names of sensors that are declared."""
        assert set(self.declared.values()) == {1}, "nothing is declared twice"
        return {key.rpartition("/")[2] for key in self.declared if "/sensor/" in key}


class Webots:
    """A Webots controller at the other end of the link; its gateway connects again and again."""

    def __init__(self) -> None:
        self.bus = CountingBus()
        self.metrics = Metrics()
        self.conversations: list[Conversation] = []
        self.connected = asyncio.Event()
        self.device = Device(
            Wc2EcRobot(Options()),
            (Address("robot.test", 27015),),
            protocol="wc2ec",
            keys=KeySpace("fleet", "r1"),
            bus=self.bus,
            authority=Authority(3.0, 2.0, lambda: bytes(16)),
            manager=SessionTable(),
            metrics=self.metrics,
            audit=Audit("r1", lambda line: None),
            connect=self._connect,
        )

    async def _connect(self, address: Address, conversation: Conversation) -> None:
        self.conversations.append(conversation)
        self.connected.set()
        conversation.attached(FakeLink(str(address)))

    def says(self, names: list[str]) -> None:
        """Register these sensors and send a reading of each."""
        told = b"".join(bytes((0, 37, n, len(name))) + name.encode() for n, name in enumerate(names))
        told += b"".join(bytes((1, 37, n)) + struct.pack("<d", 1.0) for n in range(len(names)))
        self.conversations[-1].received(told)

    async def goes(self) -> None:
        """Lose the connection, and be connected to again."""
        self.connected.clear()
        self.conversations[-1].lost("closed by peer")
        await self.connected.wait()

    def shown(self, name: str) -> int:
        """How many readings of a sensor were published."""
        return len(self.bus.values(f"fleet/r1/sensor/{name}"))

    @property
    def reason(self) -> str | None:
        reason: str | None = msgpack.unpackb(self.bus.values("fleet/r1/status")[-1])["reason"]
        return reason


@contextlib.asynccontextmanager
async def serving() -> AsyncIterator[Webots]:
    webots = Webots()
    task = asyncio.create_task(webots.device.run())
    await webots.connected.wait()
    try:
        yield webots
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


webots = scene_of(serving)


def names_of(connection: int) -> list[str]:
    return [f"c{connection}-s{number}" for number in range(SENSORS)]


async def test_the_names_of_a_connection_that_is_gone_are_undeclared_and_those_above_the_bound_never_declared(
    webots: Webots,
) -> None:
    for connection in range(41):
        names = names_of(connection)
        webots.says(names)
        published = connection < NAMES // SENSORS
        assert webots.shown(names[-1]) == published
        if published:
            assert webots.bus.sensors == set(names)
            assert webots.reason is None
        await webots.goes()
        assert webots.bus.sensors == set()
    assert len(webots.device._publishers) < 10
    assert webots.metrics.count("names_dropped").value == 41 * SENSORS - NAMES
    assert webots.reason is not None
    assert webots.reason.endswith(TEXT)


async def test_a_robot_that_connects_again_with_its_names_is_published_as_before(webots: Webots) -> None:
    for connection in range(1, 41):
        webots.says(names_of(0))
        assert webots.shown("c0-s254") == connection
        await webots.goes()
    assert webots.metrics.count("names_dropped").value == 0


async def test_an_hour_later_there_is_room_for_other_names_and_nothing_is_told_any_more(webots: Webots) -> None:
    for connection in range(5):
        webots.says(names_of(connection))
        await webots.goes()
    assert TEXT in (webots.reason or "")
    await asyncio.sleep(HOUR_S)
    assert TEXT not in (webots.reason or "")
    await webots.goes()
    webots.says(names_of(5))
    assert webots.shown("c5-s254") == 1


async def test_unregistered_devices_count_like_all_others(webots: Webots) -> None:
    webots.says(["front"])
    for kind in range(256):
        readings = b"".join(bytes((1, kind, number)) + struct.pack("<d", 1.0) for number in range(1, 256))
        webots.conversations[-1].received(readings)
    assert len(webots.bus.sensors) == NAMES
    assert TEXT in (webots.reason or "")
