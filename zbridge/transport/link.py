"""What a link is: one transport connection to a peer, and who takes what it brings. Opens nothing itself.

Implemented by :class:`~zbridge.transport.tcp.TcpLink` and, for tests, by :class:`~zbridge.transport.fake.FakeLink`.
"""

from __future__ import annotations

from typing import Protocol

STALLED_S = 0.3
"""Seconds without acknowledgement after which a robot's link takes nothing; healthy robots delay theirs up to 50 ms."""


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
