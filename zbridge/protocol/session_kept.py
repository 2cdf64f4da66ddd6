"""The part of a session that survives a restart of the gateway. Sans-IO."""

from __future__ import annotations

from collections import Counter
from typing import Any, ClassVar

import msgspec

from zbridge.errors import ProtocolError
from zbridge.protocol.kept import Budget, Exported, Kept
from zbridge.protocol.outbox import Outbox
from zbridge.protocol.rate_limit import RateLimit
from zbridge.protocol.session_states import State
from zbridge.protocol.traffic import Traffic
from zbridge.wire.frames import FrameBuffer, Partial

PARTIAL = "partial"
"""The name of the incomplete frame in a state."""
SKIPPED = "the rest of a frame whose beginning was lost with a gateway"
"""What a session counts as left out."""


class KeptSession(Kept):
    """The part of a session that another process can take over; a protocol adds its own attributes to ``kept``."""

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
    left_out: Counter[str]
    _frames: FrameBuffer

    def export(self, budget: Budget | None = None) -> Exported:
        """Write the state, with the incomplete frame.

        A deposit has no incomplete frame: it changes with every read, and who watches the reads adds it
        (:meth:`partial`).
        """
        state = super().export(budget)
        return state | {PARTIAL: list(self._frames.partial() or ())} if budget is None else state

    def partial(self, most_bytes: int) -> Partial | None:
        """Describe the incomplete frame in ``most_bytes`` at most; None if that is not possible."""
        return self._frames.partial(most_bytes)

    def restore(self, state: Exported) -> None:
        """Take over the state of the same session of another process; raise ProtocolError if it has another form.

        Call it instead of :meth:`open`, on a session newly made from the same settings.
        """
        super().restore(state)
        try:
            partial = Partial(*msgspec.convert(state.get(PARTIAL, (b"", 0)), tuple[bytes, int]))
        except msgspec.ValidationError as error:
            raise ProtocolError(f"incomplete frame: {error}") from error
        self._frames.resume(partial)
        if partial.skip:
            self.left_out[SKIPPED] += 1
