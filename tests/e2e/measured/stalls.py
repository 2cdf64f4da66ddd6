"""A robot that stalls, or whose link is cut, while it is driven: how long after it continues is it at rest?

    python -m tests.e2e.measured.stalls                      # everything, 30 repetitions; about an hour and a half
    python -m tests.e2e.measured.stalls --repetitions 2 --robots tcpudp-1.3,alf --stalls 2.5 --cuts 2 --out stalls.jsonl

Each sitting has a real gateway process, a fragile robot in a process of its own that tells its commanded motion
(:mod:`tests.e2e.rigs.fragile`), and a driver on the bus in a process of its own. It is driven for a moment; then

stall: the robot's process is stopped (SIGSTOP) and continues after some seconds (SIGCONT);
cut: what is between the robot's network namespace and the gateway's forwards nothing for some seconds. Both keep
     their addresses, routes and carriers, and nobody is told: the packets are lost as behind a switch without power.

Meanwhile the driver goes neutral, is killed, falls silent, or (cuts only) drives on without ever being neutral. The
time to rest runs from the moment when the robot or its link continues, or from when the driver's motion had to end if
that is later; a simulation that was held up by its own send continues when its kernel has tried again ("held up": the
longest time after the link was back). Then the robot must stay at rest for ``REST_S``, and be driven again over the
same connection.
A cut of ``SHOWN_S`` and more must show in ``status.reason``, no longer afterwards, and in the counter ``link_stalls``.

What drives a robot by datagrams says nothing of a cut by itself: where no stop was on its way by TCP the driver may
go on after it, and the robot must be at rest after the driver's neutral.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import queue
import random
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from tests.e2e.conftest import Fleet, Gateway, configuration, device
from tests.e2e.rigs import loss
from tests.e2e.rigs.fragile import ROBOTS
from tests.e2e.rigs.moving_robot import REST_S, TOLERANCE, MovingRobot, waited
from tests.e2e.rigs.processes import LINE_S, Part, Road, go_apart
from tests.e2e.rigs.robots import SCALE
from tests.ports import free_port
from tests.scraped import scrape, totals

LIMIT_S = 1.5
"""Most seconds from resuming to rest."""
STALLS_S = (0.3, 0.7, 2.0, 2.5, 5.0, 20.0)
CUTS_S = (1.0, 2.0, 4.0, 6.0, 8.0, 10.0)
CAUSES = {"stall": ("neutral", "killed", "silent"), "cut": ("neutral", "killed", "silent", "driving")}
"""What the driver does meanwhile, in rotation; each robot begins with another one."""
DEADMAN_S = 0.5
FIRST, AGAIN = 0.4, 0.8
"""Speed before, and speed of the driving that shows afterwards that the connection survived."""
RATE_HZ = 25.0
"""Commands of the driver in a second."""
PATIENCE_S = 4.0
"""Longest wait for rest, and for motion afterwards; after a cut twice its length more: kernels double their waits."""
ANOTHER_S = 14.0
"""Seconds until another connection is usable: the robot may not know yet that the one before has ended, and then it
never answers this one."""
SHOWN_S = 2.0
"""The shortest cut that `status` and the counter must show."""
LINK_STALLS = "link_stalls"
PUBLISHED = "bus_messages"
KERNEL = (6, 15)
"""The first Linux with TCP_RTO_MAX_MS."""
AGAIN_AT_MOST = 10
"""Repetitions that may be done again."""
LANES = 10
"""Sittings at a time: they mostly wait."""
SITTING = 6
"""Repetitions in a sitting."""
MEASURED = [name for name in ROBOTS if name != "wc2ec-draft"]
"""The robots that can be driven."""


@dataclass(frozen=True)
class Case:
    """One cell of the plan. way: "stall" or "cut"."""

    robot: str
    way: str
    seconds: float


@dataclass
class Outcome:
    """One repetition. rest_s: None where the robot drove on; faults: what else was wrong."""

    case: Case
    number: int
    cause: str
    rest_s: float | None = None
    faults: list[str] = field(default_factory=list)
    measured: bool = False
    reasons: list[str] = field(default_factory=list)
    """What `status` said during a cut and did not say before."""
    link_stalls: int = 0
    held_up_s: float = 0.0
    """How long the robot's program waited for its own send after the link was back; the time to rest begins then."""
    judge: dict[str, Any] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)

    @property
    def verdict(self) -> str:
        """Whether the robot was at rest in time, too late, or never."""
        if self.rest_s is None:
            return "drove on" if self.measured else ""
        return "late" if self.rest_s > LIMIT_S else "at rest"

    @property
    def disturbed(self) -> bool:
        """Whether the robot, before it was ever driven, was late itself, and lost packets that it joined."""
        return not self.measured and bool(self.judge.get("piled"))

    @property
    def good(self) -> bool:
        """Whether everything was as it should be."""
        return self.verdict == "at rest" and not self.faults


