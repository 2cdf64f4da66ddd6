"""Whose datagrams move the robot: a listener on real sockets, HQ programs written by hand, and attackers beside them.

Every byte is read off the protocol page.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import time
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any
from unittest import mock

import pytest

from gateways.tcpudp import PROTOCOL
from gateways.tcpudp.hq import HqOptions
from gateways.tcpudp.session import robot_role as sessions
from tests.hq.gateway import Gateway
from zbridge.bus.fake import FakeBus
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Status
from zbridge.fleet.topics import KeySpace
from zbridge.hq.listener import Listener
from zbridge.hq.robot_subscription import RobotSubscription
from zbridge.hq.settings import HqSettings, ListenerPlan
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.session_table import SessionTable
from zbridge.transport import udp as datagrams

KEYS = KeySpace("fleet", "r1")
SOON_S = 5.0
SHORT_S = 0.05
"""Time for a 5 that is not to come in time; one that is has as long as a real one."""
OLD = ("1.1", "1.2")
VERSIONS = (*OLD, "1.3")
ANSWERS = {"1.1": (b"1.1", "0100000000"), "1.2": (b"1.2", "010000000000"), "1.3": (b"1.1,1.2,1.3", "01000000000000")}
FORWARD = Drive(forward=1.0)
RIVAL = "another source of datagrams claims to be this client"
VOID = "packets by UDP from another port than this client's are not taken"


def packet(sender: int, kind: int, body: bytes = b"") -> bytes:
    return struct.pack("<iBB", 2 + len(body), sender, kind) + body


def probe(sender: int) -> bytes:
    return packet(sender, 5)


def move(sender: int) -> bytes:
    return packet(sender, 11, struct.pack("<3f", 0.0, 1.0, 1.0))


@pytest.fixture(autouse=True)
def every_stray(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look at every datagram of an attacker, however fast they come."""
    monkeypatch.setattr(datagrams, "STRAY_S", 0.0)


class Scene:
    """A listener on real sockets, a robot behind it, and a free port for each who wants one."""

    def __init__(self) -> None:
        self.bus = FakeBus("hq")
        self.gateway = Gateway(self.bus.join("gw"), self)  # type: ignore[arg-type]
        self.gateway.bus.publisher(KEYS.key("status"), topics.STATUS).put(
            payloads.encode(Status(state="established", protocol="tcpudp", version="1.3", features=("udp", "joystick")))
        )
        self.gateway.bus.announce(KEYS.alive("gateway"))
        self.metrics = Metrics()
        self.manager = SessionTable()
        self.listener: Listener
        self.client_port = free_port()

    @property
    def now(self) -> float:
        return time.monotonic()

    @property
    def address(self) -> tuple[str, int]:
        return (self.listener.address.host, self.listener.address.port)

    def drives(self) -> list[Drive]:
        """The motion that was carried out."""
        return [message for _, message in self.gateway.commands if isinstance(message, Drive) and message.moving]

    def session(self, number: int = 2) -> Any:
        return self.listener.clients[number].session

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(SOON_S):
            while not condition():  # noqa: ASYNC110
                await asyncio.sleep(0.002)

    async def taken_in(self) -> None:
        """Let all that was sent be read: a datagram of nobody's that is sent now is counted after it."""
        before = self.metrics.total("hq_foreign_datagrams")
        with udp() as last:
            last.sendto(b"last", self.address)
            await self.until(lambda: self.metrics.total("hq_foreign_datagrams") > before)

    async def reason(self, words: str) -> None:
        """Wait until a session has ended for this reason."""
        await self.until(lambda: any(words in str(entry.reason) for entry in self.manager.snapshots()))


@contextlib.asynccontextmanager
async def serving(**options: Any) -> AsyncIterator[Scene]:
    scene = Scene()
    robot = RobotSubscription(scene.bus, KEYS, scene.metrics)
    robot.open()
    plan = ListenerPlan(
        PROTOCOL,
        HqOptions(**{"client_port": scene.client_port, **options}),
        Address("127.0.0.1", 0),
        HqSettings(protocol="tcpudp", listen="tcp://127.0.0.1:0"),
        (),
    )
    scene.listener = Listener(plan, "tcpudp", robot, scene.manager, scene.metrics, lambda: scene.now)
    task = asyncio.create_task(scene.listener.run())
    await asyncio.wait_for(scene.listener.ready.wait(), SOON_S)
    try:
        yield scene
        assert not task.done(), task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def free_port() -> int:
    with udp() as sock:
        return int(sock.getsockname()[1])


@contextlib.contextmanager
def udp(port: int = 0, host: str = "127.0.0.1") -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setblocking(False)
        sock.bind((host, port))
        yield sock


