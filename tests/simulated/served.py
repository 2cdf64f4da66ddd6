"""Which of two gateways has to serve the robot, where only one of them reaches it.

Source: "The owner of a robot" in ``state-tables.md`` and the table of two gateways in ``failures.md``: the
gateway that yielded serves the robot again once the owner's robot falls silent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tests.simulated.checker import Checker

TAKEN_S = 8.0
"""Longest time until the gateway that reaches the robot serves it: 3 s of silence, and polls of both every 0.5 s."""


class ServedRules:
    """Follows which gateways reach each other and the robot."""

    def __init__(self, checker: Checker) -> None:
        self._checker = checker
        self._world = checker.world
        self._simulation = checker.simulation
        self._only: tuple[str | None, float] = (None, 0.0)
        """The only gateway of two that reaches the robot, and since when."""

    def watch(self, who: str, what: str, fields: tuple[Any, ...]) -> None:
        """Follow the trace."""

    def tick(self) -> None:
        """Look for a robot that a gateway reaches, and leaves to one that does not."""
        now, checker = self._world.now, self._checker
        only = self._reaches_alone()
        if only != self._only[0]:
            self._only = (only, now)
        since = self._only[1]
        if only is None or now - since < TAKEN_S:
            return
        if not all(
            checker.obligations.undisturbed(name, since) for name, each in checker.gateways.items() if each.serves
        ):
            return
        checker.counts["one of two gateways reached the robot"] += 1
        if not checker.obligations.serves(only):
            checker.violate("served", f"{only} leaves the robot to a gateway that has not reached it for {TAKEN_S:g} s")
            self._only = (only, now)

    def _reaches_alone(self) -> str | None:
        """Return the gateway that reaches the robot, of two that reach each other; None where that is not so."""
        simulation = self._simulation
        robot, fabric, paths = simulation.robot, simulation.fabric, simulation.paths
        serving = [each for each in simulation.gateways if each.serves]
        if len(serving) != 2 or not all(each.running for each in serving) or not fabric.works(*_sessions(serving)):
            return None
        if robot.paused or robot.crashed or robot.used_up or fabric.news_lost or fabric.news_late_s or paths.slow:
            return None
        up = {each.name: self._hears_robot(each.host.name) for each in serving}
        connected = {self._checker.by_host.get(end.peer.address[0]) for end in robot.ends if not end.peer.broken}
        reaching = [name for name, way in up.items() if way and name in connected]
        cut_off = [name for name, way in up.items() if not way]
        return reaching[0] if len(reaching) == len(cut_off) == 1 else None

    def _hears_robot(self, host: str) -> bool:
        paths = self._simulation.paths
        works = paths.up("robot", host) and paths.up(host, "robot")
        return works and host not in self._simulation.robot.mute_to


def _sessions(gateways: list[Any]) -> list[Any]:
    return [each.session for each in gateways]
