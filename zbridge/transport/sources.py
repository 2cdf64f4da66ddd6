"""Listeners at a UDP port alone: a client is a source, an address and port that sends. Knows no frame or session.

Theory of operation. A datagram of a new source makes a link, and its receiver may refuse it, as that of an accepted
connection may. Nothing closes such a link: it ends when nothing has come from its source for :data:`SILENT_S`. A link
that was refused, or ended by our side, leaves its source without a link for :data:`REST_S`: what comes meanwhile costs
little. Links to the addresses ``to`` are made unasked, again after they have ended, and last however silent they are.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable

from zbridge.errors import ProtocolError
from zbridge.log import Log
from zbridge.metrics import Count
from zbridge.protocol.address import Address, DatagramAddress
from zbridge.protocol.kept import Exported
from zbridge.transport.datagram_link import CONNECT_S, resolved
from zbridge.transport.door import Accept, Door
from zbridge.transport.kernel import KERNEL, Kernel
from zbridge.transport.link import Link, Receiver
from zbridge.transport.transferable import Parcel
from zbridge.transport.udp import DatagramHub, DatagramReader

log = Log("zbridge.link")

Source = tuple[str, int]

SILENT_S = 5.0
"""Seconds without a datagram after which a client is gone."""
_SWEEPS = 10
"""Calls of :meth:`SourceHub.sweep` within that time."""
REST_S = 1.0
"""Seconds for which a source gets no link after it was refused, or its link was closed by our side."""
RESTING = 1024
"""Most sources that rest; one more clears them all."""
TO_S = 2.0
"""Seconds between two looks whether there is a link to each address ``to``; its host name is resolved again then."""


class SourceLink(Link):
    """What comes from one source, and goes there. The kernel's queue is of all sources: a paused link's are dropped."""

    datagrams_only = True
    silent_sweeps = 0
    paused = False

    def __init__(self, hub: SourceHub, source: Source, receiver: Receiver) -> None:
        super().__init__(receiver)
        self.source = source
        self.peer = str(DatagramAddress(*source))
        self._hub = hub

    @property
    def ready(self) -> bool:
        return self._hub.links.get(self.source) is self

    def write(self, data: bytes) -> None:
        if self.ready and not self._hub.send(data, self.source):
            self.unsent()

    write_datagram = write

    def pause_reading(self) -> None:
        self.paused = True

    def resume_reading(self) -> None:
        self.paused = False

    def export(self, parcel: Parcel) -> Exported:
        """Describe nothing: the door has the socket, and the source."""
        return {}

    def detach(self) -> None:
        self.receiver = Receiver()
        self.abort()

    def abort(self) -> None:
        if self.ready:
            self._hub.end(self, "closed", rests=True)

    close = abort


class SourceHub(DatagramReader):
    """The UDP socket of a listener, and its links by their sources. receiver: makes the one of a new link."""

    def __init__(self, receiver: Callable[[], Receiver], foreign: Count, kernel: Kernel) -> None:
        super().__init__(kernel)
        self.links: dict[Source, SourceLink] = {}
        self.admits = False
        """Whether new sources get links."""
        self._receiver = receiver
        self._foreign = foreign
        self._resting: dict[Source, float] = {}
        self._timer = self._loop.call_later(SILENT_S / _SWEEPS, self.sweep)

    @property
    def bound(self) -> socket.socket:
        """The open socket."""
        assert self._socket is not None
        return self._socket

    def link(self, source: Source, receiver: Receiver | None = None, *, speaks_first: bool = False) -> SourceLink:
        """Return the link of a source, made if there is none; one that was refused has ended already."""
        link = self.links.get(source)
        if link is None:
            link = self.links[source] = SourceLink(self, source, receiver or self._receiver())
            link.speaks_first = speaks_first
            link.receiver.attached(link)
        return link

    def send(self, data: bytes, source: Source) -> bool:
        """Send a datagram; return whether the kernel accepted it."""
        with contextlib.suppress(OSError):
            return self.bound.sendto(data, source) == len(data)
        return False

    def end(self, link: SourceLink, reason: str, *, rests: bool = False) -> None:
        """End a link, and tell its receiver later. rests: its source gets no other one for :data:`REST_S`."""
        del self.links[link.source]
        self._loop.call_soon(link.receiver.lost, reason)
        if rests:
            if len(self._resting) >= RESTING:
                self._resting.clear()
            self._resting[link.source] = self._loop.time() + REST_S

    def sweep(self) -> None:
        """End the links that are silent. Sweeps are counted, not time: this process may have been frozen."""
        self._timer = self._loop.call_later(SILENT_S / _SWEEPS, self.sweep)
        now = self._loop.time()
        self._resting = {source: until for source, until in self._resting.items() if now < until}
        for link in tuple(self.links.values()) if not self._suspended else ():
            link.silent_sweeps += 1
            if link.silent_sweeps > _SWEEPS and not link.speaks_first:
                self.end(link, f"silent for {SILENT_S:g} s")

    def close(self) -> None:
        super().close()
        self._timer.cancel()
        for link in tuple(self.links.values()):
            self.end(link, "closed")

    def _take(self, data: bytes, source: Source) -> None:
        if source not in self.links:
            if not self.admits or self._loop.time() < self._resting.get(source, 0.0):
                self._foreign.value += 1
                return
            self.link(source)
        link = self.links.get(source)
        if link is not None and not link.paused:
            link.silent_sweeps = 0
            link.receiver.received(data)


class SourceDoor(Door):
    """The socket of a listener at a UDP port. to: addresses that get links unasked."""

    _sources: SourceHub

    def __init__(
        self,
        state: Exported | None = None,
        parcel: Parcel | None = None,
        kernel: Kernel = KERNEL,
        to: tuple[Address, ...] = (),
    ) -> None:
        super().__init__(state, parcel, kernel)
        self._to = to
        self._calls: asyncio.Task[None] | None = None

    async def bind(
        self, address: Address, receiver: Callable[[], Receiver], accept: Accept, hub: DatagramHub | None
    ) -> Address:
        self._sources = sources = SourceHub(receiver, self.foreign, self.kernel)
        self._hub = sources  # type: ignore[assignment]  # the base suspends and exports it
        if self._state is not None:
            sources.restore(self.kernel.adopt(self._parcel.take(self._state["udp"])))
        else:
            sources.open(*(await resolved(address))[:2])
            await self.open()
        return DatagramAddress(*sources.bound.getsockname()[:2])

    async def open(self) -> None:
        """Give new sources links, for the first time or again."""
        self._sources.admits = True
        self._sources.resume()
        if self._to and self._calls is None:
            self._calls = asyncio.create_task(self._call())

    def shut(self) -> None:
        """Give no new source a link until :meth:`open`: it sends again."""
        if self._hub is not None:
            self._sources.admits = False

    def source(self, link: Link) -> Source | None:
        return link.source if isinstance(link, SourceLink) else None

    async def admit(self, number: object, receiver: Receiver, source: Source | None) -> None:
        """Attach a client that was handed over, by its source."""
        if source is None:
            raise ProtocolError("a client without a source")
        self._sources.link(source, receiver)

    def close(self) -> None:
        if self._calls is not None:
            self._calls.cancel()
        super().close()

    def _renew(self, links: dict[Address, SourceLink], address: Address, source: Source) -> None:
        """Make the link to an address, unless there is one that still leads there."""
        before = links.get(address)
        if before is not None:
            before.speaks_first = before.source == source  # else it ends by its silence
        if self._sources.admits and not (before and before.ready and before.speaks_first):
            links[address] = link = self._sources.link(source, speaks_first=True)
            link.speaks_first = True

    async def _call(self) -> None:
        """See that there is a link to each address ``to``, where it is now, and that it lasts."""
        links: dict[Address, SourceLink] = {}
        unknown: set[Address] = set()
        while True:
            for address in self._to:
                try:
                    async with asyncio.timeout(CONNECT_S):
                        found = (await resolved(address, self._sources.bound.family))[:2]
                except (OSError, UnicodeError) as error:  # it may be known later
                    if address not in unknown:
                        log.warning("to_unresolved", "{address}: {error}; tried again", address=address, error=error)
                    unknown.add(address)
                    continue
                unknown.discard(address)
                self._renew(links, address, found)
            await asyncio.sleep(TO_S)
