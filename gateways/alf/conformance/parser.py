"""The messages of both judges, sans-IO: streams cut into messages, messages judged and written.

Shares no code with the gateway's messages, so that an error there cannot hide here.
Section names in the docstrings are those of the protocol page ``alf.md``.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Sequence
from typing import Literal

import msgspec

from zbridge.simulation.judge import shorten
from zbridge.simulation.judge import show as show_hex

Dialect = Literal["text", "binary"]

SCAN, INIT, DRIVE, INFO, END = 1, 2, 3, 4, 255
NO_ID = -1
"""Stands for the id of a text message without any number."""
POINTS = 769
LONGEST_BYTES = 65536
"""Most bytes of a text message from the HQ; its longest good one is ``3|100|1|-90|1;``."""
ANGLES = {"text": (-90, 90), "binary": (0, 180)}
"""Steering angle of full left and of full right, by dialect."""
FULL_PERCENT = 100
"""Speed that is full speed; a vehicle takes more without clamping in ``text``, as 100 in ``binary``."""
MAX_INT = 2**31 - 1
NUMBER = re.compile(r"-?[0-9]*\.?[0-9]+")
"""What deployed readers take as a field ("Dialect `text`")."""
INTEGERS = re.compile(rb"(0|-?[1-9][0-9]*)(\|(0|-?[1-9][0-9]*))*;")
"""A message of integers, as std::to_string prints them."""

_NAMES = {DRIVE: ("speed", "direction", "steering angle", "light"), END: ("end",)}
_SIZES = {DRIVE: 4, END: 1}
_MOST_DIGITS = 11


class Times(msgspec.Struct, frozen=True, kw_only=True):
    """The vehicle's times in seconds, and how patient the judge is.

    What the judge waits for is timed by its own clock, which stands still while its process is late.
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


class Heard(msgspec.Struct, frozen=True):
    """One message from the HQ: its id and fields, what is wrong with it, and whether that kills the vehicle."""

    kind: int
    fields: tuple[int, ...]
    raw: bytes
    problem: str = ""
    deadly: bool = False

    @property
    def whole(self) -> bool:
        """Whether it has the fields of its id, good or bad."""
        return len(self.fields) == len(_NAMES.get(self.kind, ()))


class Scale(msgspec.Struct, frozen=True, kw_only=True):
    """Counts of message 4 in ``binary`` for one g and for one degree/s ("Scale of accelerations and gyro")."""

    counts_per_g: float = 1000.0
    counts_per_deg_s: float = 10.0


def deadly(number: str) -> str:
    """Tell why std::stoi throws at a number, empty if it does not ("The gateway as vehicle")."""
    whole = number.split(".")[0]
    if whole in ("", "-"):
        return f"a number without leading digit, {number[:20]}"
    if len(whole.lstrip("-0")) > _MOST_DIGITS or not -MAX_INT - 1 <= integer(whole) <= MAX_INT:
        return f"an integer over 2^31-1, {number[:20]}"
    return ""


def integer(number: str) -> int:
    """Read the part before the point as std::stoi does, with any number of leading zeros."""
    whole = number.split(".")[0]
    return (-1 if whole.startswith("-") else 1) * int(whole.lstrip("-0") or "0")


def show(data: bytes, dialect: Dialect, limit: int = 60) -> str:
    """Write bytes for a sentence, the first ``limit`` of them: as text or in hex."""
    return shorten(repr(data[:limit])[1:], data, limit) if dialect == "text" else show_hex(data, limit)


class TextReader:
    """Cuts and judges the stream of a ``text`` HQ ("Dialect `text`")."""

    def __init__(self, ids: Collection[int], speed_full: int) -> None:
        """Set up for a server that knows the messages ``ids`` from an HQ."""
        self.rest = b""
        self._ids, self._speed_full = ids, speed_full

    def take(self, data: bytes) -> list[Heard]:
        """Read the messages that end in ``data``."""
        *messages, self.rest = (self.rest + data).split(b";")
        heard = [self._read(message + b";") for message in messages]
        if len(self.rest) > LONGEST_BYTES:
            problem = f"a message without end, {len(self.rest)} bytes"
            heard.append(Heard(NO_ID, (), self.rest, problem, deadly=True))
        return heard

    def _read(self, raw: bytes) -> Heard:
        """Read a message as deployed readers do: every number is a field, all else separates."""
        numbers = NUMBER.findall(raw.decode("latin-1"))
        problem = next(filter(None, map(deadly, numbers)), "")
        if problem:
            return Heard(NO_ID, (), raw, problem, deadly=True)
        kind, *fields = [integer(number) for number in numbers] or [NO_ID]
        if not numbers:
            problem = "a message without a number"
        elif not INTEGERS.fullmatch(raw):
            problem = "not written as std::to_string prints integers"
        elif kind not in self._ids:
            problem = f"id {kind}, of which this server knows nothing"
        else:
            problem = _problem("text", kind, fields, self._speed_full)
        return Heard(kind, tuple(fields), raw, problem)


