"""Transport connections to peers: bytes and addresses, nothing else. Knows no frame, session or protocol.

:class:`FakeLink` stands in for a connection in tests.
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
from typing import Protocol, cast
from urllib.parse import urlsplit

import msgspec

from zbridge.errors import LinkError
from zbridge.metrics import Count
from zbridge.session.allowance import Allowance
from zbridge.session.backlog import Backlog

log = logging.getLogger("zbridge.link")

READ_BYTES = 64 * 1024
"""Most bytes taken from a robot's socket before the loop serves others."""
CLIENT_READ_BYTES = 4096
"""The same for a peer that connected to us: there may be hundreds."""
CLIENT_WRITE_BYTES = 64 * 1024
"""Bytes the kernel keeps for a peer that connected to us and reads slowly: what is older than that helps nobody."""
KEEPALIVE_S = 1
"""Seconds of silence after which a peer that connected to us is asked whether it is there."""
STALLED_S = 0.3
"""Seconds without acknowledgement after which a robot's link takes nothing; healthy robots delay theirs up to 50 ms."""
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
            (host or "").encode("idna")
        except ValueError as error:
            raise LinkError(f"{text!r}: {error}; expected tcp://host:port") from error
        odd = parts.path or parts.query or parts.fragment or parts.username is not None
        if parts.scheme != "tcp" or not host or port is None or odd:
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

    def received_datagram(self, datagram: bytes) -> None:
        """Take a datagram of this peer."""

    def claims(self, datagram: bytes, port: int) -> bool:
        """Tell whether a datagram from a port of this peer's host that is no peer's source yet is this peer's."""

    def rivalled(self) -> None:
        """Take note that another source or another peer claims to be this peer as well: it has no source any more."""

    def stray_datagram(self, datagram: bytes) -> None:
        """Take note of a datagram of this peer's host that nobody claimed, and that was dropped."""

    def foreign_datagram(self) -> None:
        """Take note of a datagram that came from elsewhere and was dropped."""

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

    def write_datagram(self, data: bytes) -> None:
        """Send ``data`` as one datagram to the peer; lost where the network takes none."""

    def drop_source(self) -> None:
        """Take no more datagrams from the source that was taken for an accepted peer's; idempotent."""

    @property
    def silent_s(self) -> float:
        """Seconds for which the peer's machine has owed an answer: it was unplugged, or its network is in trouble."""

    @property
    def unacknowledged_s(self) -> float:
        """Seconds for which the oldest byte written has waited for its acknowledgement, as far as it is known.

        What has waited for no longer than :data:`STALLED_S` may be acknowledged already; 0 where nobody watches.
        """

    def pause(self) -> None:
        """Read nothing until :meth:`resume`."""

    def resume(self) -> None:
        """Read again."""

    def close(self) -> None:
        """Close the connection; idempotent."""

    def abort(self) -> None:
        """Close the connection now, whatever was written; idempotent."""


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


_DATAGRAM_BYTES = 65_536
_DATAGRAMS = 64
"""Most datagrams taken from a socket before the loop serves others."""
STRAYS_HZ = 20.0
"""Datagrams a second of one host that nobody claimed and that are shown to its links; the others are counted."""
STRAY_S = 0.02
"""Seconds for which a source is not listened to after a datagram that nobody claimed: a flood costs little."""
STRAY_SOURCES = 1024
"""Such sources that are kept; of more, all are forgotten."""
_DRAINED = 1024
"""Most datagrams taken before a stream is read: more than a socket's buffer holds by default."""


class _DatagramReader:
    """A bound UDP socket on the event loop; asyncio and uvloop alike."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        self._loop = asyncio.get_running_loop()

    def _listen(self, host: str, port: int) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        sock = socket.socket(family, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)
            sock.bind((host, port))
        except OSError:
            sock.close()
            raise
        self._socket = sock
        self._loop.add_reader(sock.fileno(), self._read)

    def drain(self) -> None:
        """Take all datagrams that wait."""
        self._read(_DRAINED)

    def _read(self, most: int = _DATAGRAMS) -> None:
        for _ in range(most):
            if self._socket is None:
                return
            try:
                data, source = self._socket.recvfrom(_DATAGRAM_BYTES)
            except OSError:  # nothing more, or an ICMP error of an earlier send
                return
            self._take(data, source[:2])

    def _take(self, data: bytes, source: tuple[str, int]) -> None:
        raise NotImplementedError

    def _send(self, data: bytes, destination: tuple[str, int]) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):  # a full buffer, an unreachable peer: the datagram is lost
                self._socket.sendto(data, destination)

    def close(self) -> None:
        """Close the socket; idempotent."""
        sock, self._socket = self._socket, None
        if sock is not None:
            self._loop.remove_reader(sock.fileno())
            sock.close()


class DatagramSocket(_DatagramReader):
    """Our own UDP socket towards one peer: it hears the peer's address and port, and counts everything else."""

    def __init__(self, transport: asyncio.Transport, receiver: Receiver) -> None:
        super().__init__()
        self._receiver = receiver
        self._peer: tuple[str, int] = transport.get_extra_info("peername")[:2]
        self._listen(transport.get_extra_info("sockname")[0], 0)

    def send(self, data: bytes) -> None:
        """Send to the peer."""
        self._send(data, self._peer)

    def _take(self, data: bytes, source: tuple[str, int]) -> None:
        if source == self._peer:
            self._receiver.received_datagram(data)
        else:
            self._receiver.foreign_datagram()


