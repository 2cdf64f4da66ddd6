"""What a JPEG's bytes say without being decoded. Sans-IO."""

from __future__ import annotations

START = b"\xff\xd8\xff"
"""How every JPEG begins: the marker SOI, and the first byte of the next marker."""
END = b"\xff\xd9"
"""How a whole JPEG ends: the marker EOI. Some cameras pad it with zeros or a line break."""
_SEGMENTS = 64
_SCAN, _ALONE = 0xDA, (0x01, *range(0xD0, 0xD9))
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""The markers SOF0 to SOF15: between them stand DHT, JPG and DAC."""


def is_jpeg(data: bytes) -> bool:
    """Tell whether the bytes begin as a JPEG does."""
    return data.startswith(START)


def is_whole(data: bytes) -> bool:
    """Tell whether the bytes end as a JPEG does."""
    return data[-64:].rstrip(b"\0\r\n").endswith(END)


def size(data: bytes) -> tuple[int, int] | None:
    """Return width and height in pixels as the frame header says; None where none stands among the first segments."""
    at = 2
    for _ in range(_SEGMENTS):
        if len(data) < at + 9 or data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker in _FRAMES:
            height, width = int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 7 : at + 9], "big")
            return (width, height) if width and height else None
        if marker == _SCAN:
            return None
        if marker == 0xFF:  # a fill byte
            at += 1
        else:
            at += 2 if marker in _ALONE else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None
