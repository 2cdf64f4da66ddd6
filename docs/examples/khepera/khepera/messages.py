"""The lines of the protocol: a letter and integers, separated by commas. Sans-IO.

An answer begins with the letter of its request in lower case.
"""

from __future__ import annotations

import re
from typing import Annotated, ClassVar

import msgspec

from zbridge.errors import EncodeError, ProtocolError
from zbridge.protocol.codec import Codec

LINE_BYTES = 128
"""Bytes of the longest line that is taken."""

Wheel = Annotated[int, msgspec.Meta(ge=-127, le=127)]
"""The speed of a wheel: 1 is 8 mm/s."""
Pulses = Annotated[int, msgspec.Meta(ge=-(2**31), le=2**31 - 1)]
"""What a wheel has turned: 1 is 0.08 mm on the ground."""
Light = Annotated[int, msgspec.Meta(ge=0, le=1023)]
"""Reflected light: the nearer an obstacle, the more."""
Count = Annotated[int, msgspec.Meta(ge=0, le=255)]


class Line(msgspec.Struct, frozen=True):
    """One message: the letter is the class's, the integers are the fields in their order."""

    letter: ClassVar[bytes]


class SetSpeeds(Line, frozen=True):
    letter = b"D"
    left: Wheel
    right: Wheel


class ReadSpeeds(Line, frozen=True):
    letter = b"E"


class ReadPositions(Line, frozen=True):
    letter = b"H"


class SetLed(Line, frozen=True):
    """action: 0 off, 1 on, 2 change."""

    letter = b"L"
    number: Count
    action: Annotated[int, msgspec.Meta(ge=0, le=2)]


class ReadProximity(Line, frozen=True):
    letter = b"N"


class ReadVersion(Line, frozen=True):
    letter = b"B"


class SpeedsSet(Line, frozen=True):
    letter = b"d"


class Speeds(Line, frozen=True):
    letter = b"e"
    left: Wheel
    right: Wheel


class Positions(Line, frozen=True):
    letter = b"h"
    left: Pulses
    right: Pulses


class LedSet(Line, frozen=True):
    letter = b"l"


class Proximity(Line, frozen=True):
    """The eight sensors, counter-clockwise from the right of the back."""

    letter = b"n"
    back_right: Light
    right: Light
    front_right: Light
    ahead_right: Light
    ahead_left: Light
    front_left: Light
    left: Light
    back_left: Light


class Version(Line, frozen=True):
    letter = b"b"
    major: Count
    minor: Count


REQUESTS: tuple[type[Line], ...] = (SetSpeeds, ReadSpeeds, ReadPositions, SetLed, ReadProximity, ReadVersion)
ANSWERS: tuple[type[Line], ...] = (SpeedsSet, Speeds, Positions, LedSet, Proximity, Version)
_CLASSES = {declared.letter: declared for declared in (*REQUESTS, *ANSWERS)}
_INTEGER = re.compile(rb"-?[0-9]{1,10}")


def line_end(data: bytes, start: int) -> int:
    """Find where the line that begins at ``start`` ends; behind the data where its end has not come yet."""
    found = data.find(b"\n", start)
    return found + 1 if found >= 0 else len(data) + 1


def read(line: bytes) -> Line:
    """Read one line; raise ProtocolError where it is none of the messages above."""
    letter, *numbers = line.rstrip(b"\r\n").split(b",")
    declared = _CLASSES.get(letter)
    if declared is None:
        raise ProtocolError(f"{line[:LINE_BYTES]!r} begins no message")
    names = declared.__struct_fields__
    if len(numbers) != len(names) or not all(map(_INTEGER.fullmatch, numbers)):
        raise ProtocolError(f"{line[:LINE_BYTES]!r}: expected {len(names)} integers")
    try:
        return msgspec.convert(dict(zip(names, map(int, numbers), strict=True)), declared)
    except msgspec.ValidationError as error:
        raise ProtocolError(f"{line[:LINE_BYTES]!r}: {error}") from error


def write(message: Line) -> bytes:
    """Write one line; raise EncodeError where a number is out of its range."""
    try:
        msgspec.convert(msgspec.structs.asdict(message), type(message))
    except msgspec.ValidationError as error:
        raise EncodeError(f"{message}: {error}") from error
    return b",".join((message.letter, *(b"%d" % number for number in msgspec.structs.astuple(message)))) + b"\n"


def codecs() -> tuple[Codec, ...]:
    """List the messages for the conformance kit."""
    return (Codec("lines", write, read, line_end, (*REQUESTS, *ANSWERS)),)
