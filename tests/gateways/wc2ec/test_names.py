"""A Webots robot that registers new names on every connection: what its gateway keeps of the old ones."""

import asyncio
import contextlib
import struct

import msgpack
import pytest

from gateways.wc2ec.options import Wc2EcOptions
from gateways.wc2ec.translate import Wc2EcRobot
from tests.fake_bus import FakeBus
from tests.fake_link import FakeLink
from tests.gateways.wc2ec.golden import DISTANCE, data, registration
from zbridge.bus import Publisher
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.context import ProtocolFaults, RobotContext
from zbridge.control.faults import OpenFaults
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.session_table import SessionTable
from zbridge.robot.connection import LinkSettings
from zbridge.robot.device import ControlParts, RobotDevice
from zbridge.robot.names import HOUR_S, NAMES
from zbridge.transport.conversation import Conversation

pytestmark = pytest.mark.jumping

SENSORS = 255
TEXT = "more than 1024 different names within an hour: the others are not published"


class CountingBus(FakeBus):
    """A bus that knows which sensors are declared."""

    def __init__(self) -> None:
        super().__init__("1")
        self.sensors: list[str] = []

    def publisher(self, key: str, topic: Topic, last: bytes | None = None) -> Publisher:
        publisher = super().publisher(key, topic, last)
        name, close = key.rpartition("/")[2], publisher.close

        def closed() -> None:
            close()
            self.sensors.remove(name)

        if "/sensor/" in key:
            self.sensors.append(name)
            publisher.close = closed  # type: ignore[method-assign]
        return publisher


class Webots:
    """A Webots controller at the other end of the link; its gateway connects again and again."""

    def __init__(self) -> None:
        self.bus, self.metrics, self.connected = CountingBus(), Metrics(), asyncio.Event()
        self.conversation: Conversation
        self.device = RobotDevice(
            RobotContext(
                Wc2EcRobot(Wc2EcOptions()),
                KeySpace("fleet", "r1"),
                self.bus,
                self.metrics,
                OpenFaults(),
                ProtocolFaults("r1"),
                clock=asyncio.get_running_loop().time,
            ),
            "wc2ec",
            LinkSettings(addresses=(Address("robot.test", 27015),), sessions=SessionTable(), connect=self._connect),
            ControlParts(authority=Authority(3.0, 2.0, lambda: bytes(16)), audit=Audit("r1", lambda line: None)),
        )

    async def _connect(self, address: Address, conversation: Conversation) -> None:
        self.conversation = conversation
        self.connected.set()
        conversation.attached(FakeLink(str(address)))

    def says(self, connection: int) -> list[str]:
        """Register the sensors of a connection, and send a reading of each; give those that are published now."""
        names = [f"c{connection}-s{number}" for number in range(SENSORS)]
        told = [registration(DISTANCE, number, name.encode()) for number, name in enumerate(names)]
        self.conversation.received(b"".join(told + [data(number, 1.0) for number in range(SENSORS)]))
        return [name for name in names if name in self.bus.sensors]

    async def goes(self) -> None:
        """Lose the connection, and be connected to again."""
        self.connected.clear()
        self.conversation.lost("closed by peer")
        await self.connected.wait()
        assert self.bus.sensors == []

    @property
    def reason(self) -> str:
        return str(msgpack.unpackb(self.bus.values("fleet/r1/status")[-1])["reason"])


async def test_names_are_declared_while_they_are_there_and_no_more_than_1024_within_an_hour() -> None:
    webots = Webots()
    task = asyncio.create_task(webots.device.run())
    await webots.connected.wait()
    for connection in (0, 1, 2, 3, 0, 0):
        assert len(webots.says(connection)) == SENSORS
        assert webots.reason == "None"
        await webots.goes()
    assert len(webots.says(4)) == NAMES - 4 * SENSORS
    for connection in range(5, 20):
        await webots.goes()
        assert webots.says(connection) == []
    assert webots.metrics.count("names_dropped").value == 20 * SENSORS - NAMES
    assert webots.reason.endswith(TEXT)
    await asyncio.sleep(HOUR_S)
    assert TEXT not in webots.reason
    await webots.goes()
    for kind in range(256):  # unregistered devices count like all others
        readings = (struct.pack("<BBBd", 1, kind, number, 1.0) for number in range(1, 256))
        webots.conversation.received(b"".join(readings))
    assert len(webots.bus.sensors) == NAMES
    assert TEXT in webots.reason
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