class Program:
    """An HQ program of one version; what it does is up to the test."""

    def __init__(self, scene: Scene, version: str, port: int | None = None) -> None:
        self.scene, self.version = scene, version
        self.port = scene.client_port if port is None else port
        self.tcp = socket.socket()
        self.tcp.setblocking(False)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setblocking(False)
        self.stream = b""
        self.texts: list[str] = []
        self.number = 0

    async def read(self) -> bytes:
        """Read one packet by TCP, nothing at the end; texts are kept besides."""
        async with asyncio.timeout(SOON_S):
            while len(self.stream) < 4 or len(self.stream) < 4 + struct.unpack_from("<i", self.stream)[0]:
                data = await asyncio.get_running_loop().sock_recv(self.tcp, 65536)
                if not data:
                    return b""
                self.stream += data
        size = 4 + struct.unpack_from("<i", self.stream)[0]
        frame, self.stream = self.stream[:size], self.stream[size:]
        if frame[5] == 1:
            self.texts.append(frame[10:].decode())
        return frame

    def kinds(self) -> list[int]:
        """What came by TCP and was not read yet, by packet ids."""
        with contextlib.suppress(BlockingIOError):
            self.stream += self.tcp.recv(65536)
        kinds = []
        while self.stream:
            kinds.append(self.stream[5])
            self.stream = self.stream[4 + struct.unpack_from("<i", self.stream)[0] :]
        return kinds

    async def told(self, words: str) -> None:
        while not any(words in text for text in self.texts):
            assert await self.read(), f"{words!r} is not among {self.texts}"

    async def heard(self) -> bytes:
        return await hears(self.udp)

    async def send(self, kind: int, body: bytes = b"") -> None:
        await asyncio.get_running_loop().sock_sendall(self.tcp, packet(self.number, kind, body))

    async def greet(self) -> None:
        """Shake hands up to the robot's 4, and bind the UDP port only then."""
        await asyncio.get_running_loop().sock_connect(self.tcp, self.scene.address)
        settings = await self.read()
        assert settings[4:6] == b"\x01\x02"
        self.number = settings[6]
        listed, flags = ANSWERS[self.version]
        await self.send(3, struct.pack("<i", len(listed)) + listed + bytes.fromhex(flags))
        assert await self.read() == bytes.fromhex("02000000 01 04")
        self.udp.bind(("127.0.0.1", self.port))

    def send_udp(self, data: bytes) -> None:
        self.udp.sendto(data, self.scene.address)

    async def report(self, *, heard: bool) -> None:
        """Send 7: programs of 1.3 say true whatever happened."""
        await self.send(7, bytes([heard or self.version == "1.3"]))
        await self.scene.until(lambda: self.scene.session(self.number).state.value == "established")

    async def shake(self) -> None:
        await self.greet()
        self.send_udp(probe(self.number))
        assert await self.heard() == bytes.fromhex("03000000 01 06 01")
        await self.report(heard=True)

    async def greet_and_wait(self) -> None:
        """Shake hands up to the robot's 4, and send no 5 until it is too late for that."""
        with mock.patch.object(sessions, "PROBE_S", SHORT_S):
            await self.greet()
        await self.scene.until(lambda: self.scene.session(self.number)._handshake.step is sessions.Step.UNANSWERED)

    async def lose_probe(self) -> None:
        """Shake hands, the 5 being lost."""
        await self.greet_and_wait()
        await self.report(heard=False)

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
                if by_udp:
                    self.send_udp(move(self.number))
                else:
                    await self.send(11, struct.pack("<3f", 0.0, 1.0, 1.0))
                await asyncio.sleep(0.05)
        assert self.scene.drives()[-1] == FORWARD

    async def gone(self) -> None:
        """Read until the listener has closed."""
        with contextlib.suppress(ConnectionError):
            while await self.read():
                pass

    def close(self) -> None:
        self.tcp.close()
        self.udp.close()


@contextlib.asynccontextmanager
async def program(scene: Scene, version: str, port: int | None = None) -> AsyncIterator[Program]:
    client = Program(scene, version, port)
    try:
        yield client
    finally:
        client.close()


async def hears(sock: socket.socket) -> bytes:
    async with asyncio.timeout(SOON_S):
        return await asyncio.get_running_loop().sock_recv(sock, 65536)


def silent(*socks: socket.socket) -> None:
    """Nothing came."""
    for sock in socks:
        with pytest.raises(BlockingIOError):
            sock.recv(100)


async def attack(scene: Scene, sock: socket.socket, number: int) -> None:
    """Send everything that could make a robot drive in a client's name."""
    for sender in (number, 0, 1):
        for data in (packet(sender, 10, struct.pack("<i", 2)), packet(sender, 13), move(sender), probe(sender)):
            sock.sendto(data, scene.address)
    await scene.taken_in()


# Nobody else is there


