"""TCP links, connected or accepted. Each write is a segment of its own; unacknowledged bytes are watched.

Knows no frame, session or protocol. The peer's datagrams are in :mod:`zbridge.transport.udp`.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import logging
import socket
import struct
import termios
import time
from collections.abc import AsyncIterator, Callable
from typing import cast

from zbridge.errors import LinkError
from zbridge.metrics import Count
from zbridge.protocol.address import Address
from zbridge.transport.backlog import Backlog
from zbridge.transport.link import STALLED_S, Receiver
from zbridge.transport.udp import DatagramHub, DatagramSocket

log = logging.getLogger("zbridge.link")

READ_BYTES = 64 * 1024
"""Most bytes taken from a robot's socket before the loop serves others."""
CLIENT_READ_BYTES = 4096
"""The same for an accepted peer: there may be hundreds."""
CLIENT_WRITE_BYTES = 64 * 1024
"""Bytes that the kernel keeps for an accepted peer that reads slowly; older ones are of no use."""
KEEPALIVE_S = 1
"""Seconds of silence after which the kernel asks an accepted peer for a sign of life."""
GIVE_UP_S = 60.0
"""Seconds without acknowledgement after which a robot's connection ends: long, for a deployed robot gives only one."""
CLIENT_GIVE_UP_S = 10.0
"""The same for an accepted peer."""
_RETRY_MOST_S = 1.0
"""Longest time between two retransmissions of the kernel to a robot."""
_TCP_RTO_MAX_MS = 44
"""Linux 6.15 and newer; Python has no name for it yet."""
_OUTSTANDING = struct.Struct("=i")
_SIOCOUTQ = termios.TIOCOUTQ
"""The ioctl for the unacknowledged bytes of a socket; Python names it for terminals only."""
_TCP_INFO = struct.Struct("=24xI28xI")
"""Two fields of Linux's tcp_info: unacknowledged segments, and milliseconds since the last acknowledgement."""
CLOSE_S = 1.0
"""Seconds that a closing connection waits for its last bytes to be taken."""
CONNECT_S = 5.0
"""Seconds that a connection attempt may take."""


