"""A robot that an old HQ program drives through a listener, and the program or the listener is lost: when does it stop?

    python -m tests.e2e.measured.lost_hq --repetitions 50                 # programs of each protocol, every way
    python -m tests.e2e.measured.lost_hq --program alf --way cut

A real gateway process, a router, a listener in a process of its own (`process-frozen`: in the gateway's), and a driving
HQ program in one more. Every motion has a value of its own. A program that is cut off is in a network namespace of its
own, and every packet on the way is lost.

An external controller sets velocities once and its listener holds them for as long as its connection stands: such a
controller that is frozen moves its robot on, and one that is cut off does until keep-alive has given it up.
"""

from __future__ import annotations

import contextlib
import random
import signal
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from tests.e2e.conftest import HOST, until
from tests.e2e.rigs import loss
from tests.e2e.rigs.loss import EVERYWHERE, LATE_S, Result, Scene, Way, measured, query
from tests.e2e.rigs.processes import module, report
from tests.ports import free_port

KEPT_S = 1.6
"""The longest time for which a listener believes in a controller that is gone and is sent nothing: keep-alive's second,
and most of a deadman."""
SAID_AGAIN_S = 0.5
"""Seconds after which every program has said again what its stick says."""
PUSHES = 5


@dataclass(frozen=True)
class Driven:
    """How a robot is driven. program: of ``tests.e2e.rigs.hq_programs``. deadman_s: what the protocol page gives it."""

    protocol: str
    deadman_s: float
    options: str = ""
    holds: bool = False
    """The listener repeats what was set once."""


DRIVEN = {
    "tcpudp": Driven("tcpudp", 1.3),
    "tcpudp-by-tcp": Driven("tcpudp", 1.3),
    "alf": Driven("alf", 0.3),
    "wc2ec-holds": Driven("wc2ec", 0.5, holds=True),
    "wc2ec-repeats": Driven("wc2ec", 0.5, options="hold = false"),
}


class HqScene(Scene):
    """With an HQ program as driver, and the listener that it is connected to."""

    driven_s = (0.2, 1.0)

    def __init__(self, stack: contextlib.ExitStack, program: str, *, cut: bool = False, together: bool = False) -> None:
        driven = DRIVEN[program]
        self._program = program
        self._port, host = free_port(), "0.0.0.0" if cut else HOST
        self._listener = f'[[hq]]\nprotocol = "{driven.protocol}"\nlisten = "tcp://{host}:{self._port}"\n'
        self._listener += f"options = {{ {driven.options} }}\n"
        super().__init__(stack, cut=cut, parts=self._listener if together else "", deadman_s=driven.deadman_s)
        self.hq = self.gateway if together else self.run("hq", self._listener)

    def restart_hq(self) -> None:
        """Start the listener's process again."""
        self.hq = self.run("hq", self._listener, self.hq)

    def drive(self, rng: random.Random) -> int:
        until(lambda: query(self.session, "control").get("state") in ("free", "stopped"), what="the robot is free")
        self.start_driver(*module("tests.e2e.rigs.hq_programs", self._program, self.here, self._port))
        assert self.driver.line() == "ready"
        for _ in range(PUSHES):  # a listener that has only just started may not know the robot yet
            first = self.push(0.5)
            if first is not None:
                return first
        raise AssertionError(f"the robot does not move after {PUSHES} pushes\n{self.hq.log[-2000:]}")

    def push(self, wait_s: float) -> int | None:
        """Let go of the stick, push it, and tell which of the robot's packets was the first motion, if any was."""
        begun = len(self.robot.frames)
        self.driver.say("push")
        with contextlib.suppress(AssertionError):
            until(lambda: self.moved(begun) is not None, wait_s, "the robot moves")
        return self.moved(begun)


def _see_hq_off(scene: HqScene) -> None:
    loss.see_off(scene, scene.hq)
    scene.restart_hq()


def _thaw(scene: HqScene) -> None:
    """Let continue what was frozen: it finds all that was said meanwhile, and the program says more."""
    for process in (scene.driver, scene.hq):
        process.signal(signal.SIGCONT)
    time.sleep(SAID_AGAIN_S)


WAYS: dict[str, Way[HqScene]] = {
    **EVERYWHERE,
    "frozen": Way(lambda scene: scene.driver.signal(signal.SIGSTOP), _thaw),
    "closed": Way(lambda scene: scene.driver.close(), at_once=True),
    "hq-killed": Way(lambda scene: scene.hq.signal(signal.SIGKILL), HqScene.restart_hq, at_once=True),
    "hq-ended": Way(lambda scene: scene.hq.signal(signal.SIGTERM), _see_hq_off, at_once=True),
    "hq-frozen": Way(lambda scene: scene.hq.signal(signal.SIGSTOP), _thaw),
    "process-frozen": Way(loss.freeze_gateway, resumes=True),
}


def measure(program: str, ways: Iterable[str], *, repetitions: int, seed: int = 1) -> Iterator[Result]:
    """Lose a program, or its listener, again and again; a program whose velocities are held may be frozen."""
    wanted = [way for way in ways if way != "frozen" or not DRIVEN[program].holds]
    rng = random.Random(f"{program} {seed}")
    for together in (False, True):
        group = [way for way in wanted if (way == "process-frozen") is together]
        if not group:
            continue
        with contextlib.ExitStack() as stack:
            scene = HqScene(stack, program, cut="cut" in group, together=together)
            for way in group:
                yield measured(scene, WAYS[way], _expected(program, way), repetitions=repetitions, rng=rng)


def _expected(program: str, name: str) -> Result:
    """Give the limit of a way: held velocities all look the same, so the time can only run from the loss."""
    driven, way = DRIVEN[program], WAYS[name]
    label = f"{program} {name}"
    if way.at_once or way.resumes:
        return Result(label, LATE_S, from_loss=True)
    if driven.holds:
        return Result(label, KEPT_S if name == "cut" else driven.deadman_s + LATE_S, from_loss=True)
    return Result(label, driven.deadman_s + LATE_S)


def main() -> None:
    parser = loss.options(__doc__, WAYS, repetitions=10)
    parser.add_argument("--program", choices=(*DRIVEN, "all"), default="all")
    wanted = parser.parse_args()
    ways = loss.possible("tests.e2e.measured.lost_hq", wanted.way, WAYS)
    report(
        result
        for program in DRIVEN
        if wanted.program in ("all", program)
        for result in measure(program, ways, repetitions=wanted.repetitions, seed=wanted.seed)
    )


if __name__ == "__main__":
    main()
