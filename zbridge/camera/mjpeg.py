"""Reads a camera's answer to a GET: an HTTP head, then pictures as parts of ``multipart/x-mixed-replace``. Sans-IO.

Theory of operation. :class:`MjpegReader` accepts bytes in any cut and returns whole parts. Its parser is a generator
that yields when it needs more bytes: for the blank line after the HTTP head, the first delimiter after any preamble,
and then for each part its delimiter and header, and as many bytes as Content-Length says, or, without a length, all up
to the next delimiter.

Every step has a bound; beyond it, or if bytes contradict the format, ProtocolError is raised and the reader must not be
used again. A part with a stated length is returned as soon as its last byte has arrived if it ends as a JPEG does;
otherwise only after the delimiter that must follow: a wrong length produces no broken picture.

Cameras differ from RFC 2046: the parameter ``boundary`` may hold the dashes of the delimiter, the line break
before a delimiter, or between it and the header, may be missing, and lines may end with a bare LF.

``is_jpeg``, ``is_whole`` and ``jpeg_size`` inspect a JPEG without decoding it.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator

import msgspec

from zbridge.errors import ProtocolError

START = b"\xff\xd8\xff"
"""How every JPEG begins: the marker SOI, and the first byte of the next marker."""
END = b"\xff\xd9"
"""How a whole JPEG ends: the marker EOI. Some cameras pad it with zeros or a line break."""
_SEGMENTS = 64
_SCAN, _ALONE = 0xDA, (0x01, *range(0xD0, 0xD9))
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""The markers SOF0 to SOF15: between them stand DHT, JPG and DAC."""


def is_jpeg(data: bytes) -> bool:
    """Return whether the bytes begin as a JPEG does."""
    return data.startswith(START)


def is_whole(data: bytes) -> bool:
    """Return whether the bytes end as a JPEG does."""
    return data[-64:].rstrip(b"\0\r\n").endswith(END)


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height in pixels as the frame header says; None if none stands among the first segments."""
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


HEAD_BYTES = 16 * 1024
"""Most bytes of the HTTP head, of what precedes the first part, and of a part's header."""
PICTURE_BYTES = 4 * 1024 * 1024
"""Most bytes of one picture."""
_BREAKS = 4
"""Most bytes of line breaks between a picture and the next delimiter."""
_BLANK = re.compile(rb"\r?\n\r?\n")
_STATUS = re.compile(rb"HTTP/1\.[0-9] ([0-9]{3})[ \r\n]")
_BOUNDARY = re.compile(rb';\s*boundary\s*=\s*(?:"([!#-~]{1,72})"|([!#-:<-~]{1,72}))', re.IGNORECASE)
_LENGTH = re.compile(rb"[0-9]{1,9}")
_KINDS = (b"image/jpeg", b"image/jpg", b"image/pjpeg")


class MjpegPart(msgspec.Struct, frozen=True):
    """One picture. head: delimiter and header as the camera wrote them, with the blank line."""

    head: bytes
    jpeg: bytes


