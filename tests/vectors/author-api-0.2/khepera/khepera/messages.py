"""The lines of the protocol: a letter and integers. An answer has the letter of its request in lower case."""

from typing import Annotated

from zbridge.wire import I32, U8, Line, Lines, Scalar, Whole

Wheel = Annotated[int, Scalar("h"), Whole(-127, 127)]  # speed: 1 is 8 mm/s
Light = Annotated[int, Scalar("H"), Whole(0, 1023)]  # the nearer an obstacle, the more


class ReadVersion(Line, frozen=True):
    word = b"B"


class Version(Line, frozen=True):
    word = b"b"
    major: U8
    minor: U8


class SetSpeeds(Line, frozen=True):
    word = b"D"
    left: Wheel
    right: Wheel


class SpeedsSet(Line, frozen=True):
    word = b"d"


class ReadSpeeds(Line, frozen=True):
    word = b"E"


class Speeds(Line, frozen=True):
    word = b"e"
    left: Wheel
    right: Wheel


class ReadPositions(Line, frozen=True):
    word = b"H"


class Positions(Line, frozen=True):
    """How far the wheels have turned: 1 is 0.08 mm on the ground."""

    word = b"h"
    left: I32
    right: I32


class ReadProximity(Line, frozen=True):
    word = b"N"


class Proximity(Line, frozen=True):
    """The eight sensors, counter-clockwise from the right of the back."""

    word = b"n"
    back_right: Light
    right: Light
    front_right: Light
    ahead_right: Light
    ahead_left: Light
    front_left: Light
    left: Light
    back_left: Light


class SetLed(Line, frozen=True):
    """action: 0 off, 1 on, 2 change."""

    word = b"L"
    number: U8
    action: U8


class LedSet(Line, frozen=True):
    word = b"l"


REQUESTS = (ReadVersion, SetSpeeds, ReadSpeeds, ReadPositions, ReadProximity, SetLed)
ANSWERS = (Version, SpeedsSet, Speeds, Positions, Proximity, LedSet)
LINES: Lines[Line] = Lines((*REQUESTS, *ANSWERS))
