"""The conversation with a Khepera: one request at a time, the version first, then polls at 20 Hz. Sans-IO."""

from __future__ import annotations

from khepera.messages import (
    LINE_BYTES,
    Line,
    ReadPositions,
    ReadProximity,
    ReadSpeeds,
    ReadVersion,
    Version,
    line_end,
    read,
    write,
)
from zbridge.protocol.exchange import ExchangeSession
from zbridge.protocol.session import Limits, Role

POLL_S = 0.05
VERSION_S = 0.5
"""Seconds after which a robot that does not answer is asked for its version again."""
_POLLS = {"positions": ReadPositions(), "speeds": ReadSpeeds(), "proximity": ReadProximity()}


class KheperaSession(ExchangeSession[Line]):
    """We ask, the robot answers."""

    role = Role.HQ
    frame_end = staticmethod(line_end)
    answer_s = 0.1

    def __init__(self) -> None:
        super().__init__(Limits(frame_bytes=LINE_BYTES, handshake_s=5.0))

    def encode(self, message: Line) -> bytes:
        return write(message)

    def read(self, frame: bytes) -> Line:
        return read(frame)

    def answers(self, request: bytes, message: Line) -> bool:
        return message.letter == request[:1].lower()

    def opened(self, now: float) -> None:
        self.poll("version", ReadVersion(), now, VERSION_S)

    def accept(self, message: Line, now: float) -> bool:
        if isinstance(message, Version):
            self.unpoll("version")
            self.establish(f"{message.major}.{message.minor}", ())
            for name, request in _POLLS.items():
                self.poll(name, request, now, POLL_S)
        return False
