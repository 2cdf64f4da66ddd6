"""Width and height of a JPEG, out of its markers."""

from __future__ import annotations

import pytest

from tests.camera.camera_bytes import jpeg
from zbridge.camera.mjpeg import is_whole, jpeg_size

SOI, SOF2 = b"\xff\xd8", bytes.fromhex("ffc2 0011 08 0438 0780 03")
SIZES: dict[str, tuple[bytes, tuple[int, int] | None]] = {
    "baseline": (jpeg(width=640, height=480), (640, 480)),
    "progressive, after a table": (SOI + bytes.fromhex("ffc4 0004 0000") + SOF2, (1920, 1080)),
    "fill bytes and a marker without a segment": (SOI + b"\xff\xff\xff\x01" + SOF2, (1920, 1080)),
    "no picture before the scan": (SOI + bytes.fromhex("ffda 0008 01 01 00 00 3f 00 00"), None),
    "no height: it comes later": (jpeg(height=0), None),
    "cut off": (jpeg()[:26], None),
    "no marker": (SOI + b"\x00" * 100, None),
    "a segment of no length, for ever": (SOI + b"\xff\xe0\x00\x00" * 1000, None),
    "markers for ever": (SOI + b"\xff\xd0" * 100_000, None),
    "nothing": (b"", None),
}


@pytest.mark.parametrize("name", SIZES)
def test_the_frame_header_tells_the_size(name: str) -> None:
    data, expected = SIZES[name]
    assert jpeg_size(data) == expected


@pytest.mark.parametrize(
    ("end", "whole"), [(b"\xff\xd9", True), (b"\xff\xd9\0\0\r\n", True), (b"\xff", False), (b"\xff\xd9x", False)]
)
def test_a_whole_jpeg_ends_with_its_marker(end: bytes, whole: bool) -> None:
    assert is_whole(jpeg().removesuffix(b"\xff\xd9") + end) is whole
