"""Keep-alives and silence detection of a session. Sans-IO.

Theory of operation. A watch begins when a session is established, at the next timer. Every message that could be read
is a sign of life; noise is none. After ``silent_s`` without one the robot is not driven, after ``lost_s`` the session
ends. A conversation reads what waits before it runs timers that are late, and restarts the watch when it reads again
after a pause, so a gateway does not take its own pause for the robot's.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import msgspec

from zbridge.protocol.kept import Kept


class KeepAlive(msgspec.Struct, frozen=True):
    """A message that a session repeats from its establishment on: without it the robot stops, or hangs up.

    period_s: seconds between two of them. watchdog_s: seconds without one after which the robot acts, by its manual.
    """

    message: Any
    period_s: float
    watchdog_s: float


class SilenceWatch(Kept):
    """Judges the silence of one robot. ``silent_s``, ``lost_s``: as of :class:`Session`; None, ``inf``: never."""

    kept: ClassVar[dict[str, Any]] = {"_heard_at": float, "_silent": bool}

    def __init__(self, silent_s: float | None, lost_s: float | None) -> None:
        self.silent_s, self.lost_s = silent_s or math.inf, lost_s or math.inf
        self.on = min(self.silent_s, self.lost_s) < math.inf
        """Whether there is anything to judge."""
        self._silent = False
        self._heard_at = math.inf

    def __repr__(self) -> str:
        return f"<SilenceWatch {'silent' if self._silent else 'hears'}, {self.silent_s:g} s, {self.lost_s:g} s>"

    @property
    def due(self) -> float:
        """When :meth:`judge` will find something new; ``inf``: never."""
        return self._heard_at + (self.lost_s if self._silent else min(self.silent_s, self.lost_s))

    def begin(self) -> None:
        """Begin to watch, from the next :meth:`judge` or sign of life on."""
        self._heard_at = -math.inf if self.on else math.inf

    def restart(self, now: float) -> None:
        """Count from now: until now nothing was read, so nothing could come."""
        if self._heard_at < math.inf:
            self._heard_at = max(self._heard_at, now)

    def heard(self, now: float, busy: str | None) -> str | None:
        """Note a sign of life. Return ``busy``, None if this watch had set it."""
        self._heard_at, silent, self._silent = now, self._silent, False
        return None if silent and busy == _nothing_for(self.silent_s) else busy

    def judge(self, now: float, busy: str | None) -> tuple[str | None, str | None]:
        """Return why the peer is busy now (``busy`` if it was so already), and why the session must end, or None."""
        if self._heard_at == -math.inf:
            self._heard_at = now
        self._silent = self._silent or now >= self._heard_at + self.silent_s
        lost = _nothing_for(self.lost_s) if now >= self._heard_at + self.lost_s else None
        return busy or (_nothing_for(self.silent_s) if self._silent else None), lost


def _nothing_for(seconds: float) -> str:
    return f"nothing came for {seconds:g} s"
