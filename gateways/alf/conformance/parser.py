"""The messages of both judges, sans-IO: streams cut into messages, messages judged and written."""

from __future__ import annotations

import enum
import math
import re
import struct
from collections.abc import Collection, Mapping, Sequence
from typing import Literal

import msgspec

from zbridge.simulation.judge import MessageReader, shorten
from zbridge.simulation.judge import show as show_hex

Dialect = Literal["text", "binary"]
Fields = tuple[int | float, ...]

SCAN, INIT, DRIVE, INFO, END = 1, 2, 3, 4, 255
NO_ID = -1
"""Stands for the id of a text message without any number."""
POINTS = 769
LONGEST_BYTES = 65536
"""Most bytes of a text message from the HQ; its longest good one is ``3|100|1|-90|1;``."""
ANGLES = {"text": (-90, 90), "binary": (0, 180)}
"""Steering angle of full left and of full right, by dialect; straight is in the middle."""
FULL_PERCENT = 100
"""Speed that is full speed; a vehicle takes more without clamping in ``text``, as 100 in ``binary``."""
MAX_INT = 2**31 - 1
NUMBER = re.compile(r"-?[0-9]*\.?[0-9]+")
"""What legacy readers take as a field ("Versions and dialects")."""
INTEGERS = re.compile(rb"(0|-?[1-9][0-9]*)(\|(0|-?[1-9][0-9]*))*;")
"""A message of integers, as std::to_string prints them."""

_MOST_DIGITS = 11
_COUNTS = {DRIVE: 4, END: 1}
_DRIVE_FIELDS = ("speed", "direction", "steering angle", "light")
_INT, _FLOAT = rb"\|(?:0|-?[1-9][0-9]*)", rb"\|-?(?:0|[1-9][0-9]*)\.[0-9]{6}"
_FORMS = {INIT: re.compile(b"2" + 3 * _FLOAT + 3 * _INT + b";"), INFO: re.compile(b"4" + _INT + 7 * _FLOAT + b";")}
_FLOATS = {INIT: range(3), INFO: range(1, 8)}
_NOT_POINTS, _LONGEST_NUMBER = 4, 12


class Phase(enum.Enum):
    """What either judge does."""

    WAITING = enum.auto()
    """There is no connection yet."""
    CONNECTED = enum.auto()
    ENDING = enum.auto()
    """The judge sent END, its peer has not."""
    CLOSING = enum.auto()
    """Both sent END."""
    OVER = enum.auto()


class AlfTimes(msgspec.Struct, frozen=True, kw_only=True):
    """The vehicle's times in seconds, and how patient the judge is.

    What the judge waits for is timed by its own clock, which stops while its process is late.
    """

    cycle_s: float = 0.02
    """From one read to the next."""
    scan_s: float = 0.1
    info_s: float = 1.0
    motor_s: float = 2.0
    """Seconds without a command after which the motor stops by itself: 20 cycles of 20 ticks at 200 Hz."""
    first_s: float = 0.25
    """Longest time from the connection to the first command."""
    gap_s: float = 0.1
    """Longest time from one command to the next; it should be 20 ms."""
    window_s: float = 1.0
    window_commands: int = 25
    """Fewest commands in any ``window_s``; it should be 50."""
    flight_s: float = 0.2
    """How long after the vehicle's END a command may still come: the HQ could not know."""
    answer_s: float = 1.0
    """Longest time from the vehicle's END to the HQ's."""
    close_s: float = 1.0
    """Longest time from the HQ's END to its close."""
    send_s: float = 5.0
    """Longest time one message may take to send."""


class ParsedAlfMessage(msgspec.Struct, frozen=True):
    """One message of the peer: its id and fields, what is wrong with it, and whether the judge dies of it."""

    kind: int
    fields: Fields
    raw: bytes
    problem: str = ""
    deadly: bool = False


def deadly(number: str) -> str:
    """Return why std::stoi throws at a number, empty if it does not ("Limits": numbers)."""
    whole = number.split(".", maxsplit=1)[0]
    if whole in ("", "-"):
        return f"a number without leading digit, {number[:20]}"
    if len(whole.lstrip("-0")) > _MOST_DIGITS or not -MAX_INT - 1 <= integer(whole) <= MAX_INT:
        return f"an integer over 2^31-1, {number[:20]}"
    return ""


def integer(number: str) -> int:
    """Read the part before the point as std::stoi does, with any number of leading zeros."""
    whole = number.split(".", maxsplit=1)[0]
    return (-1 if whole.startswith("-") else 1) * int(whole.lstrip("-0") or "0")


def show(data: bytes, dialect: Dialect, limit: int = 60) -> str:
    """Write bytes for a sentence, the first ``limit`` of them: as text or in hex."""
    return shorten(repr(data[:limit])[1:], data, limit) if dialect == "text" else show_hex(data, limit)


