"""An external controller to play with, as fragile as the deployed ones."""

from __future__ import annotations

import logging
from collections.abc import Coroutine
from typing import Any

from gateways.wc2ec.conformance.fragile_hq import FragileController
from gateways.wc2ec.conformance.parser import Dialect
from zbridge.simulation.fragile import log_violations
from zbridge.simulation.hq_program import HqProgram, run_hq_program

WHEEL_RAD_S = 10.0
"""Velocity of a wheel at full scale: what listeners and configurations here take as such."""
_log = logging.getLogger(__name__)


class ControllerProgram(HqProgram):
    """An external controller that drives two wheels: the motors whose names say left and right."""

    def __init__(self, judge: FragileController) -> None:
        self.judge: FragileController = judge

    def run(self, host: str, port: int) -> Coroutine[Any, Any, None]:
        return self.judge.run(host, port)

    @property
    def ready(self) -> str:
        ready = self.judge.connected.is_set() and self.judge.ready.is_set()
        return f"connected: {len(self.judge.devices)} devices, wheels {self._wheels or 'none'}" if ready else ""

    @property
    def _wheels(self) -> dict[str, str]:
        """Names of the wheels by their side."""
        names = {side: next((name for name in self.judge.motors if side in name), "") for side in ("left", "right")}
        return names if all(names.values()) else {}

    def shown(self) -> str:
        return f"{sum(self.judge.counts.values())} values of {len(self.judge.counts)} devices"

    async def neutral(self) -> None:
        await self.push(0.0, 0.0)

    async def push(self, forward: float, turn: float) -> None:
        """Set both wheels: a controller sets them once ("Roles")."""
        for side, sign in (("left", -1.0), ("right", 1.0)):
            if side in self._wheels:
                value = WHEEL_RAD_S * max(-1.0, min(1.0, forward + sign * turn))
                await self.judge.set(self._wheels[side], value)


async def simulate_fragile_hq(
    host: str, port: int, *, dialect: Dialect, split: bool = False, drive: tuple[float, float] | None = None
) -> None:
    """Run a fragile external controller until cancelled, dead or left; log each violation, and print what it does.

    drive: forward and turn, fractions of full scale; None: it sets no motor. Raise OSError if nobody listens.
    """
    controller = FragileController(dialect=dialect, split=split, note=log_violations(_log))
    await run_hq_program(ControllerProgram(controller), host, port, drive)
