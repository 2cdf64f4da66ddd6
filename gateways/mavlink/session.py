"""What every conversation in MAVLink has: frames of our system that are numbered as they leave. Sans-IO.

Source: "Frames" of the protocol page.
"""

from __future__ import annotations

from typing import Any, ClassVar, TypeVar

import msgspec

from gateways.mavlink.frames import LIMIT_BYTES, frame_end, numbered, write_frame
from gateways.mavlink.messages import MavlinkMessage
from zbridge.protocol import Limits, Outbox, Session

M = TypeVar("M")


class MavlinkSession(Session[M]):
    """Both roles. system, component: ours. A frame may be encoded once for many sessions: each numbers its own."""

    kept: ClassVar[dict[str, Any]] = {"seq": int}
    frame_end = staticmethod(frame_end)

    def __init__(self, system: int, component: int, bounds: Limits) -> None:
        super().__init__(msgspec.structs.replace(bounds, frame_bytes=LIMIT_BYTES))
        self.system, self.component = system, component
        self.seq = 0
        """The number of the next frame."""
        self.outbox = _Numbered(self)

    def encode(self, message: MavlinkMessage) -> bytes:  # type: ignore[override]
        return write_frame(message, 0, self.system, self.component)

    def undated(self, frame: bytes) -> bytes:
        return numbered(frame, 0)


class _Numbered(Outbox):
    """Numbers frames as they leave: those of a slot are repeated, and those of an urgent group overtake."""

    def __init__(self, session: MavlinkSession[Any]) -> None:
        super().__init__(session.limits.gap_s)
        self._session = session

    def take(self, now: float) -> bytes | None:
        frame = super().take(now)
        if frame is None:
            return None
        session = self._session
        seq, session.seq = session.seq, (session.seq + 1) & 0xFF
        return numbered(frame, seq)
