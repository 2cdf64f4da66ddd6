"""Whether a link is stalled: written bytes have waited too long for their acknowledgement."""

from __future__ import annotations

from collections.abc import Callable

from zbridge.transport.link import STALLED_S, Link

CHECK_S = 0.05
"""Seconds between two checks of a stalled link."""


class Stalls:
    """The stalls of one link. ``notify``: called when one begins (True) and ends (False). ``clock``: the loop's."""

    def __init__(self, clock: Callable[[], float], notify: Callable[[bool], object]) -> None:
        self.blocked = False
        """Whether nothing is written because the link is stalled."""
        self._clock = clock
        self._notify = notify

    def __repr__(self) -> str:
        return f"<Stalls {'blocked' if self.blocked else 'none'}>"

    def accepts(self, link: Link) -> bool:
        """Return whether the link is not stalled. A stall ends when the last byte is acknowledged."""
        waited_s = link.unacknowledged_s
        blocked = waited_s > (0.0 if self.blocked else STALLED_S)
        if blocked is not self.blocked:
            self.blocked = blocked
            self._notify(blocked)
        return not blocked

    def next(self, deadline: float | None, link: Link | None) -> float | None:
        """Return the next time to act: the session's deadline, or the next check for a stall."""
        waited_s = link.unacknowledged_s if link is not None else 0.0
        if not waited_s and not self.blocked:
            return deadline
        check_at = self._clock() + (CHECK_S if self.blocked else max(0.0, STALLED_S - waited_s) + CHECK_S / 10)
        return check_at if deadline is None else min(deadline, check_at)
