"""A simulated robot of a protocol's author, on TCP or UDP: one client at a time, and nothing that it sends locks it."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator

import pytest

from zbridge.errors import ConfigError, ProtocolError
from zbridge.protocol import Address, Simulation, Truth
from zbridge.protocol.address import DatagramAddress
from zbridge.simulation import SimulatedRobot, serve


class Echo(SimulatedRobot):
    """Greets, echoes in capitals, and cannot bear a question mark."""

    stepped_s = 0.0

    def connected(self) -> bytes:
        return b"hello "

    def receive(self, data: bytes) -> bytes:
        if b"?" in data:
            raise ProtocolError("a question")
        return data.upper()

    def step(self, dt: float) -> bytes:
        self.stepped_s += dt
        return b""

    def truth(self) -> Truth:
        return Truth(self.stepped_s, 0.0, 0.0)


@contextlib.asynccontextmanager
async def served(robot: Echo, truths: list[Truth], kind: type[Address] = Address) -> AsyncIterator[tuple[str, int]]:
    loop = asyncio.get_running_loop()
    ready: asyncio.Future[tuple[Address, ...]] = loop.create_future()
    faults: list[object] = []
    loop.set_exception_handler(lambda _, context: faults.append(context))
    simulation = Simulation((kind("127.0.0.1", 0),), ready=ready.set_result, report=truths.append)
    task = asyncio.create_task(serve(simulation, robot))
    try:
        (address,) = await ready
        assert type(address) is kind
        yield address.host, address.port
    finally:
        task.cancel()
        await asyncio.wait([task])
        await asyncio.sleep(0.05)
    assert faults == []


async def test_a_client_is_greeted_and_answered_and_a_second_one_is_closed() -> None:
    truths: list[Truth] = []
    async with served(Echo(), truths) as address, asyncio.timeout(5.0):
        reader, writer = await asyncio.open_connection(*address)
        writer.write(b"abc")
        assert await reader.readexactly(9) == b"hello ABC"
        second, other = await asyncio.open_connection(*address)
        assert await second.read() == b""
        await asyncio.sleep(0.1)
        for each in (other, writer):
            each.close()
            await each.wait_closed()
    assert 0.05 < truths[-1].x < 1.0
    assert truths[-1].lived_s == truths[-1].x


@pytest.mark.parametrize("last", [b"what?", b"bye"])
async def test_the_next_client_is_served_whatever_the_last_one_did(last: bytes) -> None:
    async with served(Echo(), []) as address, asyncio.timeout(5.0):
        for _ in range(3):
            reader, writer = await asyncio.open_connection(*address)
            assert await reader.readexactly(6) == b"hello "
            writer.write(last)
            if last == b"bye":
                await reader.readexactly(3)
            else:
                assert await reader.read() == b""
            writer.close()
            await writer.wait_closed()
            await asyncio.sleep(0.05)


async def test_at_a_udp_port_it_serves_the_first_source_until_that_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zbridge.simulation.simulated.SILENT_S", 0.2)
    loop = asyncio.get_running_loop()
    async with served(Echo(), [], DatagramAddress) as address, asyncio.timeout(5.0):
        with contextlib.ExitStack() as sockets:
            first, second = (sockets.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(2))
            for each in (first, second):
                each.setblocking(False)
                each.connect(address)
            await loop.sock_sendall(first, b"abc")
            assert [await loop.sock_recv(first, 99) for _ in range(2)] == [b"hello ", b"ABC"]
            await loop.sock_sendall(second, b"early")
            await loop.sock_sendall(first, b"what?")
            await loop.sock_sendall(first, b"bye")
            assert await loop.sock_recv(first, 99) == b"BYE"
            await asyncio.sleep(0.25)
            await loop.sock_sendall(second, b"late")
            assert [await loop.sock_recv(second, 99) for _ in range(2)] == [b"hello ", b"LATE"]


async def test_options_that_such_a_robot_does_not_have_are_a_clear_error() -> None:
    with pytest.raises(ConfigError, match="this simulated robot has one link, and no versions"):
        await serve(Simulation((Address("127.0.0.1", 0),), version="1"), Echo())
