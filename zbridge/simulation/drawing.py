"""Draws JPEGs of grey squares, 8 x 8 pixels each: the least that any viewer shows (ITU-T T.81, baseline). Sans-IO."""

from __future__ import annotations

SIDE = 8
"""Pixels along a side of a square."""
_LENGTHS = (2, 3, 3, 3, 3, 3, 4, 5, 6)
_CODES = (0b00, 0b010, 0b011, 0b100, 0b101, 0b110, 0b1110, 0b11110, 0b111110)
"""The codes of the sizes of differences, 0 to 8 bits, as table K.3 has them."""
_TABLES = (
    bytes.fromhex("ffdb 0043 00") + bytes([SIDE]) * 64,  # a grey is the whole DC coefficient
    bytes.fromhex("ffc4 001f 00 00010501010101010100000000000000 000102030405060708090a0b"),
    bytes.fromhex("ffc4 0014 10 01000000000000000000000000000000 00"),  # one AC code: 0, the end of the square
)


def draw(greys: bytes, columns: int) -> bytes:
    """Draw squares, row by row, 0 black to 255 white, as a JPEG. Their number is a multiple of ``columns``."""
    height, width = len(greys) // columns * SIDE, columns * SIDE
    frame = bytes.fromhex("ffc0 000b 08") + height.to_bytes(2, "big") + width.to_bytes(2, "big")
    scan = bytes.fromhex("01 01 11 00 ffda 0008 01 01 00 00 3f 00")
    return b"".join((b"\xff\xd8", *_TABLES, frame, scan, _entropy(greys), b"\xff\xd9"))


def _entropy(greys: bytes) -> bytes:
    """Code the differences from square to square; fill up with ones, and mark bytes that look like a marker."""
    bits, length, before = 0, 0, 128
    for grey in greys:
        difference, before = grey - before, grey
        size = abs(difference).bit_length()
        value = difference if difference > 0 else difference + (1 << size) - 1
        bits = (bits << _LENGTHS[size] | _CODES[size]) << size | value
        bits, length = bits << 1, length + _LENGTHS[size] + size + 1
    padding = -length % 8
    bits = bits << padding | (1 << padding) - 1
    return bits.to_bytes((length + padding) // 8, "big").replace(b"\xff", b"\xff\x00")
