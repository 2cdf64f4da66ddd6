"""Messages that come often, as bytes that are filled in: rosbags takes several times as long. Sans-IO."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

_SECOND_NS = 1_000_000_000
_STAMP, _NUMBER = struct.Struct("<iI"), struct.Struct("<d")
_MARK = _NUMBER.unpack(b"\1" * 8)[0]
_MARKED_NS = int.from_bytes(b"\1" * 4, "little") * _SECOND_NS
"""A number and a stamp that differ from zero in their first byte."""
_CDR, _NO_INTENSITIES = b"\0\1\0\0", bytes(4)
"""What a message of CDR begins with, and the number of intensities of a scan."""


class MessageTemplate:
    """A message that is always the same, but for its stamp and some float64.

    write: a message as CDR. make: makes the message of a stamp in ns and ``count`` numbers. Where each of them stands
    is found by changing it alone.
    """

    def __init__(self, write: Callable[[Any], bytes], make: Callable[..., Any], count: int) -> None:
        zeros = (0.0,) * count
        self._plain = write(make(0, *zeros))
        self._stamp_at = self._place(write(make(_MARKED_NS, *zeros)))
        marked = ((*zeros[:number], _MARK, *zeros[number + 1 :]) for number in range(count))
        self._places = [self._place(write(make(0, *numbers))) for numbers in marked]

    def __repr__(self) -> str:
        return f"<MessageTemplate of {len(self._plain)} bytes, numbers at {self._places}>"

    def fill(self, stamp_ns: int, *numbers: float) -> bytes:
        """Write the message."""
        data = bytearray(self._plain)
        _STAMP.pack_into(data, self._stamp_at, *divmod(stamp_ns, _SECOND_NS))
        for place, number in zip(self._places, numbers, strict=True):
            _NUMBER.pack_into(data, place, number)
        return bytes(data)

    def _place(self, other: bytes) -> int:
        return next(at for at, (one, two) in enumerate(zip(self._plain, other, strict=True)) if one != two)


class ScanTemplate:
    """A LaserScan, whose definition is the same in all distributions. frame: of the scanner."""

    def __init__(self, frame: str) -> None:
        name = frame.encode() + b"\0"
        self._name = len(name), name
        self._before = struct.Struct(f"<4siII{len(name)}s{-len(name) % 4}x7fI")
        """What is before the ranges."""

    def __repr__(self) -> str:
        return f"<ScanTemplate of {self._name[1].decode()}>"

    def fill(self, stamp_ns: int, numbers: tuple[float, ...], ranges: bytes) -> bytes | None:
        """Write the message; None where a number is too large for a float32.

        numbers: angle_min, angle_max, angle_increment, time_increment, scan_time, range_min, range_max; ranges: float32
        little-endian.
        """
        stamp = divmod(stamp_ns, _SECOND_NS)
        try:
            before = self._before.pack(_CDR, *stamp, *self._name, *numbers, len(ranges) // 4)
        except OverflowError:
            return None
        return b"".join((before, ranges, _NO_INTENSITIES))
