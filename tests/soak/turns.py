"""Who drives the robots, and the judging of it by the robots' own account.

Each robot is driven by turns: by a program on the bus, which has a speed of its own in each turn, or by an old HQ
program through the gateway's listener. A turn ends in one way or another, and the robot must rest in time and stay
at rest.
"""

from __future__ import annotations

import contextlib
import random
import signal
import threading
import time
from collections import Counter
from dataclasses import dataclass, field

import zenoh

from tests.e2e.rigs import loss
from tests.e2e.rigs.loss import commander
from tests.e2e.rigs.moving_robot import TOLERANCE, MovingRobot
from tests.e2e.rigs.processes import Part, module
from tests.e2e.rigs.robots import SCALE
from tests.proofs import packed
from tests.soak.scene import ROBOT_PLANS, Scene

LIMIT_S = 2.5
"""Most seconds to rest, once the driver is gone by its deadman, and robot, link and gateway work: 1.5 s on a link that
loses nothing, and one more idle stop where it does."""
REST_S = 1.5
"""Seconds for which the robot must stay at rest then."""
BEGINS_S = 6.0
"""Longest wait for motion; what is broken meanwhile may prevent it."""
DEADMAN_S, RATE_HZ = 0.5, 25.0
HQ_DEADMAN_S = {"tcpudp": 1.3, "alf": 0.3, "wc2ec": 0.5}
SPEEDS = tuple(step / 100 for step in range(20, 92, 4))
FORGED = 0.96
"""The speed that somebody commands who has no lease."""


@dataclass
class Tally:
    """What came of all turns."""

    turns: Counter[str] = field(default_factory=Counter)
    driven: int = 0
    rest_s: list[float] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


class Disturbances:
    """When the last disturbance ended that keeps a robot from resting: of its program, its link, its gateway."""

    def __init__(self) -> None:
        self._over: dict[str, float] = {}
        self.now: set[str] = set()

    def begin(self, *names: str) -> None:
        self.now.update(names)

    def end(self, *names: str) -> None:
        self._over.update(dict.fromkeys(names, time.monotonic()))
        self.now.difference_update(names)

    def over(self, name: str) -> float:
        """Give the time; a disturbance that has not ended has not ended now."""
        return time.monotonic() if name in self.now else self._over.get(name, 0.0)


class Turns(threading.Thread):
    """The turns of one robot, on a thread, while :attr:`go` is set."""

    def __init__(self, scene: Scene, name: str, disturbances: Disturbances, tally: Tally, seed: int) -> None:
        super().__init__(daemon=True)
        self.go, self.idle, self.ended = threading.Event(), threading.Event(), threading.Event()
        self._scene, self._name, self._disturbances, self._tally = scene, name, disturbances, tally
        self._rng = random.Random(f"{name} {seed}")
        self._plan = ROBOT_PLANS[name]
        self._speed = 0.0

    def run(self) -> None:
        while not self.ended.is_set():
            self.idle.set()
            if self.go.wait(0.5):
                self.idle.clear()
                with contextlib.ExitStack() as stack:
                    try:
                        self._turn(stack)
                    except (AssertionError, OSError, zenoh.ZError) as error:
                        self._tally.turns[f"no driver: {type(error).__name__}"] += 1

    def _turn(self, stack: contextlib.ExitStack) -> None:
        robot, by_hq = self._scene.robots[self._name], self._rng.random() < 0.35
        begun = len(robot.changes)
        self._speed = self._rng.choice([speed for speed in SPEEDS if speed != self._speed])
        driver = self._start(stack, by_hq)
        ends_at = time.monotonic() + BEGINS_S
        while not any(speed for _, speed in robot.changes[begun:]) and time.monotonic() < ends_at:
            time.sleep(0.02)
        self._tally.driven += any(speed for _, speed in robot.changes[begun:])
        ends_at = time.monotonic() + self._rng.uniform(1.0, 6.0)
        while driver.process.poll() is None and time.monotonic() < ends_at:
            time.sleep(0.05)
        way = "by itself" if driver.process.poll() is not None else self._end(driver, by_hq)
        ended = time.monotonic()
        self._tally.turns[f"{'HQ program' if by_hq else 'bus'}: {way}"] += 1
        self._judge_rest(robot, ended, HQ_DEADMAN_S[self._plan.protocol] if by_hq else DEADMAN_S, way)
        if not by_hq:
            self._judge_speeds(robot, begun)

    def _start(self, stack: contextlib.ExitStack, by_hq: bool) -> Part:
        if not by_hq:
            return Part(
                stack, *loss.driver(self._scene.reach, self._name, DEADMAN_S, RATE_HZ, round(self._speed * SCALE), 0)
            )
        where = (self._scene.bus_link.far, self._scene.hq_port(self._name))
        program = Part(stack, *module("tests.e2e.rigs.hq_programs", self._plan.program, *where))
        assert program.line(BEGINS_S) == "ready"
        program.say("push")
        return program

    def _end(self, driver: Part, by_hq: bool) -> str:
        """Let the driver end, or lose it; tell how."""
        way = self._rng.choice(("killed", "frozen", "closed") if by_hq else ("killed", "frozen", "silent", "neutral"))
        if way == "closed":
            driver.close()
        elif way in ("killed", "frozen"):
            driver.signal(signal.SIGKILL if way == "killed" else signal.SIGSTOP)
        else:
            driver.say(way)
        return way

    def _judge_rest(self, robot: MovingRobot, ended: float, deadman_s: float, way: str) -> None:
        """Wait until the robot has been at rest for a while; one that moves too late is a fault, and so is its name."""
        while True:
            now, (changed, speed) = time.monotonic(), robot.changes[-1]
            since = max(ended + deadman_s, self._disturbances.over(self._name), robot.went_on)
            if robot is not self._scene.robots[self._name]:
                return
            if not speed and now - max(changed, since) >= REST_S:
                self._tally.rest_s.append(max(0.0, changed - since))
                return
            if speed and now > since + LIMIT_S:
                last = [(round(at - ended, 2), speed) for at, speed in robot.changes[-4:]]
                text = f"{self._name} moves {now - since:.1f} s after its driver was gone ({way}); since then: {last}"
                self._tally.faults.append(text)
                return
            time.sleep(0.02)

    def _judge_speeds(self, robot: MovingRobot, begun: int) -> None:
        """Only the holder may have moved it: each speed is that of this turn's driver."""
        foreign = [speed for _, speed in robot.changes[begun:] if speed and abs(speed - self._speed) > TOLERANCE]
        if foreign:
            text = f"{self._name} moved at {foreign[:5]}, which its driver ({self._speed}) never said"
            self._tally.faults.append(text)


def forge(session: zenoh.Session, names: list[str], rng: random.Random, seconds: float) -> None:
    """Command a robot without a lease, and with a proof that is none."""
    name = rng.choice(names)
    commands = commander(session, "drive", name)
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        lie = packed({"lease": rng.randbytes(8), "seq": rng.randrange(1 << 40), "proof": rng.randbytes(16)})
        commands.put(packed({"forward": FORGED}), attachment=rng.choice((None, lie)))
        time.sleep(0.05)
    commands.undeclare()  # type: ignore[no-untyped-call]