def _sleep_until(at: float) -> None:
    time.sleep(max(0.0, at - time.monotonic()))


# One repetition


class Scene:
    """What all repetitions share: the bus, and an onlooker on it."""

    def __init__(self, stack: contextlib.ExitStack, seed: int) -> None:
        self.seed, self.again = seed, AGAIN_AT_MOST
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        self.fleet = Fleet(stack.enter_context(zenoh.open(configuration("router", self.endpoint))), "fleet/*/status")


class Sitting:
    """One robot, its gateway and its driver, from their start to their end, and some repetitions with them."""

    def __init__(self, scene: Scene, case: Case, numbers: deque[int]) -> None:
        self._scene, self._case, self._kind = scene, case, ROBOTS[case.robot]
        self._numbers = numbers
        self._name = f"{case.robot}-{case.way}-{case.seconds:g}-{numbers[0]}"
        self._rng = random.Random(f"{self._name} {scene.seed}")
        self._patience_s = PATIENCE_S + 2 * case.seconds * (case.way == "cut")
        self._patience_s += ANOTHER_S * (case.seconds >= self._kind.lost_s)
        self._gateway: Gateway | None = None

    def run(self, took: Callable[[Outcome], object]) -> None:
        """Take numbers and measure; what does not come about is a fault, after which nothing more is done here."""
        with contextlib.ExitStack() as stack:
            self._stack = stack
            try:
                self._begin()
                self._set_up()
                self._drive(FIRST)
                self._measure()
                while self._numbers and self.outcome.good:
                    took(self.outcome)
                    self._hear_again()
                    self._begin()
                    self._say_again(FIRST)
                    self._measure()
                self._report()
            except (AssertionError, RuntimeError, OSError, queue.Empty, zenoh.ZError) as error:
                self.outcome.faults.append(f"{type(error).__name__}: {error}")
            if not self.outcome.good and self._gateway is not None:
                self.outcome.log = self._gateway.log.splitlines()[-12:]
        if self.outcome.disturbed and self._scene.again > 0:
            self._scene.again -= 1
            self._numbers.appendleft(self.outcome.number)
        else:
            took(self.outcome)

    def _begin(self) -> None:
        number, causes = self._numbers.popleft(), CAUSES[self._case.way]
        cause = causes[(number + MEASURED.index(self._case.robot)) % len(causes)]
        self.outcome = Outcome(self._case, number, cause)

    # The scene

    def _set_up(self) -> None:
        self._road = Road(self._stack) if self._case.way == "cut" else None
        host, enter = (self._road.far, self._road.enter) if self._road else ("127.0.0.1", ())
        self._robot = MovingRobot(self._stack, self._case.robot, host, enter, self._rng.randrange(1 << 30))
        self._metrics = free_port()
        parts = (
            device(self._robot.port, self._kind.protocol, self._kind.options).replace("127.0.0.1", host),
            f'[metrics]\nlisten = "127.0.0.1:{self._metrics}"\n',
        )
        file = self._scene.folder / f"{self._name}.toml"
        self._gateway = Gateway(self._stack, file, self._scene.endpoint, *parts, robot=self._name)
        gone = self._gateway.process.poll
        if not waited(lambda: self._status.get("state") == "established" or gone() is not None, LINE_S):
            raise RuntimeError(f"not established within {LINE_S:g} s; {self._status}")
        if gone() is not None:
            raise RuntimeError(f"the gateway ended with {gone()}")

    @property
    def _status(self) -> dict[str, Any]:
        return self._scene.fleet.last(f"{self._name}/status")

    def _count(self, name: str) -> int:
        return totals(scrape(self._metrics))[name]

    def _hear_again(self) -> None:
        """Wait until the robot's own bytes come through again: a second cut would double the wait of its kernel."""
        before = self._count(PUBLISHED)
        if not waited(lambda: self._count(PUBLISHED) > before, self._patience_s):
            self.outcome.faults.append("nothing came from the robot any more")

    # What is measured

    def _drive(self, speed: float) -> None:
        number = round(speed * SCALE)
        driver = loss.driver(self._scene.endpoint, self._name, DEADMAN_S, RATE_HZ, number, 0)
        self._driver = Part(self._stack, *driver)

    def _say_again(self, speed: float) -> None:
        self._driver.say(f"again {round(speed * SCALE)}")

    def _measure(self) -> None:
        outcome, robot = self.outcome, self._robot
        if not robot.begins(FIRST, self._driver):
            counted = [line for line in self._counters() if not line.endswith(" 0")]
            self._report()
            raise RuntimeError(f"the robot was never driven; {self._status}; counters {counted}")
        time.sleep(self._rng.uniform(0.3, 0.8))
        before, stalls = self._status["reason"], self._count(LINK_STALLS)
        went, ended, on = self._disturb()
        gated = not self._kind.udp or self._count(LINK_STALLS) > stalls
        if outcome.cause == "driving" and not gated:  # its datagrams were lost, and what it says now is fresh
            time.sleep(REST_S)
            self._driver.say("neutral")
            ended = time.monotonic()
        since = max(on, ended)
        rested = robot.rest(since, self._patience_s)
        since = max(since, robot.went_on)
        outcome.held_up_s = max(0.0, robot.went_on - on)
        outcome.measured = True
        outcome.rest_s = None if rested is None else max(0.0, rested - since)
        outcome.link_stalls = self._count(LINK_STALLS) - stalls
        if self._case.way == "cut":
            self._judge_status(before, went, on, ended)
        elif outcome.link_stalls:
            outcome.faults.append("link_stalls counted a robot whose kernel took everything")
        if rested is not None:
            self._drive_again()
        if self._case.way == "cut" and self._status["reason"] in outcome.reasons:
            outcome.faults.append(f"status still shows the cut: {self._status['reason']}")

    def _disturb(self) -> tuple[float, float, float]:
        """Stall the robot or cut its link; tell when, when the driver's motion had to end, and when it continued."""
        seconds, road, cause = self._case.seconds, self._road, self.outcome.cause
        went = time.monotonic()
        if road is not None:
            road.cut()
        else:
            self._robot.part.signal(signal.SIGSTOP)
        _sleep_until(went + self._rng.uniform(0.1, 0.6 if road is not None else 0.9) * seconds)
        if cause == "killed":
            self._driver.signal(signal.SIGKILL)
        elif cause != "driving":
            self._driver.say(cause)
        ended = time.monotonic() + DEADMAN_S * (cause == "silent")
        _sleep_until(went + seconds)
        on = time.monotonic()
        if road is not None:
            road.mend()
        else:
            self._robot.part.signal(signal.SIGCONT)
        return went, ended, on

    def _judge_status(self, before: str | None, went: float, on: float, ended: float) -> None:
        """Note what `status` said during the cut; a longer one must be shown, there and by the counter.

        Datagrams are not acknowledged: a robot driven by them needs a stop by TCP that is not.
        """
        outcome = self.outcome
        statuses = self._scene.fleet.seen[f"fleet/{self._name}/status"]
        said = {status["reason"] for status in statuses if went < status["at"] < on}
        outcome.reasons = sorted(reason for reason in said if reason and reason != before)
        if self._case.seconds < SHOWN_S or (self._kind.udp and (outcome.cause == "driving" or on - ended < 1.0)):
            return
        if not outcome.reasons:
            outcome.faults.append("status did not show the cut")
        if not outcome.link_stalls:
            outcome.faults.append("link_stalls did not count the cut")

    def _drive_again(self) -> None:
        """Drive again, after a neutral: the connection must have survived, and no motion of before may come."""
        again, lost = len(self._robot.changes), self._case.seconds >= self._kind.lost_s
        if lost:
            self._driver.kill()
            waited(lambda: self._status.get("state") == "established", self._patience_s)
        if lost or self.outcome.cause == "killed" or self._driver.process.poll() is not None:
            self._drive(AGAIN)
        else:
            self._say_again(AGAIN)
        if not self._robot.moving(AGAIN, self._patience_s + DEADMAN_S):
            self.outcome.faults.append(f"not driven again: {self._status}")
        speeds = [speed for _, speed in self._robot.changes[again:]]
        if old := [speed for speed in speeds if speed and abs(speed - AGAIN) > TOLERANCE]:
            self.outcome.faults.append(f"obeyed an old drive: {old[:5]}")

    def _report(self) -> None:
        """End the robot, and take what its judge noted: one connection, unless it was silent for too long."""
        self._robot.part.signal(signal.SIGCONT)
        self._robot.part.say("end")
        waited(lambda: bool(self._robot.report), 5)
        report = self._robot.report
        self.outcome.judge = {key: value[-5:] if isinstance(value, list) else value for key, value in report.items()}
        if not report.get("alive", True):
            self.outcome.faults.append(f"the robot died: {report['violations'][-1:]}")
        lost = [event for event in report.get("events", ()) if "connection" in event or "controller left" in event]
        if lost and self._case.seconds < self._kind.lost_s:
            self.outcome.faults.append(f"the connection was lost: {lost[0]}")