@pytest.mark.parametrize("version", VERSIONS)
async def test_a_client_drives_by_datagram_from_any_port_that_sent_its_5(version: str) -> None:
    async with serving() as scene:
        for port in (scene.client_port, 0):
            async with program(scene, version, port) as client:
                await client.shake()
                await client.drive(by_udp=True)
                await client.send(13)


@pytest.mark.parametrize("sender", [0, 1])
async def test_a_5_may_bear_an_id_that_nobody_has(sender: int) -> None:
    async with serving() as scene, program(scene, "1.3") as client:
        await client.greet()
        client.send_udp(probe(sender))
        assert await client.heard() == bytes.fromhex("03000000 01 06 01")


@pytest.mark.parametrize("version", VERSIONS)
async def test_a_client_whose_5_was_lost_gets_no_6_and_drives(version: str) -> None:
    """Programs of 1.1 and 1.2 by TCP, those of 1.3 by UDP from the port that they are known to bind."""
    async with serving() as scene, program(scene, version) as client:
        await client.lose_probe()
        await client.drive(by_udp=version == "1.3")
        silent(client.udp)
        assert 6 not in client.kinds()
        assert scene.session().left_out == {}


@pytest.mark.parametrize("version", VERSIONS)
async def test_a_client_whose_5_came_late_gets_no_6_and_drives(version: str) -> None:
    async with serving() as scene, program(scene, version) as client:
        await client.greet_and_wait()
        client.send_udp(probe(client.number))
        await scene.taken_in()
        await client.report(heard=False)
        client.send_udp(probe(client.number))
        await client.drive(by_udp=version == "1.3")
        silent(client.udp)
        assert 6 not in client.kinds()


@pytest.mark.parametrize("version", VERSIONS)
async def test_a_client_whose_5_was_doubled_gets_one_6_and_drives(version: str) -> None:
    async with serving() as scene, program(scene, version) as client:
        await client.greet()
        for _ in range(2):
            client.send_udp(probe(client.number))
        assert await client.heard() == bytes.fromhex("03000000 01 06 01")
        client.send_udp(probe(client.number))
        await client.report(heard=True)
        client.send_udp(probe(client.number))
        await client.drive(by_udp=True)
        silent(client.udp)
        assert 6 not in client.kinds()


async def test_a_client_of_1_3_that_binds_another_port_and_lost_its_5_drives_into_the_void_and_is_told() -> None:
    async with serving() as scene, program(scene, "1.3", 0) as client:
        await client.lose_probe()
        await client.take_stick()
        client.send_udp(move(client.number))
        await client.told(VOID)
        await attack(scene, client.udp, client.number)
        assert scene.drives() == []
        assert scene.session().traffic.refused == 5
        assert scene.session().traffic.foreign == 5
        assert scene.metrics.total("hq_refused") == 5


async def test_of_two_clients_of_one_host_a_packet_from_the_port_binds_the_one_whose_id_it_bears() -> None:
    async with serving() as scene, program(scene, "1.3", 0) as first, program(scene, "1.3") as second:
        await first.lose_probe()
        await second.lose_probe()
        assert (first.number, second.number) == (2, 3)
        await first.take_stick()
        await second.drive(by_udp=True)
        first_session, second_session = scene.session(2), scene.session(3)
        assert (first_session.traffic.frames_in, second_session._source.bound) == (4, True), "3, 7, 13 and 10"
        second.send_udp(move(first.number))
        await scene.until(lambda: second_session.traffic.malformed == 1)
        assert second_session.last_malformed == "datagram with id 2, which is another client's"


@pytest.mark.parametrize("version", OLD)
async def test_a_5_that_two_waiting_clients_could_have_sent_is_neithers(version: str) -> None:
    async with serving() as scene, program(scene, version, 0) as first, program(scene, version, 0) as second:
        await first.greet()
        await second.greet()
        first.send_udp(probe(0))
        await scene.until(lambda: scene.metrics.total("hq_rival_sources") == 2)
        second.send_udp(probe(second.number))
        await scene.taken_in()
        for client in (first, second):
            silent(client.udp)
            await client.report(heard=False)
        await second.drive(by_udp=False)


# Attackers


@pytest.mark.parametrize("sender", [None, 0, 1])
@pytest.mark.parametrize("version", VERSIONS)
async def test_an_attacker_whose_5_came_first_is_not_heard_and_the_client_is_let_go(version, sender) -> None:
    async with serving() as scene, program(scene, version) as client:
        await client.greet()
        with udp() as attacker:
            attacker.sendto(probe(client.number if sender is None else sender), scene.address)
            assert await hears(attacker) == bytes.fromhex("03000000 01 06 01")
            await attack(scene, attacker, client.number)
            client.send_udp(probe(client.number))
            await client.gone()
            await scene.reason(RIVAL)
            await attack(scene, attacker, client.number)
            silent(attacker, client.udp)
        assert scene.drives() == []
        assert scene.metrics.total("hq_rival_sources") == 1


