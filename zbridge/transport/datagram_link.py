"""Links to a robot by datagrams alone: a UDP socket connected to the robot. Knows no frame, session or protocol.

The kernel drops what comes from elsewhere, once the socket is connected; what came before is counted as foreign. It
reports a refusal (the robot's program does not run) as an error of the next call: that ends no link.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import Any

from zbridge.errors import LinkError
from zbridge.protocol.address import Address, DatagramAddress
from zbridge.protocol.kept import Exported
from zbridge.transport.kernel import KERNEL, Kernel
from zbridge.transport.link import Link, Receiver
from zbridge.transport.transferable import Parcel
from zbridge.transport.udp import DATAGRAM_BYTES

CONNECT_S = 5.0
"""Seconds until an address is resolved, and a robot that speaks first has spoken."""


class DatagramLink(Link):
    """A connected UDP socket. One datagram is read in a turn of the event loop: the kernel's buffer bounds the rest."""

    datagrams_only = True

    def __init__(self, sock: socket.socket, receiver: Receiver) -> None:
        super().__init__(receiver)
        self._source = sock.getpeername()[:2]
        self.peer = str(DatagramAddress(*self._source))
        self._socket = sock
        self._loop = asyncio.get_running_loop()
        self._refused = False
        """Whether a write met an error that the event loop may have seen too."""

    def begin(self, first: bytes | None = None) -> DatagramLink:
        """Attach the receiver and begin to read; called once. first: a datagram that was read already."""
        self.resume_reading()
        self.receiver.attached(self)
        if first is not None:
            self.receiver.received(first)
        return self

    @property
    def descriptors(self) -> tuple[int, ...]:
        return (self._socket.fileno(),) if self.ready else ()

    @property
    def ready(self) -> bool:
        return self._socket.fileno() >= 0

    def write(self, data: bytes) -> None:
        """Send ``data`` as one datagram; it is lost, and ``unsent`` called, if the kernel does not accept it now."""
        if not self.ready:
            return
        for _ in range(2):
            try:
                self._socket.send(data)
                return
            except ConnectionRefusedError:  # of an earlier datagram: this one was not sent
                self._refused = True
            except OSError:
                break
        self.unsent()

    write_datagram = write

    def pause_reading(self) -> None:
        if self.ready:
            self._loop.remove_reader(self._socket.fileno())

    def resume_reading(self) -> None:
        if self.ready:
            self._loop.add_reader(self._socket.fileno(), self._read)

    def export(self, parcel: Parcel) -> Exported:
        """Put the socket into a parcel: it knows its peer."""
        return {"udp": parcel.put(self._socket.fileno())}

    def detach(self) -> None:
        self.receiver = Receiver()
        self.abort()

    def abort(self) -> None:
        if self.ready:
            self.pause_reading()
            self._socket.close()
            self._loop.call_soon(self.receiver.lost, "closed")

    close = abort

    def _read(self) -> None:
        """Read one datagram; the receiver gets b"" if there is none: who watches the reads must learn that."""
        self.reads()
        data, refused, self._refused = b"", self._refused, False
        try:
            data, source = self._socket.recvfrom(DATAGRAM_BYTES)
            if source[:2] != self._source:
                data = b""
                self.receiver.foreign_datagram()
        except OSError:
            refused = True
        if refused:  # uvloop watches a socket no more that had an error
            self.pause_reading()
            self.resume_reading()
        self.receiver.received(data)


async def connect(address: DatagramAddress, receiver: Receiver, kernel: Kernel = KERNEL) -> DatagramLink:
    """Connect a socket to the robot, or wait for its first datagram, for :data:`CONNECT_S`; raise LinkError."""
    first = None
    with contextlib.ExitStack() as failed:
        try:
            async with asyncio.timeout(CONNECT_S):
                where = await resolved(address)
                ours = where[:2] if address.waits else ("::" if ":" in where[0] else "0.0.0.0", 0)
                sock = kernel.datagrams(*ours)
                failed.callback(sock.close)
                if address.waits:
                    await _readable(sock)
                    first, where = sock.recvfrom(DATAGRAM_BYTES)
                sock.connect(where)
                link = DatagramLink(sock, receiver)
                link.speaks_first = not address.waits
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or str(error) or f"no datagram within {CONNECT_S:g} s"
            raise LinkError(f"{address}: {reason}") from error
        failed.pop_all()
    return link.begin(first)


def attach(state: Exported, parcel: Parcel, receiver: Receiver, kernel: Kernel = KERNEL) -> DatagramLink:
    """Attach ``receiver`` to the socket that another process handed over; raise ProtocolError, OSError."""
    sock = kernel.adopt(parcel.take(state.get("udp")))
    sock.setblocking(False)
    return DatagramLink(sock, receiver).begin()


async def resolved(address: Address, family: int = socket.AF_UNSPEC) -> tuple[Any, ...]:
    """Return the address as sockets of a family take it; raise OSError, UnicodeError."""
    flags = socket.AI_V4MAPPED if family == socket.AF_INET6 else 0
    look_up = asyncio.get_running_loop().getaddrinfo
    found = await look_up(address.host, address.port, family=family, type=socket.SOCK_DGRAM, flags=flags)
    return found[0][4]


async def _readable(sock: socket.socket) -> None:
    loop, there = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(sock.fileno(), there.set)
    try:
        await there.wait()
    finally:
        loop.remove_reader(sock.fileno())