# The plan


def measure(
    cases: Sequence[Case],
    *,
    repetitions: int,
    lanes: int = LANES,
    seed: int = 1,
    took: Callable[[Outcome], None] = lambda _: None,
) -> list[Outcome]:
    """Do every case so often, so many at a time, and call ``took`` with each outcome; the longest go first."""
    plan = [
        (case, deque(range(first, min(first + SITTING, repetitions))))
        for case in sorted(cases, key=lambda case: case.seconds, reverse=True)
        for first in range(0, repetitions, SITTING)
    ]
    waiting, outcomes, taking = iter(plan), list[Outcome](), threading.Lock()

    def take(outcome: Outcome) -> None:
        with taking:
            outcomes.append(outcome)
            took(outcome)

    def lane() -> None:
        for case, numbers in waiting:
            while numbers:
                Sitting(scene, case, numbers).run(take)

    with contextlib.ExitStack() as stack:
        scene = Scene(stack, seed)
        threads = [threading.Thread(target=lane) for _ in range(min(lanes, len(plan)))]
        try:
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        except KeyboardInterrupt:  # what has begun comes to its end
            for _, numbers in plan:
                numbers.clear()
            for thread in threads:
                thread.join()
    return outcomes


def table(outcomes: Iterable[Outcome]) -> Iterator[str]:
    """Write the results as the rows of a Markdown table."""
    yield "| robot | version | what | s | times | median s | worst s | held up s | drove on | late | other faults |"
    yield "|---|---|---|---:|---:|---:|---:|---:|---:|---:|---|"
    cells: dict[Case, list[Outcome]] = {}
    for outcome in outcomes:
        cells.setdefault(outcome.case, []).append(outcome)
    for case in sorted(cells, key=lambda case: (case.way != "stall", MEASURED.index(case.robot), case.seconds)):
        yield _row(case, cells[case])


