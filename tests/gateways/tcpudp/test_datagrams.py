"""Whose datagrams move the robot: a listener on real sockets, HQ programs written by hand, and attackers beside them.

Every byte is read off the protocol page. Which source a session takes is shown in test_robot_role.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import time
from collections.abc import AsyncIterator, Callable
from typing import Any
from unittest import mock

import pytest

from gateways.tcpudp import PROTOCOL
from gateways.tcpudp.options import TcpUdpHqOptions
from gateways.tcpudp.session import robot_role as sessions
from tests.clock import scene_of
from tests.fake_bus import FakeBus
from tests.gateways.tcpudp.frames import ANSWER_TRUE, LISTED, START, bearing, client_settings, framed
from tests.hq.gateway import KEYS, Gateway
from zbridge.clocks import Clocks
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Status
from zbridge.hq.listener import Listener
from zbridge.hq.robot_subscription import RobotSubscription
from zbridge.hq.settings import HqSettings, ListenerPlan
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.session_table import SessionTable
from zbridge.transport import udp as datagrams

SOON_S = 5.0
SHORT_S = 0.05
"""Time for a 5 that is not to come in time; one that is has as long as a real one."""
LISTS = {"1.1": (b"1.1", "0100000000"), "1.2": (b"1.2", "010000000000"), "1.3": (LISTED, "01000000000000")}
RIVAL = "another source of datagrams claims to be this client"
VOID = "packets by UDP from another port than this client's are not taken"
AHEAD = struct.pack("<3f", 0.0, 1.0, 1.0)

old_and_new = pytest.mark.parametrize("version", ["1.1", "1.3"])


@pytest.fixture(autouse=True)
def every_stray(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inspect every datagram of an attacker, however fast they come."""
    monkeypatch.setattr(datagrams, "STRAY_S", 0.0)


class Scene:
    """A listener on real sockets, and a robot behind it."""

    def __init__(self, **options: Any) -> None:
        self.open = contextlib.ExitStack()
        self.client_port: int = self.udp().getsockname()[1]
        self.open.close()
        bus = FakeBus("hq")
        self.gateway = Gateway(bus.join("gw"), self)  # type: ignore[arg-type]
        self.gateway.bus.publisher(KEYS.key("status"), topics.STATUS).put(
            payloads.encode(Status(state="established", protocol="tcpudp", version="1.3", features=("udp", "joystick")))
        )
        self.gateway.bus.announce(KEYS.alive("gateway"))
        self.metrics, self.manager = Metrics(), SessionTable()
        robot = RobotSubscription(bus, KEYS, self.metrics)
        robot.open()
        plan = ListenerPlan(
            PROTOCOL,
            TcpUdpHqOptions(client_port=self.client_port, **options),
            Address("127.0.0.1", 0),
            HqSettings(protocol="tcpudp", listen="tcp://127.0.0.1:0"),
            (),
        )
        self.listener = Listener(plan, "tcpudp", robot, self.manager, self.metrics, Clocks(lambda: self.now))

    @property
    def now(self) -> float:
        return time.monotonic()

    @property
    def address(self) -> tuple[str, int]:
        return (self.listener.address.host, self.listener.address.port)

    def udp(self, port: int = 0, host: str = "127.0.0.1") -> socket.socket:
        sock = self.open.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        sock.setblocking(False)
        sock.bind((host, port))
        return sock

    def drives(self) -> list[Drive]:
        """The motion that was carried out."""
        return [message for _, message in self.gateway.commands if isinstance(message, Drive) and message.moving]

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(SOON_S):
            while not condition():  # noqa: ASYNC110
                await asyncio.sleep(0.002)

    async def rivals(self, count: int) -> None:
        await self.until(lambda: self.metrics.total("hq_rival_sources") == count)

    async def taken_in(self) -> None:
        """Let all that was sent be read: a datagram of nobody's that is sent now is counted after it."""
        before = self.metrics.total("hq_foreign_datagrams")
        self.udp().sendto(b"last", self.address)
        await self.until(lambda: self.metrics.total("hq_foreign_datagrams") > before)

    async def attack(self, sock: socket.socket, number: int) -> None:
        """Send everything that could make a robot drive in a client's name; nothing moves."""
        before = len(self.drives())
        for sender in (number, 0, 1):
            for kind, body in ((10, struct.pack("<i", 2)), (13, b""), (11, AHEAD), (5, b"")):
                sock.sendto(framed(sender, kind, body), self.address)
        await self.taken_in()
        assert len(self.drives()) == before
        silent(sock)


@contextlib.asynccontextmanager
async def serving(**options: Any) -> AsyncIterator[Scene]:
    scene = Scene(**options)
    task = asyncio.create_task(scene.listener.run())
    await asyncio.wait_for(scene.listener.ready.wait(), SOON_S)
    with scene.open:
        yield scene
        assert not task.done(), task
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


