"""A gateway that hangs or dies while its robot moves: how long after it is the robot at rest?

    python -m tests.e2e.crashes                       # all robots and ways, 30 times each; about ten minutes
    python -m tests.e2e.crashes --times 3 --robots alf --ways killed --out crashes.jsonl

One supervisor (``zbridge run DIR``) runs all gateways. Each repetition has a fragile robot of its own, in a process
that tells its commanded motion (:mod:`tests.e2e.fragile`), a robot file that comes while the supervisor runs, and a
driver on the bus. When the robot moves, its gateway

hung: blocks its event loop for good;
frozen: is stopped (SIGSTOP);
killed: is killed (SIGKILL).

The time to rest runs from that moment. The driver drives on all the time, and the robot must stay at rest for
``REST_S``. The robot's judge must have nothing to say.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import random
import re
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from tests.e2e import loss
from tests.e2e.conftest import Fleet, configuration, device, end, until
from tests.e2e.fragile import DISTURBED, ROBOTS, charges
from tests.e2e.processes import LINE_S, Part
from tests.e2e.robots import SCALE
from tests.e2e.stalls import MovingRobot
from tests.e2e.supervised import Supervised
from tests.ports import free_port

LIMIT_S = 1.5
"""Most seconds from the crash to rest."""
REST_S = 1.0
"""Seconds that a robot must stay at rest."""
PATIENCE_S = 6.0
SPEED = 0.4
DEADMAN_S, RATE_HZ = 0.5, 25.0
MEASURED = ("tcpudp-1.3", "tcpudp-1.3-udp", "alf", "wc2ec")
WAYS = {"hung": signal.SIGUSR1, "frozen": signal.SIGSTOP, "killed": signal.SIGKILL}
LANES = 4
_numbers = itertools.count()


@dataclass
class Outcome:
    """One repetition. rest_s: None where the robot drove on; faults: what else was wrong."""

    robot: str
    way: str
    rest_s: float | None = None
    kept: bool = False
    """Whether the robot saw one connection all the time: the next process went on with it."""
    faults: list[str] = field(default_factory=list)
    disturbed: bool = False
    """Whether the robot was never driven, and was late itself: it lost packets that it read as one."""

    @property
    def good(self) -> bool:
        """Whether everything was as it should be."""
        return self.rest_s is not None and self.rest_s <= LIMIT_S and not self.faults


class Scene:
    """What all repetitions share: the bus, an onlooker on it, and the supervisor."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "robots"
        self.folder.mkdir()
        self.fleet = Fleet(stack.enter_context(zenoh.open(configuration("router", self.endpoint))), "fleet/*/status")
        self.place("idle", device(1))  # a supervisor wants one file; nobody listens at port 1
        self.supervisor = Supervised(stack, self.folder, hangs=True)
        until(lambda: "ready" in self.supervisor.log, LINE_S, "the supervisor")

    def place(self, name: str, *parts: str) -> Path:
        """Write a robot's file, at one stroke."""
        bus = f'[bus]\nconnect = ["{self.endpoint}"]\nmulticast = false\n'
        new = self.folder / f"{name}.new"
        new.write_text(f'[robot]\nname = "{name}"\n' + "".join(parts) + bus)
        return new.rename(self.folder / f"{name}.toml")


def repeat(scene: Scene, robot: str, way: str) -> Outcome:
    """Let one gateway crash while its robot moves; what does not come about is a fault."""
    outcome, name = Outcome(robot, way), f"{robot[:6]}.{next(_numbers)}"
    with contextlib.ExitStack() as stack:
        try:
            _measure(scene, stack, outcome, name)
        except (AssertionError, RuntimeError, OSError) as error:
            outcome.faults.append(f"{type(error).__name__}: {error}; {scene.fleet.last(f'{name}/status')}")
    return outcome


def _measure(scene: Scene, stack: contextlib.ExitStack, outcome: Outcome, name: str) -> None:
    kind = ROBOTS[outcome.robot]
    robot = MovingRobot(stack, outcome.robot, "127.0.0.1", (), random.randrange(1 << 30))
    file = scene.place(name, device(robot.port, kind.protocol, kind.options))
    stack.callback(scene.supervisor.reload)
    stack.callback(file.unlink)
    scene.supervisor.reload()
    until(lambda: scene.fleet.last(f"{name}/status").get("state") == "established", LINE_S, "established")
    pid = scene.supervisor.gateway(name)
    driver = Part(stack, *loss.driver(scene.endpoint, name, DEADMAN_S, RATE_HZ, round(SPEED * SCALE), 0))
    if not robot.begins(SPEED, driver):
        robot.part.say("end")
        until(lambda: robot.report, 5, "the robot's report")
        outcome.disturbed = bool(robot.report["piled"])
        raise RuntimeError("the robot was never driven")
    time.sleep(random.uniform(0.5, 1.5))
    crashed = time.monotonic()
    os.kill(pid, WAYS[outcome.way])
    outcome.rest_s = _rest(robot, crashed)
    scene.supervisor.gateway(name, not_pid=pid)
    until(lambda: _goes_on(scene, name), LINE_S, "the next process")
    robot.part.say("end")
    until(lambda: robot.report, 5, "the robot's report")
    outcome.faults += charges(robot.report["violations"], LIMIT_S)  # which excuses commands that are too rare
    outcome.kept = not any("connection" in event or "left" in event for event in robot.report["events"])
    if robot.report["moving"]:
        outcome.faults.append("the robot moves at the end")


