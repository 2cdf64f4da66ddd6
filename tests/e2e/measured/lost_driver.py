"""A robot whose driver is lost: how long after the last motion that it was told does the robot get its stop?

    python -m tests.e2e.measured.lost_driver                       # killed, frozen, cut 100 times; other ways 10 times
    python -m tests.e2e.measured.lost_driver --way cut --deadman 0.5 --repetitions 20

The driver is a program on the bus that holds the lease, in a process of its own. Every command has a value of its own.
A driver that is cut off is in a network namespace of its own, and every packet on the way is lost.
"""

from __future__ import annotations

import contextlib
import itertools
import random
import signal

from tests.e2e.conftest import until
from tests.e2e.rigs import loss
from tests.e2e.rigs.loss import EVERYWHERE, LATE_S, Result, Scene, Way, measured, query
from tests.e2e.rigs.processes import report
from tests.e2e.rigs.robots import SCALE

DEADMAN_S = 0.2
FEW = 10
"""Repetitions of the ways that are measured for the documentation only."""


class DriverScene(Scene):
    """With a driver that is on the bus."""

    _firsts = (SCALE // 10 + number * 500 % (SCALE * 8 // 10) for number in itertools.count())

    def drive(self, rng: random.Random) -> int:
        begun = len(self.robot.frames)
        self.start_driver(*loss.driver(self.reach, "r1", self.deadman_s, rng.uniform(20, 50), next(self._firsts)))
        until(lambda: self.moved(begun) is not None, what="the robot moves")
        first = self.moved(begun)
        assert first is not None
        return first


def _take_over(scene: Scene) -> None:
    lease = query(scene.session, "@rpc/control/takeover/supervisor", who="supervisor", lease_s=1.0)
    if not lease.get("ok"):
        scene.faults.append(f"takeover refused: {lease}")


def _see_gateway_off(scene: Scene) -> None:
    loss.see_off(scene, scene.gateway)
    scene.restart_gateway()


WAYS: dict[str, Way[Scene]] = {
    **EVERYWHERE,
    "exited": Way(lambda scene: scene.driver.close(), at_once=True),
    "taken-over": Way(_take_over, at_once=True),
    "stopped": Way(Scene.stop, at_once=True),
    "router-killed": Way(lambda scene: scene.router.kill(), Scene.restart_router, at_once=True),
    "gateway-ended": Way(lambda scene: scene.gateway.signal(signal.SIGTERM), _see_gateway_off, at_once=True),
    "gateway-killed": Way(
        lambda scene: scene.gateway.signal(signal.SIGKILL), Scene.restart_gateway, connection_ends=True
    ),
}


def measure(way: str, *, repetitions: int, deadman_s: float = DEADMAN_S, seed: int = 1) -> Result:
    """Lose the driver in one way again and again."""
    from_loss = WAYS[way].resumes or WAYS[way].at_once
    result = Result(way, LATE_S if from_loss else deadman_s + LATE_S, from_loss=from_loss)
    with contextlib.ExitStack() as stack:
        scene = DriverScene(stack, cut=way == "cut", deadman_s=deadman_s)
        return measured(scene, WAYS[way], result, repetitions=repetitions, rng=random.Random(f"{way} {seed}"))


def main() -> None:
    parser = loss.options(__doc__, WAYS, repetitions=100)
    parser.add_argument("--deadman", type=float, default=DEADMAN_S)
    wanted = parser.parse_args()
    times = {way: wanted.repetitions if WAYS[way].often else min(wanted.repetitions, FEW) for way in WAYS}
    report(
        measure(way, repetitions=times[way], deadman_s=wanted.deadman, seed=wanted.seed)
        for way in loss.possible("tests.e2e.measured.lost_driver", wanted.way, WAYS)
    )


if __name__ == "__main__":
    main()
