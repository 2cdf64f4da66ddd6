"""Reads a camera's answer to a GET: an HTTP head, then pictures as parts of ``multipart/x-mixed-replace``. Sans-IO.

Theory of operation. :class:`MjpegReader` takes bytes as they come and gives whole parts. It is in one of five steps:

====== ========================================= ==========================
step   waits for                                 next
====== ========================================= ==========================
ANSWER the blank line after the HTTP head        FIRST
FIRST  the first delimiter, after any preamble   HEAD
HEAD   delimiter and header of a part            SIZED or OPEN
SIZED  so many bytes as Content-Length says      HEAD
OPEN   the next delimiter, where no length came  HEAD
====== ========================================= ==========================

Every step has a bound; beyond it, or where bytes contradict the form, ProtocolError is raised and the reader must not
be used again. A part of a stated length is given as soon as its last byte has come if it ends as a JPEG does; else only
after the delimiter that has to follow: a wrong length gives no broken picture.

Cameras differ from RFC 2046: the parameter ``boundary`` may hold the dashes of the delimiter, no line break need stand
before a delimiter or between it and the header, and lines may end with a bare LF.

``is_jpeg``, ``is_whole`` and ``jpeg_size`` say what a JPEG's bytes tell without being decoded.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from enum import Enum

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
    """Tell whether the bytes begin as a JPEG does."""
    return data.startswith(START)


def is_whole(data: bytes) -> bool:
    """Tell whether the bytes end as a JPEG does."""
    return data[-64:].rstrip(b"\0\r\n").endswith(END)


def jpeg_size(data: bytes) -> tuple[int, int] | None:
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


HEAD_BYTES = 16 * 1024
"""Bound of the HTTP head, of what precedes the first part, and of a part's header."""
PICTURE_BYTES = 4 * 1024 * 1024
"""Bound of one picture."""
_BREAKS = 4
"""Bytes of line breaks that may stand between a picture and the next delimiter."""
_BLANK = re.compile(rb"\r?\n\r?\n")
_STATUS = re.compile(rb"HTTP/1\.[0-9] ([0-9]{3})[ \r\n]")
_BOUNDARY = re.compile(rb';\s*boundary\s*=\s*(?:"([!#-~]{1,72})"|([!#-:<-~]{1,72}))', re.IGNORECASE)
_LENGTH = re.compile(rb"[0-9]{1,9}")
_KINDS = (b"image/jpeg", b"image/jpg", b"image/pjpeg")


class MjpegPart(msgspec.Struct, frozen=True):
    """One picture. head: delimiter and header as the camera wrote them, with the blank line."""

    head: bytes
    jpeg: bytes


class MjpegStep(Enum):
    """What a reader waits for."""

    ANSWER = "the HTTP head"
    FIRST = "the first part"
    HEAD = "a part"
    SIZED = "a picture of a stated length"
    OPEN = "a picture and the delimiter after it"