scene = scene_of(serving)


async def hears(sock: socket.socket) -> bytes:
    async with asyncio.timeout(SOON_S):
        return await asyncio.get_running_loop().sock_recv(sock, 65536)


def silent(sock: socket.socket) -> None:
    """Nothing came."""
    with pytest.raises(BlockingIOError):
        sock.recv(100)


class Program:
    """An HQ program of one version; what it does is up to the test."""

    def __init__(self, scene: Scene, version: str = "1.3", port: int | None = None) -> None:
        self.scene, self.version = scene, version
        self.port = scene.client_port if port is None else port
        self.texts: list[str] = []

    @property
    def session(self) -> Any:
        return self.scene.listener.clients[self.number].session

    async def read(self) -> bytes:
        """Read one packet by TCP, nothing at the end."""
        async with asyncio.timeout(SOON_S):
            length = await self.reader.read(4)
            frame = length and length + await self.reader.readexactly(int.from_bytes(length, "little"))
        if frame[5:6] == b"\x01":
            self.texts.append(frame[10:].decode())
        return frame

    async def told(self, words: str) -> None:
        while not any(words in text for text in self.texts):
            assert await self.read(), f"{words!r} is not among {self.texts}"

    async def let_go(self) -> None:
        """Read until the listener has closed for there was a rival."""
        with contextlib.suppress(ConnectionError):
            while await self.read():
                pass
        await self.scene.until(lambda: any(RIVAL in str(entry.reason) for entry in self.scene.manager.snapshots()))

    async def send(self, kind: int, body: bytes = b"") -> None:
        self.writer.write(framed(self.number, kind, body))
        await self.writer.drain()

    def send_udp(self, kind: int, body: bytes = b"", sender: int | None = None) -> None:
        self.udp.sendto(framed(self.number if sender is None else sender, kind, body), self.scene.address)

    async def greet(self) -> Program:
        """Shake hands up to the robot's 4, and bind the UDP port only then."""
        self.reader, self.writer = await asyncio.open_connection(*self.scene.address)
        self.scene.open.callback(self.writer.close)
        self.number = (await self.read())[6]
        self.writer.write(client_settings(*LISTS[self.version]))
        assert await self.read() == START
        self.udp = self.scene.udp(self.port)
        return self

    async def report(self, *, heard: bool) -> None:
        """Send 7: programs of 1.3 say true whatever happened."""
        await self.send(7, bytes([heard or self.version == "1.3"]))
        await self.scene.until(lambda: self.session.state.value == "established")

    async def shake(self, times: int = 1) -> Program:
        await self.greet()
        for _ in range(times):
            self.send_udp(5)
        assert await hears(self.udp) == ANSWER_TRUE
        await self.report(heard=True)
        return self

    async def lose_probe(self, late: int = 0) -> Program:
        """Shake hands, the 5 being lost; or it comes so many times, too late."""
        with mock.patch.object(sessions, "PROBE_S", SHORT_S):
            await self.greet()
        await self.scene.until(lambda: self.session._handshake.step is sessions.RobotStep.UNANSWERED)
        for _ in range(late):
            self.send_udp(5)
        await self.scene.taken_in()
        await self.report(heard=False)
        return self

    async def take_stick(self) -> None:
        """Say neutral, and that the stick is to drive."""
        await self.send(13)
        await self.send(10, struct.pack("<i", 2))
        operator = self.scene.listener.clients[self.number].operator
        await self.scene.until(lambda: operator.intent.mode == "manual")

    async def drive(self, *, by_udp: bool) -> None:
        """Drive until the robot does."""
        await self.take_stick()
        before = len(self.scene.drives())
        async with asyncio.timeout(SOON_S):
            while len(self.scene.drives()) == before:
                await self.send(13)  # on a busy machine the listener may have stood still, and wants neutral again
                if by_udp:
                    self.send_udp(11, AHEAD)
                else:
                    await self.send(11, AHEAD)
                await asyncio.sleep(0.05)
        assert self.scene.drives()[-1] == Drive(forward=1.0)


# Nobody else is there


@old_and_new
@pytest.mark.parametrize("port", [None, 0], ids=["known port", "another port"])
async def test_a_client_drives_by_datagram_from_any_port_that_sent_its_5_and_gets_one_6(scene, version, port) -> None:
    client = await Program(scene, version, port).shake(times=3)
    client.send_udp(5)
    await client.drive(by_udp=True)
    silent(client.udp)