class DatagramHub(_DatagramReader):
    """The UDP socket of a listener: each source belongs to the link of the same host that claimed it.

    A datagram of a source that is nobody's is shown to every link of its host. The one that claims it gets the source,
    if it has none; where several claim it, or one that has a source already, somebody speaks in another's name: none
    of them has a source from then on.
    """

    def __init__(self, foreign: Count) -> None:
        super().__init__()
        self._hosts: dict[str, dict[Link, Receiver]] = {}
        self._strays: dict[str, Allowance] = {}
        self._deaf_until: dict[tuple[str, int], float] = {}
        self._owners: dict[tuple[str, int], tuple[Link, Receiver]] = {}
        self._sources: dict[Link, tuple[str, int]] = {}
        self._foreign = foreign

    def open(self, host: str, port: int) -> None:
        """Bind the port."""
        self._listen(host, port)

    def add(self, link: Link, host: str, receiver: Receiver) -> None:
        """Let a link have the datagrams of its host that it claims."""
        self._hosts.setdefault(host, {})[link] = receiver
        self._strays.setdefault(host, Allowance(STRAYS_HZ))

    def remove(self, link: Link) -> None:
        """Forget a link and its source; idempotent."""
        for host, links in tuple(self._hosts.items()):
            links.pop(link, None)
            if not links:
                del self._hosts[host], self._strays[host]
        self.unbind(link)

    def unbind(self, link: Link) -> None:
        """Forget the source of a link; idempotent."""
        source = self._sources.pop(link, None)
        if source is not None:
            del self._owners[source]

    def send(self, link: Link, data: bytes) -> None:
        """Send to the source a link has claimed; nowhere while there is none."""
        source = self._sources.get(link)
        if source is not None:
            self._send(data, source)

    def _take(self, data: bytes, source: tuple[str, int]) -> None:
        owner = self._owners.get(source)
        if owner is not None:
            owner[1].received_datagram(data)
            return
        now = self._loop.time()
        if now < self._deaf_until.get(source, now):
            self._foreign.value += 1
            return
        peers = tuple(self._hosts.get(source[0], {}).items())
        claiming = [(link, receiver) for link, receiver in peers if receiver.claims(data, source[1])]
        if len(claiming) == 1 and claiming[0][0] not in self._sources:
            self._sources[claiming[0][0]] = source
            self._owners[source] = claiming[0]
            claiming[0][1].received_datagram(data)
            return
        self._foreign.value += 1
        if claiming:
            for link, receiver in claiming:
                self.unbind(link)
                receiver.rivalled()
        elif peers:
            self._note_stray(data, source, now)

    def _note_stray(self, data: bytes, source: tuple[str, int], now: float) -> None:
        """Show a datagram that nobody claimed to the links of its host; do not listen to its source for a moment."""
        if len(self._deaf_until) >= STRAY_SOURCES:
            self._deaf_until.clear()
        self._deaf_until[source] = now + STRAY_S
        if self._strays[source[0]].take(now):
            for receiver in tuple(self._hosts[source[0]].values()):
                receiver.stray_datagram(data)


class FakeLink:
    """A link without a socket: keeps what was written, and the test plays the peer."""

    def __init__(self, peer: str = "tcp://robot.test:1") -> None:
        self.peer = peer
        self.ready = True
        self.silent_s = 0.0
        self.unacknowledged_s = 0.0
        self.written: list[bytes] = []
        self.datagrams: list[bytes] = []
        self.sources_dropped = 0
        self.paused = False
        self.closed = False

    def write(self, data: bytes) -> None:
        """Keep ``data``."""
        self.written.append(data)

    def write_datagram(self, data: bytes) -> None:
        """Keep ``data``."""
        self.datagrams.append(data)

    def drop_source(self) -> None:
        """Take note."""
        self.sources_dropped += 1

    def pause(self) -> None:
        """Take note."""
        self.paused = True

    def resume(self) -> None:
        """Take note."""
        self.paused = False

    def close(self) -> None:
        """Take note."""
        self.closed = True

    def abort(self) -> None:
        """Take note."""
        self.closed = True
