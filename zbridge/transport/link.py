"""The interfaces of a link (one transport connection to a peer) and of its receiver. Opens nothing itself.

Links are :class:`~zbridge.transport.tcp.TcpLink`, :class:`~zbridge.transport.serial.SerialLink` and, for tests,
:class:`~zbridge.transport.fake.FakeLink`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from zbridge.protocol.kept import Exported
from zbridge.transport.transferable import Parcel

STALLED_S = 0.3
"""Seconds without acknowledgement after which a robot's link is stalled; healthy robots acknowledge within 50 ms."""


class Receiver(Protocol):
    """Takes what a link reads. All methods run on the event loop's thread."""

    def attached(self, link: Link) -> None:
        """Start: the connection is up. Called once, before every other method."""

    def received(self, data: bytes) -> None:
        """Take bytes in any cut."""

    def received_datagram(self, datagram: bytes) -> None:
        """Take a datagram from the peer."""

    def claims(self, datagram: bytes, port: int) -> bool:
        """Tell whether a datagram from a port of the peer's host that is nobody's source yet is from the peer."""

    def rivalled(self) -> None:
        """React to a second source, or a second receiver, with the same claim: the peer has no source any more."""

    def stray_datagram(self, datagram: bytes) -> None:
        """ReadPayload at a datagram of the peer's host that nobody claimed; the link has dropped it."""

    def foreign_datagram(self) -> None:
        """Count a datagram from elsewhere; the link has dropped it."""

    def lost(self, reason: str) -> None:
        """End: the connection is gone. Called once, after every other method."""

    def writable(self) -> None:
        """Resume writing: ``ready`` is True again."""


class Link(Protocol):
    """One connection to a peer."""

    peer: str
    reads: Callable[[], object]
    """Called before bytes are taken from the kernel; set by who watches the link. :meth:`Receiver.received` follows,
    with b"" where there were none."""

    @property
    def descriptors(self) -> tuple[int, ...]:
        """File descriptors: of the stream, then of the datagrams where there are any. Empty while there is no link."""

    @property
    def ready(self) -> bool:
        """Whether the link takes a write now; if not, :meth:`Receiver.writable` is called when it does."""

    def write(self, data: bytes) -> None:
        """Write ``data`` as one segment."""

    def write_datagram(self, data: bytes) -> None:
        """Send ``data`` as one datagram to the peer. It is lost if the network does not take it now."""

    def drop_source(self) -> None:
        """Forget which source an accepted peer's datagrams come from; idempotent."""

    @property
    def silent_s(self) -> float:
        """Seconds for which the peer's machine has not answered: it is unplugged, or its network fails. 0: unknown."""

    @property
    def unacknowledged_s(self) -> float:
        """Seconds for which the oldest written byte has waited for its acknowledgement.

        Exact above :data:`STALLED_S`; below, the byte may be acknowledged already. 0 only where nothing waits, or where
        the platform does not tell.
        """

    def pause_reading(self) -> None:
        """Read nothing until :meth:`resume_reading`."""

    def resume_reading(self) -> None:
        """Read again."""

    @property
    def blocker(self) -> str | None:
        """Why this connection cannot be handed to another process; None where it can."""

    def suspend(self) -> None:
        """Read nothing, neither stream nor datagrams, until :meth:`resume`: another process may do so meanwhile."""

    def resume(self) -> None:
        """Read again, after :meth:`suspend`."""

    def export(self, parcel: Parcel) -> Exported:
        """Put what the connection consists of into a parcel; describe it. The link must be suspended and ``ready``."""

    def detach(self) -> None:
        """Give up a connection that another process has now: neither the peer nor the receiver notices."""

    def close(self) -> None:
        """Close the connection after what was written; idempotent."""

    def abort(self) -> None:
        """Close the connection now; what was written may be lost. Idempotent."""

    async def ended(self) -> None:
        """Wait, after :meth:`close` or a loss, until no thread of the link runs; the process may end then."""


class _Nobody:
    """Takes nothing: the receiver of a link that was given up."""

    def attached(self, link: Link) -> None: ...
    def received(self, data: bytes) -> None: ...
    def received_datagram(self, datagram: bytes) -> None: ...
    def claims(self, datagram: bytes, port: int) -> bool:
        return False

    def rivalled(self) -> None: ...
    def stray_datagram(self, datagram: bytes) -> None: ...
    def foreign_datagram(self) -> None: ...
    def lost(self, reason: str) -> None: ...
    def writable(self) -> None: ...


NOBODY: Receiver = _Nobody()
