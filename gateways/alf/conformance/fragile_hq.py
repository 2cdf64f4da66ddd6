"""A simulated ALF operator program as fragile as the legacy ones: the judge of a gateway that plays the vehicle."""

from __future__ import annotations

import asyncio
import math
import socket
import time
from collections import deque
from collections.abc import Iterable
from typing import Literal, NoReturn

from gateways.alf.conformance import parser as wire
from gateways.alf.conformance.parser import (
    END,
    INFO,
    INIT,
    SCAN,
    Dialect,
    Fields,
    ParsedAlfMessage,
    Phase,
    VehicleReader,
    show,
)
from zbridge.simulation.fragile import Work
from zbridge.simulation.hq_program import HqProgram
from zbridge.simulation.judge import Ended
from zbridge.simulation.timing import Ticker

Serves = Literal["auto", "drive", "laser", "both"]
"""What the gateway's listener is configured to serve ("Towards HQ programs")."""
Deployed = Literal["driving", "scanning"]
"""Which legacy program; none tolerates both kinds of messages ("What crashes a peer" in ``fragile-robots.md``)."""

_SERVED = {"drive": (INFO, END), "laser": (INIT, SCAN, END), "both": (INIT, SCAN, INFO, END)}
_MOST_SCANS = 10
"""Measurements after which the legacy driving program stops reading."""
FULL = {"text": 255, "binary": 100}
"""The speed that is full speed."""