class _AlfReader(MessageReader[ParsedAlfMessage]):
    """Cuts and judges the stream of a peer in either dialect. ``counts``: of the fields, by the id of a known message.

    A protocol role contributes what it knows of the fields: :meth:`_read_text`, :meth:`_breaks` and :meth:`_wrong`.
    """

    _unknown: str

    def __init__(self, dialect: Dialect, counts: Mapping[int, int], longest: int = LONGEST_BYTES) -> None:
        super().__init__()
        self._dialect, self._counts, self._longest = dialect, counts, longest
        self._layouts = {kind: _layout(kind, count) for kind, count in counts.items()}

    def take(self, data: bytes) -> list[ParsedAlfMessage]:
        if self._dialect == "binary":
            return super().take(data)
        *texts, self.rest = (self.rest + data).split(b";")
        messages = [self._read_text(text + b";") for text in texts]
        if len(self.rest) > self._longest:
            problem = f"a message without end, {len(self.rest)} bytes"
            messages.append(ParsedAlfMessage(NO_ID, (), self.rest, problem, deadly=True))
        return messages

    def whole(self, message: ParsedAlfMessage) -> bool:
        """Return whether a message has as many fields as its id has, valid or not."""
        return len(message.fields) == self._counts.get(message.kind)

    def _lost(self, data: bytes) -> str:
        return "" if data[0] in self._counts else f"id {data[0]}, {self._unknown}: the framing is lost"

    def _lose(self, problem: str, after: int) -> ParsedAlfMessage:
        self.dead = True
        return ParsedAlfMessage(self.rest[0], (), self.rest, problem, deadly=True)

    def _size(self, data: bytes) -> int:
        return self._layouts[data[0]].size

    def _read(self, raw: bytes) -> ParsedAlfMessage:
        kind, *fields = self._layouts[raw[0]].unpack(raw)
        return self._judge(kind, tuple(fields), raw)

    def _read_text(self, raw: bytes) -> ParsedAlfMessage:
        """Read a message as legacy readers do: a number is a field, all else separates ("Versions and dialects")."""
        raise NotImplementedError

    def _judge(self, kind: int, fields: Fields, raw: bytes) -> ParsedAlfMessage:
        """Judge a message by its fields ("Towards HQ programs", "Limits", "Versions and dialects")."""
        breaks = self._breaks(kind, fields)
        if breaks:
            problem = breaks
        elif kind not in self._counts:
            problem = f"id {kind}, {self._unknown}"
        elif len(fields) != self._counts[kind]:
            problem = f"{len(fields)} fields instead of {self._counts[kind]}"
        elif self._dialect == "text" and not _FORMS.get(kind, INTEGERS).fullmatch(raw):
            problem = "not written as std::to_string prints numbers"
        else:
            problem = self._wrong(kind, fields)
        return ParsedAlfMessage(kind, fields, raw, problem, deadly=bool(breaks))

    def _breaks(self, kind: int, fields: Fields) -> str:
        """Return what the reader breaks on, empty if on nothing."""
        return ""

    def _wrong(self, kind: int, fields: Fields) -> str:
        """Return what is wrong with the values of a message of the right length, where nothing breaks."""
        raise NotImplementedError


class CommandReader(_AlfReader):
    """Cuts and judges the stream of an HQ, for a server that knows the messages ``ids``."""

    _unknown = "of which this server knows nothing"

    def __init__(self, dialect: Dialect, ids: Collection[int]) -> None:
        super().__init__(dialect, {kind: _COUNTS[kind] for kind in ids})
        speeds = (0, FULL_PERCENT if dialect == "text" else 255)
        self._bounds = {DRIVE: (speeds, (0, 1), ANGLES[dialect], (0, 1)), END: ((1, 1),)}

    def _read_text(self, raw: bytes) -> ParsedAlfMessage:
        numbers = NUMBER.findall(raw.decode("latin-1"))
        problem = next(filter(None, map(deadly, numbers)), "")
        if problem or not numbers:
            return ParsedAlfMessage(NO_ID, (), raw, problem or "a message without a number", deadly=bool(problem))
        kind, *fields = map(integer, numbers)
        if not INTEGERS.fullmatch(raw):
            return ParsedAlfMessage(kind, tuple(fields), raw, "not written as std::to_string prints integers")
        return self._judge(kind, tuple(fields), raw)

    def _wrong(self, kind: int, fields: Fields) -> str:
        names = _DRIVE_FIELDS if kind == DRIVE else ("end",)
        for name, value, (low, high) in zip(names, fields, self._bounds[kind], strict=True):
            if not low <= value <= high:
                return f"{name} {value} instead of " + (f"{low}" if low == high else f"{low}..{high}")
        return ""


