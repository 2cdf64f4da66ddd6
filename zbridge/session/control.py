"""Control authority: what may move the robot, and when it must be stopped. Sans-IO.

This is where the lease will sit; the deadman is here from the first day. Motion that is not renewed within
``deadman_s`` ends with a stop. After a stop, of whatever cause, only a neutral drive makes motion possible
again: nobody's stale stick moves a robot that has just been stopped.

    state      motion             neutral   stop, deadman, robot or bus lost
    free       applied            applied   -> stopped
    stopped    refused            -> free   stopped
"""

from __future__ import annotations

import math
from collections import OrderedDict

from zbridge.errors import Refused
from zbridge.fleet.messages import Control, Refusal

REFUSALS = 16
"""Different refusals that ``control`` shows; the oldest makes room."""


_NAMED, _EXPLAINED = 64, 200
"""Characters of a command's name and of a reason that are kept."""


class Authority:
    """Decides on commands and watches over motion. ``deadman_s``: seconds that motion outlives its command."""

    def __init__(self, deadman_s: float) -> None:
        self.deadman_s = deadman_s
        self.moving = False
        self.on_its_own = False
        """Whether the robot was told to move without being driven: no deadman, but every other stop."""
        self.stop_reason: str | None = None
        self._stop_at = math.inf
        self._refusals: OrderedDict[tuple[str | None, str, str], int] = OrderedDict()

    def __repr__(self) -> str:
        return f"<Authority {'moving' if self.moving else self.stop_reason or 'free'}>"

    def admit(self, *, moving: bool) -> None:
        """Raise Refused where a drive command must not be carried out now."""
        if moving and self.stop_reason is not None:
            raise Refused(f"stopped ({self.stop_reason}): send a neutral drive first")

    def applied(self, *, moving: bool, now: float) -> None:
        """Take note of a drive command that was carried out."""
        self.moving = moving
        self._stop_at = now + self.deadman_s if moving else math.inf
        if not moving:
            self.stop_reason = None

    def stopped(self, reason: str) -> None:
        """Take note that the robot is being stopped, or is out of reach."""
        self.moving = self.on_its_own = False
        self._stop_at = math.inf
        self.stop_reason = reason

    def deadline(self) -> float | None:
        """Tell when :meth:`overdue` may become true."""
        return None if self._stop_at == math.inf else self._stop_at

    def overdue(self, now: float) -> bool:
        """Tell whether the robot moves without a fresh command."""
        return now >= self._stop_at

    def refuse(self, command: str, reason: str, who: str | None = None) -> None:
        """Count a refusal; it shows on ``control``."""
        key = (who, command[:_NAMED], reason[:_EXPLAINED])
        self._refusals[key] = self._refusals.pop(key, 0) + 1
        if len(self._refusals) > REFUSALS:
            self._refusals.popitem(last=False)

    def report(self) -> Control:
        """Say who drives and what was refused."""
        return Control(
            state="free" if self.stop_reason is None else "stopped",
            refusals=tuple(
                Refusal(who=who, command=command, reason=reason, count=count)
                for (who, command, reason), count in self._refusals.items()
            ),
        )
