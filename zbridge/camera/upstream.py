"""Fetches one camera's stream by plain HTTP/1.0 over one connection. Knows no bus and no relay.

HTTP/1.0 requests the stream unchanged: a server must not chunk it. Redirects are not followed: a camera must not choose
what else this machine requests. Plain sockets suffice, and every wait and buffer has a bound here; an HTTP library
would add a dependency and hide them.
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable

from zbridge.camera.mjpeg import MjpegPart, MjpegReader
from zbridge.camera.pace import ReadBudget
from zbridge.camera.settings import CameraSource
from zbridge.errors import LinkError

CONNECT_S = 5.0
"""Longest time until the connection is established."""
_READ_BYTES = 64 * 1024

OnParts = Callable[[MjpegReader, list[MjpegPart]], None]
"""Called with the parts of one read, perhaps none; ``rejected`` counts the parts of this read that were dropped."""


async def fetch(source: CameraSource, stall_s: float, on_parts: OnParts) -> None:
    """Fetch a stream and pass on its pictures until it ends, which always raises LinkError or ProtocolError.

    A stream without a whole picture for ``stall_s`` seconds is ended. One that sends more than a camera does is read
    more slowly (:class:`ReadBudget`).
    """
    try:
        reader, writer = await _connect(source)
        try:
            lines = (f"GET {source.target} HTTP/1.0", f"Host: {source.authority}", "User-Agent: zbridge", "", "")
            writer.write("\r\n".join(lines).encode("ascii"))
            await _read(reader, stall_s, on_parts)
        finally:
            writer.transport.abort()
    except OSError as error:
        raise LinkError(explain(error)) from error


def explain(error: OSError) -> str:
    """Return the operating system's text of an error, on every event loop: ``Connection refused``."""
    known = error.errno is not None and error.errno > 0 and not isinstance(error, socket.gaierror)
    return os.strerror(error.errno) if known and error.errno is not None else error.strerror or str(error)


async def _connect(source: CameraSource) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    try:
        async with asyncio.timeout(CONNECT_S):
            return await asyncio.open_connection(source.host, source.port)
    except TimeoutError:
        raise LinkError(f"no connection within {CONNECT_S:g} s") from None


async def _read(reader: asyncio.StreamReader, stall_s: float, on_parts: OnParts) -> None:
    """Read until the stream ends. What is read at once is not timed by ``timeout_at``: the deadline is checked too."""
    loop, mjpeg, budget = asyncio.get_running_loop(), MjpegReader(), ReadBudget()
    deadline, stalled = loop.time() + stall_s, LinkError(f"no picture for {stall_s:g} s")
    while not mjpeg.ended:
        try:
            async with asyncio.timeout_at(deadline):
                data = await reader.read(_READ_BYTES)
        except TimeoutError:
            raise stalled from None
        if not data:
            break
        parts = mjpeg.receive(data)
        now = loop.time()
        pause_s = budget.pause_s(len(data), len(parts) + mjpeg.rejected, now)
        on_parts(mjpeg, parts)
        mjpeg.rejected = 0
        if parts:
            await asyncio.sleep(min(pause_s, stall_s))
            deadline = loop.time() + stall_s
        else:
            await asyncio.sleep(max(0.0, min(pause_s, deadline - now)))
            if loop.time() >= deadline:
                raise stalled
    raise LinkError("the stream ended")
