"""The conversation: three SYNCs, then the robot sends by itself, and needs a PULSE. Sans-IO."""

from typing import Any, ClassVar

from zbridge.protocol import KeepAlive, ProtocolError, Role, Session, State
from zbridge.wire import Message

from arcos.messages import PACKETS, Command, Do, Report, Setting, Synced, read, write

SYNC_S = 0.5  # a SYNC without an answer is repeated


class ArcosSession(Session[Message]):
    """The gateway opens the robot; it closes one first that is open already."""

    role = Role.HQ
    frame_end, encode, decode = staticmethod(PACKETS.end), staticmethod(write), staticmethod(read)
    handled = frozenset({Synced})
    silent_s, lost_s = 0.5, 3.0
    keep_alive = KeepAlive(Command(Do.PULSE), period_s=0.5, watchdog_s=2.0)
    kept: ClassVar[dict[str, Any]] = {"_awaited": int}
    _awaited = 0  # the SYNC that the robot has not answered yet

    def opened(self, now: float) -> None:
        self._sync(0, now)

    def accept(self, message: Message, now: float) -> bool:
        if self.state is State.ESTABLISHED:  # malformed, so no sign of life: the session ends after lost_s
            raise ProtocolError("a PULSE was answered as SYNC0: the robot was switched off and on")
        match message:
            case Report():  # the robot is still open, from a connection that was lost
                self._sync(0, now, Command(Do.CLOSE))
            case Synced(2, texts) if self._awaited == 2:
                self.outbox.clear("sync")
                self.send_first(Command(Do.OPEN))
                self.send_first(Setting.of(Do.SONAR, 1))
                self.establish(" ".join(texts.decode("ascii", "replace").split("\0")[1:3]), ())
            case Synced(number) if number == self._awaited:
                self._sync(number + 1, now)
        return False

    def _sync(self, number: int, now: float, *before: Command) -> None:
        self._awaited = number
        self.outbox.set("sync", tuple(map(write, (*before, Command(number)))), now, period_s=SYNC_S)