@pytest.mark.parametrize("version", VERSIONS)
async def test_a_rival_that_comes_before_the_7_costs_the_client_its_connection_and_moves_nothing(
    version: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with serving() as scene, program(scene, version) as client:
        await client.greet()
        client.send_udp(probe(client.number))
        assert await client.heard() == bytes.fromhex("03000000 01 06 01")
        with udp() as attacker:
            attacker.sendto(probe(client.number), scene.address)
            await client.gone()
            await scene.reason(RIVAL)
            await attack(scene, attacker, client.number)
            silent(attacker)
        assert scene.drives() == []
        assert scene.metrics.total("hq_rival_sources") == 1
    assert "another source of datagrams claims to be tcp://127.0.0.1" in caplog.text


@pytest.mark.parametrize("version", VERSIONS)
async def test_of_two_sources_that_came_before_the_6_was_sent_neither_is_heard(version: str) -> None:
    """The listener keeps half a second between its packets here, so that the 6 waits."""
    async with serving(gap_s=0.5) as scene, program(scene, version) as client:
        await client.greet()
        with udp() as attacker:
            attacker.sendto(probe(client.number), scene.address)
            client.send_udp(probe(client.number))
            await scene.until(lambda: scene.metrics.total("hq_rival_sources") == 1)
            await client.report(heard=False)
            await attack(scene, attacker, client.number)
            assert scene.drives() == []
            await client.drive(by_udp=version == "1.3")
            silent(attacker, client.udp)


@pytest.mark.parametrize("version", OLD)
async def test_an_attacker_whose_5_was_answered_instead_of_the_lost_one_is_dropped_with_the_7(version: str) -> None:
    """A program of 1.1 or 1.2 that got no 6 says so."""
    async with serving() as scene, program(scene, version) as client:
        await client.greet()
        with udp() as attacker:
            attacker.sendto(probe(client.number), scene.address)
            assert await hears(attacker) == bytes.fromhex("03000000 01 06 01")
            await attack(scene, attacker, client.number)
            await client.report(heard=False)
            await client.take_stick()
            await attack(scene, attacker, client.number)
            assert scene.drives() == []
            await client.drive(by_udp=False)
            silent(attacker)


async def test_an_attacker_whose_5_was_answered_instead_of_the_lost_one_of_1_3_is_found_out_when_it_drives() -> None:
    async with serving() as scene, program(scene, "1.3") as client:
        await client.greet()
        with udp() as attacker:
            attacker.sendto(probe(client.number), scene.address)
            await hears(attacker)
            await client.report(heard=False)
            client.send_udp(move(client.number))
            await scene.until(lambda: scene.metrics.total("hq_rival_sources") == 1)
            await client.take_stick()
            await attack(scene, attacker, client.number)
            client.send_udp(move(client.number))
            await client.told(VOID)
            assert scene.drives() == []


@pytest.mark.parametrize("version", VERSIONS)
async def test_an_attacker_with_the_right_id_and_another_port_moves_nothing(version: str) -> None:
    async with serving() as scene, program(scene, version) as client:
        await client.shake()
        await client.take_stick()
        with udp() as attacker:
            await attack(scene, attacker, client.number)
            assert scene.drives() == []
            await client.told(VOID)
            await client.drive(by_udp=True)
            silent(attacker)
        assert scene.metrics.total("hq_rival_sources") == 0
        assert len(client.texts) == 1, "told once, not with every datagram"


@pytest.mark.parametrize("version", VERSIONS)
async def test_an_attacker_after_a_lost_5_moves_nothing(version: str) -> None:
    async with serving() as scene, program(scene, version) as client:
        await client.lose_probe()
        await client.take_stick()
        with udp() as attacker:
            await attack(scene, attacker, client.number)
            assert scene.drives() == []
            await client.drive(by_udp=version == "1.3")
            silent(attacker)


async def test_an_attacker_at_another_address_is_nobody() -> None:
    async with serving() as scene, program(scene, "1.3") as client:
        await client.greet()
        with udp(scene.client_port, "127.0.0.2") as attacker:
            attacker.sendto(probe(client.number), scene.address)
            client.send_udp(probe(client.number))
            assert await client.heard() == bytes.fromhex("03000000 01 06 01")
            await client.report(heard=True)
            await client.take_stick()
            await attack(scene, attacker, client.number)
            assert (scene.drives(), client.texts, scene.session().traffic.refused) == ([], [], 0)
            await client.drive(by_udp=True)
            silent(attacker)
        assert scene.metrics.total("hq_rival_sources") == 0
