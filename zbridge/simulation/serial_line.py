"""A simulated robot at the far end of a serial line: a pair of pseudo terminals in place of its TCP port.

The simulated robot listens on loopback. :class:`SerialLine` is its only client, and copies bytes both ways between that
connection and the far terminal; a program opens the near one like a serial device. As on a serial line, there is no
flow control: what an end does not read in time is lost. Knows no frame and no protocol.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import tty
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec

from zbridge.log import Log
from zbridge.protocol.address import Address, SerialAddress
from zbridge.protocol.plugin import Simulation
from zbridge.tasks import race

READ_BYTES = 4096
WAITING_BYTES = 65_536
"""Most bytes that wait for either end; more are dropped."""
STALLED_S = 0.5
"""Seconds without any progress after which what waits for a reader of the near end is dropped as outdated."""
RECONNECT_S = 0.1
"""Seconds from the end of a connection with the simulated robot to the next one."""
_log = Log(__name__)


async def simulate_on_serial_line(
    simulate: Callable[[Simulation], Coroutine[Any, Any, None]],
    simulation: Simulation,
    baud: int,
    ready: Callable[[SerialAddress], None],
) -> None:
    """Simulate a robot on a serial line until cancelled; ``ready`` is called with the address of the near end.

    simulate: as of a protocol whose simulated robot has one link. simulation: its addresses are replaced. baud: stands
    in the address; a pseudo terminal takes any. Ends when ``simulate`` ends, and raises what it raises.
    """
    bound: asyncio.Future[Address] = asyncio.get_running_loop().create_future()

    def listening(addresses: tuple[Address, ...]) -> None:
        if not bound.done():
            bound.set_result(addresses[0])

    async def serve() -> None:
        address = await bound
        with contextlib.closing(SerialLine(baud)) as line:
            ready(line.address)
            await line.run(address)

    on_loopback = msgspec.structs.replace(simulation, addresses=(Address("127.0.0.1", 0),), ready=listening)
    await race(simulate(on_loopback), serve())


class SerialLine:
    """A pair of pseudo terminals, its far end connected to a simulated robot. Needs a running event loop.

    The near end stays open here too, so it keeps its settings and its path while no program has it open. ``address``:
    of the near end. ``dropped``: bytes that did not fit, in both directions.
    """

    def __init__(self, baud: int) -> None:
        self._loop = asyncio.get_running_loop()
        self._far, self._near = os.openpty()
        tty.setraw(self._near)
        os.set_blocking(self._far, False)
        self.address = SerialAddress(os.ttyname(self._near), baud)
        self.dropped = 0
        self._robot: asyncio.StreamWriter | None = None
        self._waiting = bytearray()
        """What the terminal has not accepted yet."""
        self._progress_at = 0.0
        self._open = True
        self._loop.add_reader(self._far, self._read)

    def __repr__(self) -> str:
        return f"<SerialLine {self.address}, {self.dropped} bytes dropped>"

    async def run(self, robot: Address) -> None:
        """Connect to the simulated robot, again whenever it closes the connection, until cancelled."""
        while True:
            try:
                reader, self._robot = await asyncio.open_connection(robot.host, robot.port)
                while data := await reader.read(READ_BYTES):
                    self._write(data)
                _log.debug(
                    "serial_closed", "{address}: the simulated robot closed its connection", address=self.address
                )
            except OSError as error:
                _log.debug("serial_failed", "{address}: {peer}: {error}", address=self.address, peer=robot, error=error)
            finally:
                writer, self._robot = self._robot, None
                if writer is not None:
                    writer.close()
            await asyncio.sleep(RECONNECT_S)

    def close(self) -> None:
        """Close both ends; idempotent."""
        if not self._open:
            return
        self._open = False
        self._loop.remove_reader(self._far)
        if self._waiting:
            self._loop.remove_writer(self._far)
        os.close(self._far)
        os.close(self._near)

    def _read(self) -> None:
        """Pass what was written to the near end to the simulated robot."""
        try:
            data = os.read(self._far, READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        robot = self._robot
        room = 0 if robot is None else WAITING_BYTES - robot.transport.get_write_buffer_size()
        if robot is None or len(data) > room:
            self._drop(len(data), "to the robot")
        else:
            robot.write(data)

    def _write(self, data: bytes) -> None:
        """Write what the simulated robot sends to the near end."""
        now, writing = self._loop.time(), bool(self._waiting)
        if writing and now - self._progress_at > STALLED_S:
            self._drop(len(self._waiting), "without a reader")
            self._waiting.clear()
        room = WAITING_BYTES - len(self._waiting)
        self._drop(len(data) - room, "without a reader")
        self._waiting += data[:room]
        if not writing:
            self._progress_at = now
            self._write_on()
            if self._waiting:
                self._loop.add_writer(self._far, self._write_ready)

    def _write_ready(self) -> None:
        self._write_on()
        if not self._waiting:
            self._loop.remove_writer(self._far)

    def _write_on(self) -> None:
        """Give the terminal what it accepts."""
        with contextlib.suppress(BlockingIOError, InterruptedError):
            count = os.write(self._far, self._waiting)
            if count:
                del self._waiting[:count]
                self._progress_at = self._loop.time()

    def _drop(self, count: int, why: str) -> None:
        if count > 0:
            self.dropped += count
            template = "{address}: dropped {count} bytes {why}, {dropped} in all"
            _log.debug("bytes_dropped", template, address=self.address, count=count, why=why, dropped=self.dropped)