class MjpegReader:
    """Cuts the pictures out of one camera's answer.

    head: the HTTP head with its blank line, once it has come. boundary: as the head names it. ended: the camera said
    that no part follows. rejected: parts that were no JPEG and were left out.
    """

    def __init__(self) -> None:
        self.head = self.boundary = b""
        self.ended = False
        self.rejected = 0
        self.step = MjpegStep.ANSWER
        self._delimiter = b""
        self._part_head = b""
        self._length = 0
        self._is_image = True
        self._doubtful: MjpegPart | None = None
        self._buffer = bytearray()
        self._searched = self._breaks = 0
        self._parts: list[MjpegPart] = []

    def __repr__(self) -> str:
        return f"<MjpegReader waits for {self.step.value}, {len(self._buffer)} bytes>"

    def receive(self, data: bytes) -> list[MjpegPart]:
        """Take bytes; return the parts that are whole now. Raises ProtocolError."""
        self._buffer += data
        while not self.ended and _STEPS[self.step](self):
            pass
        parts, self._parts = self._parts, []
        return parts

    # One method for each step; True: it is done, continue with the next

    def _read_answer(self) -> bool:
        head = self._take_head("an HTTP head")
        if head is None:
            return False
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
        boundary = _BOUNDARY.search(kind)
        if boundary is None:
            raise ProtocolError("the answer names no boundary")
        self.head, self.boundary, self.step = head, boundary[1] or boundary[2], MjpegStep.FIRST
        return True

    def _read_first(self) -> bool:
        written = (b"--" + self.boundary, *((self.boundary,) if self.boundary.startswith(b"--") else ()))
        for delimiter in written:
            at = self._buffer.find(delimiter)
            if at >= 0:
                self._delimiter, self.step = delimiter, MjpegStep.HEAD
                self._drop(at)
                return True
        if len(self._buffer) > HEAD_BYTES:
            raise ProtocolError(f"no part within {HEAD_BYTES} bytes")
        return False

    def _read_head(self) -> bool:
        self._skip_breaks()
        if not self._begins_with_delimiter():
            return False
        end = len(self._delimiter) + 2
        if self._buffer[end - 2 : end] == b"--":
            self.ended = True
            self._buffer.clear()
            return False
        head = self._take_head("the header of a part")
        if head is None:
            return False
        fields = _fields(head[len(self._delimiter) :])
        kind = fields.get(b"content-type", _KINDS[0]).partition(b";")[0].strip().lower()
        self._part_head, self._is_image, self._length = head, kind in _KINDS, _length(fields)
        self.step = MjpegStep.OPEN if self._length < 0 else MjpegStep.SIZED
        return True

    def _read_sized(self) -> bool:
        if len(self._buffer) < self._length:
            return False
        self._finish(bytes(self._buffer[: self._length]), followed=False)
        self._drop(self._length)
        return True

    def _read_open(self) -> bool:
        delimiter = b"\n" + self._delimiter
        at = self._buffer.find(delimiter, self._searched)
        most = PICTURE_BYTES + 1  # with the carriage return before the delimiter
        if at < 0 and len(self._buffer) <= most + len(delimiter):
            self._searched = max(0, len(self._buffer) - len(delimiter))
            return False
        if at < 0 or at > most:
            raise ProtocolError(f"a picture of more than {PICTURE_BYTES} bytes")
        self._finish(bytes(self._buffer[:at]).removesuffix(b"\r"), followed=True)
        self._drop(at + 1)
        return True

    # What steps share

    def _skip_breaks(self) -> None:
        """Leave out the line breaks between a picture and the next delimiter."""
        begin = bytes(self._buffer[: _BREAKS + 1])
        count = len(begin) - len(begin.lstrip(b"\r\n"))
        self._breaks += count
        if self._breaks > _BREAKS:
            raise ProtocolError(f"more than {_BREAKS} bytes of line breaks after a picture")
        if count:
            self._drop(count)

    def _begins_with_delimiter(self) -> bool:
        """Tell whether the delimiter has come, and give the part that it confirms; False: too few bytes."""
        known = self._buffer[: len(self._delimiter)]
        if not self._delimiter.startswith(known):
            raise ProtocolError("no delimiter where a part ends: its Content-Length is wrong")
        if len(self._buffer) < len(self._delimiter) + 2:
            return False
        if self._doubtful is not None:
            self._parts.append(self._doubtful)
            self._doubtful = None
        return True

    def _finish(self, jpeg: bytes, *, followed: bool) -> None:
        self.step, self._breaks = MjpegStep.HEAD, 0
        if not (self._is_image and is_jpeg(jpeg)):
            self.rejected += 1
        elif followed or is_whole(jpeg):
            self._parts.append(MjpegPart(self._part_head, jpeg))
        else:
            self._doubtful = MjpegPart(self._part_head, jpeg)

    def _take_head(self, what: str) -> bytes | None:
        """Take all bytes through the next blank line; None: it has not come yet."""
        found = _BLANK.search(self._buffer, self._searched)
        end = found.end() if found else len(self._buffer)
        if end > HEAD_BYTES:
            raise ProtocolError(f"{what} of more than {HEAD_BYTES} bytes")
        if found is None:
            self._searched = max(0, end - 3)
            return None
        head = bytes(self._buffer[:end])
        self._drop(end)
        return head

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._searched = 0


def _fields(head: bytes) -> dict[bytes, bytes]:
    """Read the fields of a head, names in small letters; the first of a name counts. Other lines are left out."""
    fields: dict[bytes, bytes] = {}
    for line in head.split(b"\n"):
        name, colon, value = line.partition(b":")
        if colon:
            fields.setdefault(name.strip().lower(), value.strip())
    return fields


def _length(fields: dict[bytes, bytes]) -> int:
    """Return the length of a part; -1 where its header states none."""
    text = fields.get(b"content-length")
    if text is None:
        return -1
    if not _LENGTH.fullmatch(text):
        raise ProtocolError("a Content-Length that is no number of bytes")
    if int(text) > PICTURE_BYTES:
        raise ProtocolError(f"a picture of {int(text)} bytes exceeds {PICTURE_BYTES}")
    return int(text)


_STEPS: dict[MjpegStep, Callable[[MjpegReader], bool]] = {
    MjpegStep.ANSWER: MjpegReader._read_answer,
    MjpegStep.FIRST: MjpegReader._read_first,
    MjpegStep.HEAD: MjpegReader._read_head,
    MjpegStep.SIZED: MjpegReader._read_sized,
    MjpegStep.OPEN: MjpegReader._read_open,
}
