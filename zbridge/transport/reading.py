"""When a link is read: not while it is paused, nor while its share of a processor is used up. Knows no session."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from zbridge.transport.fair_share import FairShare
from zbridge.transport.link import Link


class Reading:
    """Pauses and resumes the reading of one link.

    ``share``: of a processor; None: as much as there is. ``clock``: seconds on the loop's time line.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, clock: Callable[[], float], share: FairShare | None = None
    ) -> None:
        self.link: Link | None = None
        self.suspended = False
        """Whether another process has the connection, or may get it: then it is not read, whatever else is said."""
        self._loop = loop
        self._clock = clock
        self._share = share
        self._paused = False
        self._rests: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<Reading {'paused' if self._paused else 'rests' if self.rests else 'on'}>"

    @property
    def rests(self) -> bool:
        """Whether nothing is read because the share is used up."""
        return self._rests is not None

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
        """Note work for the link that began at ``begun`` and ends now; rest where it was more than the share."""
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
