"""MAVLink frames: versions 1 and 2 are read, version 2 is written. Sans-IO.

Source: "Frames" of the protocol page. Theory of operation. The stream may be damaged. What cannot begin a frame, and
what fails its checksum, is cut off as noise up to the next marker behind the one that failed: a wrong byte costs no
frame but its own. A message that is not declared cannot be checked, nor can a frame whose end has not come: that frame
is *doubtful*. It gives way to a frame that begins within it and can be checked, so a wrong length delays nothing beyond
the next whole frame, and a marker in noise swallows none.
"""

from __future__ import annotations

import struct
from binascii import crc_hqx

import msgspec

from gateways.mavlink.messages import MESSAGES, MavlinkMessage
from zbridge.protocol import EncodeError, ProtocolError

MARKER, MARKER_1 = 0xFD, 0xFE
"""The first byte of a frame of version 2, and of version 1."""
SIGNED = 1
"""The only bit of ``incompat_flags`` that is known: a signature of 13 bytes follows the checksum."""
MOST_BYTES = 10 + 255 + 2 + 13
LIMIT_BYTES = 2 * MOST_BYTES
"""Most bytes that wait: a doubtful frame, and one that begins within it."""
HEADER, HEADER_1 = 10, 6
_SEQ_AT = 4
_SIGNATURE = 13
_QUOTED = 24
_REVERSED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))
_PREFIX = struct.Struct("<BBBBBBBHB")
_SEED = 0xFFFF


class MavlinkFrame(msgspec.Struct, frozen=True, gc=False):
    """A frame that was read. message: None if its id is not declared. seq: counts per sender, modulo 256."""

    message_id: int
    message: MavlinkMessage | None
    system: int
    component: int
    seq: int


def checksum(data: bytes, extra: bytes) -> int:
    """Compute CRC-16/MCRF4XX over what stands between marker and checksum, and CRC_EXTRA."""
    mirrored = crc_hqx((data + extra).translate(_REVERSED), _SEED)
    return _REVERSED[mirrored & 0xFF] << 8 | _REVERSED[mirrored >> 8]


def frame_end(data: bytes, start: int) -> int:
    """Find where the frame, or the noise, that begins at ``start`` ends; beyond ``data`` while that is unknown."""
    size = len(data)
    found = _header(data, start, size)
    if found is None:
        return _next_marker(data, start, size)
    end, payload_at, message_id = found
    spec = MESSAGES.get(message_id)
    if end > size or spec is None:
        return _doubtful_end(data, start, end, size)
    if _sum_matches(data, start, payload_at, end, spec.crc_extra):
        return end
    return _next_marker(data, start, size)


def read_frame(frame: bytes) -> MavlinkFrame:
    """Read one frame, as :func:`frame_end` cut it; raise ProtocolError for noise."""
    found = _header(frame, 0, len(frame)) if frame else None
    if found is None or found[0] != len(frame):
        raise ProtocolError(f"noise: {frame[:_QUOTED].hex(' ')}")
    _, payload_at, message_id = found
    payload = frame[payload_at : payload_at + frame[1]]
    if frame[0] == MARKER:
        seq, system, component = frame[4], frame[5], frame[6]
    else:
        seq, system, component = frame[2], frame[3], frame[4]
    spec = MESSAGES.get(message_id)
    if spec is None:
        return MavlinkFrame(message_id, None, system, component, seq)
    if not _sum_matches(frame, 0, payload_at, len(frame), spec.crc_extra):
        raise ProtocolError(f"wrong checksum: {frame[:_QUOTED].hex(' ')}")
    return MavlinkFrame(message_id, spec.decode(payload), system, component, seq)


def write_frame(message: MavlinkMessage, seq: int, system: int, component: int) -> bytes:
    """Write a message as a frame of version 2; raise EncodeError. seq: of the sender, its last 8 bits are written."""
    return frame_of(message.spec.id, message.spec.encode(message), message.spec.crc_extra, seq, system, component)


def frame_of(message_id: int, payload: bytes, crc_extra: bytes, seq: int, system: int, component: int) -> bytes:
    """Put a payload that was encoded into a frame."""
    try:
        ids = (seq & 0xFF, system, component, message_id & 0xFFFF, message_id >> 16)
        head = _PREFIX.pack(MARKER, len(payload), 0, 0, *ids)
    except struct.error as error:
        raise EncodeError(f"system {system}, component {component}: expected 0 to 255") from error
    crc = checksum(head[1:] + payload, crc_extra)
    return head + payload + crc.to_bytes(2, "little")


def numbered(frame: bytes, seq: int) -> bytes:
    """Return a frame that :func:`write_frame` wrote with another sequence number; what is no such frame as it is."""
    spec = MESSAGES.get(frame[7] | frame[8] << 8 | frame[9] << 16) if len(frame) > HEADER else None
    if spec is None:
        return frame
    changed = b"".join((frame[1:_SEQ_AT], bytes((seq & 0xFF,)), frame[_SEQ_AT + 1 : -2]))
    return b"".join((frame[:1], changed, checksum(changed, spec.crc_extra).to_bytes(2, "little")))


def _header(data: bytes, start: int, size: int) -> tuple[int, int, int] | None:
    """Return the end of a frame, where its payload begins, and its id; None if none can begin here.

    While the header is not there, the end is that of the shortest frame, beyond ``data``, and the id -1.
    """
    marker = data[start]
    if marker == MARKER:
        if size - start < HEADER:
            return start + HEADER + 2, start + HEADER, -1
        if data[start + 2] & ~SIGNED:
            return None
        end = start + HEADER + 2 + data[start + 1] + (_SIGNATURE if data[start + 2] else 0)
        return end, start + HEADER, data[start + 7] | data[start + 8] << 8 | data[start + 9] << 16
    if marker == MARKER_1:
        if size - start < HEADER_1:
            return start + HEADER_1 + 2, start + HEADER_1, -1
        return start + HEADER_1 + 2 + data[start + 1], start + HEADER_1, data[start + 5]
    return None


def _sum_matches(data: bytes, start: int, payload_at: int, end: int, crc_extra: bytes) -> bool:
    at = payload_at + data[start + 1]
    return checksum(data[start + 1 : at], crc_extra) == data[at] | data[at + 1] << 8


def _next_marker(data: bytes, start: int, size: int) -> int:
    """Return where the next marker is, at most a frame away."""
    most = min(size, start + MOST_BYTES)
    marker, marker_1 = data.find(MARKER, start + 1, most), data.find(MARKER_1, start + 1, most)
    return min((at for at in (marker, marker_1) if at >= 0), default=most)


def _doubtful_end(data: bytes, start: int, end: int, size: int) -> int:
    """Return where a frame that cannot be checked gives way to one that can; else its end, beyond ``data`` to wait."""
    waits = end > size
    at = _next_marker(data, start, size)
    while at < min(end, size):
        found = _header(data, at, size)
        if found is not None:
            inner_end, payload_at, message_id = found
            spec = MESSAGES.get(message_id)
            if inner_end > size:  # it is waited for if it may be one of ours: what is behind it waits too
                waits = waits or message_id < 0 or (spec is not None and data[at + 1] <= spec.size)
            elif spec is not None and _sum_matches(data, at, payload_at, inner_end, spec.crc_extra):
                return at
        at = _next_marker(data, at, size)
    return size + 1 if waits else end
