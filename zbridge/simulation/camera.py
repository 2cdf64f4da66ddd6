"""A simulated camera: streams drawn JPEGs as legacy robots do, MJPEG by HTTP at ``/stream.mjpg``."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from email.utils import formatdate
from itertools import count

from zbridge.errors import LinkError
from zbridge.log import Log
from zbridge.protocol.address import Address

SIDE = 8
"""Pixels along a side of a square."""
_LENGTHS = (2, 3, 3, 3, 3, 3, 4, 5, 6)
_CODES = (0b00, 0b010, 0b011, 0b100, 0b101, 0b110, 0b1110, 0b11110, 0b111110)
"""The codes of the sizes of differences, 0 to 8 bits, as table K.3 has them."""
_TABLES = (
    bytes.fromhex("ffdb 0043 00") + bytes([SIDE]) * 64,  # a grey is the whole DC coefficient
    bytes.fromhex("ffc4 001f 00 00010501010101010100000000000000 000102030405060708090a0b"),
    bytes.fromhex("ffc4 0014 10 01000000000000000000000000000000 00"),  # one AC code: 0, the end of the square
)


def draw(greys: bytes, columns: int) -> bytes:
    """Draw squares, row by row, 0 black to 255 white, as a JPEG. Their number is a multiple of ``columns``."""
    height, width = len(greys) // columns * SIDE, columns * SIDE
    frame = bytes.fromhex("ffc0 000b 08") + height.to_bytes(2, "big") + width.to_bytes(2, "big")
    scan = bytes.fromhex("01 01 11 00 ffda 0008 01 01 00 00 3f 00")
    return b"".join((b"\xff\xd8", *_TABLES, frame, scan, _entropy(greys), b"\xff\xd9"))


def _entropy(greys: bytes) -> bytes:
    """Code the differences from square to square; fill up with ones, and mark bytes that look like a marker."""
    bits, length, before = 0, 0, 128
    for grey in greys:
        difference, before = grey - before, grey
        size = abs(difference).bit_length()
        value = difference if difference > 0 else difference + (1 << size) - 1
        bits = (bits << _LENGTHS[size] | _CODES[size]) << size | value
        bits, length = bits << 1, length + _LENGTHS[size] + size + 1
    padding = -length % 8
    bits = bits << padding | (1 << padding) - 1
    return bits.to_bytes((length + padding) // 8, "big").replace(b"\xff", b"\xff\x00")


log = Log("zbridge.simulation.camera")

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
        log.info("viewer_watches", "{peer} watches", peer=f"{host}:{port}")
        if request.startswith(f"GET {PATH} ".encode()):
            await _stream(writer)
        else:
            writer.write(b"HTTP/1.0 404 Not Found\r\n\r\n")
            await writer.drain()
    log.info("viewer_gone", "{peer} has gone", peer=f"{host}:{port}")
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
        head = b"--FRAME\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(picture)
        writer.writelines((head, picture, b"\r\n"))
        await writer.drain()
        await asyncio.sleep(EVERY_S)


def scene(number: int) -> bytes:
    """Paint one picture as greys of its squares, row by row: a light that moves over a gradient."""
    light = number % (COLUMNS * ROWS)
    return bytes(255 if at == light else 40 + 6 * (at % COLUMNS) for at in range(COLUMNS * ROWS))
