"""The sockets of a listener: bound here, or taken over from another process. Knows no session.

A door is open while it accepts peers. A shut door keeps its sockets: new peers wait in the kernel's queue for this
process (:meth:`Door.open`), or for the one that is handed the sockets.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import TypeVar

from zbridge.errors import ProtocolError
from zbridge.metrics import Count
from zbridge.protocol.address import Address
from zbridge.protocol.kept import Exported
from zbridge.transport.kernel import KERNEL, Kernel
from zbridge.transport.link import Link, Receiver
from zbridge.transport.transferable import Parcel
from zbridge.transport.udp import DatagramHub

Accept = Callable[[Receiver], asyncio.BufferedProtocol]
"""``accept(receiver)``: makes the link of an accepted peer."""
WAITING = 16
"""Most clients that wait in the kernel's queue; further ones are refused."""
L = TypeVar("L", bound=asyncio.BaseProtocol)


class Door:
    """The sockets of one listener. ``state``, ``parcel``: as another process exported them; such a door begins shut."""

    def __init__(self, state: Exported | None = None, parcel: Parcel | None = None, kernel: Kernel = KERNEL) -> None:
        self.kernel = kernel
        self._state = state
        self._parcel = parcel or Parcel()
        self._sockets: list[socket.socket] = []
        self._servers: list[asyncio.Server] = []
        self._hub: DatagramHub | None = None
        self._receiver: Callable[[], Receiver]
        self._accept: Accept
        self.foreign = Count()
        """Counts datagrams that belong to no client."""

    def __repr__(self) -> str:
        return f"<Door of {len(self._sockets)} sockets, {'open' if self._servers else 'shut'}>"

    async def bind(
        self, address: Address, receiver: Callable[[], Receiver], accept: Accept, hub: DatagramHub | None
    ) -> Address:
        """Bind the address and open, or take the sockets over; return the address with its port. Raise OSError."""
        self._receiver, self._accept, self._hub = receiver, accept, hub
        if self._state is not None:
            self._restore(self._state)
        else:
            loop = asyncio.get_running_loop()
            server = await loop.create_server(lambda: accept(receiver()), address.host, address.port)
            self._servers = [server]
            self._sockets = [self.kernel.adopt(self.kernel.duplicate(bound.fileno())) for bound in server.sockets]
        host, port = self._sockets[0].getsockname()[:2]
        if hub is not None and self._state is None:
            hub.open(host, port)
        return Address(host, port, address.tls)

    def _restore(self, state: Exported) -> None:
        self._sockets = [self.kernel.adopt(self._parcel.take(number)) for number in state["tcp"]]
        if not self._sockets or (state["udp"] is None) is not (self._hub is None):
            raise ProtocolError("other sockets than this listener's")
        if self._hub is not None:
            self._hub.restore(self.kernel.adopt(self._parcel.take(state["udp"])))

    async def open(self) -> None:
        """Accept peers, for the first time or again; receive their datagrams."""
        loop = asyncio.get_running_loop()
        for bound in self._sockets if not self._servers else ():
            copy = self.kernel.adopt(self.kernel.duplicate(bound.fileno()))
            copy.setblocking(False)
            self._servers.append(await loop.create_server(lambda: self._accept(self._receiver()), sock=copy))
        if self._hub is not None:
            self._hub.resume()

    def shut(self) -> None:
        """Accept nobody until :meth:`open`. Peers accepted in this turn of the loop are attached in the next two."""
        servers, self._servers = self._servers, []
        for server in servers:
            server.close()

    def suspend(self) -> None:
        """Receive no datagrams until :meth:`open`."""
        if self._hub is not None:
            self._hub.suspend()

    def export(self, parcel: Parcel) -> Exported:
        """Put the sockets into a parcel; describe them for the process that gets it."""
        udp = parcel.put(self._hub.fileno()) if self._hub is not None else None
        return {"tcp": [parcel.put(bound.fileno()) for bound in self._sockets], "udp": udp}

    def source(self, link: Link) -> tuple[str, int] | None:
        """Return the source of an accepted peer's datagrams."""
        return self._hub.source(link) if self._hub is not None else None

    async def admit(self, number: object, receiver: Receiver, source: tuple[str, int] | None) -> None:
        """Attach an accepted peer that was handed over, with the source of its datagrams."""
        connection = self.kernel.adopt(self._parcel.take(number))
        connection.setblocking(False)
        link = await make_link(connection, lambda: self._accept(receiver))
        if source is not None and self._hub is not None:
            self._hub.bind(link, source)  # type: ignore[arg-type]

    def close(self) -> None:
        """Close the sockets of this process; idempotent."""
        self.shut()
        if self._hub is not None:
            self._hub.close()
        for bound in self._sockets:
            bound.close()


async def make_link(sock: socket.socket, make: Callable[[], L]) -> L:
    """Make a link of a connected socket, whose descriptor belongs to the link from now on; raise OSError.

    If the peer is already gone, uvloop closes the descriptor before it knows the socket object. That object must not
    close it again: by then the number may belong to another file of this process.
    """
    transport, link = await asyncio.get_running_loop().create_connection(make, sock=sock)
    inner = transport.get_extra_info("socket")
    if transport.is_closing() and (inner is None or inner.fileno() < 0):
        sock.detach()
    return link


async def waiting_sockets(address: Address, waiting: int = WAITING) -> list[socket.socket]:
    """Listen at every address of the host; raise OSError if one of them is not available.

    waiting: most clients that wait to be accepted.
    """
    loop, sockets = asyncio.get_running_loop(), list[socket.socket]()
    try:
        for family, _, _, _, where in await loop.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM):
            sockets.append(listening := socket.create_server(where, family=family, backlog=waiting))
            listening.setblocking(False)
    except OSError:
        for listening in sockets:
            listening.close()
        raise
    return sockets
