"""What cameras write: the answer of a legacy robot's ``/stream.mjpg``, and JPEGs as small as they can be.

The answer has the form of the server of the Raspberry Pi's camera library, which serves this path at this port (its
example "Web streaming"): no page of ours has a capture.
"""

from __future__ import annotations

CRLF = b"\r\n"
HEAD = CRLF.join(
    (
        b"HTTP/1.0 200 OK",
        b"Server: BaseHTTP/0.6 Python/3.7.3",
        b"Date: Sat, 01 Jan 2022 12:00:00 GMT",
        b"Age: 0",
        b"Cache-Control: no-cache, private",
        b"Pragma: no-cache",
        b"Content-Type: multipart/x-mixed-replace; boundary=FRAME",
        b"",
        b"",
    )
)


def jpeg(number: int = 0, size: int = 64, width: int = 640, height: int = 480) -> bytes:
    """Make bytes with the markers of a baseline JPEG (SOI, APP0, SOF0, SOS, EOI) around a number and a filling."""
    app0 = bytes.fromhex("ffe0 0010 4a46494600 0101 00 0001 0001 00 00")
    sof0 = bytes.fromhex("ffc0 000b 08") + height.to_bytes(2, "big") + width.to_bytes(2, "big") + b"\x01\x01\x11\x00"
    sos = bytes.fromhex("ffda 0008 01 01 00 00 3f 00")
    return b"\xff\xd8" + app0 + sof0 + sos + number.to_bytes(4, "big") + b"\x55" * size + b"\xff\xd9"


def part(picture: bytes) -> bytes:
    """Write a picture as a legacy robot does."""
    length = str(len(picture)).encode()
    return b"--FRAME\r\nContent-Type: image/jpeg\r\nContent-Length: " + length + b"\r\n\r\n" + picture + CRLF
