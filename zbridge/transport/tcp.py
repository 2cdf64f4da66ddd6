"""TCP links, connected or accepted: every write a segment of its own, unacknowledged bytes watched.

Knows no frame, session or protocol. Datagrams of the same peer go by :mod:`zbridge.transport.udp`.
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

from zbridge.address import Address
from zbridge.errors import LinkError
from zbridge.metrics import Count
from zbridge.transport.backlog import Backlog
from zbridge.transport.link import STALLED_S, Receiver
from zbridge.transport.udp import DatagramHub, DatagramSocket

log = logging.getLogger("zbridge.link")

READ_BYTES = 64 * 1024
"""Most bytes taken from a robot's socket before the loop serves others."""
CLIENT_READ_BYTES = 4096
"""The same for a peer that connected to us: there may be hundreds."""
CLIENT_WRITE_BYTES = 64 * 1024
"""Bytes the kernel keeps for a peer that connected to us and reads slowly: what is older than that helps nobody."""
KEEPALIVE_S = 1
"""Seconds of silence after which a peer that connected to us is asked whether it is there."""
GIVE_UP_S = 60.0
"""Seconds without acknowledgement after which a robot's connection is given up: a deployed robot gives only one."""
CLIENT_GIVE_UP_S = 10.0
"""The same for a peer that connected to us."""
_RETRY_MOST_S = 1.0
"""Longest time between two attempts of the kernel to send a robot what a broken link lost."""
_TCP_RTO_MAX_MS = 44
"""Linux 6.15 and newer; Python does not name it yet."""
_OUTSTANDING = struct.Struct("=i")
_SIOCOUTQ = termios.TIOCOUTQ
"""Asks a socket for the bytes that are not acknowledged, by its name for terminals."""
_TCP_INFO = struct.Struct("=24xI28xI")
"""Of Linux's tcp_info: segments not acknowledged, and milliseconds since the last acknowledgement."""
CLOSE_S = 1.0
"""Seconds a peer is given to take what was written before its connection was closed."""
CONNECT_S = 5.0
"""Longest time a connection attempt may take."""


class TcpLink(asyncio.BufferedProtocol):
    """A TCP connection: every write a segment of its own, a vanished peer noticed by keep-alive.

    ``buffer``: where reads go; what is read is copied at once, so the links of one loop may share it.
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
        """Whether the peer takes what is written."""
        return self._transport is not None and not self._held_back

    def write(self, data: bytes) -> None:
        """Write ``data`` as one segment."""
        if self._transport is not None:
            if self._backlog is not None:
                self._backlog.written(len(data), time.monotonic())
            self._transport.write(data)

    def write_datagram(self, data: bytes) -> None:
        """Send ``data`` as one datagram to the peer; lost where the network takes none.

        Towards a peer we connected to, the first one opens a socket of our own, that hears nobody but the
        peer's address and port. An accepted peer is answered from the listener's port.
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
        """Take no more datagrams from the source that was taken for an accepted peer's; idempotent."""
        if self._hub is not None:
            self._hub.unbind(self)

    @property
    def silent_s(self) -> float:
        """Seconds for which the peer's machine has owed an answer: it was unplugged, or its network is in trouble."""
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
        """Seconds for which the oldest byte written has waited for its acknowledgement; see :class:`Link`."""
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
        """Close the connection now, whatever was written; idempotent."""
        if self._transport is not None:
            self._transport.abort()

    # asyncio's side

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)  # uvloop's is none by inheritance
        self._transport.set_write_buffer_limits(high=0)  # so uvloop writes at once, not at the end of its round
        peer = transport.get_extra_info("peername")
        if peer is None:  # reset before we came to look; connection_lost follows
            self._transport.abort()
            return
        self.peer = str(Address(*peer[:2]))
        sock = transport.get_extra_info("socket")
        _tune(sock, CLIENT_GIVE_UP_S if self._accepted else GIVE_UP_S)
        if self._accepted:
            _keep_alive(sock)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, CLIENT_WRITE_BYTES)
        else:
            _try_again_soon(sock)
            self._backlog = _new_backlog(sock)
        if self._hub is not None:
            self._hub.add(self, peer[0], self._receiver)
        self._receiver.attached(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._view

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._view[:nbytes])
        if self._hub is not None:
            self._hub.drain()  # datagrams that wait are older: motion must not overtake the stop that followed it
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
    """Ask a silent peer every second whether it is there; the connection is given up as late as any other."""
    for option, value in (("TCP_KEEPIDLE", KEEPALIVE_S), ("TCP_KEEPINTVL", KEEPALIVE_S), ("TCP_KEEPCNT", 10)):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


def _try_again_soon(sock: socket.socket) -> None:
    """Have what a broken link lost sent again within :data:`_RETRY_MOST_S`, where the kernel can be told."""
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.IPPROTO_TCP, _TCP_RTO_MAX_MS, round(_RETRY_MOST_S * 1000))


_unwatched_said = False


def _new_backlog(sock: socket.socket) -> Backlog | None:
    """Give a backlog where the platform tells what is not acknowledged; say once where it does not."""
    global _unwatched_said
    try:
        _queued(sock)
    except OSError:
        if not _unwatched_said:
            _unwatched_said = True
            log.warning("this platform does not tell what robots acknowledged: drives are written to broken links too")
        return None
    return Backlog()


def _outstanding(transport: asyncio.Transport) -> int:
    """Count the bytes that were written and not acknowledged: the kernel's and the transport's own."""
    queued = 0
    with contextlib.suppress(OSError):  # closed meanwhile; connection_lost follows
        queued = _queued(transport.get_extra_info("socket"))
    return queued + transport.get_write_buffer_size()


def _queued(sock: socket.socket) -> int:
    """Count the bytes that the kernel keeps until they are acknowledged; raise OSError where it does not tell."""
    queued: int = _OUTSTANDING.unpack(fcntl.ioctl(sock.fileno(), _SIOCOUTQ, bytes(_OUTSTANDING.size)))[0]
    return queued


async def connect(address: Address, receiver: Receiver) -> TcpLink:
    """Connect within :data:`CONNECT_S`; raise LinkError with the reason otherwise."""
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
    address: Address, receiver: Callable[[], Receiver], *, datagrams: bool = False, foreign: Count | None = None
) -> AsyncIterator[Address]:
    """Listen for peers, each with a receiver of its own; give the address, with the port that was had.

    ``datagrams``: serve UDP on the same port number too; ``foreign`` counts those that are no peer's. Raises LinkError
    where the address cannot be had.
    """
    loop = asyncio.get_running_loop()
    hub = DatagramHub(foreign or Count()) if datagrams else None
    buffer = bytearray(CLIENT_READ_BYTES)
    async with contextlib.AsyncExitStack() as stack:
        try:
            server = await loop.create_server(lambda: TcpLink(receiver(), hub, buffer), address.host, address.port)
            await stack.enter_async_context(server)
            host, port = server.sockets[0].getsockname()[:2]
            if hub is not None:
                hub.open(host, port)
                stack.callback(hub.close)
        except OSError as error:
            raise LinkError(f"{address}: {error.strerror or error}") from error
        yield Address(host, port)