def _row(case: Case, outcomes: list[Outcome]) -> str:
    kind = ROBOTS[case.robot]
    times = [outcome.rest_s for outcome in outcomes if outcome.rest_s is not None]
    drove_on, late = (sum(outcome.verdict == verdict for outcome in outcomes) for verdict in ("drove on", "late"))
    median, worst = (f"{of(times):.2f}" if times else "-" for of in (statistics.median, max))
    held_up = max(outcome.held_up_s for outcome in outcomes)
    faults = [fault for outcome in outcomes for fault in outcome.faults]
    kinds = [
        f"{sum(one.startswith(kind) for one in faults)} x {kind}" for kind in sorted({f.split(":")[0] for f in faults})
    ]
    told = "; ".join(kinds).replace("|", "/") or "-"
    count = f"{case.seconds:g} | {len(outcomes)}"
    return (
        f"| {kind.protocol} | {kind.version} | {case.way} | {count} | {median} | {'never' if drove_on else worst} "
        f"| {held_up:.2f} | {drove_on} | {late} | {told} |"
    )


def _parsed() -> argparse.Namespace:
    def seconds(text: str) -> tuple[float, ...]:
        return tuple(float(part) for part in text.split(",") if part)

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=30)
    parser.add_argument("--robots", default=",".join(MEASURED), help="some of %(default)s")
    parser.add_argument("--stalls", type=seconds, default=STALLS_S, help='seconds, as in 0.3,2.5; "" for none')
    parser.add_argument("--cuts", type=seconds, default=CUTS_S, help='seconds; "" for none')
    parser.add_argument("--lanes", type=int, default=LANES, help="repetitions at a time")
    parser.add_argument("--out", type=Path, help="where one JSON line a repetition goes")
    parser.add_argument("--seed", type=int, default=os.getpid(), help="of the moments")
    wanted = parser.parse_args()
    wanted.robots = wanted.robots.split(",")
    if unknown := [name for name in wanted.robots if name not in MEASURED]:
        parser.error(f"no robot {', '.join(unknown)}: expected some of {', '.join(MEASURED)}")
    return wanted


