"""Links to a robot by datagrams alone: a UDP socket connected to the robot. Knows no frame, session or protocol.

The kernel drops what comes from elsewhere, once the socket is connected; what came before is counted as foreign. It
reports a refusal (the robot's program does not run) as an error of the next call: that ends no link.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any

from zbridge.errors import LinkError
from zbridge.protocol.address import DatagramAddress
from zbridge.protocol.kept import Exported
from zbridge.transport.kernel import KERNEL, Kernel
from zbridge.transport.link import Link, Receiver
from zbridge.transport.tcp import CONNECT_S
from zbridge.transport.transferable import Parcel
from zbridge.transport.udp import DATAGRAM_BYTES

_READS = 4
"""Most calls without a datagram in a turn of the event loop: refusals, and datagrams from elsewhere."""


class DatagramLink(Link):
    """A connected UDP socket. One datagram is read in a turn of the event loop: the kernel's buffer bounds the rest."""

    datagrams_only = True

    def __init__(self, sock: socket.socket, receiver: Receiver) -> None:
        super().__init__(receiver)
        self._source = sock.getpeername()[:2]
        self.peer = str(DatagramAddress(*self._source))
        self._socket: socket.socket | None = sock
        self._loop = asyncio.get_running_loop()
        self._reading = self._suspended = False
        self._refused = False
        """Whether a write met an error that the event loop may have seen too."""

    def __repr__(self) -> str:
        return f"<DatagramLink {self.peer}>"

    def begin(self, first: bytes | None = None) -> None:
        """Attach the receiver and begin to read; called once. first: a datagram that was read already."""
        self.resume_reading()
        self.receiver.attached(self)
        if first is not None:
            self.receiver.received(first)

    @property
    def descriptors(self) -> tuple[int, ...]:
        return (self._socket.fileno(),) if self._socket is not None else ()

    @property
    def ready(self) -> bool:
        return self._socket is not None

    def write(self, data: bytes) -> None:
        """Send ``data`` as one datagram; it is lost, and ``unsent`` called, if the kernel does not accept it now."""
        if self._socket is None:
            return
        try:
            try:
                self._socket.send(data)
            except ConnectionRefusedError:  # of an earlier datagram: this one was not sent
                self._refused = True
                self._socket.send(data)
        except OSError:
            self.unsent()

    write_datagram = write

    def pause_reading(self) -> None:
        if self._reading and self._socket is not None:
            self._loop.remove_reader(self._socket.fileno())
        self._reading = False

    def resume_reading(self) -> None:
        if self._socket is not None and not self._reading and not self._suspended:
            self._reading = True
            self._loop.add_reader(self._socket.fileno(), self._read)

    def suspend(self) -> None:
        self._suspended = True
        self.pause_reading()

    def resume(self) -> None:
        self._suspended = False
        self.resume_reading()

    def export(self, parcel: Parcel) -> Exported:
        """Put the socket into a parcel: it knows its peer."""
        assert self._socket is not None
        return {"udp": parcel.put(self._socket.fileno())}

    def detach(self) -> None:
        """Give up the own descriptor of a socket that another process has now."""
        self.receiver = Receiver()
        self.abort()

    def close(self) -> None:
        self.abort()

    def abort(self) -> None:
        if self._socket is not None:
            self.pause_reading()
            sock, self._socket = self._socket, None
            sock.close()
            self._loop.call_soon(self.receiver.lost, "closed")

    def _read(self) -> None:
        """Read one datagram; the receiver gets b"" if there is none: who watches the reads must learn that."""
        if self._socket is None:
            return
        self.reads()
        data, refused, self._refused = b"", self._refused, False
        for _ in range(_READS):
            try:
                found, source = self._socket.recvfrom(DATAGRAM_BYTES)
            except OSError as error:
                refused = True
                if isinstance(error, BlockingIOError):
                    break
            else:
                if source[:2] == self._source:
                    data = found
                    break
                self.receiver.foreign_datagram()
        if refused:  # uvloop watches a socket no more that had an error
            self.pause_reading()
            self.resume_reading()
        self.receiver.received(data)


async def connect(address: DatagramAddress, receiver: Receiver, kernel: Kernel = KERNEL) -> DatagramLink:
    """Connect a socket to the robot, or wait for its first datagram, for :data:`CONNECT_S`; raise LinkError."""
    sock = None
    try:
        async with asyncio.timeout(CONNECT_S):
            where = await resolved(address)
            if not address.waits:
                sock = kernel.datagrams("::" if ":" in where[0] else "0.0.0.0", 0)
                sock.connect(where)
                first = None
            else:
                sock = kernel.datagrams(*where[:2])
                await _readable(sock)
                first, source = sock.recvfrom(DATAGRAM_BYTES)
                sock.connect(source)
        link = DatagramLink(sock, receiver)
    except BaseException as error:
        if sock is not None:
            sock.close()
        if isinstance(error, TimeoutError):
            missing = "datagram" if address.waits else "address"
            raise LinkError(f"{address}: no {missing} within {CONNECT_S:g} s") from error
        if isinstance(error, OSError | UnicodeError):
            raise LinkError(f"{address}: {getattr(error, 'strerror', None) or error}") from error
        raise
    link.begin(first)
    return link


def attach(state: Exported, parcel: Parcel, receiver: Receiver, kernel: Kernel = KERNEL) -> DatagramLink:
    """Attach ``receiver`` to the socket that another process handed over; raise ProtocolError, OSError."""
    sock = kernel.adopt(parcel.take(state.get("udp")))
    sock.setblocking(False)
    link = DatagramLink(sock, receiver)
    link.begin()
    return link


async def resolved(address: DatagramAddress, family: int = socket.AF_UNSPEC) -> tuple[Any, ...]:
    """Return the address as sockets take it; raise OSError, UnicodeError. family: of the socket."""
    flags = socket.AI_V4MAPPED if family == socket.AF_INET6 else 0
    found = await asyncio.get_running_loop().getaddrinfo(
        address.host, address.port, family=family, type=socket.SOCK_DGRAM, flags=flags
    )
    return found[0][4]


async def _readable(sock: socket.socket) -> None:
    """Wait until a datagram has come."""
    loop, there = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(sock.fileno(), there.set)
    try:
        await there.wait()
    finally:
        loop.remove_reader(sock.fileno())
