"""Frames of a link that is a Zenoh session: what a session declares and puts there, and what it receives. Sans-IO.

A protocol whose robots speak plain Zenoh declares ``Protocol(keyed=True)``. Its sessions then write and read these
frames where others write and read bytes; :mod:`zbridge.transport.zenoh_link` carries them out. Everything else stays
as it is: outbox, limits, states, taps.

=========== ==================================================== ==============================================
written     SUBSCRIBE, WATCH and ANNOUNCE declare until the      ``key``: an expression; ANNOUNCE: a liveliness
            link ends; WITHDRAW takes back what was declared     token; ``kept``: SUBSCRIBE wants the last samples
            on a key; KEEP and PUT put; WATCH again asks         from before, KEEP keeps its last one
            for the tokens that are there
read        OPENED first, and when the link was idle; SAMPLE;    ``stamp_ns``: when it came, Unix time
            APPEARED and GONE of watched tokens; DROPPED         ``payload``: OPENED the id of the Zenoh session,
                                                                 DROPPED how many samples, u32
=========== ==================================================== ==============================================
"""

from __future__ import annotations

import struct
from enum import IntEnum

import msgspec

from zbridge.errors import EncodeError, ProtocolError

_HEADER = struct.Struct("<IBHHq")
_NONE = 0xFFFF
"""Stands for no attachment."""
_COUNT = struct.Struct("<I")
SAMPLE_BYTES = 16 * 2**20
"""Most bytes of a frame: a map of 4000 x 4000 cells."""


class SampleKind(IntEnum):
    """The kind of a frame."""

    SUBSCRIBE = 1
    WATCH = 2
    ANNOUNCE = 3
    WITHDRAW = 4
    PUT = 5
    KEEP = 6
    OPENED = 16
    SAMPLE = 17
    APPEARED = 18
    GONE = 19
    DROPPED = 20


class KeyedSample(msgspec.Struct, frozen=True):
    """One frame. stamp_ns: when it was received, Unix nanoseconds; 0 in written frames."""

    kind: SampleKind
    key: str = ""
    payload: bytes = b""
    attachment: bytes | None = None
    stamp_ns: int = 0

    @property
    def count(self) -> int:
        """The number of samples that DROPPED reports; raises ProtocolError if it has none."""
        if len(self.payload) != _COUNT.size:
            raise ProtocolError(f"DROPPED of {len(self.payload)} bytes: expected {_COUNT.size}")
        return int(_COUNT.unpack(self.payload)[0])


def subscription(key: str, *, kept: bool = False) -> KeyedSample:
    """Make SUBSCRIBE. kept: the last samples that publishers have kept come first."""
    return KeyedSample(SampleKind.SUBSCRIBE, key, b"kept" if kept else b"")


def dropped(count: int) -> KeyedSample:
    """Make DROPPED."""
    return KeyedSample(SampleKind.DROPPED, payload=_COUNT.pack(min(count, 2**32 - 1)))


def write_sample(sample: KeyedSample) -> bytes:
    """Write a frame; raise EncodeError if key, attachment or payload is too long."""
    key, attachment = sample.key.encode(), sample.attachment
    shown = attachment or b""
    size = _HEADER.size + len(key) + len(shown) + len(sample.payload)
    if len(key) >= _NONE or len(shown) >= _NONE or size > SAMPLE_BYTES:
        raise EncodeError(f"{sample.key[:80]}: sample of {size} bytes, attachment of {len(shown)}")
    extra = _NONE if attachment is None else len(shown)
    return b"".join((_HEADER.pack(size, sample.kind, len(key), extra, sample.stamp_ns), key, shown, sample.payload))


def read_sample(frame: bytes) -> KeyedSample:
    """Read a frame; raise ProtocolError if it is none."""
    if sample_end(frame, 0) != len(frame):
        raise ProtocolError(f"sample of {len(frame)} bytes is cut off")
    _, kind, key_bytes, extra, stamp_ns = _HEADER.unpack_from(frame)
    shown_at = _HEADER.size + key_bytes
    payload_at = shown_at + (0 if extra == _NONE else extra)
    try:
        key = frame[_HEADER.size : shown_at].decode()
        return KeyedSample(
            SampleKind(kind), key, frame[payload_at:], None if extra == _NONE else frame[shown_at:payload_at], stamp_ns
        )
    except ValueError as error:
        raise ProtocolError(f"sample of {len(frame)} bytes: {error}") from error


def sample_end(data: bytes, start: int) -> int:
    """Find the end of the frame at ``start``; the framing function of these sessions."""
    if len(data) - start < _HEADER.size:
        return start + _HEADER.size
    size, _, key_bytes, extra, _ = _HEADER.unpack_from(data, start)
    if size < _HEADER.size + key_bytes + (0 if extra == _NONE else extra):
        raise ProtocolError(f"sample of {size} bytes with a key of {key_bytes}")
    return start + int(size)
