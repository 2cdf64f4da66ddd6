"""What one session may carry, and what it has carried. Sans-IO."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import msgspec

from zbridge.protocol.kept import Frame


class Limits(msgspec.Struct, frozen=True):
    """Bounds of one session: bytes of a frame, seconds for the handshake, seconds between two writes.

    ``rate_hz``: frames a second that the peer may send, a second's worth at once; one more ends the session.
    """

    frame_bytes: int
    handshake_s: float
    gap_s: float = 0.0
    rate_hz: float = math.inf


class Datagram(Frame):
    """A frame that goes by datagram; every other frame goes by the stream."""


class SourceClaims(ABC):
    """What a session tells of datagrams where it is one of several: which of its host's sources is its peer's."""

    drops_source = False
    """Set when the source turns out not to be the peer; the driver forgets the source and clears it."""

    @abstractmethod
    def claims(self, datagram: bytes, port: int) -> bool:
        """Return whether a datagram from a port of the peer's host that is nobody's source yet is from the peer."""

    @abstractmethod
    def rivalled(self, now: float) -> None:
        """React to a second source, or session, with the same claim; the peer has no source of datagrams any more."""

    @abstractmethod
    def stray(self, datagram: bytes) -> None:
        """Inspect a datagram of the peer's host that nobody claimed; raise Refused to tell the peer why."""


class Traffic(msgspec.Struct):
    """Counters of one session."""

    frames_in: int = 0
    frames_out: int = 0
    bytes_in: int = 0
    bytes_out: int = 0
    malformed: int = 0
    foreign: int = 0
    """Datagrams from other sources than the peer."""
    dropped: int = 0
    """Frames dropped because a queue was full: the session's, or the kernel's for datagrams."""
    refused: int = 0
    """Commands of the peer that were not carried out."""
    unanswered: int = 0
    """Requests that the peer did not answer in time."""

    def drop(self) -> None:
        """Count a frame that was dropped."""
        self.dropped += 1
