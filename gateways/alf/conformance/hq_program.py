"""An ALF operator program to play with, as fragile as the deployed ones."""

from __future__ import annotations

import logging
from collections.abc import Coroutine
from typing import Any

from gateways.alf.conformance import parser as wire
from gateways.alf.conformance.fragile_hq import ANGLES, FULL, FragileHq
from gateways.alf.conformance.parser import Dialect
from zbridge.simulation.fragile import log_violations
from zbridge.simulation.hq_program import HqProgram, run_hq_program

_log = logging.getLogger(__name__)


class AlfProgram(HqProgram):
    """The driving program."""

    def __init__(self, judge: FragileHq) -> None:
        self.judge: FragileHq = judge

    def run(self, host: str, port: int) -> Coroutine[Any, Any, None]:
        return self.judge.run(host, port)

    @property
    def ready(self) -> str:
        return f"connected, dialect {self.judge.dialect}" if self.judge.connected.is_set() else ""

    def shown(self) -> str:
        judge = self.judge
        info = f"speed {judge.infos[-1][0]:g}" if judge.infos else "no drive info"
        return f"{info}, {judge.scans} measurements"

    async def neutral(self) -> None:
        self.judge.idle()

    async def push(self, forward: float, turn: float) -> None:
        """Push the stick; the wheels are turned to the right by positive angles, and the other way backward (3)."""
        left, straight, right = ANGLES[self.judge.dialect]
        rightward = turn if forward < 0 else -turn
        steering = round(straight + rightward * (right - left) / 2)
        self.judge.drive(round(abs(forward) * FULL[self.judge.dialect]), int(forward < 0), steering)


async def simulate_fragile_hq(
    host: str,
    port: int,
    *,
    dialect: Dialect,
    points: int = wire.POINTS,
    drive: tuple[float, float] | None = None,
) -> None:
    """Run the fragile driving HQ until cancelled, dead or left by the vehicle; log violations, print what it does.

    drive: forward and turn, fractions of full scale; None: its stick stays centred. Raise OSError if nobody listens.
    """
    hq = FragileHq(
        dialect=dialect,
        points=points,
        serves="both",  # what the listener is configured to serve is not known here
        deployed="driving",
        note=log_violations(_log),
    )
    await run_hq_program(AlfProgram(hq), host, port, drive)