def _goes_on(scene: Scene, name: str) -> bool:
    log = scene.supervisor.log
    return re.search(rf"{name}: (process \d+ goes on with|next process in)", log) is not None


def _rest(robot: MovingRobot, since: float) -> float | None:
    """Wait until the robot has been at rest for REST_S; give the seconds from ``since`` to rest."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        at, speed = robot.changes[-1]
        if not speed and time.monotonic() - max(at, since) >= REST_S:
            return max(0.0, at - since)
        time.sleep(0.02)
    return None


def measure(
    cases: Iterable[tuple[str, str]], *, lanes: int = LANES, took: Callable[[Outcome], object] = lambda _: None
) -> list[Outcome]:
    """Do every case (robot, way) once, so many at a time; give what came of them."""
    waiting, taking, outcomes = iter(cases), threading.Lock(), list[Outcome]()

    def lane() -> None:
        while True:
            with taking:
                case = next(waiting, None)
            if case is None:
                return
            for _ in range(DISTURBED):
                outcome = repeat(scene, *case)
                if not outcome.disturbed:
                    break
            with taking:
                outcomes.append(outcome)
                took(outcome)

    with contextlib.ExitStack() as stack:
        scene = Scene(stack)
        threads = [threading.Thread(target=lane) for _ in range(lanes)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        end(scene.supervisor.process)
        if any(not outcome.good for outcome in outcomes):
            print(scene.supervisor.log, file=sys.stderr)
    return outcomes


def table(outcomes: list[Outcome]) -> Iterator[str]:
    """Write the results as the rows of a Markdown table."""
    yield "| robot | gateway | times | at rest within 1.5 s | median s | worst s | connection kept | faults |"
    yield "|---|---|---:|---:|---:|---:|---:|---|"
    for robot, way in sorted({(outcome.robot, outcome.way) for outcome in outcomes}):
        mine = [outcome for outcome in outcomes if (outcome.robot, outcome.way) == (robot, way)]
        times = [outcome.rest_s for outcome in mine if outcome.rest_s is not None]
        within = sum(one <= LIMIT_S for one in times)
        median, worst = (f"{of(times):.2f}" if times else "-" for of in (statistics.median, max))
        faults = sorted({fault.split(":")[0] for outcome in mine for fault in outcome.faults})
        worst = worst if len(times) == len(mine) else "never"
        kept = sum(outcome.kept for outcome in mine)
        told = f"{len(mine)} | {within} | {median} | {worst} | {kept} | {'; '.join(faults) or '-'}"
        yield f"| {robot} | {way} | {told} |"


def _parsed() -> Any:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--times", type=int, default=30)
    parser.add_argument("--robots", default=",".join(MEASURED), help="some of %(default)s")
    parser.add_argument("--ways", default=",".join(WAYS), help="some of %(default)s")
    parser.add_argument("--lanes", type=int, default=LANES, help="repetitions at a time")
    parser.add_argument("--out", type=Path, help="where one JSON line a repetition goes")
    return parser.parse_args()


def main() -> None:
    wanted = _parsed()
    cases = [
        (robot, way)
        for _ in range(wanted.times)
        for robot in wanted.robots.split(",")
        for way in wanted.ways.split(",")
    ]
    out = wanted.out.open("a") if wanted.out else None

    def took(outcome: Outcome) -> None:
        if out is not None:
            print(json.dumps({**asdict(outcome), "good": outcome.good}), file=out, flush=True)
        if not outcome.good:
            print(outcome, file=sys.stderr, flush=True)

    outcomes = measure(cases, lanes=wanted.lanes, took=took)
    print("\n".join(table(outcomes)))
    good = sum(outcome.good for outcome in outcomes)
    print(f"\n{good} of {len(outcomes)} as they should be.")
    sys.exit(not outcomes or good < len(outcomes))


if __name__ == "__main__":
    main()
