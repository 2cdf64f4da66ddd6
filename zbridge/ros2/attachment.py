"""What stands beside each sample, request and reply: its number, its time, and who sent it. 33 bytes."""

from __future__ import annotations

import struct

import msgspec

from zbridge.errors import ProtocolError

_FORMAT = struct.Struct("<qqB16s")
GID_BYTES = 16
_NAMED = b"\x0fsequence_number"
"""How attachments began that rmw_zenoh wrote before its release 0.2.5 (jazzy) and 0.1.2 (humble)."""


class Attachment(msgspec.Struct, frozen=True):
    """number: from 1, rising with each message of a publisher. stamp_ns: when it was sent, Unix nanoseconds.

    gid: 16 bytes, of the publisher's or client's token.
    """

    number: int
    stamp_ns: int
    gid: bytes

    def encode(self) -> bytes:
        """Write it; numbers beyond 64 bits raise struct.error."""
        return _FORMAT.pack(self.number, self.stamp_ns, GID_BYTES, self.gid)


def read_attachment(data: bytes | None) -> Attachment:
    """Read it; raise ProtocolError if it is missing, has another length, or negative numbers."""
    if data is not None and data.startswith(_NAMED):
        raise ProtocolError("attachment of an old rmw_zenoh: expected 0.2.5 (jazzy), 0.1.2 (humble) or later")
    if data is None or len(data) != _FORMAT.size:
        raise ProtocolError(f"attachment of {len(data or b'')} bytes: expected {_FORMAT.size}")
    number, stamp_ns, length, gid = _FORMAT.unpack(data)
    if length != GID_BYTES or number < 0 or stamp_ns < 0:
        raise ProtocolError(f"attachment: number {number}, time {stamp_ns}, gid of {length} bytes")
    return Attachment(number, stamp_ns, gid)
