"""Datagrams beside a TCP link: our own socket to one peer, and the shared socket of a listener.

Knows no frame, session or protocol.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket

from zbridge.metrics import Count
from zbridge.protocol.rate_limit import RateLimit
from zbridge.transport.kernel import KERNEL, Kernel
from zbridge.transport.link import Link

DATAGRAM_BYTES = 65_536
_DATAGRAMS = 64
"""Most datagrams read from a socket before the loop serves others."""
STRAYS_HZ = 20.0
"""Unclaimed datagrams a second of one host that its links may inspect; the others are only counted."""
STRAY_S = 0.02
"""Seconds for which a source is ignored after an unclaimed datagram: a flood must cost little."""
STRAY_SOURCES = 1024
"""Most ignored sources; one more clears them all."""
_DRAINED = 1024
"""Most datagrams read before a stream is read; a socket's default buffer holds fewer."""


class DatagramReader:
    """A bound UDP socket on the event loop; asyncio and uvloop alike."""

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        self._socket: socket.socket | None = None
        self._loop = asyncio.get_running_loop()
        self._suspended = False

    def open(self, host: str, port: int) -> None:
        """Bind the port, and read."""
        self._socket = self._kernel.datagrams(host, port)
        self.resume()

    def fileno(self) -> int:
        """Return the descriptor of the open socket."""
        assert self._socket is not None
        return self._socket.fileno()

    def restore(self, sock: socket.socket) -> None:
        """Use a socket that another process bound; read nothing before :meth:`resume`."""
        sock.setblocking(False)
        self._socket, self._suspended = sock, True

    def suspend(self) -> None:
        """Read nothing until :meth:`resume`: input waits in the kernel."""
        self._suspended = True
        if self._socket is not None:
            self._loop.remove_reader(self._socket.fileno())

    def resume(self) -> None:
        """Read again."""
        self._suspended = False
        if self._socket is not None:
            self._loop.add_reader(self._socket.fileno(), self._read)

    def drain(self) -> None:
        """Read all datagrams that wait."""
        self._read(_DRAINED)

    def _read(self, most: int = _DATAGRAMS) -> None:
        for _ in range(most):
            if self._socket is None or self._suspended:
                return
            try:
                data, source = self._socket.recvfrom(DATAGRAM_BYTES)
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


class DatagramSocket(DatagramReader):
    """A UDP socket to one robot: receives from the robot's address and port, and counts everything else."""

    def __init__(
        self,
        transport: asyncio.Transport,
        link: Link,
        restored: socket.socket | None = None,
        kernel: Kernel = KERNEL,
    ) -> None:
        """``restored``: the socket of another process, that was suspended."""
        super().__init__(kernel)
        self._link = link
        self._peer: tuple[str, int] = transport.get_extra_info("peername")[:2]
        if restored is not None:
            self.restore(restored)
        else:
            self.open(transport.get_extra_info("sockname")[0], 0)

    def send(self, data: bytes) -> None:
        """Send to the peer."""
        self._send(data, self._peer)

    def _take(self, data: bytes, source: tuple[str, int]) -> None:
        if source == self._peer:
            self._link.receiver.received_datagram(data)
        else:
            self._link.receiver.foreign_datagram()


class DatagramHub(DatagramReader):
    """The UDP socket of a listener: each source (address and port) belongs to the link of its host that claimed it.

    Every link of the host is asked for a datagram of an unclaimed source. If exactly one claims it and has no source
    yet, that link gets the source. If several claim it, or one that has a source, somebody sends in another's name: all
    of them lose their sources and are notified (``rivalled``).
    """

    def __init__(self, foreign: Count, kernel: Kernel = KERNEL) -> None:
        super().__init__(kernel)
        self._hosts: dict[str, dict[Link, None]] = {}
        self._strays: dict[str, RateLimit] = {}
        self._deaf_until: dict[tuple[str, int], float] = {}
        self._owners: dict[tuple[str, int], Link] = {}
        self._sources: dict[Link, tuple[str, int]] = {}
        self._foreign = foreign

    def add(self, link: Link, host: str) -> None:
        """Ask this link for the datagrams of its host from now on."""
        self._hosts.setdefault(host, {})[link] = None
        self._strays.setdefault(host, RateLimit(STRAYS_HZ))

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

    def source(self, link: Link) -> tuple[str, int] | None:
        """Return the source that is the link's."""
        return self._sources.get(link)

    def bind(self, link: Link, source: tuple[str, int]) -> None:
        """Let a source be the link's."""
        self._sources[link] = source
        self._owners[source] = link

    def send(self, link: Link, data: bytes) -> None:
        """Send to the source of a link; without a source the datagram is lost."""
        source = self._sources.get(link)
        if source is not None:
            self._send(data, source)

    def _take(self, data: bytes, source: tuple[str, int]) -> None:
        owner = self._owners.get(source)
        if owner is not None:
            owner.receiver.received_datagram(data)
            return
        now = self._loop.time()
        if now < self._deaf_until.get(source, now):
            self._foreign.value += 1
            return
        links = tuple(self._hosts.get(source[0], ()))
        claiming = [link for link in links if link.receiver.claims(data, source[1])]
        if len(claiming) == 1 and claiming[0] not in self._sources:
            self.bind(claiming[0], source)
            claiming[0].receiver.received_datagram(data)
            return
        self._foreign.value += 1
        if claiming:
            for link in claiming:
                self.unbind(link)
                link.receiver.rivalled()
        elif links:
            self._note_stray(data, source, now)

    def _note_stray(self, data: bytes, source: tuple[str, int], now: float) -> None:
        """Show an unclaimed datagram to the links of its host; ignore its source for :data:`STRAY_S`."""
        if len(self._deaf_until) >= STRAY_SOURCES:
            self._deaf_until.clear()
        self._deaf_until[source] = now + STRAY_S
        if self._strays[source[0]].take(now):
            for link in tuple(self._hosts[source[0]]):
                link.receiver.stray_datagram(data)
