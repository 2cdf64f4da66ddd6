"""The rhythm of a simulated peer: one tick every period, and how late this process was."""

from __future__ import annotations

import asyncio
import time


class Ticker:
    """Ticks every ``period_s`` seconds, the first time after ``first_s`` (default: a period).

    A late tick delays those after it. ``catch_up_s``: lost time that ticks in quick succession make up for.
    """

    def __init__(self, period_s: float, *, first_s: float | None = None, catch_up_s: float = 0.0) -> None:
        self.passed_s = 0.0
        """Seconds between the last two ticks; before the second one, since the ticker was made."""
        self.late_s = 0.0
        """Seconds by which this process slept too long before the last tick."""
        self._period_s, self._catch_up_s = period_s, catch_up_s
        self._last = time.monotonic()
        self._due = self._last + (period_s if first_s is None else first_s)

    def __repr__(self) -> str:
        return f"<Ticker every {self._period_s:g} s, {self.late_s:.3f} s late>"

    async def tick(self) -> None:
        """Sleep until the next tick is due."""
        due = max(self._due, time.monotonic() - self._catch_up_s)
        await asyncio.sleep(due - time.monotonic())
        now = time.monotonic()
        self.passed_s, self.late_s = now - self._last, now - due
        self._last, self._due = now, due + self._period_s
