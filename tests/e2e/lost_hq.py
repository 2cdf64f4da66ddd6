"""A robot that an old HQ program drives through a listener, and the program or the listener is lost: when does it stop?

    python -m tests.e2e.lost_hq --repetitions 50                 # programs of each protocol, every way
    python -m tests.e2e.lost_hq --program alf --way cut

A real gateway process, a router, a listener in a process of its own (`process-frozen`: in the gateway's), and a driving
HQ program in one more. Every motion has a value of its own. A program is cut off by unplugging the network namespace
that it runs in.

An external controller sets velocities once and its listener holds them for as long as its connection stands: such a
controller that is frozen moves its robot on, and one that is cut off does until keep-alive has given it up.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import select
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from tests.e2e.conftest import WAIT_S, free_port, until
from tests.e2e.loss import (
    LATE_S,
    Cable,
    NotHereError,
    Result,
    Scene,
    Way,
    be_measurement,
    cut_driver_off,
    freeze_driver,
    freeze_gateway,
    heading,
    kill,
    kill_driver,
    let_driver_end,
    measured,
    measured_apart,
    mend_cable,
    query,
    stop_since,
    thaw_driver,
)
from tests.machine import Patience, contended_s

KEPT_S = 1.6
"""The longest time for which a listener believes in a controller that is gone and is sent nothing: keep-alive's second,
and most of a deadman."""
SAID_AGAIN_S = 0.5
"""Seconds after which every program has said again what its stick says."""
PUSHES = 5


@dataclass(frozen=True)
class Driven:
    """How a robot is driven. program: of ``tests.e2e.hq_programs``. deadman_s: what the protocol page gives it."""

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

    def __init__(
        self, stack: contextlib.ExitStack, program: str, *, cable: bool = False, together: bool = False
    ) -> None:
        driven = DRIVEN[program]
        self._program = program
        self._address = (Cable.HERE if cable else "127.0.0.1", free_port())
        listener = f'[[hq]]\nprotocol = "{driven.protocol}"\nlisten = "tcp://{self._address[0]}:{self._address[1]}"\n'
        listener += f"options = {{ {driven.options} }}\n"
        super().__init__(stack, cable=cable, parts=listener if together else "")
        self.deadman_s = driven.deadman_s
        self._hq_file = self.configured("hq", listener)
        self.hq = self.gateway if together else self.run(self._hq_file)
        stack.callback(lambda: kill(self.hq))

    def restart_hq(self) -> None:
        """Start the listener's process again."""
        kill(self.hq)
        self.hq = self.run(self._hq_file)

    def drive(self, rng: random.Random) -> int:
        until(lambda: query(self.session, "control").get("state") in ("free", "stopped"), what="the robot is free")
        self.start_driver(sys.executable, "-m", "tests.e2e.hq_programs", self._program, *map(str, self._address))
        patience = Patience(WAIT_S)
        while not select.select([self.driving.stdout], [], [], 0.05)[0]:
            if patience.over:
                raise AssertionError(f"{self._program} is not connected after {WAIT_S:g} s\n{self.end_of_log}")
        for _ in range(PUSHES):  # a listener that has only just started may not know the robot yet
            first = self.push(0.5)
            if first is not None:
                return first
        raise AssertionError(f"the robot does not move after {PUSHES} pushes\n{self.end_of_log}")

    def push(self, wait_s: float) -> int | None:
        """Let go of the stick, push it, and tell which of the robot's packets was the first motion, if any was."""
        begun = len(self.robot.frames)
        assert self.driving.stdin is not None
        self.driving.stdin.write("push\n")
        self.driving.stdin.flush()
        with contextlib.suppress(AssertionError):
            until(lambda: self.moved(begun) is not None, wait_s, "the robot moves")
        return self.moved(begun)


def _thaw(scene: HqScene) -> None:
    thaw_driver(scene)
    time.sleep(SAID_AGAIN_S)


def _kill_hq(scene: HqScene) -> float:
    at = time.monotonic()
    scene.hq.kill()
    return at


def _end_hq(scene: HqScene) -> float:
    at = time.monotonic()
    scene.hq.terminate()
    return at


def _see_hq_off(scene: HqScene) -> None:
    code = scene.hq.wait(timeout=5)
    if code != 0:
        scene.faults.append(f"the listener's process ended with {code}")
    scene.restart_hq()


def _freeze_hq(scene: HqScene) -> float:
    at = time.monotonic()
    scene.hq.send_signal(signal.SIGSTOP)
    return at


def _thaw_hq(scene: HqScene) -> None:
    """Let it go on: it finds all that its program has said meanwhile, and the program says more."""
    scene.hq.send_signal(signal.SIGCONT)
    time.sleep(SAID_AGAIN_S)


