"""TCP links, connected or accepted. Each write is a segment of its own; unacknowledged bytes are watched.

Knows no frame, session or protocol. The peer's datagrams are in :mod:`zbridge.transport.udp`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import struct
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import cast

from zbridge.errors import LinkError
from zbridge.metrics import Count
from zbridge.protocol.address import Address
from zbridge.protocol.kept import Exported
from zbridge.transport.backlog import Backlog
from zbridge.transport.door import Door, make_link
from zbridge.transport.kernel import KERNEL, Kernel
from zbridge.transport.link import NOBODY, STALLED_S, Receiver
from zbridge.transport.tcp_options import KEEPALIVE_S, bound_retries, keep_alive, new_backlog, outstanding, tune
from zbridge.transport.transferable import Parcel
from zbridge.transport.udp import DatagramHub, DatagramSocket

log = logging.getLogger("zbridge.link")

READ_BYTES = 64 * 1024
"""Most bytes taken from a robot's socket before the loop serves others."""
SHARED_READ_BYTES = 4 * 1024
"""The same where the loop serves other robots too."""
CLIENT_READ_BYTES = 4096
"""The same for an accepted peer: there may be hundreds."""
CLIENT_WRITE_BYTES = 64 * 1024
"""Bytes that the kernel keeps for an accepted peer that reads slowly; older ones are of no use."""
GIVE_UP_S = 60.0
"""Seconds without acknowledgement after which a robot's connection ends: long, for a legacy robot gives only one."""
CLIENT_GIVE_UP_S = 10.0
"""The same for an accepted peer."""
_TCP_INFO = struct.Struct("=24xI28xI")
"""Two fields of Linux's tcp_info: unacknowledged segments, and milliseconds since the last acknowledgement."""
CLOSE_S = 1.0
"""Seconds that a closing connection waits for its last bytes to be taken."""
CONNECT_S = 5.0
"""Seconds that a connection attempt may take."""


def _unwatched() -> None:
    """Do nothing: nobody watches the reads of the link."""


class TcpLink(asyncio.BufferedProtocol):
    """A TCP connection. ``hub``: the listener's UDP socket, if the peer was accepted there.

    ``buffer``: where reads go, :data:`READ_BYTES` of its own by default. Reads are copied at once, so all links of a
    loop may share it. ``accepted``: by a listener. ``restored_udp``: the socket for datagrams to a robot, where another
    process handed the connection over.
    """

    def __init__(
        self,
        receiver: Receiver,
        hub: DatagramHub | None = None,
        buffer: bytearray | None = None,
        *,
        accepted: bool = False,
        restored_udp: socket.socket | None = None,
        kernel: Kernel = KERNEL,
    ) -> None:
        self._kernel = kernel
        self.peer = ""
        self.reads: Callable[[], object] = _unwatched
        self._restored_udp = restored_udp
        self._backlog: Backlog | None = None
        self._hub = hub
        self._accepted = accepted
        self._datagrams: DatagramSocket | None = None
        self._receiver = receiver
        self._transport: asyncio.Transport | None = None
        self._view = memoryview(bytearray(READ_BYTES) if buffer is None else buffer)
        self._writing_paused = False

    def __repr__(self) -> str:
        return f"<TcpLink {self.peer or 'unconnected'}>"

    @property
    def descriptors(self) -> tuple[int, ...]:
        """File descriptors of the stream, and of our own socket for datagrams where there is one."""
        if self._transport is None:
            return ()
        stream: int = self._transport.get_extra_info("socket").fileno()
        datagrams = self._datagrams.fileno() if self._datagrams is not None else -1
        return tuple(number for number in (stream, datagrams) if number >= 0)

    @property
    def ready(self) -> bool:
        """Whether the kernel took all that was written."""
        return self._transport is not None and not self._writing_paused

    def write(self, data: bytes) -> None:
        """Write ``data`` as one segment."""
        if self._transport is not None:
            if self._backlog is not None:
                self._backlog.written(len(data), self._kernel.monotonic())
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
                    self._datagrams = DatagramSocket(self._transport, self._receiver, kernel=self._kernel)
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
        now = self._kernel.monotonic()
        if now - backlog.since > STALLED_S:
            backlog.settle(outstanding(transport, self._kernel))
        return backlog.waited_s(now)

    def pause_reading(self) -> None:
        """Read nothing until :meth:`resume_reading`."""
        if self._transport is not None and self._transport.is_reading():
            self._transport.pause_reading()

    def resume_reading(self) -> None:
        """Read again."""
        if self._transport is not None and not self._transport.is_reading():
            self._transport.resume_reading()

    @property
    def blocker(self) -> str | None:
        """Why this connection cannot be handed over: a tls connection has keys that no other process knows."""
        tls = self._transport is not None and self._transport.get_extra_info("ssl_object") is not None
        return "a tls connection cannot be handed over" if tls else None

    def suspend(self) -> None:
        """Read nothing, neither stream nor datagrams of our own socket, until :meth:`resume`."""
        self.pause_reading()
        if self._datagrams is not None:
            self._datagrams.suspend()

    def resume(self) -> None:
        """Read again, after :meth:`suspend`."""
        self.resume_reading()
        if self._datagrams is not None:
            self._datagrams.resume()

    def export(self, parcel: Parcel) -> Exported:
        """Put the sockets into a parcel. What the kernel has is sent by the kernel."""
        assert self._transport is not None
        udp = parcel.put(self._datagrams.fileno()) if self._datagrams is not None else None
        return {"tcp": parcel.put(self._transport.get_extra_info("socket").fileno()), "udp": udp}

    def detach(self) -> None:
        """Give up the own descriptors of a connection that another process has now: no FIN is sent."""
        self._receiver = NOBODY
        self.abort()

    def close(self) -> None:
        """Close the connection after what was written, within :data:`CLOSE_S`; idempotent."""
        transport = self._transport
        if transport is not None and not transport.is_closing():
            transport.close()
            if self._writing_paused:
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
        tune(sock, CLIENT_GIVE_UP_S if self._accepted else GIVE_UP_S)
        if self._accepted:
            keep_alive(sock)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, CLIENT_WRITE_BYTES)
        else:
            bound_retries(sock)
            self._backlog = new_backlog(sock, self._kernel)
            if self._restored_udp is not None:
                self._datagrams = DatagramSocket(self._transport, self._receiver, self._restored_udp, self._kernel)
                self._datagrams.resume()
        if self._hub is not None:
            self._hub.add(self, peer[0], self._receiver)
        self._receiver.attached(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        self.reads()
        return self._view

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._view[:nbytes])
        if self._hub is not None:
            self._hub.drain()  # datagrams that wait are older: an old drive must not follow a newer stop
        self._receiver.received(data)
        if nbytes == len(self._view) and self.reads is not _unwatched:
            # libuv reads once more, often in vain: who watches the reads must learn that nothing was taken.
            asyncio.get_running_loop().call_soon(self._read_in_vain)

    def _read_in_vain(self) -> None:
        self._receiver.received(b"")

    def eof_received(self) -> bool:
        return False

    def pause_writing(self) -> None:
        self._writing_paused = True

    def resume_writing(self) -> None:
        self._writing_paused = False
        self._receiver.writable()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        if self._datagrams is not None:
            self._datagrams.close()
        if self._hub is not None:
            self._hub.remove(self)
        self._receiver.lost(f"connection lost: {exc}" if exc else "closed by peer")


