"""The five messages of ALF, each declared once for both dialects, and their framing.

Source: "Versions and dialects" of the protocol page. A field's type is its binary form; a comment marks a field whose
text form differs. Sans-IO.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from enum import Enum
from functools import partial
from typing import Annotated, ClassVar, TypeVar

import msgspec

from zbridge.protocol import Codec, ProtocolError, Role
from zbridge.wire import (
    F32,
    I32,
    U8,
    U32,
    BinaryCodec,
    Bool,
    Decimal,
    I64Fill,
    Message,
    Scalar,
    TextCodec,
    Whole,
)
from zbridge.wire.frames import FrameEnd

POINTS = 769
"""Points of a measurement of the legacy scanner."""
MOST_POINTS = 10_000
_MOST_MEASURED = 1e9
POINT_BYTES = 8


class AlfDialect(Enum):
    """The packed fields of the document, or the ASCII of legacy programs."""

    BINARY = "binary"
    TEXT = "text"


class AlfMessage(Message, frozen=True):
    """A message of this protocol."""

    spec: ClassVar[AlfSpec]


A = TypeVar("A", bound=AlfMessage)

Counter = Annotated[int, Scalar("I"), Whole(0, 2**63 - 1)]
"""A counter: 32 bits in binary, in text as large as the vehicle's own integers."""
Raw16 = Annotated[float, Scalar("h"), Decimal()]
"""A measured value: raw 16 bits in binary, a number in its unit in text."""
Speed = Annotated[int, Scalar("B"), Whole(0, 2**31 - 1)]
Steering = Annotated[int, Scalar("B"), Whole(-90, 90)]
"""Binary: 0 full left, 90 straight, 180 full right. Text: -90 full left, 90 full right."""


class AlfSpec(msgspec.Struct, frozen=True, eq=False):
    """A row of the message table. sender: None if both send it."""

    id: int
    name: str
    sender: Role | None
    message: type[AlfMessage]
    binary: BinaryCodec[AlfMessage]
    text: TextCodec[AlfMessage]


MESSAGES: dict[int, AlfSpec] = {}
"""The message table, by id."""


def message(message_id: int, name: str, sender: Role | None) -> Callable[[type[A]], type[A]]:
    """Enter a declaration into the message table."""

    def enter(declared: type[A]) -> type[A]:
        declared.spec = MESSAGES[message_id] = AlfSpec(
            message_id,
            name,
            sender,
            declared,
            BinaryCodec(declared),
            TextCodec(declared),
        )
        return declared

    return enter


@message(1, "measurement", Role.ROBOT)
class Measurement(AlfMessage, frozen=True, eq=False):
    """One sweep of the scanner. points: int64[n], mm; the valid indices are inclusive."""

    sequence: Counter
    timestamp_ms: Counter
    points: I64Fill
    first_valid: U32
    last_valid: U32


@message(2, "scanner init", Role.ROBOT)
class ScannerInit(AlfMessage, frozen=True):
    """The geometry of the scanner: degrees, ms, mm."""

    angle_min_deg: F32
    angle_max_deg: F32
    angle_increment_deg: F32
    time_increment_ms: I32
    range_min_mm: I32
    range_max_mm: I32

    def check(self) -> None:
        angles = (self.angle_min_deg, self.angle_max_deg, self.angle_increment_deg)
        if not all(map(math.isfinite, angles)) or not self.angle_increment_deg:
            raise ProtocolError(f"scanner init with angles {angles}")


@message(3, "drive command", Role.HQ)
class DriveCommand(AlfMessage, frozen=True):
    """How the vehicle shall move. ``direction``: 0 forward, 1 backward."""

    speed: Speed
    direction: U8
    steering: Steering
    light: Bool


@message(4, "drive info", Role.ROBOT)
class DriveInfo(AlfMessage, frozen=True):
    """How the vehicle moves. Accelerations: ``lateral`` to the right, ``vertical`` towards the ground."""

    speed: Speed
    longitudinal: Raw16
    lateral: Raw16
    vertical: Raw16
    gyro_x: Raw16
    gyro_y: Raw16
    gyro_z: Raw16
    temperature: F32

    def check(self) -> None:
        values = (self.longitudinal, self.lateral, self.vertical, self.gyro_x, self.gyro_y, self.gyro_z)
        if not all(abs(value) <= _MOST_MEASURED for value in (*values, self.temperature)):
            raise ProtocolError(f"drive info with {values} and temperature {self.temperature:g}")


@message(255, "end", None)
class End(AlfMessage, frozen=True):
    """The end of the conversation: both sides close."""

    always_1: U8 = 1

    def check(self) -> None:
        if self.always_1 != 1:
            raise ProtocolError(f"end with {self.always_1}, expected 1")


