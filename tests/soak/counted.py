"""A TCP/UDP robot that numbers and dates its positions, and tells when each command came: ``... counted HOST``.

Position: x is the time at which it is sent (CLOCK_MONOTONIC), y the number. Both are whole numbers below 2**24, so that
the packet's floats hold them exactly. Prints its port, then ``AT NUMBER`` for each motion that is another one.
Datagrams to the same port come back.
"""

from __future__ import annotations

import socket
import sys
import threading
import time
from typing import Any

from tests.e2e.measured import restarts
from tests.e2e.rigs.robots import MOVE, Frame, position

TICK_S = 1e-5
WRAP = 10_000_000
"""Ticks, and numbers, until they begin again."""


class Counted(restarts.Package):
    """Sends fifty positions a second."""

    period_s = 0.02

    def __init__(self, host: str) -> None:
        super().__init__(host)
        self._known = 0
        self._echo = socket.socket(type=socket.SOCK_DGRAM)
        self._echo.bind((host, self.port))
        threading.Thread(target=self._answer, daemon=True).start()
        print(self.port, flush=True)

    def _answer(self) -> None:
        while True:
            self._echo.sendto(*self._echo.recvfrom(100))

    def message(self, number: int) -> bytes:
        return position(float(ticks()), float(number % WRAP), 0.0)

    def hear(self, data: bytes) -> None:
        at = time.monotonic()
        self._rest += data
        while len(self._rest) >= 6 and len(self._rest) >= (end := 4 + int.from_bytes(self._rest[:4], "little")):
            frame = Frame(at, self._rest[5], self._rest[6:end])
            if frame.packet_id == MOVE and frame.number != self._known:
                self._known = frame.number
                print(f"{at:.6f} {frame.number}", flush=True)
            self._rest = self._rest[end:]


def ticks() -> int:
    """Give the time now, as a position carries it."""
    return round(time.monotonic() / TICK_S) % WRAP


def read(pose: dict[str, Any]) -> tuple[float, int]:
    """Give the seconds since a position was sent, and its number."""
    late = (ticks() - round(pose["x"] * 100)) % WRAP
    return (late - WRAP if late > WRAP // 2 else late) * TICK_S, round(pose["y"] * 100)


if __name__ == "__main__":
    restarts.CUT_S = 0.0
    Counted(sys.argv[1])
    sys.stdin.read()
