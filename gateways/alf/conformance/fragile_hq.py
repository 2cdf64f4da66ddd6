"""A simulated ALF operator program as fragile as the deployed ones: the judge of a gateway that plays the vehicle.

It records each violation of what the protocol page ``alf.md`` demands towards HQ programs, and dies of what they break
on. It shares no code with the gateway: not its messages, sessions or translation. Section names in the docstrings are
those of that page.
"""

from __future__ import annotations

import asyncio
import contextlib
import enum
import math
import re
import socket
import struct
import time
from collections.abc import Callable
from typing import Literal, NamedTuple

import msgspec

from gateways.alf.conformance import parser as wire
from gateways.alf.conformance.parser import DRIVE, END, INFO, INIT, NO_ID, SCAN, Dialect, show
from zbridge.simulation.judge import Ended, Judge
from zbridge.simulation.sockets import connected
from zbridge.simulation.ticker import Ticker

Serves = Literal["auto", "drive", "laser", "both"]
"""What the gateway's listener is configured to serve ("The gateway as vehicle")."""
Deployed = Literal["driving", "scanning"]
"""Which of the deployed programs; none bears both kinds of messages ("The gateway as vehicle")."""
Fields = tuple[int | float, ...]

_INT, _FLOAT = rb"\|(?:0|-?[1-9][0-9]*)", rb"\|-?(?:0|[1-9][0-9]*)\.[0-9]{6}"
_FORMS = {INIT: re.compile(b"2" + 3 * _FLOAT + 3 * _INT + b";"), INFO: re.compile(b"4" + _INT + 7 * _FLOAT + b";")}
_FLOATS = {INIT: range(3), INFO: range(1, 8)}
_LAYOUTS = {INIT: "<B3f3i", INFO: "<BB6hf", END: "<BB"}
_SERVED = {"drive": (INFO, END), "laser": (INIT, SCAN, END), "both": (INIT, SCAN, INFO, END)}
_BEARS = 10
"""Measurements after which the deployed driving program stops reading."""
_NOT_POINTS, _LONGEST_NUMBER = 4, 12
ANGLES = {"text": (-90, 0, 90), "binary": (0, 90, 180)}
FULL = {"text": 255, "binary": 100}
_READ_BYTES = 65536


class Told(msgspec.Struct, frozen=True):
    """One message of a vehicle: its id and fields, what is wrong with it, and whether that breaks the HQ."""

    kind: int
    fields: Fields
    raw: bytes
    problem: str = ""
    deadly: bool = False


class Scan(NamedTuple):
    """The last measurement, as it was sent: points in mm, valid indices inclusive."""

    sequence: int
    stamp: int
    points: tuple[int, ...]
    first: int
    last: int