class VehicleReader(_AlfReader):
    """Cuts and judges the stream of a vehicle; ``points``: of a measurement, which is not on the wire."""

    _unknown = "which no vehicle sends"

    def __init__(self, dialect: Dialect, points: int) -> None:
        counts = {SCAN: points + _NOT_POINTS, INIT: 6, INFO: 8, END: 1}
        super().__init__(dialect, counts, max(LONGEST_BYTES, 2 * _LONGEST_NUMBER * counts[SCAN]))
        self._points = points

    def _read_text(self, raw: bytes) -> ParsedAlfMessage:
        first, *numbers = NUMBER.findall(raw.decode("latin-1")) or [str(NO_ID)]
        if first == str(NO_ID):
            return ParsedAlfMessage(NO_ID, (), raw, "a message without an id")
        kind = NO_ID if deadly(first) else integer(first)
        is_float = [at in _FLOATS.get(kind, ()) for at in range(len(numbers))]
        breaks = ["NaN" if b"nan" in raw.lower() else "", deadly(first)]
        for number, real in zip(numbers, is_float, strict=True):  # a float may be large, but needs its leading digit
            breaks.append("" if real and not number.lstrip("-").startswith(".") else deadly(number))
        if problem := next(filter(None, breaks), ""):
            return ParsedAlfMessage(kind, (), raw, problem, deadly=True)
        fields = (float(number) if real else integer(number) for number, real in zip(numbers, is_float, strict=True))
        return self._judge(kind, tuple(fields), raw)

    def _breaks(self, kind: int, fields: Fields) -> str:
        if kind == SCAN and len(fields) > self._counts[SCAN]:
            return f"{len(fields) - _NOT_POINTS} points instead of {self._points}"
        if any(map(math.isnan, fields)):
            return "NaN"
        over = [one for one in fields if isinstance(one, int) and not -MAX_INT - 1 <= one <= MAX_INT]
        return f"an integer over 2^31-1, {over[0]}" if over else ""

    def _wrong(self, kind: int, fields: Fields) -> str:
        if not all(map(math.isfinite, fields)):
            return "an infinite number"
        if kind == END and fields[0] != 1:
            return f"end {fields[0]} instead of 1"
        if kind != SCAN:
            return ""
        sequence, stamp, *_, first, last = fields
        if sequence < 0 or stamp < 0:
            return f"sequence {sequence}, timestamp {stamp}: below 0"
        if not (0 <= first < self._points and 0 <= last < self._points):
            return f"valid indices {first} and {last} of {self._points} points"
        return ""


class Repeats:
    """The rhythm of the commands ("Translation of commands": repeats every 20 ms while the link is open)."""

    def __init__(self, times: AlfTimes) -> None:
        self._times, self._limit_s = times, times.first_s
        self._silent_s, self._noted = 0.0, False
        self._window_s, self._commands = 0.0, 0

    def cycle(self, passed_s: float, commands: int) -> str:
        """Return what is wrong after one more cycle, empty if nothing."""
        self._silent_s += passed_s
        if commands:
            self._silent_s, self._noted, self._limit_s = 0.0, False, self._times.gap_s
        elif self._silent_s > self._limit_s and not self._noted:
            self._noted, self._window_s, self._commands = True, 0.0, 0
            return f"no drive command for {self._silent_s:.2f} s"
        return "" if self._noted else self._window(passed_s, commands)

    def _window(self, passed_s: float, commands: int) -> str:
        self._window_s += passed_s
        self._commands += commands
        if self._window_s < self._times.window_s:
            return ""
        rate = f"{self._commands} drive commands in {self._window_s:.2f} s"
        few = self._commands < self._times.window_commands
        self._window_s, self._commands = 0.0, 0
        return rate if few else ""


def write(dialect: Dialect, kind: int, fields: Sequence[int | float]) -> bytes:
    """Write a message of either one; ``fields`` as the dialect has them, int or float as they are printed."""
    if dialect == "text":
        texts = [f"{value:.6f}" if isinstance(value, float) else str(value) for value in fields]
        return "|".join([str(kind), *texts]).encode("ascii") + b";"
    return _layout(kind, len(fields)).pack(kind, *fields)


def end(dialect: Dialect) -> bytes:
    """Write END ("Versions and dialects", 255)."""
    return write(dialect, END, [1])


def _layout(kind: int, count: int) -> struct.Struct:
    """Return the widths of a message in ``binary``; ``count``: of its fields ("Versions and dialects")."""
    layouts = {SCAN: f"<BII{count - 4}qII", INIT: "<B3f3i", DRIVE: "<5B", INFO: "<BB6hf", END: "<BB"}
    return struct.Struct(layouts[kind])
