"""A link (one transport connection to a peer) and its receiver, as each kind of them begins. Opens nothing itself.

Links are :class:`~zbridge.transport.tcp.TcpLink`, its form with TLS, :class:`~zbridge.transport.serial.SerialLink`,
:class:`~zbridge.transport.zenoh_link.ZenohLink`, and those of datagrams alone:
:class:`~zbridge.transport.datagram_link.DatagramLink`, :class:`~zbridge.transport.sources.SourceLink`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

from zbridge.errors import NotReady
from zbridge.protocol.kept import Exported
from zbridge.transport.transferable import Parcel

STALLED_S = 0.3
"""Seconds without acknowledgement after which a robot's link is stalled; healthy robots acknowledge within 50 ms."""


class Receiver:
    """Takes what a link reads; override what concerns you. All methods run on the event loop's thread."""

    def attached(self, link: Link) -> None:
        """Start: the connection is up. Called once, before every other method."""

    def received(self, data: bytes) -> None:
        """Take bytes in any cut."""

    def received_datagram(self, datagram: bytes) -> None:
        """Take a datagram from the peer."""

    def claims(self, datagram: bytes, port: int) -> bool:
        """Return whether a datagram from a port of the peer's host that is nobody's source yet is from the peer."""
        return False

    def rivalled(self) -> None:
        """React to a second source, or a second receiver, with the same claim: the peer has no source any more."""

    def stray_datagram(self, datagram: bytes) -> None:
        """Inspect a datagram of the peer's host that nobody claimed; the link has dropped it."""

    def foreign_datagram(self) -> None:
        """Count a datagram from elsewhere; the link has dropped it."""

    def lost(self, reason: str) -> None:
        """End: the connection is gone. Called once, after every other method."""

    def writable(self) -> None:
        """Resume writing: ``ready`` is True again."""


class Link(ABC):
    """One connection to a peer. Without more it has no datagrams, tells of no delay, and stays in its process."""

    peer = ""
    datagrams_only = False
    """Whether there is no stream: each write is a datagram, and each ``received`` is one, of whole frames."""
    speaks_first = False
    """Whether we speak first by datagrams, and the peer may be silent for as long as it likes."""
    receiver: Receiver
    """Takes what is read."""

    def __init__(self, receiver: Receiver) -> None:
        self.receiver = receiver
        self.reads: Callable[[], object] = unwatched
        """Called before bytes are taken from the kernel; set by who watches the link. :meth:`Receiver.received`
        follows, with b"" where there were none."""
        self.unsent: Callable[[], object] = unwatched
        """Called for each datagram that is lost at once, because the kernel does not accept it."""

    @property
    def descriptors(self) -> tuple[int, ...]:
        """File descriptors: of the stream, then of the datagrams where there are any. Empty while there is no link."""
        return ()

    @property
    @abstractmethod
    def ready(self) -> bool:
        """Whether the link accepts a write now; if not, :meth:`Receiver.writable` is called when it does."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Write ``data`` as one segment."""

    def write_datagram(self, data: bytes) -> None:  # noqa: B027
        """Send ``data`` as one datagram to the peer. It is lost if the network does not take it now."""

    def drop_source(self) -> None:  # noqa: B027
        """Forget which source an accepted peer's datagrams come from; idempotent."""

    @property
    def silent_s(self) -> float:
        """Seconds for which the peer's machine has not answered: it is unplugged, or its network fails. 0: unknown."""
        return 0.0

    @property
    def unacknowledged_s(self) -> float:
        """Seconds for which the oldest written byte has waited for its acknowledgement.

        Exact above :data:`STALLED_S`; below, the byte may be acknowledged already. 0 only if nothing waits, or if the
        platform does not report it.
        """
        return 0.0

    @abstractmethod
    def pause_reading(self) -> None:
        """Read nothing until :meth:`resume_reading`."""

    @abstractmethod
    def resume_reading(self) -> None:
        """Read again."""

    @property
    def blocker(self) -> str | None:
        """Why this connection cannot be handed to another process; None where it can."""
        return None

    def suspend(self) -> None:
        """Read nothing, neither stream nor datagrams, until :meth:`resume`: another process may do so meanwhile."""
        self.pause_reading()

    def resume(self) -> None:
        """Read again, after :meth:`suspend`."""
        self.resume_reading()

    def export(self, parcel: Parcel) -> Exported:
        """Put what the connection consists of into a parcel; describe it. The link must be suspended and ``ready``."""
        raise NotReady(str(self.blocker))

    def detach(self) -> None:
        """Give up a connection that another process has now: neither the peer nor the receiver notices."""
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Close the connection after what was written; idempotent."""

    @abstractmethod
    def abort(self) -> None:
        """Close the connection now; what was written may be lost. Idempotent."""

    async def ended(self) -> None:  # noqa: B027
        """Wait, after :meth:`close` or a loss, until no thread of the link runs; the process may end then."""


def unwatched() -> None:
    """Do nothing: nobody watches this of the link."""