class Reader:
    """Cuts and judges the stream of a vehicle of either dialect."""

    def __init__(self, dialect: Dialect, points: int) -> None:
        """Set up; ``points``: of a measurement, a setting that nothing on the wire tells ("Dialect `binary`")."""
        self.rest = b""
        self._dialect, self._points = dialect, points
        self._counts = {SCAN: points + _NOT_POINTS, INIT: 6, INFO: 8, END: 1}
        self._layouts = {kind: struct.Struct(layout) for kind, layout in _LAYOUTS.items()}
        self._layouts[SCAN] = struct.Struct(f"<BII{points}qII")
        self._longest = max(wire.LONGEST_BYTES, 2 * _LONGEST_NUMBER * (points + _NOT_POINTS))
        self._dead = False

    def take(self, data: bytes) -> list[Told]:
        """Read the messages that end in ``data``."""
        self.rest += data
        return self._text() if self._dialect == "text" else self._binary()

    def counts(self, told: Told) -> bool:
        """Whether it has as many fields as its id has, good or bad."""
        return len(told.fields) == self._counts.get(told.kind)

    def _text(self) -> list[Told]:
        *messages, self.rest = self.rest.split(b";")
        told = [self._read(message + b";") for message in messages]
        if len(self.rest) > self._longest:
            told.append(Told(NO_ID, (), self.rest, f"a message without end, {len(self.rest)} bytes", deadly=True))
        return told

    def _binary(self) -> list[Told]:
        """Cut by the widths of the document; nothing can be read after an unknown id."""
        told: list[Told] = []
        while self.rest and not self._dead:
            kind = self.rest[0]
            layout = self._layouts.get(kind)
            if layout is None:
                self._dead = True
                told.append(Told(kind, (), self.rest, f"id {kind}, which no vehicle sends: the framing is lost", True))
            elif len(self.rest) < layout.size:
                break
            else:
                raw, self.rest = self.rest[: layout.size], self.rest[layout.size :]
                told.append(self._judge(kind, layout.unpack(raw)[1:], raw))
        return told

    def _read(self, raw: bytes) -> Told:
        """Read a message as deployed readers do: every number is a field, all else separates ("Dialect `text`")."""
        first, *numbers = wire.NUMBER.findall(raw.decode("latin-1")) or [str(NO_ID)]
        if first == str(NO_ID):
            return Told(NO_ID, (), raw, "a message without an id")
        kind = NO_ID if wire.deadly(first) else wire.integer(first)
        floats = _FLOATS.get(kind, range(0))
        breaks = "NaN" if b"nan" in raw.lower() else wire.deadly(first)
        breaks = breaks or next(filter(None, (_breaks(n, at in floats) for at, n in enumerate(numbers))), "")
        if breaks:
            return Told(kind, (), raw, breaks, deadly=True)
        return self._judge(
            kind, tuple(float(n) if at in floats else wire.integer(n) for at, n in enumerate(numbers)), raw
        )

    def _judge(self, kind: int, fields: Fields, raw: bytes) -> Told:
        """Judge a message by its fields ("The gateway as vehicle": what they break on; "Dialect ...")."""
        breaks = self._deadly(kind, fields)
        if breaks:
            return Told(kind, fields, raw, breaks, deadly=True)
        problem = ""
        if kind not in self._counts:
            problem = f"id {kind}, which no vehicle sends"
        elif len(fields) != self._counts[kind]:
            problem = f"{len(fields)} fields instead of {self._counts[kind]}"
        elif self._dialect == "text" and not _FORMS.get(kind, wire.INTEGERS).fullmatch(raw):
            problem = "not written as std::to_string prints numbers"
        return Told(kind, fields, raw, problem or self._wrong(kind, fields))

    def _deadly(self, kind: int, fields: Fields) -> str:
        if kind == SCAN and len(fields) > self._counts[SCAN]:
            return f"{len(fields) - _NOT_POINTS} points instead of {self._points}"
        if any(map(math.isnan, fields)):
            return "NaN"
        over = [one for one in fields if isinstance(one, int) and not -wire.MAX_INT - 1 <= one <= wire.MAX_INT]
        return f"an integer over 2^31-1, {over[0]}" if over else ""

    def _wrong(self, kind: int, fields: Fields) -> str:
        """Tell what is wrong with the values, where nothing breaks."""
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


def _breaks(number: str, is_float: bool) -> str:
    """Tell why an HQ breaks on a number: a float may be large, but needs its leading digit."""
    bare = number.lstrip("-").startswith(".")
    return wire.deadly(number) if bare or not is_float else ""


class _Phase(enum.Enum):
    CONNECTING = enum.auto()
    CONNECTED = enum.auto()
    ENDING = enum.auto()
    """The HQ sent END, the vehicle has not."""
    CLOSING = enum.auto()
    """Both sent END."""
    OVER = enum.auto()