class MjpegReader:
    """Extracts the pictures from one camera's answer.

    head: the HTTP head with its blank line, once it has arrived. boundary: as the head names it. ended: the camera said
    that no part follows. rejected: parts that were no JPEG and were left out.
    """

    def __init__(self) -> None:
        self.head = self.boundary = b""
        self.ended = False
        self.rejected = 0
        self._buffer = bytearray()
        self._parts: list[MjpegPart] = []
        self._parser = self._parse()

    def __repr__(self) -> str:
        return f"<MjpegReader {len(self._buffer)} bytes{' ended' if self.ended else ''}>"

    def receive(self, data: bytes) -> list[MjpegPart]:
        """Add bytes; return the parts that are complete now. Raises ProtocolError."""
        self._buffer += data
        next(self._parser, None)
        parts, self._parts = self._parts, []
        return parts

    def _parse(self) -> Iterator[None]:
        self.head = yield from self._take_head("an HTTP head")
        self.boundary = _boundary(self.head)
        delimiter = yield from self._find_first()
        doubtful: MjpegPart | None = None
        while True:
            yield from self._await_delimiter(delimiter)
            if doubtful is not None:
                self._parts.append(doubtful)
            if self._buffer[len(delimiter) :].startswith(b"--"):
                self.ended = True
                self._buffer.clear()
                return
            head = yield from self._take_head("the header of a part")
            fields = _fields(head[len(delimiter) :])
            kind = fields.get(b"content-type", _KINDS[0]).partition(b";")[0].strip().lower()
            length = _length(fields)
            jpeg = yield from (self._take_open(delimiter) if length < 0 else self._take_sized(length))
            part, doubtful = MjpegPart(head, jpeg), None
            if kind not in _KINDS or not is_jpeg(jpeg):
                self.rejected += 1
            elif length < 0 or is_whole(jpeg):
                self._parts.append(part)
            else:
                doubtful = part

    # What the parser waits for

    def _take_head(self, what: str) -> Generator[None, None, bytes]:
        """Take all bytes through the next blank line."""
        searched = 0
        while True:
            found = _BLANK.search(self._buffer, searched)
            end = found.end() if found else len(self._buffer)
            if end > HEAD_BYTES:
                raise ProtocolError(f"{what} of more than {HEAD_BYTES} bytes")
            if found:
                return self._cut(end)
            searched = max(0, end - 3)
            yield

    def _find_first(self) -> Generator[None, None, bytes]:
        """Drop what precedes the first delimiter, and return the delimiter as the camera writes it."""
        written = [b"--" + self.boundary] + ([self.boundary] if self.boundary.startswith(b"--") else [])
        while True:
            for delimiter in written:
                at = self._buffer.find(delimiter)
                if at >= 0:
                    del self._buffer[:at]
                    return delimiter
            if len(self._buffer) > HEAD_BYTES:
                raise ProtocolError(f"no part within {HEAD_BYTES} bytes")
            yield

    def _await_delimiter(self, delimiter: bytes) -> Iterator[None]:
        """Drop line breaks, and wait for the delimiter and two more bytes."""
        breaks = 0
        while True:
            begin = bytes(self._buffer[: _BREAKS + 1])
            count = len(begin) - len(begin.lstrip(b"\r\n"))
            breaks += count
            if breaks > _BREAKS:
                raise ProtocolError(f"more than {_BREAKS} bytes of line breaks after a picture")
            del self._buffer[:count]
            if not delimiter.startswith(self._buffer[: len(delimiter)]):
                raise ProtocolError("no delimiter where a part ends: its Content-Length is wrong")
            if len(self._buffer) >= len(delimiter) + 2:
                return
            yield

    def _take_sized(self, length: int) -> Generator[None, None, bytes]:
        while len(self._buffer) < length:
            yield
        return self._cut(length)

    def _take_open(self, delimiter: bytes) -> Generator[None, None, bytes]:
        """Take a picture up to the next delimiter."""
        end, searched = b"\n" + delimiter, 0
        most = PICTURE_BYTES + 1  # with the carriage return before the delimiter
        while (at := self._buffer.find(end, searched)) < 0 and len(self._buffer) <= most + len(end):
            searched = max(0, len(self._buffer) - len(end))
            yield
        if at < 0 or at > most:
            raise ProtocolError(f"a picture of more than {PICTURE_BYTES} bytes")
        jpeg = self._cut(at).removesuffix(b"\r")
        del self._buffer[:1]
        return jpeg

    def _cut(self, count: int) -> bytes:
        """Remove this many bytes from the buffer."""
        cut = bytes(self._buffer[:count])
        del self._buffer[:count]
        return cut


def _boundary(head: bytes) -> bytes:
    """Read the boundary that an HTTP head names; raise ProtocolError if it promises no such stream."""
    status = _STATUS.match(head)
    if status is None:
        raise ProtocolError("the answer is not HTTP")
    if status[1] != b"200":
        raise ProtocolError(f"the answer is HTTP {status[1].decode()}")
    fields = _fields(head)
    for name in (b"transfer-encoding", b"content-encoding"):
        if fields.get(name, b"identity").lower() != b"identity":
            raise ProtocolError(f"the answer has a {name.decode()}, which nobody asked for")
    kind = fields.get(b"content-type", b"")
    if not kind.lower().startswith(b"multipart/"):
        raise ProtocolError("the answer is not multipart/x-mixed-replace")
    found = _BOUNDARY.search(kind)
    if found is None:
        raise ProtocolError("the answer names no boundary")
    boundary: bytes = found[1] or found[2]
    return boundary


def _fields(head: bytes) -> dict[bytes, bytes]:
    """Read the fields of a head, names in lower case; the first of a name counts. Other lines are ignored."""
    fields: dict[bytes, bytes] = {}
    for line in head.split(b"\n"):
        name, colon, value = line.partition(b":")
        if colon:
            fields.setdefault(name.strip().lower(), value.strip())
    return fields


def _length(fields: dict[bytes, bytes]) -> int:
    """Return the length of a part; -1 if its header states none."""
    text = fields.get(b"content-length")
    if text is None:
        return -1
    if not _LENGTH.fullmatch(text):
        raise ProtocolError("a Content-Length that is no number of bytes")
    if int(text) > PICTURE_BYTES:
        raise ProtocolError(f"a picture of {int(text)} bytes exceeds {PICTURE_BYTES}")
    return int(text)
