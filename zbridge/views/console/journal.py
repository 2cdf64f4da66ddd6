"""What the users of the console did: JSON lines, since stops and switches carry no user's name on the bus."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime

from zbridge.fleet.printable import as_json, shown
from zbridge.protocol.rate_limit import RateLimit
from zbridge.views.console.rights import Caller

FILE_BYTES, FILES = 10_000_000, 10
LINES, REFUSALS = (5.0, 100.0), (0.5, 20.0)
"""Lines a second of one user, and at once: nobody can rotate older lines away quickly. Others are counted."""
_TEXT = 300


class Journal:
    """Writes what was asked for, and what came of it. write: appends a line."""

    def __init__(
        self, write: Callable[[str], None] = lambda line: None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._write = write
        self._clock = clock
        self._rooms: dict[tuple[str, bool], RateLimit] = {}
        """By user, and whether it is a refusal: what strangers and others try takes no room of what a user does."""
        self._left_out = 0

    def __repr__(self) -> str:
        return f"<Journal, {self._left_out} lines left out>"

    def note(self, caller: Caller, action: str, robot: str = "", result: str = "", *, refused: bool = False) -> None:
        """Write one line: who, from where, what, of which robot (none: of all), and the result, or why not."""
        now_ns = time.time_ns()
        room = self._rooms.setdefault((caller.user, refused), RateLimit(*(REFUSALS if refused else LINES)))
        if not room.take(self._clock()):
            self._left_out += 1
            return
        fields = {
            "time": datetime.fromtimestamp(now_ns / 1e9, UTC).isoformat(timespec="milliseconds"),
            "user": shown(caller.user, _TEXT),
            "role": caller.role,
            "address": caller.address,
            "action": action,
            "robot": robot,
            "result": shown(f"refused: {result}" if refused else result, _TEXT),
            "left_out": self._left_out or None,
        }
        self._left_out = 0
        self._write(as_json({name: value for name, value in fields.items() if value}))
