"""Transport connections to peers: bytes and addresses, nothing else. Knows no frame, session or protocol.

:class:`FakeLink` stands in for a connection in tests.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Protocol, cast
from urllib.parse import urlsplit

import msgspec

from zbridge.errors import LinkError

READ_BYTES = 64 * 1024
"""Most bytes taken from a socket before the loop serves others."""
CONNECT_S = 5.0
"""Longest time a connection attempt may take."""
_WRITE_BYTES = 16 * 1024
"""Bytes the transport may hold back before a link is no longer writable."""


class Address(msgspec.Struct, frozen=True):
    """Where a peer is: ``tcp://host:port``."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """Read ``tcp://host:port``; raise LinkError saying what was expected."""
        try:
            parts = urlsplit(text)
            host, port = parts.hostname, parts.port
        except ValueError as error:
            raise LinkError(f"{text!r}: {error}; expected tcp://host:port") from error
        if parts.scheme != "tcp" or not host or port is None or parts.path or parts.query:
            raise LinkError(f"{text!r}: expected tcp://host:port")
        return cls(host, port)

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp://{host}:{self.port}"


class Receiver(Protocol):
    """Who takes what a link brings; called on the event loop's thread."""

    def attached(self, link: Link) -> None:
        """Take note that the connection is there; called once, before everything else."""

    def received(self, data: bytes) -> None:
        """Take bytes as they were read."""

    def lost(self, reason: str) -> None:
        """Take note that the connection is gone; called once, nothing follows."""

    def writable(self) -> None:
        """Take note that a link that was not writable is so again."""


class Link(Protocol):
    """One connection to a peer."""

    peer: str

    @property
    def ready(self) -> bool:
        """Whether the peer takes what is written."""

    def write(self, data: bytes) -> None:
        """Write ``data`` as one segment."""

    def pause(self) -> None:
        """Read nothing until :meth:`resume`."""

    def resume(self) -> None:
        """Read again."""

    def close(self) -> None:
        """Close the connection; idempotent."""


class TcpLink(asyncio.BufferedProtocol):
    """A TCP connection: every write a segment of its own, a vanished peer noticed by keep-alive."""

    def __init__(self, receiver: Receiver) -> None:
        self.peer = ""
        self._receiver = receiver
        self._transport: asyncio.Transport | None = None
        self._buffer = bytearray(READ_BYTES)
        self._view = memoryview(self._buffer)
        self._held_back = False

    def __repr__(self) -> str:
        return f"<TcpLink {self.peer or 'unconnected'}>"

    @property
    def ready(self) -> bool:
        """Whether the peer takes what is written."""
        return self._transport is not None and not self._held_back

    def write(self, data: bytes) -> None:
        """Write ``data`` as one segment."""
        if self._transport is not None:
            self._transport.write(data)

    def pause(self) -> None:
        """Read nothing until :meth:`resume`."""
        if self._transport is not None and self._transport.is_reading():
            self._transport.pause_reading()

    def resume(self) -> None:
        """Read again."""
        if self._transport is not None and not self._transport.is_reading():
            self._transport.resume_reading()

    def close(self) -> None:
        """Close the connection after what was written; idempotent."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close the connection now, whatever was written."""
        if self._transport is not None:
            self._transport.abort()

    # asyncio's side

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)  # uvloop's is none by inheritance
        self._transport.set_write_buffer_limits(high=_WRITE_BYTES)
        peer = transport.get_extra_info("peername")
        if peer is None:  # reset before we came to look; connection_lost follows
            self._transport.abort()
            return
        self.peer = str(Address(*peer[:2]))
        _tune(transport.get_extra_info("socket"))
        self._receiver.attached(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._view

    def buffer_updated(self, nbytes: int) -> None:
        self._receiver.received(bytes(self._view[:nbytes]))

    def eof_received(self) -> bool:
        return False

    def pause_writing(self) -> None:
        self._held_back = True

    def resume_writing(self) -> None:
        self._held_back = False
        self._receiver.writable()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        self._receiver.lost(f"connection lost: {exc}" if exc else "closed by peer")


def _tune(sock: socket.socket) -> None:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        ("TCP_KEEPIDLE", 5),
        ("TCP_KEEPINTVL", 2),
        ("TCP_KEEPCNT", 3),
        ("TCP_USER_TIMEOUT", 10_000),
    ):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


async def connect(address: Address, receiver: Receiver) -> TcpLink:
    """Connect within :data:`CONNECT_S`; raise LinkError with the reason otherwise."""
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(CONNECT_S):
            _, link = await loop.create_connection(lambda: TcpLink(receiver), address.host, address.port)
    except TimeoutError as error:
        raise LinkError(f"{address}: no answer within {CONNECT_S:g} s") from error
    except OSError as error:
        raise LinkError(f"{address}: {error.strerror or error}") from error
    return link


async def listen(address: Address, receiver: Callable[[], Receiver]) -> asyncio.Server:
    """Listen for peers, each with a receiver of its own; raise LinkError where the address cannot be had."""
    loop = asyncio.get_running_loop()
    try:
        return await loop.create_server(lambda: TcpLink(receiver()), address.host, address.port)
    except OSError as error:
        raise LinkError(f"{address}: {error.strerror or error}") from error


class FakeLink:
    """A link without a socket: keeps what was written, and the test plays the peer."""

    def __init__(self, peer: str = "tcp://robot.test:1") -> None:
        self.peer = peer
        self.ready = True
        self.written: list[bytes] = []
        self.paused = False
        self.closed = False

    def write(self, data: bytes) -> None:
        """Keep ``data``."""
        self.written.append(data)

    def pause(self) -> None:
        """Take note."""
        self.paused = True

    def resume(self) -> None:
        """Take note."""
        self.paused = False

    def close(self) -> None:
        """Take note."""
        self.closed = True