def sent_by(sender: Role) -> frozenset[int]:
    """List the ids that one side sends."""
    return frozenset(spec.id for spec in MESSAGES.values() if spec.sender in (sender, None))


# Text

_NUMBER = re.compile(rb"-?[0-9]*\.?[0-9]+")
_FIELD_BYTES = 24
_FIXED_FIELDS = 16
_TERMINATOR = b";"


def text_limit(points: int) -> int:
    """Return the length of the longest text message that is accepted, bytes."""
    return (points + _FIXED_FIELDS) * _FIELD_BYTES


def text_frame_end(limit: int) -> FrameEnd:
    """Make the framing function of the text dialect: up to the next ``;``, or ``limit`` bytes without one."""

    def frame_end(data: bytes, start: int) -> int:
        found = data.find(_TERMINATOR, start, start + limit)
        if found >= 0:
            return found + 1
        return start + limit if len(data) - start >= limit else len(data) + 1

    return frame_end


def read_text(frame: bytes, ids: frozenset[int]) -> AlfMessage:
    """Read one text message; raise ProtocolError if its id is not in ``ids`` or its fields are wrong."""
    if not frame.endswith(_TERMINATOR):
        raise ProtocolError(f"{len(frame)} bytes without ';'")
    number = _NUMBER.search(frame)
    if number is None:
        raise ProtocolError(f"message without an id: {frame[:_FIELD_BYTES]!r}")
    spec = _known(number.group(), ids)
    end = number.end()
    return spec.text.decode(frame[end + 1 if frame.startswith(b"|", end) else end : -1])


def write_text(message: AlfMessage) -> bytes:
    """Write one text message; raise EncodeError for a value that its type cannot carry."""
    spec = message.spec
    return b"%d|%b;" % (spec.id, spec.text.encode(message))


def _known(number: bytes, ids: frozenset[int]) -> AlfSpec:
    shown = number[:_FIELD_BYTES].decode()
    if not number.isdigit() or len(number) > 3 or int(number) not in ids:
        raise ProtocolError(f"message id {shown}, expected one of {sorted(ids)}")
    return MESSAGES[int(number)]


# Binary


def binary_size(message_id: int, points: int) -> int:
    """Return the length of a binary message with its id, bytes."""
    size = 1 + MESSAGES[message_id].binary.fixed_size
    return size + POINT_BYTES * points if message_id == Measurement.spec.id else size


def binary_frame_end(ids: frozenset[int], points: Callable[[], int]) -> FrameEnd:
    """Make the framing function of the binary dialect: the id sets the length, ``points()`` that of a measurement.

    Bytes that begin no message make a frame of their own, up to the next byte that might.
    """
    begins = re.compile(b"[" + re.escape(bytes(sorted(ids))) + b"]")

    def frame_end(data: bytes, start: int) -> int:
        message_id = data[start]
        if message_id in ids:
            return start + binary_size(message_id, points())
        found = begins.search(data, start, start + _SKIPPED)
        return found.start() if found else min(len(data), start + _SKIPPED)

    return frame_end


def read_binary(frame: bytes, ids: frozenset[int]) -> AlfMessage:
    """Read one binary message; raise ProtocolError if its id is not in ``ids`` or its fields are wrong."""
    if frame[0] not in ids:
        raise ProtocolError(f"{len(frame)} bytes that begin no message: id {frame[0]}, expected {sorted(ids)}")
    return MESSAGES[frame[0]].binary.decode(frame, 1)


def write_binary(message: AlfMessage) -> bytes:
    """Write one binary message; raise EncodeError for a value that its type cannot carry."""
    spec = message.spec
    return bytes((spec.id,)) + spec.binary.encode(message)


_SKIPPED = 4096
"""Bytes without a message that are skipped, and counted, as one."""


def codecs() -> tuple[Codec, ...]:
    """List the messages of both dialects and both sides for the conformance kit; one measurement has two points."""
    found = []
    for name, sender in (("vehicle", Role.ROBOT), ("hq", Role.HQ)):
        ids = sent_by(sender)
        whole = (DriveInfo(1, 2, 3, 4, 5, 6, 7, 0.5),) if sender is Role.ROBOT else ()
        messages = (*(MESSAGES[number].message for number in sorted(ids - {DriveInfo.spec.id})), *whole)
        end = binary_frame_end(ids, lambda: 2)
        found += [
            Codec(f"text, {name}", write_text, partial(read_text, ids=ids), text_frame_end(4096), messages),
            Codec(f"binary, {name}", write_binary, partial(read_binary, ids=ids), end, messages),
        ]
    return tuple(found)
