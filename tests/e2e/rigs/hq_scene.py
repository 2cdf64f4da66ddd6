"""What the tests of the HQ side share: waiting beside HQ programs, and a program written by hand."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any, TypeVar

from tests.e2e.conftest import HOST, WAIT_S, Bench
from tests.machine import Patience
from tests.ports import free_port

T = TypeVar("T")
ANSWER = bytes.fromhex("18000000 00 03 0b000000") + b"1.1,1.2,1.3" + bytes(7)
"""Packet 3 of a program of version 1.3 that has no feature, and no UDP."""
PUSHES = 3
NEUTRAL = bytes.fromhex("02000000 00 0d")


async def soon(condition: Callable[[], T], what: str, timeout_s: float = WAIT_S) -> T:
    """Wait as :func:`tests.e2e.conftest.until` does, while HQ programs run on the same loop."""
    patience = Patience(timeout_s)
    while True:
        over = patience.over
        if value := condition():
            return value
        if over:
            raise AssertionError(f"{what} not within {timeout_s} s")
        await asyncio.sleep(0.01)


async def pushed(program: Any, forward: float, moved: Callable[[], object], what: str) -> None:
    """Push a program's stick until the robot moves; centre it and push again, as people do, where nothing comes of it.

    A gateway that a busy machine froze holds motion back until then.
    """
    for tries in range(PUSHES):
        await program.drive(forward)
        try:
            await soon(moved, what)
            return
        except AssertionError:
            if tries == PUSHES - 1:
                raise
        await program.idle()
        await asyncio.sleep(0.5)


def ports(count: int) -> list[int]:
    """Give so many free ports."""
    return [free_port() for _ in range(count)]


def sessions(bench: Bench) -> list[dict[str, Any]]:
    """The session tables of every process on the bus, together."""
    return [entry for table in bench.fleet.get("fleet/r1/@rpc/sessions/*") for entry in table["sessions"]]


class ByHand:
    """A TCP/UDP HQ program of a few lines: what it sends, and the ids of the packets that came."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    @classmethod
    async def connect(cls, port: int, *, receive_bytes: int = 0) -> ByHand:
        """Connect; ``receive_bytes``: what the kernel is to keep for it."""
        conn = socket.socket()
        conn.setblocking(False)
        if receive_bytes:
            conn.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
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
