"""A TCP/UDP HQ program to play with, as fragile as the deployed ones."""

from __future__ import annotations

import logging
from collections.abc import Coroutine
from typing import Any

from gateways.tcpudp.conformance.fragile_hq import FragileHq
from gateways.tcpudp.conformance.parser import HqTimes
from zbridge.simulation.fragile import log_violations
from zbridge.simulation.hq_program import HqProgram, run_hq_program

_DEPLOYED = HqTimes()
_log = logging.getLogger(__name__)


class TcpUdpProgram(HqProgram):
    """One program."""

    def __init__(self, judge: FragileHq) -> None:
        self.judge: FragileHq = judge
        self._joystick = False

    def run(self, host: str, port: int) -> Coroutine[Any, Any, None]:
        return self.judge.run(host, port)

    @property
    def ready(self) -> str:
        settings = self.judge.settings
        if settings is None or not self.judge.established.is_set():
            return ""
        features = ", ".join(feature.name.lower() for feature in sorted(settings.features)) or "none"
        return f"established: client id {settings.client}, robot of {settings.versions}, features {features}"

    def shown(self) -> str:
        judge = self.judge
        position = "no position" if judge.position is None else "position {:.2f} {:.2f} {:.1f}".format(*judge.position)
        cells = f"a map of {len(judge.map)} cells" if judge.map else "no map"
        return ", ".join([position, cells, *(f"text {text!r}" for text in judge.texts[-1:])])

    async def neutral(self) -> None:
        if not self._joystick:
            self._joystick = True
            self.judge.mode(2)  # joystick ("Packets")
        self.judge.idle()

    async def push(self, forward: float, turn: float) -> None:
        """Push one of the two sticks: the one that is pushed further (11, 12)."""
        if abs(forward) >= abs(turn):
            self.judge.move(0.0, 1.0 if forward >= 0 else -1.0, abs(forward))
        else:
            self.judge.rotate(-turn)


async def simulate_fragile_hq(
    host: str,
    port: int,
    *,
    version: str,
    udp: bool,
    drive: tuple[float, float] | None = None,
    times: HqTimes = _DEPLOYED,
) -> None:
    """Run a fragile HQ until cancelled, dead or left; log violations, print what it does and what it died of.

    drive: forward and turn, fractions of full scale; None: its stick stays centred. Raise OSError if nobody listens.
    """
    hq = FragileHq(version=version, udp=udp, times=times, note=log_violations(_log))
    await run_hq_program(TcpUdpProgram(hq), host, port, drive)
