"""What of a session survives a restart of the gateway. Sans-IO."""

from __future__ import annotations

from typing import Any, ClassVar

from zbridge.errors import ProtocolError
from zbridge.protocol.kept import Exported, Kept
from zbridge.protocol.outbox import Outbox
from zbridge.protocol.rate_limit import RateLimit
from zbridge.protocol.session_states import State
from zbridge.protocol.traffic import Traffic
from zbridge.wire.frames import FrameBuffer


class KeptSession(Kept):
    """The part of a session that another process can take over; a protocol names in ``kept`` what is its own."""

    kept: ClassVar[dict[str, Any]] = {
        "state": State,
        "reason": str | None,
        "busy": str | None,
        "doubts": tuple[str, ...],
        "version": str | None,
        "features": tuple[str, ...],
        "transport": str,
        "traffic": Traffic,
        "left_out": dict[str, int],
        "last_malformed": str | None,
        "outbox": Outbox,
        "_limit_at": float,
        "_allowance": RateLimit,
    }
    _frames: FrameBuffer

    def export(self) -> Exported:
        """Write the state, with the frame that has come in part. A protocol names in ``kept`` what is its own."""
        return super().export() | {"rest": self._frames.rest}

    def restore(self, state: Exported) -> None:
        """Take over the state of the same session of another process; raise ProtocolError if it has another form.

        To be called in place of :meth:`open`, on a session that was just made from the same settings.
        """
        super().restore(state)
        for frame in self._frames.feed(state.get("rest", b"")):
            raise ProtocolError(f"a whole frame of {len(frame)} bytes was left over")