WAYS: dict[str, Way[HqScene]] = {
    "killed": Way(kill_driver, at_once=True),
    "closed": Way(let_driver_end, at_once=True),
    "frozen": Way(freeze_driver, _thaw),
    "cut": Way(cut_driver_off, mend_cable),
    "hq-killed": Way(_kill_hq, HqScene.restart_hq, at_once=True),
    "hq-ended": Way(_end_hq, _see_hq_off, at_once=True),
    "hq-frozen": Way(_freeze_hq, _thaw_hq),
    "gateway-frozen": Way(freeze_gateway, resumes=True),
    "process-frozen": Way(freeze_gateway, resumes=True),
}


def ways_of(program: str) -> list[str]:
    """Give the ways that stop a robot: a program whose velocities are held may be frozen."""
    return [way for way in WAYS if way != "frozen" or not DRIVEN[program].holds]


def measure(program: str, ways: Iterable[str], *, repetitions: int, seed: int = 1) -> list[Result]:
    """Lose a program, or its listener, again and again; raise NotHereError where this machine does not allow it."""
    ways = list(ways)
    if "cut" not in ways:
        return _measured(program, ways, repetitions=repetitions, seed=seed)
    wishes = (program, ",".join(ways), repetitions, seed)
    return measured_apart("tests.e2e.lost_hq", *wishes, timeout_s=60 + 20 * repetitions * len(ways))


def _measured(program: str, ways: list[str], *, repetitions: int, seed: int) -> list[Result]:
    found, rng = [], random.Random(f"{program} {seed}")
    for together in (False, True):
        group = [way for way in ways if (way == "process-frozen") is together]
        if not group:
            continue
        with contextlib.ExitStack() as stack:
            scene = HqScene(stack, program, cable="cut" in group, together=together)
            for way in group:
                result = _expected(program, way)
                found.append(measured(scene, WAYS[way], result, repetitions=repetitions, rng=rng))
    return found


def _expected(program: str, name: str) -> Result:
    """Give the limit of a way: held velocities all look the same, so the time can only run from the loss."""
    driven, way = DRIVEN[program], WAYS[name]
    label = f"{program} {name}"
    if way.at_once or way.resumes:
        return Result(label, LATE_S, from_loss=True)
    if driven.holds:
        return Result(label, KEPT_S if name == "cut" else driven.deadman_s + LATE_S, from_loss=True)
    return Result(label, driven.deadman_s + LATE_S)


def hold_on(frozen_s: float) -> tuple[float, float, float]:
    """Freeze a controller whose velocities are held, then kill it.

    Give for how long after its freezing its robot was still told to move, how long after its death it got its stop, and
    what of that excuses the machine.
    """
    with contextlib.ExitStack() as stack:
        scene = HqScene(stack, "wc2ec-holds")
        begun = scene.drive(random.Random(1))
        frozen_at = freeze_driver(scene)
        time.sleep(frozen_s)
        frames = scene.robot.frames[begun:]
        assert all(frame.moves for frame in frames), "stopped"
        contended = contended_s()
        killed_at = kill_driver(scene)
        stop = until(lambda: stop_since(scene.robot.frames, begun, killed_at), what="stop")
        contended = contended_s() - contended
        return frames[-1].at - frozen_at, scene.robot.frames[stop].at - killed_at, contended


def results(programs: Iterable[str], way: str | None, *, repetitions: int, seed: int) -> Iterator[Result | str]:
    """Measure several programs; a text where one way is not possible here."""
    for program in programs:
        for name in ways_of(program):
            if way not in (None, name):
                continue
            try:
                yield from measure(program, [name], repetitions=repetitions, seed=seed)
            except NotHereError as error:
                yield f"{program} {name} skipped: {error}"


def main() -> None:
    if sys.argv[1:3] == ["--be", "measurement"]:
        program, ways, repetitions, seed = sys.argv[3:]
        be_measurement(lambda: _measured(program, ways.split(","), repetitions=int(repetitions), seed=int(seed)))
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=10)
    parser.add_argument("--program", choices=(*DRIVEN, "all"), default="all")
    parser.add_argument("--way", choices=(*WAYS, "all"), default="all")
    parser.add_argument("--seed", type=int, default=os.getpid(), help="of the moments")
    wanted = parser.parse_args()
    print(heading(), flush=True)
    programs = DRIVEN if wanted.program == "all" else (wanted.program,)
    way = None if wanted.way == "all" else wanted.way
    failed = False
    for result in results(programs, way, repetitions=wanted.repetitions, seed=wanted.seed):
        print(result, flush=True)
        failed = failed or (isinstance(result, Result) and not result.clean)
    sys.exit(failed)


if __name__ == "__main__":
    main()
