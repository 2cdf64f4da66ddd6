"""When a message was measured, for ROS: within what ROS can write, and never from the future. Sans-IO."""

from __future__ import annotations

from msgspec import UnsetType

from zbridge.metrics import Metrics

AHEAD_NS = 1_000_000_000
"""A stamp may be so far ahead of our clock: clocks of machines differ."""
_LAST_NS = (2**31 - 1) * 1_000_000_000
"""From here on ROS has no number for a second."""


class Stamps:
    """Reads the stamps of fleet messages. One from the far future or that ROS cannot write becomes now; counted."""

    def __init__(self, metrics: Metrics) -> None:
        self._clamped = metrics.count("ros2_stamps_clamped")

    def __repr__(self) -> str:
        return f"<Stamps {self._clamped.value} clamped>"

    def read(self, stamp_ns: int | UnsetType, now_ns: int) -> int:
        """Return Unix nanoseconds; ``now_ns`` where there is no stamp."""
        if not isinstance(stamp_ns, int):
            return now_ns
        if stamp_ns < 0 or stamp_ns >= min(now_ns + AHEAD_NS, _LAST_NS):
            self._clamped.value += 1
            return now_ns
        return stamp_ns