class FragileHq(Judge):
    """One connection of an operator program: records every violation and dies of what breaks it.

    ``points``: of every measurement; ``serves``: what the listener is configured to serve; ``deployed``: be the
    driving program, which stops reading after ten measurements, or the scanning one, which sends no commands and
    takes any id but 1 and 2 as END; None: neither, it bears both; ``repeat_s``: from one drive command to the next,
    None for a viewer that sends none; ``stops_reading_after``: so many measurements it reads no more, for good;
    ``answer_s``: longest time to the vehicle's END after ours, and to its close after both; ``flight_s``: how long
    after the first command measurements may still come; ``keep``: most entries of every list; ``note``: called with
    each violation.
    """

    def __init__(
        self,
        *,
        dialect: Dialect = "text",
        points: int = wire.POINTS,
        serves: Serves = "auto",
        deployed: Deployed | None = None,
        repeat_s: float | None = 0.02,
        stops_reading_after: int | None = None,
        answer_s: float = 2.0,
        flight_s: float = 1.0,
        keep: int = 10_000,
        note: Callable[[str], None] | None = None,
    ) -> None:
        if dialect not in FULL or serves not in ("auto", *_SERVED):
            raise ValueError(f"no such HQ: dialect {dialect!r}, serves {serves!r}")
        super().__init__(keep=keep, note=note)
        self.dialect: Dialect = dialect
        self.received: list[tuple[float, int, Fields]] = []
        """Monotonic seconds, id, fields; of a measurement of the right length without its points."""
        self.connected = asyncio.Event()
        self.scanner: Fields | None = None
        """The last message 2."""
        self.scans = 0
        self.last_scan: Scan | None = None
        self.infos: list[Fields] = []
        """Every message 4."""
        self._serves: Serves = serves
        self._scanning = deployed == "scanning"
        self._repeat_s = None if self._scanning else repeat_s
        self._stops_after = _BEARS if deployed == "driving" and stops_reading_after is None else stops_reading_after
        self._answer_s, self._flight_s = answer_s, flight_s
        self._drove_at = math.inf
        """When the first command was sent."""
        self._blind = False
        """True once it took a message as END: it shows nothing more."""
        self._reader = Reader(dialect, points)
        self._command: tuple[int, int, int, int]
        self.idle()
        self._prepare()

    def _prepare(self) -> None:
        """Set up what belongs to the connection."""
        self._phase, self._stopped, self._midway = _Phase.CONNECTING, False, False
        self._conn: socket.socket | None = None
        self._limit: asyncio.Timeout | None = None
        self._sending, self._over = asyncio.Lock(), asyncio.Event()
        self._broken, self._error = asyncio.Event(), ""

    def __repr__(self) -> str:
        state = f"{self._phase.name} scans={self.scans} violations={len(self.violations)} alive={self.alive}"
        return f"<FragileHq {self.dialect} {state}>"

    def drive(self, speed: int, direction: int = 0, steering: int | None = None, light: bool = False) -> None:
        """Repeat another command from now on ("Dialect ..." 3); ``steering``: as the dialect has it, None is straight.

        Raise ValueError for what no HQ program of the dialect sends.
        """
        left, straight, right = ANGLES[self.dialect]
        steering = straight if steering is None else steering
        if not (0 <= speed <= FULL[self.dialect] and direction in (0, 1) and left <= steering <= right):
            raise ValueError(f"{self.dialect}: speed {speed}, direction {direction}, steering {steering}")
        self._command = (speed, direction, steering, int(light))

    def idle(self) -> None:
        """Repeat the command of the start: speed 0, straight, forward, light off."""
        self.drive(0)

    async def run(self, host: str, port: int) -> None:
        """Connect and play until dead, until the vehicle closed, or until cancelled: it leaves with END then.

        Raise OSError if nobody listens.
        """
        async with connected(host, port) as conn:
            self._conn, self._phase = conn, _Phase.CONNECTED
            self.connected.set()
            try:
                async with asyncio.TaskGroup() as tasks:
                    sender = tasks.create_task(self._repeat(conn))
                    await self._live(conn)
                    sender.cancel()
            finally:
                if self._phase is _Phase.CONNECTED and self.alive:
                    self._say_end(conn)
                self._phase, self._conn = _Phase.OVER, None
                self._over.set()

    async def end(self) -> None:
        """Send END, and wait for the end of the connection: END back, then the close (255: both sides then close)."""
        async with self._sending:
            if self._phase is _Phase.CONNECTED and self._conn is not None:
                self._say_end(self._conn)
                self._phase = _Phase.ENDING
                self._hurry(0.0 if self._stopped else self._answer_s)
        if self._phase is not _Phase.CONNECTING:
            await self._over.wait()

    # The connection

    async def _live(self, conn: socket.socket) -> None:
        """Read and judge until the connection is over."""
        try:
            async with asyncio.timeout(None) as self._limit:
                while data := await self._read(conn):
                    for told in self._reader.take(data):
                        if not self._stopped:
                            self._hear(conn, told)
                self._part()
        except Ended as ended:
            self._event(str(ended))
        except TimeoutError:
            self._late()

    async def _read(self, conn: socket.socket) -> bytes:
        """Read, unless it stopped reading for good ("the driving one stops reading ... after ten measurements")."""
        if self._stopped:
            await self._broken.wait()
            return b""
        try:
            return await asyncio.get_running_loop().sock_recv(conn, _READ_BYTES)
        except OSError as error:
            self._error = repr(error)
            return b""

    def _hurry(self, seconds: float) -> None:
        """Give the vehicle ``seconds`` to do what is due."""
        if self._limit is not None:
            self._limit.reschedule(asyncio.get_running_loop().time() + seconds)

    def _late(self) -> None:
        if self._phase is _Phase.ENDING and not self._stopped:
            self._violate(f"no END within {self._answer_s:g} s of the HQ's")
        elif self._phase is _Phase.CLOSING:
            self._violate(f"the vehicle did not close within {self._answer_s:g} s of both ENDs")
        self._event("the HQ closed")

    def _part(self) -> None:
        """Judge an end of the connection ("HQ programs do not notice EOF: send END before closing")."""
        how = self._error or "EOF"
        if self._phase is _Phase.CLOSING or self._stopped:
            self._event(f"the vehicle closed: {how}")
            self._phase = _Phase.OVER
            return
        if self._reader.rest:
            self._violate(f"the connection ended within a message: {show(self._reader.rest, self.dialect)}")
        self._violate(f"the vehicle closed without END: {how}")
        self._phase = _Phase.OVER

    # Messages of the vehicle

    def _hear(self, conn: socket.socket, told: Told) -> None:
        whole = self._reader.counts(told)
        fields = told.fields[:2] + told.fields[-2:] if whole and told.kind == SCAN else told.fields
        self.received.append((time.monotonic(), told.kind, fields))
        del self.received[: -self._keep]
        raw = show(told.raw, self.dialect)
        if self._phase is _Phase.CLOSING:
            return self._violate(f"a message after END: {raw}")
        if told.deadly:
            self._die(f"{told.problem}: {raw}")
        if told.problem:
            self._violate(f"{told.problem}: {raw}")
        elif told.kind not in self._served():
            self._violate(f"message {told.kind} from a listener that does not serve it: {raw}")
        if told.kind == END:
            self._answer(conn)
        elif self._scanning and told.kind not in (INIT, SCAN):
            self._violate(f"message {told.kind} taken as END, it shows nothing more: {raw}")
            self._blind = True
        elif whole and not self._blind:
            self._take(told)
        return None

    def _served(self) -> tuple[int, ...]:
        """Give the ids that may come now: with ``auto`` 1 and 2 until the first command, from then on 4."""
        if self._serves != "auto":
            return _SERVED[self._serves]
        since_s = time.monotonic() - self._drove_at
        return _SERVED["laser" if since_s < 0 else "both" if since_s < self._flight_s else "drive"]

    def _take(self, told: Told) -> None:
        """Take a message of the right length ("Send the cached 2 first, then 1 and 4 as they come")."""
        if told.kind == INIT:
            if self.scanner is not None:
                self._event("another scanner init")
            self.scanner = told.fields
        elif told.kind == INFO:
            self.infos.append(told.fields)
            del self.infos[: -self._keep]
        else:
            if self.scanner is None and not self.scans:
                self._violate("a measurement before the scanner init")
            sequence, stamp, *points, first, last = map(int, told.fields)
            self.scans, self.last_scan = self.scans + 1, Scan(sequence, stamp, tuple(points), first, last)
            if self.scans == self._stops_after:
                self._stopped = True
                self._event(f"it reads no more, after {self.scans} measurements")

    def _answer(self, conn: socket.socket) -> None:
        """Take END: answer it unless it is an answer, close this side, and listen for what must not come (255)."""
        self._event("END")
        if self._phase is _Phase.CONNECTED:
            self._say_end(conn)
        self._phase = _Phase.CLOSING
        self._hurry(self._answer_s)
        with contextlib.suppress(OSError):
            conn.shutdown(socket.SHUT_WR)

    # Messages of the HQ

    async def _repeat(self, conn: socket.socket) -> None:
        """Send the command every 20 ms even when unchanged ("Dialect `text`" 3)."""
        if self._repeat_s is None:
            return
        ticker = Ticker(self._repeat_s, first_s=0.0)
        while self._phase is _Phase.CONNECTED and not self._broken.is_set():
            await ticker.tick()
            await self._send(conn, wire.write(self.dialect, DRIVE, self._command))

    async def _send(self, conn: socket.socket, data: bytes) -> None:
        async with self._sending:
            if self._phase is not _Phase.CONNECTED:
                return
            self._drove_at = min(self._drove_at, time.monotonic())
            try:
                self._midway = True
                await asyncio.get_running_loop().sock_sendall(conn, data)
                self._midway = False
            except OSError as error:  # reported once: the next read takes what is left, and sees an end
                self._error = repr(error)
                self._broken.set()

    def _say_end(self, conn: socket.socket) -> None:
        """Send END between two messages and without waiting: it is too short to be sent in part."""
        if not self._midway:
            with contextlib.suppress(OSError):
                conn.send(wire.write(self.dialect, END, [1]))