class BinaryReader:
    """Cuts and judges the stream of a ``binary`` HQ ("Dialect `binary`")."""

    def __init__(self, ids: Collection[int]) -> None:
        """Set up for a server that knows the messages ``ids`` from an HQ."""
        self.rest = b""
        self._ids, self._dead = ids, False

    def take(self, data: bytes) -> list[Heard]:
        """Read the messages that end in ``data``; nothing can be read after an unknown id."""
        heard: list[Heard] = []
        self.rest += data
        while self.rest and not self._dead:
            kind = self.rest[0]
            size = 1 + _SIZES.get(kind, 0)
            if kind not in self._ids:
                problem = f"id {kind}, of which this server knows nothing: the framing is lost"
                heard.append(Heard(kind, (), self.rest, problem, deadly=True))
                self._dead = True
            elif len(self.rest) < size:
                break
            else:
                raw, self.rest = self.rest[:size], self.rest[size:]
                fields = tuple(raw[1:])
                heard.append(Heard(kind, fields, raw, _problem("binary", kind, fields, 255)))
        return heard


def reader(dialect: Dialect, ids: Collection[int], speed_full: int) -> TextReader | BinaryReader:
    """Make the reader of a dialect."""
    return TextReader(ids, speed_full) if dialect == "text" else BinaryReader(ids)


class Repeats:
    """The rhythm of the commands ("The gateway as HQ": repeats every 20 ms for as long as the link stands)."""

    def __init__(self, times: Times) -> None:
        """Begin with the connection."""
        self.longest_s = 0.0
        """Longest time without a command so far."""
        self._times, self._limit_s = times, times.first_s
        self._silent_s, self._noted = 0.0, False
        self._window_s, self._commands = 0.0, 0

    def cycle(self, passed_s: float, commands: int) -> str:
        """Tell what is wrong after one more cycle, empty if nothing."""
        self._silent_s += passed_s
        self.longest_s = max(self.longest_s, self._silent_s)
        silent_s = self._silent_s
        if commands:
            self._silent_s, self._noted, self._limit_s = 0.0, False, self._times.gap_s
        elif self._silent_s > self._limit_s and not self._noted:
            self._noted, self._window_s, self._commands = True, 0.0, 0
            return f"no drive command for {silent_s:.2f} s"
        return "" if self._noted else self._window(passed_s, commands)

    def _window(self, passed_s: float, commands: int) -> str:
        self._window_s += passed_s
        self._commands += commands
        if self._window_s < self._times.window_s:
            return ""
        told = f"{self._commands} drive commands in {self._window_s:.2f} s"
        few = self._commands < self._times.window_commands
        self._window_s, self._commands = 0.0, 0
        return told if few else ""


def write(dialect: Dialect, kind: int, fields: Sequence[int | float]) -> bytes:
    """Write a message of either one; ``fields`` as the dialect has them, int or float as they are printed."""
    if dialect == "text":
        texts = [f"{value:.6f}" if isinstance(value, float) else str(value) for value in fields]
        return "|".join([str(kind), *texts]).encode("ascii") + b";"
    layout = {SCAN: f"<BII{len(fields) - 4}qII", INIT: "<B3f3i", DRIVE: "<5B", INFO: "<BB6hf", END: "<BB"}[kind]
    return struct.pack(layout, kind, *fields)


def _problem(dialect: Dialect, kind: int, fields: Sequence[int], speed_full: int) -> str:
    """Tell what is wrong with the fields of a message that the server knows."""
    names = _NAMES[kind]
    if len(fields) != len(names):
        return f"{len(fields)} fields instead of {len(names)}"
    bounds = ((0, speed_full), (0, 1), ANGLES[dialect], (0, 1)) if kind == DRIVE else ((1, 1),)
    for name, value, (low, high) in zip(names, fields, bounds, strict=True):
        if not low <= value <= high:
            return f"{name} {value} instead of " + (f"{low}" if low == high else f"{low}..{high}")
    return ""
