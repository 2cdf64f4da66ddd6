"""When a link is read: not while it is paused, nor while its share of a processor is used up. Knows no session."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from zbridge.metrics import Histogram
from zbridge.transport.link import Link

BURST_S = 0.02
"""Seconds of work that may be done at once after a quiet time."""
TIMED_S = 0.05
"""Least seconds between two reads that are timed."""


class FairShare:
    """Allows ``part`` seconds of work a second for long, and :data:`BURST_S` at once."""

    def __init__(self, part: float) -> None:
        self._part = part
        self._left_s = BURST_S
        self._at: float | None = None

    def __repr__(self) -> str:
        return f"<FairShare {self._part:g}, {self._left_s:.3f} s left>"

    def spent(self, work_s: float, now: float) -> float:
        """Note work that ended now; return for how many seconds no more may be begun."""
        idle_s = now - self._at if self._at is not None else 0.0
        self._left_s = min(BURST_S, self._left_s + idle_s * self._part) - work_s
        self._at = now
        return max(0.0, -self._left_s / self._part)


class ReadControl:
    """Pauses and resumes the reading of one link.

    ``share``: of a processor; None: unlimited. ``clock``: seconds on the loop's time line.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, clock: Callable[[], float], share: FairShare | None = None
    ) -> None:
        self.link: Link | None = None
        self.suspended = False
        """Whether another process has the connection, or may get it: then it is not read in any case."""
        self._loop = loop
        self._clock = clock
        self._share = share
        self._paused = False
        self._rests: asyncio.TimerHandle | None = None
        self.resumed: Callable[[], object] = lambda: None
        """Called when the link is read again."""

    def __repr__(self) -> str:
        return f"<ReadControl {'paused' if self._paused else 'rests' if self.rests else 'on'}>"

    @property
    def rests(self) -> bool:
        """Whether nothing is read because the share is used up."""
        return self._rests is not None

    @property
    def off(self) -> bool:
        """Whether nothing is read now."""
        return self._paused or self.rests

    def pause(self) -> None:
        """Read nothing until :meth:`resume`."""
        self._paused = True
        if self.link is not None:
            self.link.pause_reading()

    def resume(self) -> None:
        """Read again."""
        self._paused = False
        self._resume()

    def worked(self, begun: float) -> None:
        """Record work for the link that began at ``begun`` and ends now; pause if it exceeded the share."""
        if self._share is None:
            return
        now = self._clock()
        rest_s = self._share.spent(now - begun, now)
        if rest_s and self._rests is None and self.link is not None:
            self.link.pause_reading()
            self._rests = self._loop.call_later(rest_s, self._rested)

    def end(self) -> None:
        """Forget the link."""
        self.link = None
        if self._rests is not None:
            self._rests.cancel()
            self._rests = None

    def _rested(self) -> None:
        self._rests = None
        if not self._paused:
            self._resume()

    def _resume(self) -> None:
        if self.link is not None and self._rests is None and not self.suspended:
            self.link.resume_reading()
            self.resumed()


class ReadTimes:
    """Times reads that are :data:`TIMED_S` apart; to time each would cost too much. due: when the next is timed."""

    def __init__(self, seconds: Histogram | None) -> None:
        self.due = -math.inf if seconds is not None else math.inf
        self._seconds = seconds

    def __repr__(self) -> str:
        return f"<ReadTimes {self._seconds}>"

    def note(self, begun: float, now: float) -> None:
        """Note that a read is handed on, and when the next one is timed."""
        if self._seconds is not None:
            self._seconds.observe(now - begun)
            self.due = begun + TIMED_S


UNTIMED = ReadTimes(None)
"""Times nothing."""
