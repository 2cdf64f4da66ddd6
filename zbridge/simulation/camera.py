"""A robot's camera to play with: streams drawn pictures as deployed robots do, MJPEG by HTTP at ``/stream.mjpg``."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable
from email.utils import formatdate
from itertools import count

from zbridge.errors import LinkError
from zbridge.protocol.address import Address
from zbridge.simulation.drawing import draw

log = logging.getLogger("zbridge.simulation.camera")

PATH = "/stream.mjpg"
EVERY_S = 0.1
"""Seconds between two pictures."""
COLUMNS, ROWS = 20, 15
"""Squares of 8 x 8 pixels of a picture."""
_REQUEST_BYTES = 8192


async def serve_camera(address: Address, ready: Callable[[str], object]) -> None:
    """Stream to every client until cancelled; ``ready`` is called with the URL. Raises LinkError."""
    try:
        server = await asyncio.start_server(_serve, address.host, address.port, limit=_REQUEST_BYTES, backlog=16)
    except OSError as error:
        raise LinkError(f"{address.host}:{address.port}: {error.strerror or error}") from error
    async with server:
        ready(f"http://{address.host}:{server.sockets[0].getsockname()[1]}{PATH}")
        await server.serve_forever()


async def _serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    host, port, *_ = writer.get_extra_info("peername")
    with contextlib.suppress(OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, asyncio.CancelledError):
        request = await reader.readuntil(b"\r\n\r\n")
        log.info("%s:%d watches", host, port)
        if request.startswith(f"GET {PATH} ".encode()):
            await _stream(writer)
        else:
            writer.write(b"HTTP/1.0 404 Not Found\r\n\r\n")
            await writer.drain()
    log.info("%s:%d has gone", host, port)
    writer.close()


async def _stream(writer: asyncio.StreamWriter) -> None:
    fields = (
        "HTTP/1.0 200 OK",
        "Server: BaseHTTP/0.6 Python/3.7.3",
        f"Date: {formatdate(usegmt=True)}",
        "Age: 0",
        "Cache-Control: no-cache, private",
        "Pragma: no-cache",
        "Content-Type: multipart/x-mixed-replace; boundary=FRAME",
    )
    writer.write("\r\n".join((*fields, "", "")).encode())
    for number in count():
        picture = draw(scene(number), COLUMNS)
        writer.write(b"--FRAME\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(picture))
        writer.write(picture)
        writer.write(b"\r\n")
        await writer.drain()
        await asyncio.sleep(EVERY_S)


def scene(number: int) -> bytes:
    """Paint one picture as greys of its squares, row by row: a light that wanders over a slope."""
    light = number % (COLUMNS * ROWS)
    return bytes(255 if at == light else 40 + 6 * (at % COLUMNS) for at in range(COLUMNS * ROWS))
