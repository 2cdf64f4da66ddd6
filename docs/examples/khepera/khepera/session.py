"""The conversation: one request at a time, the version first, then polls at 20 Hz. Sans-IO."""

from zbridge.protocol import ExchangeSession, Role
from zbridge.wire import Line

from khepera.messages import LINES, ReadPositions, ReadProximity, ReadSpeeds, ReadVersion, Version

POLL_S, VERSION_S = 0.05, 0.5
_POLLS = {"positions": ReadPositions(), "speeds": ReadSpeeds(), "proximity": ReadProximity()}


class KheperaSession(ExchangeSession[Line]):
    """The gateway sends requests, the robot answers."""

    role = Role.HQ
    frame_end, encode, read = staticmethod(LINES.end), LINES.write, LINES.read

    def answers(self, request: bytes, message: Line) -> bool:
        return message.word == request[:1].lower()

    def opened(self, now: float) -> None:
        self.poll("version", ReadVersion(), now, VERSION_S)

    def accept(self, message: Line, now: float) -> bool:
        if isinstance(message, Version):
            self.unpoll("version")
            self.establish(f"{message.major}.{message.minor}", ())
            for name, request in _POLLS.items():
                self.poll(name, request, now, POLL_S)
        return False