class FragileAlfHq(HqProgram):
    """One connection of an operator program: records every violation and dies of what breaks it.

    ``points``: of every measurement; ``serves``: what the listener is configured to serve; ``deployed``: be the
    driving program, which stops reading after ten measurements, or the scanning one, which sends no commands and
    takes any id but 1 and 2 as END; None: neither, it tolerates both; ``repeat_s``: from one drive command to the next,
    None for a viewer that sends none; ``stops_reading_after``: so many measurements it reads no more, for good;
    ``answer_s``: longest time to the vehicle's END after ours, and to its close after both; ``flight_s``: how long
    after the first command measurements may still come. A row of ``received``: monotonic seconds, id, fields; of a
    measurement of the right length without its points.
    """

    _phase: Phase
    _reader: VehicleReader

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
    ) -> None:
        if dialect not in FULL or serves not in ("auto", *_SERVED):
            raise ValueError(f"no such HQ: dialect {dialect!r}, serves {serves!r}")
        super().__init__()
        self.dialect: Dialect = dialect
        self.scanner: Fields | None = None
        """The last message 2."""
        self.scans = 0
        self.last_points: Fields = ()
        """The points of the last measurement as they were sent, in mm."""
        self.infos: deque[Fields] = self._rows()
        """Every message 4."""
        self._serves: Serves = serves
        self._scanning = deployed == "scanning"
        self._repeat_s = None if self._scanning else repeat_s
        self._stops_after = stops_reading_after or (_MOST_SCANS if deployed == "driving" else None)
        self._answer_s, self._flight_s = answer_s, flight_s
        self._drove_at = math.inf
        """When the first command was sent."""
        self._blind = False
        """True once it took a message as END: it shows nothing more."""
        self._stopped = False
        """True once it reads no more."""
        self._phase = Phase.WAITING
        self._limit: asyncio.Timeout | None = None
        self._reader = VehicleReader(dialect, points)
        self._command: tuple[int, int, int, int]
        self.idle()

    def drive(self, speed: int, direction: int = 0, steering: int | None = None, light: bool = False) -> None:
        """Repeat another command from now on ("Versions and dialects", 3).

        ``steering``: as the dialect has it, None is straight.
        Raise ValueError for what no HQ program of the dialect sends.
        """
        left, right = wire.ANGLES[self.dialect]
        steering = (left + right) // 2 if steering is None else steering
        if not (0 <= speed <= FULL[self.dialect] and direction in (0, 1) and left <= steering <= right):
            raise ValueError(f"{self.dialect}: speed {speed}, direction {direction}, steering {steering}")
        self._command = (speed, direction, steering, int(light))

    def idle(self) -> None:
        """Repeat the command of the start: speed 0, straight, forward, light off."""
        self.drive(0)

    @property
    def agreed(self) -> str:
        return f"connected, dialect {self.dialect}" if self.connected.is_set() else ""

    def shown(self) -> str:
        info = f"speed {self.infos[-1][0]:g}" if self.infos else "no drive info"
        return f"{info}, {self.scans} measurements"

    async def neutral(self) -> None:
        self.idle()

    async def push(self, forward: float, turn: float) -> None:
        """Push the stick; the wheels are turned to the right by positive angles, and the other way backward (3)."""
        left, right = wire.ANGLES[self.dialect]
        rightward = turn if forward < 0 else -turn
        steering = round((left + right + rightward * (right - left)) / 2)
        self.drive(round(abs(forward) * FULL[self.dialect]), int(forward < 0), steering)

    async def end(self) -> None:
        """Send END, and wait for the end of the connection: END back, then the close (255: both sides then close)."""
        async with self._sending:
            if self._phase is Phase.CONNECTED:
                self._send_end()
                self._phase = Phase.ENDING
                self._limit_to(0.0 if self._stopped else self._answer_s)
        if self._phase is not Phase.WAITING:
            await self._over.wait()

    # The connection

    def _work(self) -> Iterable[Work]:
        self._phase = Phase.CONNECTED
        return self._repeat(), self._live()

    def _before_close(self) -> None:
        if self._phase is Phase.CONNECTED and self.alive:
            self._send_end()
        self._phase = Phase.OVER

    async def _live(self) -> None:
        """Read and judge until the connection is over."""
        try:
            async with asyncio.timeout(None) as self._limit:
                while not self._stopped:
                    await self._read()
                if self._broken:
                    self._judge_end(self._broken)
                await asyncio.Event().wait()  # for good ("What crashes a peer" in ``fragile-robots.md``)
        except TimeoutError:
            self._judge_delay()

    def _limit_to(self, seconds: float) -> None:
        """Give the vehicle ``seconds`` to do what is due."""
        if self._limit is not None:
            self._limit.reschedule(asyncio.get_running_loop().time() + seconds)

    def _judge_delay(self) -> NoReturn:
        if self._phase is Phase.ENDING and not self._stopped:
            self._violate(f"no END within {self._answer_s:g} s of the HQ's")
        elif self._phase is Phase.CLOSING:
            self._violate(f"the vehicle did not close within {self._answer_s:g} s of both ENDs")
        raise Ended("the HQ closed")

    def _judge_end(self, end: str) -> NoReturn:
        """Judge an end of the connection ("Towards HQ programs": END is sent before every close)."""
        closing = self._phase is Phase.CLOSING
        self._phase = Phase.OVER
        if closing or self._stopped:
            raise Ended(f"the vehicle closed: {end}")
        if self._reader.rest:
            self._violate(f"the connection ended within a message: {show(self._reader.rest, self.dialect)}")
        self._violate(f"the vehicle closed without END: {end}")
        raise Ended

    # Messages of the vehicle

    def _receive(self, message: ParsedAlfMessage) -> None:
        if self._stopped:
            return None
        kind, whole = message.kind, self._reader.whole(message)
        fields = message.fields[:2] + message.fields[-2:] if whole and kind == SCAN else message.fields
        self.received.append((time.monotonic(), kind, fields))
        raw = show(message.raw, self.dialect)
        if self._phase is Phase.CLOSING:
            return self._violate(f"a message after END: {raw}")
        problem = message.problem
        if not problem and kind not in self._served():
            problem = f"message {kind} from a listener that does not serve it"
        self._report(problem, raw, deadly=message.deadly)
        if kind == END:
            self._answer()
        elif self._scanning and kind not in (INIT, SCAN):
            self._violate(f"message {kind} taken as END, it shows nothing more: {raw}")
            self._blind = True
        elif whole and not self._blind:
            self._show(message)
        return None

    def _served(self) -> tuple[int, ...]:
        """Return the ids that may come now: with ``auto`` 1 and 2 until the first command, from then on 4."""
        if self._serves != "auto":
            return _SERVED[self._serves]
        since_s = time.monotonic() - self._drove_at
        return _SERVED["laser" if since_s < 0 else "both" if since_s < self._flight_s else "drive"]

    def _show(self, message: ParsedAlfMessage) -> None:
        """Take a message of the right length ("Towards HQ programs": 2 comes before any 1)."""
        if message.kind == INIT:
            if self.scanner is not None:
                self._event("another scanner init")
            self.scanner = message.fields
        elif message.kind == INFO:
            self.infos.append(message.fields)
        else:
            if self.scanner is None and not self.scans:
                self._violate("a measurement before the scanner init")
            self.scans, self.last_points = self.scans + 1, message.fields[2:-2]
            if self.scans == self._stops_after:
                self._stopped = True
                self._event(f"it reads no more, after {self.scans} measurements")

    def _answer(self) -> None:
        """Take END: answer it unless it is an answer, close this side, and listen for what must not come (255)."""
        self._event("END")
        if self._phase is Phase.CONNECTED:
            self._send_end()
        self._phase = Phase.CLOSING
        self._limit_to(self._answer_s)
        self._shut(socket.SHUT_WR)

    # Messages of the HQ

    async def _repeat(self) -> None:
        """Send the command every 20 ms even when unchanged, as a gateway does ("Translation of commands")."""
        if self._repeat_s is None:
            return
        ticker = Ticker(self._repeat_s, first_s=0.0)
        while not self._broken:
            await ticker.tick()
            async with self._sending:
                if self._phase is not Phase.CONNECTED:
                    return
                self._drove_at = min(self._drove_at, time.monotonic())
                await self._write(wire.write(self.dialect, wire.DRIVE, self._command))
        if self._stopped:  # else the next read takes what is left, and sees the end
            self._judge_end(self._broken)

    def _send_end(self) -> None:
        if not self._midway:
            self._write_now(wire.end(self.dialect))