def _cases(wanted: argparse.Namespace) -> list[Case]:
    """List what is wanted; a kernel without TCP_RTO_MAX_MS is not cut off for long."""
    release = tuple(int(part) for part in os.uname().release.split("-")[0].split(".")[:2])
    cuts = [seconds for seconds in wanted.cuts if release >= KERNEL or seconds <= 4.0]
    if len(cuts) < len(wanted.cuts):
        print("This kernel has no TCP_RTO_MAX_MS: cuts of up to 4 s only.")
    ways = [("stall", seconds) for seconds in wanted.stalls] + [("cut", seconds) for seconds in cuts]
    return [Case(robot, way, seconds) for way, seconds in ways for robot in wanted.robots]


def main() -> None:
    wanted = _parsed()
    if wanted.cuts and not go_apart("tests.e2e.measured.stalls"):
        wanted.cuts = ()
    os.nice(5)
    cases = _cases(wanted)
    count, done, began = len(cases) * wanted.repetitions, list[Outcome](), time.monotonic()
    print(f"{len(cases)} cases, {wanted.repetitions} times each, {wanted.lanes} at a time")
    print(f"Linux {os.uname().release}, {os.cpu_count()} processors; seed {wanted.seed}", flush=True)
    out = wanted.out.open("a") if wanted.out else None

    def took(outcome: Outcome) -> None:
        done.append(outcome)
        if out is not None:
            print(json.dumps({**asdict(outcome), "good": outcome.good}), file=out, flush=True)
        if len(done) % max(1, count // 20) == 0:
            bad = sum(not outcome.good for outcome in done)
            passed = time.monotonic() - began
            print(f"{len(done)} of {count} after {passed:.0f} s, {bad} bad", file=sys.stderr, flush=True)

    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background of a shell's script
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    measure(cases, repetitions=wanted.repetitions, lanes=wanted.lanes, seed=wanted.seed, took=took)
    print("\n".join(table(done)))
    good = sum(outcome.good for outcome in done)
    print(f"\n{good} of {len(done)} as they should be; {count - len(done)} not done.")
    sys.exit(not done or good < len(done))


if __name__ == "__main__":
    main()
