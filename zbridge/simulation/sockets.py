"""Plain sockets for judges, which decide themselves when to read; no transport of the gateway allows that.

All sockets are non-blocking. Knows no protocol.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator, Iterable

_READ_BYTES = 65536
_READS = 16
_PORT_TRIES = 20


def bind_tcp(host: str, port: int) -> socket.socket:
    """Listen on ``port``, 0 for any; raise OSError."""
    tcp = socket.create_server((host, port), family=_family(host))
    tcp.setblocking(False)
    return tcp


def bind_tcp_and_udp(host: str, port: int) -> tuple[socket.socket, socket.socket]:
    """Listen on TCP and UDP with the same number, 0 for any; raise OSError."""
    for left in reversed(range(_PORT_TRIES)):
        tcp, udp = bind_tcp(host, port), socket.socket(_family(host), socket.SOCK_DGRAM)
        udp.setblocking(False)
        try:
            udp.bind((host, tcp.getsockname()[1]))
        except OSError:
            tcp.close()
            udp.close()
            if port or not left:
                raise
        else:
            break
    return tcp, udp


@contextlib.asynccontextmanager
async def connected(host: str, port: int, options: Iterable[tuple[int, int, int]] = ()) -> AsyncIterator[socket.socket]:
    """Connect, every write a segment of its own; ``options`` are set before; raise OSError if nobody listens."""
    with socket.socket(_family(host)) as tcp:
        tcp.setblocking(False)
        send_at_once(tcp)
        for level, name, value in options:
            tcp.setsockopt(level, name, value)
        await asyncio.get_running_loop().sock_connect(tcp, (host, port))
        yield tcp


def send_at_once(tcp: socket.socket) -> None:
    """Make every write a segment of its own."""
    tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def reset_on_close(tcp: socket.socket) -> None:
    """Make closing a connection reset it, as a power failure would."""
    tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def drain(tcp: socket.socket) -> tuple[bytes, str]:
    """Read all that is there; return it, and how the connection ended ("" while it is open)."""
    data = b""
    for _ in range(_READS):
        try:
            part = tcp.recv(_READ_BYTES)
        except BlockingIOError:
            break
        except OSError as error:
            return data, repr(error)
        if not part:
            return data, "closed"
        data += part
    return data, ""


async def readable(sock: socket.socket, most_s: float | None = None) -> None:
    """Wait until a read would return data, ``most_s`` at most; works with asyncio's and uvloop's loop."""
    loop, there = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(sock.fileno(), there.set)
    try:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(most_s):
                await there.wait()
    finally:
        loop.remove_reader(sock.fileno())


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET
