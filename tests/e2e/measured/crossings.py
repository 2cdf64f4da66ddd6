"""A gateway crashes, or restarts and dies on the way, while its robot is driven: does the robot rest, and stay usable?

    python -m tests.e2e.measured.crossings                     # everything, 20 times each; about an hour and a half
    python -m tests.e2e.measured.crossings --times 3 --only 'alf' 'successor after go' --out crossings.jsonl
    python -m tests.e2e.measured.crossings --list

One supervisor (``zbridge run DIR``) runs all gateways, each with a listener. Each repetition has a fragile robot of its
own, in a process that tells its commanded motion (:mod:`tests.e2e.rigs.moving_robot`) and has a map as large as the
field's, a robot file that comes while the supervisor runs, an HQ program at the listener, and a driver on the bus.
While the robot moves, its gateway

hung: blocks its event loop for good; frozen: is stopped (SIGSTOP); killed: is killed (SIGKILL);
restart: is restarted, and both processes come through;
predecessor, successor: is restarted, and this process dies, or is frozen, at this step (:mod:`tests.e2e.rigs.steps`);
again: is killed, and so is the process that continues with its connections, at this step.

The time to rest runs from that moment; where the driver may drive on (the successor died early), from the driver's end.
Then the robot is driven again. Its judge must have nothing to say, and must have seen one connection. The HQ program
connects anew; the time runs until the listener has greeted it.
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
import socket
import statistics
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from tests.e2e.conftest import HOST, Fleet, configuration, device, end, listener, until
from tests.e2e.rigs import loss, steps
from tests.e2e.rigs.fragile import DISTURBED, ROBOTS, charges
from tests.e2e.rigs.hq_scene import ANSWER
from tests.e2e.rigs.moving_robot import MovingRobot
from tests.e2e.rigs.processes import LINE_S, Part
from tests.e2e.rigs.robots import SCALE
from tests.e2e.rigs.steps import STEPS, Of, Order
from tests.e2e.rigs.supervised import Supervised
from tests.ports import free_port

LIMIT_S = 1.5
"""Most seconds from the crash to rest."""
REST_S = 1.0
"""Seconds that a robot must stay at rest."""
GREETED_S = 5.0
"""Most seconds until the listener has greeted an HQ program again."""
PATIENCE_S = 6.0
STEP_S = 30.0
"""Longest wait for a step of a restart."""
SPEED, AGAIN = 0.4, 0.8
DEADMAN_S, RATE_HZ = 0.5, 25.0
LANES = 4
MAPS: dict[str, dict[str, Any]] = {
    "tcpudp-1.1": {"side": 500},
    "tcpudp-1.3": {"side": 2048},
    "tcpudp-1.3-udp": {"side": 240},
    "tcpudp-1.4": {"side": 2048, "times": {"part_s": 0.2}},
    "alf": {},
    "mavlink": {"supervised": True},
    "wc2ec": {},
}
"""The robots that are measured, and what they are told; side: of a map, in cells."""
CRASHES = {"hung": signal.SIGUSR1, "frozen": signal.SIGSTOP, "killed": signal.SIGKILL}
EARLY = (steps.BEFORE_HELLO, steps.AFTER_HELLO, steps.AFTER_GIVEN, steps.AFTER_UP)
"""A successor that dies at one of these has not got the robot: the gateway continues."""
_numbers = itertools.count()


@dataclass(frozen=True)
class Case:
    """One row of the plan: a robot, and what happens to its gateway."""

    robot: str
    way: str

    def __str__(self) -> str:
        return f"{self.robot}: {self.way}"

    @property
    def crash(self) -> signal.Signals | None:
        """The signal that the gateway is sent; None: it is restarted."""
        return CRASHES.get(self.way, signal.SIGKILL if self.way.startswith("again ") else None)

    @property
    def order(self) -> Order | None:
        """What happens at which step."""
        of, _, step = self.way.removeprefix("again ").partition(" ")
        if of not in tuple(Of):
            return None
        number = signal.SIGSTOP if step.startswith("frozen ") else signal.SIGKILL
        return Order(Of(of), step.removeprefix("frozen "), number)

    @property
    def goes_on(self) -> bool:
        """Whether the gateway may continue as before, and its driver drive on."""
        order = self.order
        return self.crash is None and order is not None and order.of is Of.SUCCESSOR and order.step in EARLY


WAYS = (
    *CRASHES,
    "restart",
    *(f"{of} {step}" for of in Of for step in STEPS[of]),
    f"predecessor frozen {steps.AFTER_GIVEN}",
    f"successor frozen {steps.AFTER_GO}",
    f"again successor {steps.AFTER_GIVEN}",
    f"again successor {steps.AFTER_GO}",
)


@dataclass
class Outcome:
    """One repetition. rest_s: None where the robot drove on; faults: what else was wrong."""

    case: Case
    rest_s: float | None = None
    greeted_s: float | None = None
    """Seconds until the listener greeted the HQ program again; None: its connection never ended."""
    kept: bool = False
    """Whether the robot saw one connection all the time."""
    faults: list[str] = field(default_factory=list)
    disturbed: bool = False
    """Whether the robot was never driven, and was late itself: it lost packets that it read as one."""

    within_a_read: bool = False
    """Whether the process died while it read: then nobody can resume its connection."""

    @property
    def good(self) -> bool:
        """Whether everything was as it should be."""
        return self.rest_s is not None and self.rest_s <= LIMIT_S and self.kept and not self.faults


class HqProgram:
    """An HQ program that only looks on: connects, is greeted, reads, and connects anew. A thread of its own."""

    def __init__(self, stack: contextlib.ExitStack, port: int, protocol: str) -> None:
        self.greeted: list[float] = []
        """When a listener sent it the first bytes of a connection."""
        self.ended: list[float] = []
        self._address, self._answer = (HOST, port), ANSWER if protocol == "tcpudp" else b""
        self._closed = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()
        stack.callback(self._closed.set)

    def _run(self) -> None:
        while not self._closed.wait(0.02):
            with contextlib.suppress(OSError), socket.create_connection(self._address, timeout=1.0) as end:
                self._talk(end)

    def _talk(self, end: socket.socket) -> None:
        end.settimeout(0.2)
        greeted = False
        while not self._closed.is_set():
            with contextlib.suppress(TimeoutError):
                if not end.recv(65_536):
                    break
                if not greeted:
                    greeted = True
                    self.greeted.append(time.monotonic())
                    end.sendall(self._answer)
        if greeted:
            self.ended.append(time.monotonic())


class Scene:
    """What all repetitions share: the bus, an onlooker on it, and the supervisor."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.endpoint = f"tcp/{HOST}:{free_port()}"
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "robots"
        self.folder.mkdir()
        self.session = stack.enter_context(zenoh.open(configuration("router", self.endpoint)))
        self.fleet = Fleet(self.session, "fleet/*/status")
        self.place("idle", device(1))  # a supervisor wants one file; nobody listens at port 1
        self.supervisor = Supervised(stack, self.folder, hangs=True)
        until(lambda: "ready" in self.supervisor.log, LINE_S, "the supervisor")

    def place(self, name: str, *parts: str) -> Path:
        """Write a robot's file, at one stroke."""
        bus = f'[bus]\nconnect = ["{self.endpoint}"]\nmulticast = false\n'
        new = self.folder / f"{name}.new"
        new.write_text(f'[robot]\nname = "{name}"\n' + "".join(parts) + bus)
        return new.rename(self.folder / f"{name}.toml")

    def established(self, name: str) -> bool:
        """Whether a gateway said within the last second that it has its robot."""
        last = self.fleet.last(f"{name}/status")
        return last.get("state") == "established" and time.monotonic() - last["at"] < 1.2


class Crossing:
    """One repetition: a robot, its gateway, an HQ program and a driver, from their start to their end."""

    def __init__(self, scene: Scene, stack: contextlib.ExitStack, outcome: Outcome) -> None:
        self._scene, self._stack, self._outcome, self._case = scene, stack, outcome, outcome.case
        self._name = f"{outcome.case.robot[:6]}.{next(_numbers)}"
        self._kind = ROBOTS[outcome.case.robot]

    def run(self) -> None:
        """Let it happen; what does not come about raises AssertionError, RuntimeError or OSError."""
        outcome, scene = self._outcome, self._scene
        robot = self._robot = MovingRobot(
            self._stack, self._case.robot, HOST, (), random.randrange(1 << 30), **MAPS[self._case.robot]
        )
        port = free_port()
        listens = listener("desk", self._kind.protocol, port, self._kind.hq)
        file = scene.place(self._name, device(robot.port, self._kind.protocol, self._kind.options), listens)
        self._stack.callback(scene.supervisor.reload)
        self._stack.callback(file.unlink)
        scene.supervisor.reload()
        until(lambda: scene.established(self._name), LINE_S, "established")
        program = HqProgram(self._stack, port, self._kind.protocol)
        until(lambda: program.greeted, LINE_S, "an HQ program that is greeted")
        driver = self._drive(SPEED)
        if not robot.begins(SPEED, driver):
            self._report()
            outcome.disturbed = bool(robot.report["piled"])
            raise RuntimeError("the robot was never driven")
        time.sleep(random.uniform(0.5, 1.5))
        at = self._happens()
        outcome.rest_s = self._rest(at, driver)
        until(lambda: scene.established(self._name), LINE_S, "established again")
        self._drives_again()
        self._see_greeted(program, at)
        self._report()
        self._judge()

    def _drive(self, speed: float) -> Part:
        return Part(
            self._stack,
            *loss.driver(self._scene.endpoint, self._name, DEADMAN_S, RATE_HZ, round(speed * SCALE), 0),
        )

    def _happens(self) -> float:
        """Let the gateway crash, or restart and die on the way; tell when."""
        scene, case = self._scene, self._case
        pid, orders = scene.supervisor.gateway(self._name), scene.supervisor.orders
        if case.order is not None:
            case.order.write(orders, self._name)
        at, logged = time.monotonic(), scene.supervisor.logged
        os.kill(pid, case.crash or signal.SIGUSR2)
        if case.order is not None:
            at = until(lambda: Order.carried_out(orders, self._name), STEP_S, f"the step: {case.way}")
        elif case.crash is None:
            served = re.compile(rf"{re.escape(self._name)}: process \d+ serves it now")
            until(lambda: served.search(scene.supervisor.log_since(logged)), STEP_S, "the restart")
        return at

    def _rest(self, since: float, driver: Part) -> float | None:
        """Wait until the robot has been at rest for REST_S; give the seconds to rest.

        They run from ``since``, or, where the gateway continues, from the driver's end.
        """
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            at, speed = self._robot.changes[-1]
            if not speed and time.monotonic() - max(at, since) >= REST_S:
                return max(0.0, at - since)
            if self._case.goes_on and time.monotonic() > since + LIMIT_S and driver.process.poll() is None:
                driver.kill()
                since = time.monotonic()
            time.sleep(0.02)
        return None

    def _drives_again(self) -> None:
        deadline, driver = time.monotonic() + LINE_S, self._drive(AGAIN)
        while not self._robot.moving(AGAIN, 0.5):
            if time.monotonic() > deadline:
                self._outcome.faults.append("not driven again")
                break
            if driver.process.poll() is not None:  # its lease ended
                driver = self._drive(AGAIN)
            driver.say(f"again {round(AGAIN * SCALE)}")
        driver.kill()
        killed = time.monotonic()
        rested = self._robot.rest(killed, PATIENCE_S)
        if rested is None or rested - killed > LIMIT_S:
            self._outcome.faults.append("not at rest after it was driven again")

    def _see_greeted(self, program: HqProgram, at: float) -> None:
        """Wait until the HQ program is greeted again, if its connection ended; note the time from then."""
        if program.ended and program.ended[-1] > at - LIMIT_S:
            until(lambda: program.greeted[-1] > program.ended[-1], GREETED_S, "an HQ program that is greeted again")
            self._outcome.greeted_s = max(0.0, program.greeted[-1] - max(at, program.ended[-1]))

    def _report(self) -> None:
        self._robot.part.say("end")
        until(lambda: self._robot.report, 5, "the robot's report")

    def _judge(self) -> None:
        outcome, report = self._outcome, self._robot.report
        outcome.faults += charges(report["violations"], LIMIT_S)  # which excuses commands that are too rare
        lost = [event for event in report["events"] if "connection" in event or "left" in event]
        outcome.kept = not lost
        outcome.faults += [f"its connection: {lost[0]}"] if lost else []
        if report["moving"]:
            outcome.faults.append("the robot moves at the end")


def repeat(scene: Scene, case: Case) -> Outcome:
    """Do a case once; what does not come about is a fault."""
    outcome, logged = Outcome(case), scene.supervisor.logged
    with contextlib.ExitStack() as stack:
        crossing = Crossing(scene, stack, outcome)
        try:
            crossing.run()
        except (AssertionError, RuntimeError, OSError) as error:
            status = scene.fleet.last(f"{crossing._name}/status")
            outcome.faults.append(f"{type(error).__name__}: {error}; {status}")
        if not outcome.good and not outcome.disturbed:
            lines = [line for line in scene.supervisor.log_since(logged).splitlines() if f"{crossing._name}:" in line]
            outcome.within_a_read = any("it died while it read" in line for line in lines)
            print(outcome, *lines[-25:], sep="\n  ", file=sys.stderr, flush=True)
    return outcome


def measure(
    cases: Iterable[Case], *, lanes: int = LANES, took: Callable[[Outcome], object] = lambda _: None
) -> list[Outcome]:
    """Do every case once, so many at a time; give what came of them."""
    waiting, taking, outcomes = deque(cases), threading.Lock(), list[Outcome]()

    def lane() -> None:
        while waiting:
            try:
                case = waiting.popleft()
            except IndexError:  # another lane was quicker
                return
            for _ in range(DISTURBED):
                outcome = repeat(scene, case)
                if not outcome.disturbed:
                    break
            with taking:
                outcomes.append(outcome)
                took(outcome)

    with contextlib.ExitStack() as stack:
        scene = Scene(stack)
        threads = [threading.Thread(target=lane) for _ in range(lanes)]
        try:
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        except KeyboardInterrupt:  # what has begun comes to its end
            waiting.clear()
            for thread in threads:
                thread.join()
        end(scene.supervisor.process)
        if "Traceback" in scene.supervisor.log:
            print(scene.supervisor.log, file=sys.stderr)
    return outcomes


def table(outcomes: list[Outcome]) -> Iterator[str]:
    """Write the results as a Markdown table: a row for what happens, a column for each robot."""
    robots = [robot for robot in MAPS if any(outcome.case.robot == robot for outcome in outcomes)]
    yield f"| what happens | {' | '.join(robots)} |"
    yield f"|---{'|---' * len(robots)}|"
    for way in WAYS:
        if any(outcome.case.way == way for outcome in outcomes):
            cells = [[each for each in outcomes if each.case == Case(robot, way)] for robot in robots]
            yield f"| {way} | {' | '.join(map(_cell, cells))} |"


def _cell(outcomes: list[Outcome]) -> str:
    """Good of all; median and worst time to rest; connections kept if not all; worst time to the HQ's greeting."""
    if not outcomes:
        return ""
    rests = [outcome.rest_s for outcome in outcomes if outcome.rest_s is not None]
    greeted = [outcome.greeted_s for outcome in outcomes if outcome.greeted_s is not None]
    kept = sum(outcome.kept for outcome in outcomes)
    cell = f"{sum(outcome.good for outcome in outcomes)}/{len(outcomes)}"
    cell += f": {statistics.median(rests):.2f} / {max(rests):.2f}" if rests else ": -"
    cell += f"; kept {kept}" if kept < len(outcomes) else ""
    return cell + (f"; HQ {max(greeted):.1f}" if greeted else "")


def cases(only: Iterable[str] = (), times: int = 1) -> list[Case]:
    """List the plan so often: all cases whose words ("alf: killed") have one of ``only`` in them."""
    plan = [Case(robot, way) for robot in MAPS for way in WAYS]
    wanted = [case for case in plan if not only or any(part in str(case) for part in only)]
    return [case for _ in range(times) for case in wanted]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--only", nargs="*", default=(), help='parts of cases, such as "alf: killed", "after go"')
    parser.add_argument("--list", action="store_true", help="print the cases and end")
    parser.add_argument("--lanes", type=int, default=LANES, help="repetitions at a time")
    parser.add_argument("--out", type=Path, help="where one JSON line a repetition goes")
    wanted = parser.parse_args()
    plan = cases(wanted.only, wanted.times)
    if wanted.list:
        print("\n".join(map(str, cases(wanted.only))))
        return
    out = wanted.out.open("a") if wanted.out else None
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background of a shell's script
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))

    def took(outcome: Outcome) -> None:
        if out is not None:
            print(json.dumps({**asdict(outcome), "good": outcome.good}), file=out, flush=True)

    outcomes = measure(plan, lanes=wanted.lanes, took=took)
    print("\n".join(table(outcomes)))
    good = sum(outcome.good for outcome in outcomes)
    print(f"\n{good} of {len(outcomes)} as they should be.")
    sys.exit(not outcomes or good < len(outcomes))


if __name__ == "__main__":
    main()
