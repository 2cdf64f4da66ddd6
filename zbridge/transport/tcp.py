"""TCP links, connected or accepted. Each write is a segment of its own; unacknowledged bytes are watched.

Knows no frame, session or protocol. The peer's datagrams are in :mod:`zbridge.transport.udp`.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import cast

from zbridge.errors import LinkError
from zbridge.log import Log
from zbridge.metrics import Count
from zbridge.protocol.address import Address, DatagramAddress
from zbridge.protocol.kept import Exported
from zbridge.transport.backlog import LEAST_S, Backlog
from zbridge.transport.door import Door, make_link
from zbridge.transport.kernel import KERNEL, Kernel
from zbridge.transport.link import STALLED_S, Link, Receiver, unwatched
from zbridge.transport.sources import SourceDoor
from zbridge.transport.tcp_options import KEEPALIVE_S, bound_retries, keep_alive, new_backlog, outstanding, tune
from zbridge.transport.transferable import Parcel
from zbridge.transport.udp import DatagramHub, DatagramSocket

log = Log("zbridge.link")

READ_BYTES = 64 * 1024
"""Most bytes read from a robot's socket before the loop serves others."""
SHARED_READ_BYTES = 4 * 1024
"""The same if the loop serves other robots too."""
CLIENT_READ_BYTES = 4096
"""The same for an accepted peer: there may be hundreds."""
CLIENT_WRITE_BYTES = 64 * 1024
"""Bytes that the kernel buffers for an accepted peer that reads slowly; older ones are useless."""
GIVE_UP_S = 60.0
"""Seconds without acknowledgement after which a robot's connection ends: long, for a legacy robot gives only one."""
CLIENT_GIVE_UP_S = 10.0
"""The same for an accepted peer."""
_TCP_INFO = struct.Struct("=24xI28xI")
"""Two fields of Linux's tcp_info: unacknowledged segments, and milliseconds since the last acknowledgement."""
CLOSE_S = 1.0
"""Seconds that a closing connection waits until its last bytes are accepted."""
CONNECT_S = 5.0
"""Seconds that a connection attempt may take."""