class TcpLink(asyncio.BufferedProtocol):
    """A TCP connection. ``hub``: the listener's UDP socket, if the peer was accepted there.

    ``buffer``: where reads of an accepted peer go. Reads are copied at once, so all links of a loop may share it.
    """

    def __init__(self, receiver: Receiver, hub: DatagramHub | None = None, buffer: bytearray | None = None) -> None:
        self.peer = ""
        self._backlog: Backlog | None = None
        self._hub = hub
        self._accepted = buffer is not None
        self._datagrams: DatagramSocket | None = None
        self._receiver = receiver
        self._transport: asyncio.Transport | None = None
        self._view = memoryview(bytearray(READ_BYTES) if buffer is None else buffer)
        self._held_back = False

    def __repr__(self) -> str:
        return f"<TcpLink {self.peer or 'unconnected'}>"

    @property
    def ready(self) -> bool:
        """Whether the kernel took all that was written."""
        return self._transport is not None and not self._held_back

    def write(self, data: bytes) -> None:
        """Write ``data`` as one segment."""
        if self._transport is not None:
            if self._backlog is not None:
                self._backlog.written(len(data), time.monotonic())
            self._transport.write(data)

    def write_datagram(self, data: bytes) -> None:
        """Send ``data`` as one datagram to the peer. It is lost if the network does not take it now.

        To a robot, the first datagram opens a socket that hears the robot's address and port only. An accepted peer
        gets datagrams from the listener's port.
        """
        if self._hub is not None:
            self._hub.send(self, data)
        elif self._transport is not None:
            if self._datagrams is None:
                try:
                    self._datagrams = DatagramSocket(self._transport, self._receiver)
                except OSError as error:  # no descriptor, no port: the datagram is lost, the next one tries again
                    log.warning("%s: no socket for datagrams: %s", self.peer, error)
                    return
            self._datagrams.send(data)

    def drop_source(self) -> None:
        """Forget which source an accepted peer's datagrams come from; idempotent."""
        if self._hub is not None:
            self._hub.unbind(self)

    @property
    def silent_s(self) -> float:
        """Seconds for which the peer's machine has not answered: it is unplugged, or its network fails."""
        if self._transport is None or not hasattr(socket, "TCP_INFO"):
            return 0.0
        sock = self._transport.get_extra_info("socket")
        info = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO.size)
        if len(info) < _TCP_INFO.size:
            return 0.0
        unacknowledged, heard_ms = _TCP_INFO.unpack(info)
        silent_s: float = heard_ms / 1000 - (0.0 if unacknowledged else KEEPALIVE_S)
        return max(0.0, silent_s)

    @property
    def unacknowledged_s(self) -> float:
        """Seconds for which the oldest written byte has waited for its acknowledgement; see :class:`Link`."""
        backlog, transport = self._backlog, self._transport
        if backlog is None or backlog.since is None or transport is None:
            return 0.0
        now = time.monotonic()
        if now - backlog.since > STALLED_S:
            backlog.settle(_outstanding(transport))
        return now - backlog.since if backlog.since is not None else 0.0

    def pause(self) -> None:
        """Read nothing until :meth:`resume`."""
        if self._transport is not None and self._transport.is_reading():
            self._transport.pause_reading()

    def resume(self) -> None:
        """Read again."""
        if self._transport is not None and not self._transport.is_reading():
            self._transport.resume_reading()

    def close(self) -> None:
        """Close the connection after what was written, within :data:`CLOSE_S`; idempotent."""
        transport = self._transport
        if transport is not None and not transport.is_closing():
            transport.close()
            if self._held_back:
                asyncio.get_running_loop().call_later(CLOSE_S, self.abort)

    def abort(self) -> None:
        """Close the connection now; what was written may be lost. Idempotent."""
        if self._transport is not None:
            self._transport.abort()

    # What asyncio calls

    async def ended(self) -> None:
        """Return at once: such a link has no threads."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)  # uvloop's transport does not inherit from it
        self._transport.set_write_buffer_limits(high=0)  # makes uvloop write at once, not at the end of its iteration
        peer = transport.get_extra_info("peername")
        if peer is None:  # already reset; connection_lost follows
            self._transport.abort()
            return
        self.peer = str(Address(*peer[:2]))
        sock = transport.get_extra_info("socket")
        _tune(sock, CLIENT_GIVE_UP_S if self._accepted else GIVE_UP_S)
        if self._accepted:
            _keep_alive(sock)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, CLIENT_WRITE_BYTES)
        else:
            _bound_retries(sock)
            self._backlog = _new_backlog(sock)
        if self._hub is not None:
            self._hub.add(self, peer[0], self._receiver)
        self._receiver.attached(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._view

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._view[:nbytes])
        if self._hub is not None:
            self._hub.drain()  # datagrams that wait are older: an old drive must not follow a newer stop
        self._receiver.received(data)

    def eof_received(self) -> bool:
        return False

    def pause_writing(self) -> None:
        self._held_back = True

    def resume_writing(self) -> None:
        self._held_back = False
        self._receiver.writable()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        if self._datagrams is not None:
            self._datagrams.close()
        if self._hub is not None:
            self._hub.remove(self)
        self._receiver.lost(f"connection lost: {exc}" if exc else "closed by peer")


def _tune(sock: socket.socket, give_up_s: float) -> None:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        ("TCP_KEEPIDLE", 5),
        ("TCP_KEEPINTVL", 2),
        ("TCP_KEEPCNT", 3),
        ("TCP_USER_TIMEOUT", round(give_up_s * 1000)),
    ):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


def _keep_alive(sock: socket.socket) -> None:
    """Ask a silent peer for a sign of life every second; ``_tune`` says when the connection ends."""
    for option, value in (("TCP_KEEPIDLE", KEEPALIVE_S), ("TCP_KEEPINTVL", KEEPALIVE_S), ("TCP_KEEPCNT", 10)):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


def _bound_retries(sock: socket.socket) -> None:
    """Bound the time between retransmissions by :data:`_RETRY_MOST_S`, where the kernel can."""
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.IPPROTO_TCP, _TCP_RTO_MAX_MS, round(_RETRY_MOST_S * 1000))


_unwatched_warned = False


def _new_backlog(sock: socket.socket) -> Backlog | None:
    """Make a backlog if the platform tells what is unacknowledged; else warn once and return None."""
    global _unwatched_warned
    try:
        _queued(sock)
    except OSError:
        if not _unwatched_warned:
            _unwatched_warned = True
            log.warning("this platform does not tell what robots acknowledged: drives are written to broken links too")
        return None
    return Backlog()


def _outstanding(transport: asyncio.Transport) -> int:
    """Count the unacknowledged bytes: the kernel's and the transport's own."""
    queued = 0
    with contextlib.suppress(OSError):  # closed meanwhile; connection_lost follows
        queued = _queued(transport.get_extra_info("socket"))
    return queued + transport.get_write_buffer_size()


def _queued(sock: socket.socket) -> int:
    """Count the unacknowledged bytes of the kernel; raise OSError where the platform does not tell."""
    queued: int = _OUTSTANDING.unpack(fcntl.ioctl(sock.fileno(), _SIOCOUTQ, bytes(_OUTSTANDING.size)))[0]
    return queued


async def connect(address: Address, receiver: Receiver) -> TcpLink:
    """Connect within :data:`CONNECT_S`, or raise LinkError with the reason."""
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(CONNECT_S):
            _, link = await loop.create_connection(lambda: TcpLink(receiver), address.host, address.port)
    except TimeoutError as error:
        raise LinkError(f"{address}: no answer within {CONNECT_S:g} s") from error
    except (OSError, UnicodeError) as error:
        raise LinkError(f"{address}: {getattr(error, 'strerror', None) or error}") from error
    return link


@contextlib.asynccontextmanager
async def listen(
    address: Address,
    receiver: Callable[[], Receiver],
    *,
    datagrams: bool = False,
    foreign: Count | None = None,
    secured: Callable[[Receiver], Receiver] | None = None,
) -> AsyncIterator[Address]:
    """Accept peers, each with a receiver of its own; give the address that is bound, with its port.

    ``datagrams``: serve UDP on the same port number too; ``foreign`` counts the datagrams of nobody. ``secured`` puts a
    filter before each receiver (TLS); then there are no datagrams. Raise LinkError if the address cannot be bound.
    """
    loop = asyncio.get_running_loop()
    hub = DatagramHub(foreign or Count()) if datagrams and secured is None else None
    make = receiver if secured is None else lambda: secured(receiver())
    buffer = bytearray(CLIENT_READ_BYTES)
    async with contextlib.AsyncExitStack() as stack:
        try:
            server = await loop.create_server(lambda: TcpLink(make(), hub, buffer), address.host, address.port)
            await stack.enter_async_context(server)
            host, port = server.sockets[0].getsockname()[:2]
            if hub is not None:
                hub.open(host, port)
                stack.callback(hub.close)
        except OSError as error:
            raise LinkError(f"{address}: {error.strerror or error}") from error
        yield Address(host, port, address.tls)