async def connect(
    address: Address, receiver: Receiver, buffer: bytearray | None = None, kernel: Kernel = KERNEL
) -> TcpLink:
    """Connect within :data:`CONNECT_S`, or raise LinkError with the reason. buffer: where reads go; links may share it.

    Reads are as large as the buffer at most.
    """
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(CONNECT_S):
            _, link = await loop.create_connection(
                lambda: TcpLink(receiver, buffer=buffer, kernel=kernel), address.host, address.port
            )
    except TimeoutError as error:
        raise LinkError(f"{address}: no answer within {CONNECT_S:g} s") from error
    except (OSError, UnicodeError) as error:
        raise LinkError(f"{address}: {getattr(error, 'strerror', None) or error}") from error
    return link


async def attach(state: Exported, parcel: Parcel, receiver: Receiver, kernel: Kernel = KERNEL) -> TcpLink:
    """Attach ``receiver`` to the connection that another process handed over; raise ProtocolError, OSError."""
    sock = kernel.adopt(parcel.take(state.get("tcp")))
    sock.setblocking(False)
    udp = kernel.adopt(parcel.take(state["udp"])) if state.get("udp") is not None else None
    return await make_link(sock, lambda: TcpLink(receiver, restored_udp=udp, kernel=kernel))


@contextlib.asynccontextmanager
async def listen(
    address: Address,
    receiver: Callable[[], Receiver],
    *,
    datagrams: bool = False,
    foreign: Count | None = None,
    secured: Callable[[Receiver], Receiver] | None = None,
    door: Door | None = None,
) -> AsyncIterator[Address]:
    """Accept peers, each with a receiver of its own; give the address that is bound, with its port.

    ``datagrams``: serve UDP on the same port number too; ``foreign`` counts the datagrams of nobody. ``secured`` puts a
    filter before each receiver (TLS); then there are no datagrams. ``door``: keeps the sockets, for who shuts it or
    hands them over. Raise LinkError if the address cannot be bound.
    """
    door = door or Door()
    kernel = door.kernel
    hub = DatagramHub(foreign or Count(), kernel) if datagrams and secured is None else None
    make = receiver if secured is None else lambda: secured(receiver())
    buffer = bytearray(CLIENT_READ_BYTES)
    async with contextlib.AsyncExitStack() as stack:
        try:
            stack.callback(door.close)
            accept = partial(TcpLink, hub=hub, buffer=buffer, accepted=True, kernel=kernel)
            bound = await door.bind(address, make, accept, hub)
        except OSError as error:
            raise LinkError(f"{address}: {error.strerror or error}") from error
        yield bound
