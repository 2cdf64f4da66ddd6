"""A robot as fragile as legacy ones, with a record of its commands: one connection per start, no fault tolerated.

Usage: robot.py PORT ACCOUNT. Each line of the file ACCOUNT is a time (monotonic seconds) and the commanded speed, or a
word and what happened: ``event: second connection ...``, ``violation: ...``.
"""

import asyncio
import math
import struct
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from gateways.tcpudp.conformance.fragile_robot import FragileRobot
from gateways.tcpudp.conformance.machine import Quirks


class RecordingRobot(FragileRobot):
    """Records each change of its commanded speed."""

    def __init__(self, account: Path) -> None:
        self._account, self._known = account.open("w", buffering=1), 0.0
        super().__init__(version="1.3", udp=False, seed=1, quirks=Quirks(client_id=2))
        self.note = partial(self.record, "violation:")
        steer = self.machine.steer

        def obey(body: bytes) -> None:
            steer(body)
            values = struct.unpack(f"<{len(body) // 4}f", body)
            speed = math.hypot(*values[:2]) * values[2] if len(values) == 3 else sum(map(abs, values))
            if speed != self._known:
                self._known = speed
                self.record(f"{time.monotonic():.3f}", f"{speed:.3g}")

        self.machine.steer = obey  # type: ignore[method-assign]

    def record(self, *words: Any) -> None:
        """Write one line."""
        print(*words, file=self._account)

    def _event(self, text: str) -> None:
        super()._event(text)
        self.record("event:", text)


async def main(port: str, account: str) -> None:
    """Simulate the robot until it is killed, or dies of a fault."""
    robot = RecordingRobot(Path(account))
    await robot.serve("127.0.0.1", int(port), lambda _: robot.record("event:", "listening"))
    robot.record("event:", "ended", robot.death)


asyncio.run(main(*sys.argv[1:]))