class TcpLink(asyncio.BufferedProtocol, Link):
    """A TCP connection. ``hub``: the listener's UDP socket, if the peer was accepted there.

    ``buffer``: receives what is read; :data:`READ_BYTES` of its own by default. Reads are copied at once, so all links
    of a loop may share it. ``accepted``: by a listener. ``restored_udp``: the socket for datagrams to a robot, if
    another process handed the connection over.
    """

    ready = False
    """Whether the kernel took all that was written."""

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
        super().__init__(receiver)
        self._kernel = kernel
        self._restored_udp = restored_udp
        self._backlog: Backlog | None = None
        self._hub = hub
        self._accepted = accepted
        self._datagrams: DatagramSocket | None = None
        self._transport: asyncio.Transport | None = None
        self._view = memoryview(bytearray(READ_BYTES) if buffer is None else buffer)

    def __repr__(self) -> str:
        return f"<TcpLink {self.peer or 'unconnected'}>"

    @property
    def descriptors(self) -> tuple[int, ...]:
        if self._transport is None:
            return ()
        stream: int = self._transport.get_extra_info("socket").fileno()
        datagrams = self._datagrams.fileno() if self._datagrams is not None else -1
        return tuple(number for number in (stream, datagrams) if number >= 0)

    def write(self, data: bytes) -> None:
        if self._transport is not None:
            if self._backlog is not None:
                self._backlog.written(len(data), self._kernel.monotonic())
            self._transport.write(data)

    def write_datagram(self, data: bytes) -> None:
        """Send ``data`` as one datagram to the peer. It is lost if the network does not accept it now.

        To a robot, the first datagram opens a socket that receives from the robot's address and port only. An accepted
        peer gets datagrams from the listener's port.
        """
        if self._hub is not None:
            self._hub.send(self, data)
        elif self._transport is not None:
            if self._datagrams is None:
                try:
                    self._datagrams = DatagramSocket(self._transport, self, kernel=self._kernel)
                except OSError as error:  # no descriptor, no port: the datagram is lost, the next one tries again
                    log.warning(
                        "no_datagram_socket", "{peer}: no socket for datagrams: {error}", peer=self.peer, error=error
                    )
                    return
            self._datagrams.send(data)

    def drop_source(self) -> None:
        if self._hub is not None:
            self._hub.unbind(self)

    @property
    def silent_s(self) -> float:
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
        backlog, transport = self._backlog, self._transport
        if backlog is None or backlog.since is None or transport is None:
            return 0.0
        now = self._kernel.monotonic()
        waited_s = now - backlog.since
        if waited_s <= STALLED_S:
            return max(waited_s, LEAST_S)
        backlog.settle(outstanding(transport, self._kernel))
        return backlog.waited_s(now)

    def pause_reading(self) -> None:
        if self._transport is not None and self._transport.is_reading():
            self._transport.pause_reading()

    def resume_reading(self) -> None:
        if self._transport is not None and not self._transport.is_reading():
            self._transport.resume_reading()

    @property
    def blocker(self) -> str | None:
        """Why this connection cannot be handed over: a tls connection has keys that no other process knows."""
        tls = self._transport is not None and self._transport.get_extra_info("ssl_object") is not None
        return "a tls connection cannot be handed over" if tls else None

    def suspend(self) -> None:
        self.pause_reading()
        if self._datagrams is not None:
            self._datagrams.suspend()

    def resume(self) -> None:
        self.resume_reading()
        if self._datagrams is not None:
            self._datagrams.resume()

    def export(self, parcel: Parcel) -> Exported:
        """Put the sockets into a parcel. The kernel sends what it has buffered."""
        assert self._transport is not None
        udp = parcel.put(self._datagrams.fileno()) if self._datagrams is not None else None
        return {"tcp": parcel.put(self._transport.get_extra_info("socket").fileno()), "udp": udp}

    def detach(self) -> None:
        """Give up the own descriptors of a connection that another process has now: no FIN is sent."""
        self.receiver = Receiver()
        self.abort()

    def close(self) -> None:
        """Close the connection after what was written, within :data:`CLOSE_S`; idempotent."""
        transport = self._transport
        if transport is not None and not transport.is_closing():
            transport.close()
            if not self.ready:
                asyncio.get_running_loop().call_later(CLOSE_S, self.abort)

    def abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()

    # What asyncio calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)  # uvloop's transport does not inherit from it
        self.ready = True
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
                self._datagrams = DatagramSocket(self._transport, self, self._restored_udp, self._kernel)
                self._datagrams.resume()
        if self._hub is not None:
            self._hub.add(self, peer[0])
        self.receiver.attached(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        self.reads()
        return self._view

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._view[:nbytes])
        if self._hub is not None:
            self._hub.drain()  # datagrams that wait are older: an old drive must not follow a newer stop
        self.receiver.received(data)
        if nbytes == len(self._view) and self.reads is not unwatched:
            # libuv reads once more, often in vain: who watches the reads must learn that nothing was taken.
            asyncio.get_running_loop().call_soon(self._read_in_vain)

    def _read_in_vain(self) -> None:
        self.receiver.received(b"")

    def eof_received(self) -> bool:
        return False

    def pause_writing(self) -> None:
        self.ready = False

    def resume_writing(self) -> None:
        self.ready = self._transport is not None
        self.receiver.writable()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport, self.ready = None, False
        if self._datagrams is not None:
            self._datagrams.close()
        if self._hub is not None:
            self._hub.remove(self)
        self.receiver.lost(f"connection lost: {exc}" if exc else "closed by peer")


async def connect(
    address: Address, receiver: Receiver, buffer: bytearray | None = None, kernel: Kernel = KERNEL
) -> TcpLink:
    """Connect within :data:`CONNECT_S`, or raise LinkError with the reason.

    buffer: receives what is read, at most its size at a time; links may share it.
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
    """Accept peers, each with a receiver of its own; return the bound address with its port.

    ``datagrams``: serve UDP on the same port number too; ``foreign`` counts datagrams that belong to no client.
    ``secured`` puts a filter before each receiver (TLS); then there are no datagrams. ``door``: keeps the sockets, to
    be shut or handed over; at ``udp://`` a SourceDoor. Raise LinkError if the address cannot be bound.
    """
    door = door or (SourceDoor() if isinstance(address, DatagramAddress) else Door())
    door.foreign = foreign = foreign or Count()
    kernel = door.kernel
    hub = DatagramHub(foreign, kernel) if datagrams and secured is None else None
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