@pytest.mark.parametrize("late", [0, 1], ids=["lost", "late"])
@pytest.mark.parametrize("version", LISTS)
async def test_a_client_whose_5_was_lost_or_late_gets_no_6_and_drives(scene: Scene, version: str, late: int) -> None:
    """Programs of 1.1 and 1.2 by TCP, those of 1.3 by UDP from the port that they are known to bind."""
    client = await Program(scene, version).lose_probe(late)
    await client.drive(by_udp=version == "1.3")
    silent(client.udp)
    assert client.session.left_out == {}


async def test_of_two_clients_of_one_host_a_packet_from_the_port_binds_the_one_whose_id_it_bears(scene: Scene) -> None:
    first, second = await Program(scene, port=0).lose_probe(), await Program(scene).lose_probe()
    assert (first.number, second.number) == (2, 3)
    await first.take_stick()
    await second.drive(by_udp=True)
    assert first.session.traffic.frames_in == 4, "3, 7, 13 and 10"
    second.send_udp(11, AHEAD, sender=first.number)
    await scene.until(lambda: second.session.traffic.malformed == 1)
    assert second.session.last_malformed == "datagram with id 2, which is another client's"


async def test_a_5_that_two_waiting_clients_could_have_sent_is_neithers(scene: Scene) -> None:
    first, second = await Program(scene, "1.1", 0).greet(), await Program(scene, "1.1", 0).greet()
    first.send_udp(5, sender=0)
    await scene.rivals(2)
    second.send_udp(5)
    await scene.taken_in()
    for client in (first, second):
        silent(client.udp)
        await client.report(heard=False)
    await second.drive(by_udp=False)


# Attackers


@pytest.mark.parametrize("sender", [None, 0, 1])
@pytest.mark.parametrize("attacker_first", [True, False])
@old_and_new
async def test_of_two_sources_before_the_7_none_is_heard_and_the_client_is_let_go(
    scene: Scene, version: str, attacker_first: bool, sender: int | None, caplog: pytest.LogCaptureFixture
) -> None:
    client, attacker = await Program(scene, version).greet(), scene.udp()
    first, second = (attacker, client.udp) if attacker_first else (client.udp, attacker)
    probe = framed(client.number, 5)
    first.sendto(bearing(probe, client.number if sender is None else sender), scene.address)
    assert await hears(first) == ANSWER_TRUE
    if attacker_first:
        await scene.attack(attacker, client.number)
    second.sendto(probe, scene.address)
    await client.let_go()
    await scene.attack(attacker, client.number)
    silent(client.udp)
    assert scene.metrics.total("hq_rival_sources") == 1
    assert "another source of datagrams claims to be tcp://127.0.0.1" in caplog.text


@old_and_new
async def test_an_attacker_whose_5_was_answered_instead_of_the_lost_one_moves_nothing(scene: Scene, version) -> None:
    """A program of 1.1 says that it got no 6; one of 1.3 says that it did, and shows up by what it drives."""
    client, attacker = await Program(scene, version).greet(), scene.udp()
    attacker.sendto(framed(client.number, 5), scene.address)
    assert await hears(attacker) == ANSWER_TRUE
    await scene.attack(attacker, client.number)
    await client.report(heard=False)
    if version == "1.3":
        client.send_udp(11, AHEAD)
        await scene.rivals(1)
    await client.take_stick()
    await scene.attack(attacker, client.number)
    if version == "1.3":
        client.send_udp(11, AHEAD)
        await client.told(VOID)
        assert scene.drives() == []
    else:
        await client.drive(by_udp=False)


@pytest.mark.parametrize("lost", [False, True], ids=["5 taken", "5 lost"])
@old_and_new
async def test_an_attacker_with_the_right_id_and_another_port_moves_nothing(scene, version: str, lost: bool) -> None:
    client, attacker = Program(scene, version), scene.udp()
    await (client.lose_probe() if lost else client.shake())
    await client.take_stick()
    await scene.attack(attacker, client.number)
    await client.told(VOID)
    await client.drive(by_udp=version == "1.3" or not lost)
    silent(attacker)
    assert scene.metrics.total("hq_rival_sources") == 0
    assert len(client.texts) == 1, "told once, not with every datagram"
    assert client.session.traffic.refused == client.session.traffic.foreign == scene.metrics.total("hq_refused") > 0


async def test_an_attacker_at_another_address_is_nobody(scene: Scene) -> None:
    client = await Program(scene).greet()
    attacker = scene.udp(scene.client_port, "127.0.0.2")
    attacker.sendto(framed(client.number, 5), scene.address)
    client.send_udp(5)
    assert await hears(client.udp) == ANSWER_TRUE
    await client.report(heard=True)
    await client.take_stick()
    await scene.attack(attacker, client.number)
    assert (client.texts, client.session.traffic.refused) == ([], 0)
    await client.drive(by_udp=True)
    assert scene.metrics.total("hq_rival_sources") == 0
