"""What the tests of the HQ side share: processes that log to files, listeners, and HQ programs written by hand."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

from tests.e2e.conftest import Bench, end, free_port
from tests.machine import Patience

T = TypeVar("T")
HOST = "127.0.0.1"
WHEELS = """
bounds_default = [0.0, 1000.0]
[device.options.differential]
left = ["left wheel motor"]
right = ["right wheel motor"]
wheel_radius_m = 0.05
track_m = 0.3
speed_full_m_s = 0.5
turn_full_rad_s = 1.0
"""
"""The options of the fragile Webots controller's robot: 10 rad/s of both wheels are full scale."""
ANSWER = bytes.fromhex("18000000 00 03 0b000000") + b"1.1,1.2,1.3" + bytes(7)
"""Packet 3 of a program of version 1.3 that has no feature, and no UDP."""
NEUTRAL = bytes.fromhex("02000000 00 0d")


async def soon(condition: Callable[[], T], what: str, timeout_s: float = 10.0) -> T:
    """Wait until ``condition()`` is true and give its value, while HQ programs run on the same loop.

    A busy machine puts the timeout off.
    """
    patience = Patience(timeout_s)
    while True:
        over = patience.over
        if value := condition():
            return value
        if over:
            raise AssertionError(f"{what} not within {timeout_s} s")
        await asyncio.sleep(0.01)


class Gateway:
    """A process of ``zbridge run``; its log goes to a file, for a pipe that nobody reads would stop it."""

    def __init__(self, file: Path) -> None:
        self._log = file.with_suffix(".log")
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "zbridge", "run", str(file)],
                stdout=log,
                stderr=log,
                text=True,
                env={**os.environ, "PYTHONUNBUFFERED": "1"},
            )

    @property
    def log(self) -> str:
        """What it has logged."""
        return self._log.read_text()

    def listens(self, count: int) -> bool:
        """Whether so many listeners are open; a process that ended says why."""
        if self.process.poll() is not None:
            raise AssertionError(f"the gateway ended: {self.log}")
        return self.log.count("HQ programs connect at") >= count

    def end(self) -> None:
        """End it; an exit that is not clean is an error."""
        end(self.process)
        assert self.process.returncode == 0, self.log
        assert "Traceback" not in self.log, self.log

    def kill(self) -> None:
        """End it whatever it does; idempotent."""
        end(self.process, signal.SIGKILL)


def listener(name: str, protocol: str, port: int, more: str = "") -> str:
    """Write one ``[[hq]]``."""
    return f'[[hq]]\nname = "{name}"\nprotocol = "{protocol}"\nlisten = "tcp://{HOST}:{port}"\n{more}\n'


def device(protocol: str, port: int, options: str = "") -> str:
    """Write ``[device]``."""
    return f'[device]\nprotocol = "{protocol}"\nconnect = ["tcp://{HOST}:{port}"]\n[device.options]\n{options}\n'


def gateway(bench: Bench, stack: contextlib.ExitStack, *parts: str, name: str = "r1", lease_s: float = 3.0) -> Gateway:
    """Start a process for robot r1 with these parts of a configuration; it is killed with the stack."""
    file = bench.folder / f"{name}.toml"
    file.write_text(
        '[robot]\nname = "r1"\n' + "".join(parts) + f"[control]\nlease_s = {lease_s}\n"
        f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n'
    )
    process = Gateway(file)
    bench.count(process.process.pid)
    stack.callback(process.kill)
    return process


def sessions(bench: Bench) -> list[dict[str, Any]]:
    """The session tables of every process on the bus, together."""
    return [entry for table in bench.fleet.get("fleet/r1/@rpc/sessions/*") for entry in table["sessions"]]


class ByHand:
    """A TCP/UDP HQ program of a few lines: what it sends, and the ids of the packets that came."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    @classmethod
    async def connect(cls, port: int, host: str = HOST, *, receive_bytes: int = 0) -> ByHand:
        """Connect; ``receive_bytes``: what the kernel is to keep for it."""
        conn = socket.socket()
        conn.setblocking(False)
        if receive_bytes:
            conn.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
        conn.bind((host, 0))
        try:
            await asyncio.get_running_loop().sock_connect(conn, (HOST, port))
        except BaseException:
            conn.close()
            raise
        return cls(*await asyncio.open_connection(sock=conn, limit=receive_bytes or 65536))

    async def packet(self) -> tuple[int, bytes]:
        """Read one packet: its id and body. Raises IncompleteReadError at the end of the stream."""
        size, _, kind = struct.unpack("<iBB", await self.reader.readexactly(6))
        return kind, await self.reader.readexactly(size - 2)

    async def shake(self) -> int:
        """Shake hands without UDP; give the client id."""
        kind, body = await self.packet()
        assert kind == 2, f"packet {kind} before the settings"
        self.writer.write(ANSWER)
        return body[0]

    async def until(self, *kinds: int) -> bytes:
        """Read until a packet of these ids comes."""
        while True:
            kind, body = await self.packet()
            if kind in kinds:
                return body

    async def closed(self) -> bool:
        """Read to the end of the stream, which the gateway has closed; close it here too."""
        with contextlib.suppress(OSError):
            while await self.reader.read(65536):
                pass
        await self.leave()
        return True

    async def leave(self, *, abruptly: bool = False) -> None:
        """Close the connection, with a FIN, or with a RST where anything is unread."""
        if abruptly:
            self.writer.transport.abort()
        self.writer.close()
        with contextlib.suppress(OSError):
            await self.writer.wait_closed()


@contextlib.asynccontextmanager
async def playing(*programs: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    """Run HQ programs beside what is done; they are cancelled in the end, and what they raised is raised."""
    tasks = [asyncio.create_task(program) for program in programs]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            raise result


def ports(count: int) -> list[int]:
    """Give so many free ports."""
    found: set[int] = set()
    while len(found) < count:
        found.add(free_port())
    return list(found)
