"""Stamps of fleet messages: which ones ROS can write, and a new one in a payload. Sans-IO."""

from __future__ import annotations

import struct

from msgspec import UnsetType

from zbridge.errors import PayloadError
from zbridge.fleet import payload as payloads
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


_NAME = b"\xa8stamp_ns\xcf"
"""The field as our encoder writes it: the first of the map, its number in 8 bytes."""
_AT = 1 + len(_NAME)
_MAPS = range(0x80, 0x90)
_LARGEST = 2**64 - 1


def with_stamp(payload: bytes, stamp_ns: int) -> bytes:
    """Return a payload with this stamp in place of its own; unchanged where it has none or cannot be read."""
    stamp_ns = min(max(stamp_ns, 0), _LARGEST)
    if payload[1:_AT] == _NAME and payload[0] in _MAPS and len(payload) >= _AT + 8:
        return payload[:_AT] + struct.pack(">Q", stamp_ns) + payload[_AT + 8 :]
    if b"stamp_ns" not in payload:
        return payload
    try:
        values = payloads.unpack(payload)
    except PayloadError:
        return payload
    return payloads.pack(values | {"stamp_ns": stamp_ns}) if "stamp_ns" in values else payload
