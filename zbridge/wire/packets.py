r"""Packets with a head, a count and a checksum, cut from a stream that may be damaged. Sans-IO.

    head   count   body ...   checksum

:class:`Packets` reads, writes and frames the packets of a protocol; every part of the layout is an argument.

Theory of operation. A stream that was damaged is searched for the next packet, from its head on. The bytes before it
are noise: they are cut into frames of their own, for which :meth:`Packets.body` raises ProtocolError, so they are
counted and dropped. What looks like a packet and has a wrong checksum is noise up to the next head *behind its own*,
not up to the end that its count claims: a wrong count, or a head within a body, costs no packet but its own. A wrong
count delays the following packets by at most ``most`` bytes; it does not lose them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from zbridge.errors import EncodeError, ProtocolError

Checksum = Callable[[bytes], bytes]
"""``checksum(data)``: the bytes that follow ``data``, a packet up to there, always of the same length."""

_QUOTED = 40


class Packets:
    r"""The packets of one protocol.

    head: the bytes that begin each packet. count: the :mod:`struct` code of the field that follows the head, with its
    byte order (``"B"``, ``"<H"``). uncounted: bytes of a packet that the count leaves out. checksum: computes the bytes
    at the end from all bytes before them; it must accept any bytes. most: bytes of the longest packet.

    ARCOS: ``Packets(b"\xfa\xfb", "B", uncounted=3, checksum=arcos_checksum, most=208)``.
    """

    def __init__(self, head: bytes, count: str, *, uncounted: int, checksum: Checksum, most: int) -> None:
        self._head, self._count = head, struct.Struct(count)
        self._body_at = len(head) + self._count.size
        self._uncounted, self._checksum, self.most = uncounted, checksum, most
        self._sum_bytes = len(checksum(head + bytes(self._count.size)))
        self._least = self._body_at + self._sum_bytes
        if not head or most < self._least:
            raise ValueError(f"head {head!r}, most {most}: expected a byte or more, and {self._least} or more")

    def __repr__(self) -> str:
        return f"<Packets {self._head!r} {self._count.format}, {self.most} bytes at most>"

    def end(self, data: bytes, start: int) -> int:
        """Find where the packet, or the noise, that begins at ``start`` ends; beyond ``data`` while that is unknown."""
        if not data.startswith(self._head, start):
            begun = len(data) - start < len(self._head) and self._head.startswith(data[start:])
            return start + len(self._head) if begun else self._noise_end(data, start)
        if start + self._body_at > len(data):
            return start + self._body_at
        end = start + self._size(data, start)
        if not self._least <= end - start <= self.most:
            return self._noise_end(data, start)
        return end if end > len(data) or self._is_sound(data[start:end]) else self._noise_end(data, start)

    def body(self, frame: bytes) -> bytes:
        """Return the body of a packet; raise ProtocolError for noise and for a wrong checksum."""
        whole = frame.startswith(self._head) and len(frame) >= self._least and self._size(frame, 0) == len(frame)
        if not whole:
            raise ProtocolError(f"no packet: {_shown(frame)}")
        end = len(frame) - self._sum_bytes
        if not self._is_sound(frame):
            expected = self._checksum(frame[:end])
            raise ProtocolError(f"checksum {frame[end:].hex()}, expected {expected.hex()}: {_shown(frame)}")
        return frame[self._body_at : end]

    def packet(self, body: bytes) -> bytes:
        """Write a body as a packet; raise EncodeError if it is too long."""
        size = self._body_at + len(body) + self._sum_bytes
        try:
            count = self._count.pack(size - self._uncounted)
        except struct.error as error:
            raise EncodeError(f"a packet of {size} bytes: {error}") from error
        if size > self.most:
            raise EncodeError(f"a packet of {size} bytes, expected {self.most} at most")
        begun = self._head + count + body
        return begun + self._checksum(begun)

    def seal(self, frame: bytes) -> bytes:
        """Recompute head, count and checksum of a damaged packet, for fuzzing."""
        return self.packet(frame[self._body_at : len(frame) - self._sum_bytes])

    def _size(self, data: bytes, start: int) -> int:
        (count,) = self._count.unpack_from(data, start + len(self._head))
        return int(count) + self._uncounted

    def _is_sound(self, packet: bytes) -> bool:
        end = len(packet) - self._sum_bytes
        return self._checksum(packet[:end]) == packet[end:]

    def _noise_end(self, data: bytes, start: int) -> int:
        """Find the next place behind ``start`` where a packet may begin; long noise is cut into several frames."""
        found = data.find(self._head, start + 1)
        if found < 0:
            sizes = range(min(len(self._head) - 1, len(data) - start - 1), 0, -1)
            found = len(data) - next((size for size in sizes if data.endswith(self._head[:size])), 0)
        return min(found, start + self.most)


def _shown(frame: bytes) -> str:
    more = f" and {len(frame) - _QUOTED} bytes more" if len(frame) > _QUOTED else ""
    return f"{frame[:_QUOTED].hex(' ')}{more}"
