"""Sessions of ALF in both roles and dialects: framing, END, and the drive command that repeats for ever. Sans-IO.

Source: "Links", "Handshake", "Translation of commands" and "Versions and dialects" of the protocol page. There is no
handshake: a session is established at once.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import msgspec

from gateways.alf import messages
from zbridge.protocol import Code, Limits, NotReady, ProtocolError, Role, Session, State

REPEAT_S = 0.02
"""Seconds between repetitions of the drive command."""
ENDED = "ended"
HANDSHAKE_S = 5.0
_DRIVE = "drive"
_BOUNDS = Limits(frame_bytes=0, handshake_s=HANDSHAKE_S)


class AlfSession(Session[messages.AlfMessage]):
    """Both roles. ``points``: points of a measurement; the binary framing depends on it.

    ``bounds``: what a listener demands of its clients.
    """

    kept: ClassVar[dict[str, Any]] = {"points": int, "_broken": bool}
    handled = frozenset({messages.End})

    def __init__(
        self,
        dialect: messages.AlfDialect,
        *,
        points: int = messages.POINTS,
        points_from_scanner: bool = False,
        gap_s: float = 0.0,
        bounds: Limits = _BOUNDS,
    ) -> None:
        self.dialect = dialect
        self.points = points
        self._ids = messages.sent_by(Role.ROBOT if self.role is Role.HQ else Role.HQ)
        self._broken = False
        self._points_from_scanner = points_from_scanner
        if dialect is messages.AlfDialect.TEXT:
            limit = messages.text_limit(messages.MOST_POINTS if points_from_scanner else max(points, messages.POINTS))
            self.frame_end = messages.text_frame_end(limit)
            self._read, self._write = messages.read_text, messages.write_text
        else:
            limit = messages.binary_size(messages.Measurement.spec.id, messages.MOST_POINTS)
            self.frame_end = messages.binary_frame_end(self._ids, lambda: self.points)
            self._read, self._write = messages.read_binary, messages.write_binary
        super().__init__(msgspec.structs.replace(bounds, frame_bytes=limit, gap_s=gap_s))

    def send(self, message: messages.AlfMessage) -> None:
        if self.over:
            raise NotReady("closing", Code.CLOSING)
        super().send(message)

    def encode(self, message: messages.AlfMessage) -> bytes:
        return self._write(message)

    def decode(self, frame: bytes) -> messages.AlfMessage:
        if self.dialect is messages.AlfDialect.TEXT:
            broken, self._broken = self._broken, not frame.endswith(b";")
            if broken:  # these bytes are the rest of a message that was too long
                raise ProtocolError(f"{len(frame)} bytes more of a message without an end")
        message = self._read(frame, self._ids)
        if isinstance(message, messages.ScannerInit) and self._points_from_scanner:
            self.points = points_of(message)
        if isinstance(message, messages.Measurement) and len(message.points) != self.points:
            raise ProtocolError(f"measurement of {len(message.points)} points, expected {self.points}")
        return message

    def opened(self, now: float) -> None:
        self.establish("", ())

    def accept(self, message: messages.AlfMessage, now: float) -> bool:
        if isinstance(message, messages.End):
            self.close(ENDED, now)
            return False
        return True

    def close(self, reason: str, now: float) -> None:
        """Send END once; nothing follows it."""
        if self.state is State.ESTABLISHED:
            self.outbox.clear(_DRIVE)
            super().send(messages.End())
        super().close(reason, now)


class AlfHqRole(AlfSession):
    """We play HQ towards a vehicle. ``at_first``: the command that a link that drives repeats from the start."""

    role = Role.HQ
    silent_s = math.inf  # a vehicle without a scanner says nothing for seconds
    at_first: messages.DriveCommand | None = None

    def opened(self, now: float) -> None:
        super().opened(now)
        if self.at_first is not None:
            self.drive(self.at_first, now)

    def drive(self, command: messages.DriveCommand, now: float, *, urgent: bool = False) -> None:
        """Send a command at once, and again every 20 ms until the next one."""
        if self.over:
            raise NotReady("closing", Code.CLOSING)
        self.outbox.set(_DRIVE, (self.encode(command),), now, period_s=REPEAT_S, urgent=urgent)


class VehicleRole(AlfSession):
    """We play the vehicle towards an HQ."""

    role = Role.ROBOT


def points_of(scanner: messages.ScannerInit) -> int:
    """Compute the number of points from a scanner's geometry; raise ProtocolError if the number is absurd."""
    points = (scanner.angle_max_deg - scanner.angle_min_deg) / scanner.angle_increment_deg + 1
    if not 0.5 <= points <= messages.MOST_POINTS:
        raise ProtocolError(f"scanner init with {points:g} points, expected 1 to {messages.MOST_POINTS}")
    return round(points)
