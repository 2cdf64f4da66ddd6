"""Stamps of fleet messages: when a message was measured, and a new stamp in a payload. Sans-IO."""

from __future__ import annotations

import struct

from msgspec import UnsetType

from zbridge.errors import PayloadError
from zbridge.fleet import payload as payloads

_NAME = b"\xa8stamp_ns\xcf"
"""The field as our encoder writes it: the first of the map, its number in 8 bytes."""
_AT = 1 + len(_NAME)
_MAPS = range(0x80, 0x90)
_LARGEST = 2**64 - 1


def measured_ns(stamp_ns: int | UnsetType, now_ns: int, end_ns: int) -> int:
    """Return the stamp, Unix nanoseconds; ``now_ns`` where there is none, or none from 0 to before ``end_ns``."""
    return stamp_ns if isinstance(stamp_ns, int) and 0 <= stamp_ns < end_ns else now_ns


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
