"""Detects that the process of a listener did not run for a while, so that queued input causes no motion. Sans-IO."""

from __future__ import annotations

import math
from collections.abc import Callable

FROZEN_S = 0.6
"""Seconds without a beat after which the process counts as frozen: what its clients sent meanwhile is stale."""
CATCH_UP_S = 0.3
"""Seconds after a freeze for which input still counts as stale."""
FROZEN = "the gateway was frozen"


class FreezeWatch:
    """Watches the beats of an event loop. ``frozen`` is called with the seconds that a freeze lasted, once for each.

    suspended_s: seconds for which the machine was suspended so far, which the time of the loop does not count.
    """

    def __init__(
        self, now: float, frozen: Callable[[float], None], suspended_s: Callable[[], float] = lambda: 0.0
    ) -> None:
        self._suspended_s = suspended_s
        self._beat_at = now + suspended_s()
        self._stale_until = -math.inf
        self._frozen = frozen

    def __repr__(self) -> str:
        return f"<FreezeWatch beat at {self._beat_at:.1f}, stale until {self._stale_until:.1f}>"

    def begin(self, now: float) -> None:
        """Watch from now on; earlier time is not counted."""
        self._beat_at = now + self._suspended_s()

    def beat(self, now: float) -> None:
        """Record that the event loop runs; call it several times within :data:`FROZEN_S`."""
        self.stale(now)
        self.begin(now)

    def stale(self, now: float) -> bool:
        """Return True just after a freeze: input may have been queued meanwhile and must not cause motion."""
        frozen_s = now + self._suspended_s() - self._beat_at
        if frozen_s >= FROZEN_S:
            self.begin(now)
            self._stale_until = now + CATCH_UP_S
            self._frozen(frozen_s)
        return now < self._stale_until
