"""A simulated robot on a pair of pseudo terminals: bytes both ways, ends without a reader, connections that end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import AsyncIterator, Callable, Iterator

import pytest

from zbridge.errors import ConfigError
from zbridge.protocol.address import Address, SerialAddress
from zbridge.protocol.plugin import Simulation
from zbridge.simulation import serial_line
from zbridge.simulation.serial_line import SerialLine, simulate_on_serial_line

pytestmark = pytest.mark.both_loops
EVERY_BYTE = bytes(range(256))
KERNEL_BYTES = 32_768
"""More than a pair of pseudo terminals holds."""


class FakeRobot:
    """Listens, and keeps what it received and its connections."""

    def __init__(self) -> None:
        self.received = b""
        self.writers: list[asyncio.StreamWriter] = []

    async def simulate(self, simulation: Simulation) -> None:
        (address,) = simulation.addresses
        async with await asyncio.start_server(self._serve, address.host, address.port) as server:
            simulation.ready((Address(*server.sockets[0].getsockname()[:2]),))
            await asyncio.Event().wait()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.append(writer)
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(4096):
                self.received += data
        writer.close()


async def soon(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(10.0):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


@contextlib.asynccontextmanager
async def on_line(robot: FakeRobot) -> AsyncIterator[str]:
    """Run the robot on a serial line; yield the path of the near end."""
    found: list[SerialAddress] = []
    running = asyncio.ensure_future(simulate_on_serial_line(robot.simulate, Simulation(()), 57600, found.append))
    try:
        await soon(lambda: robot.writers or running.done())
        assert not running.done(), running.exception()
        assert found[0].baud == 57600
        yield found[0].path
    finally:
        running.cancel()
        await asyncio.wait((running,))
        for descriptor in os.listdir("/proc/self/fd"):
            with contextlib.suppress(OSError):
                assert not os.readlink(f"/proc/self/fd/{descriptor}").startswith((found[0].path, "/dev/ptmx"))


@contextlib.contextmanager
def opened(path: str) -> Iterator[int]:
    """Open the near end as it is, without settings."""
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


async def read(descriptor: int, count: int) -> bytes:
    data = b""
    async with asyncio.timeout(5.0):
        while len(data) < count:
            with contextlib.suppress(BlockingIOError):
                data += os.read(descriptor, count - len(data))
            await asyncio.sleep(0.002)
    return data


async def test_every_byte_passes_unchanged_in_both_directions_for_one_program_after_the_other() -> None:
    robot = FakeRobot()
    async with on_line(robot) as path:
        for program in (1, 2):
            with opened(path) as near:
                os.write(near, EVERY_BYTE)
                await soon(lambda program=program: len(robot.received) == 256 * program)
                robot.writers[0].write(EVERY_BYTE)
                assert await read(near, 256) == EVERY_BYTE
        assert robot.received == EVERY_BYTE * 2
        assert len(robot.writers) == 1


async def test_a_burst_that_the_terminal_does_not_hold_arrives_where_it_is_read() -> None:
    robot, burst = FakeRobot(), EVERY_BYTE * 200
    async with on_line(robot) as path:
        with opened(path) as near:
            robot.writers[0].write(burst)
            assert await read(near, len(burst)) == burst


async def test_a_robot_whose_line_nobody_reads_is_not_blocked_and_the_outdated_bytes_are_dropped(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_line, "STALLED_S", 0.2)
    caplog.set_level(logging.DEBUG, serial_line.__name__)
    robot, size = FakeRobot(), 1_000_000

    def dropped() -> int:
        counts = [line for line in caplog.messages if "without a reader" in line]
        return int(counts[-1].split()[-3]) if counts else 0

    async with on_line(robot) as path:
        robot.writers[0].write(bytes(size))
        await soon(lambda: dropped() > size - serial_line.WAITING_BYTES - KERNEL_BYTES)
        await asyncio.sleep(0.3)
        robot.writers[0].write(b"new")
        await soon(lambda: dropped() > size - KERNEL_BYTES)
        with opened(path) as near:
            os.write(near, b"hello")
            await soon(lambda: robot.received == b"hello")
            assert await read(near, size - dropped() + 3) == bytes(size - dropped()) + b"new"
    assert path in caplog.messages[-1]


async def test_a_connection_that_the_robot_closes_is_made_anew() -> None:
    robot = FakeRobot()
    async with on_line(robot) as path:
        with opened(path) as near:
            robot.writers[0].close()
            await soon(lambda: len(robot.writers) == 2)
            os.write(near, b"again")
            await soon(lambda: robot.received == b"again")
            robot.writers[1].write(b"yes")
            assert await read(near, 3) == b"yes"


async def test_what_is_written_while_the_robot_does_not_listen_is_dropped() -> None:
    with contextlib.closing(SerialLine(9600)) as line, opened(line.address.path) as near:
        os.write(near, b"lost")
        await soon(lambda: line.dropped)
        assert repr(line) == f"<SerialLine serial://{line.address.path}?baud=9600, 4 bytes dropped>"
        line.close()


async def test_a_robot_that_does_not_start_ends_the_simulation_with_its_error() -> None:
    async def simulate(simulation: Simulation) -> None:
        raise ConfigError("no dialect")

    with pytest.raises(ConfigError, match="no dialect"):
        async with asyncio.timeout(5.0):
            await simulate_on_serial_line(simulate, Simulation(()), 9600, print)


async def test_a_robot_that_ends_ends_the_simulation() -> None:
    async def simulate(simulation: Simulation) -> None:
        """It never listens."""

    async with asyncio.timeout(5.0):
        await simulate_on_serial_line(simulate, Simulation(()), 9600, print)
