"""Mixed commands through a real gateway against a fragile robot: no violation, and everything arrives.

What all judges of that kind share. The judge holds the robot's lease, and acquires it anew after each stop. Each value
is used once, so that every command is its own. What a robot cannot do must be refused and never arrive.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from tests.e2e.conftest import Bench, device, until
from tests.e2e.rigs.fragile import DISTURBED, disturbed, fragile_robot
from tests.e2e.rigs.processes import Finding

Arrival = tuple[Any, ...]


class Put(NamedTuple):
    """What is put at ``fleet/r1/@cmd/<path>``, and what of it must arrive at the robot."""

    path: str
    fields: dict[str, Any] | bytes
    arrivals: tuple[Arrival, ...] = ()


@dataclass
class Judgement(Finding):
    """What came of one run."""

    name: str
    sent: Counter[str] = field(default_factory=Counter)
    unanswered: Counter[str] = field(default_factory=Counter)
    excused: list[str] = field(default_factory=list)
    overtaken: list[str] = field(default_factory=list)
    """Commands that did not arrive, as far as that is allowed: a newer one replaced them, or a stop overtook them."""
    late_s: float = 0.0
    disturbed: bool = False
    """The robot lost a packet of the handshake because its own process was late: it understands nothing after that."""
    arrived: int = 0
    seconds: float = 0.0

    def __str__(self) -> str:
        return (
            f"{self.name}: {sum(self.sent.values())} commands in {self.seconds:.0f} s, {self.arrived} arrived, "
            f"{len(self.faults)} violations or missing, {len(self.excused)} excused (the robot's process was late), "
            f"{len(self.overtaken)} overtaken"
        )


class Run:
    """Sends commands, remembers what must arrive, and holds what arrived against it."""

    robot: str
    """Its name among the fragile ones."""
    options: ClassVar[dict[str, Any]] = {}
    pace_s: float
    """Seconds between two commands."""
    kinds: ClassVar[dict[str, Callable[[int], list[Put]]]]
    weights: ClassVar[dict[str, int]]
    """How often each kind comes; a kind that is no put is a method."""

    def __init__(self, bench: Bench, judgement: Judgement, seed: int) -> None:
        self.bench, self.judgement = bench, judgement
        self.expected: list[Arrival] = []
        self.refused: list[Arrival] = []
        """What would arrive of commands that the robot cannot take."""
        self._rng = random.Random(seed)

    def command(self, number: int) -> None:
        """Give the command of this number."""
        (kind,) = self._rng.choices([*self.weights], [*self.weights.values()])
        self.judgement.sent[kind] += 1
        if kind in self.kinds:
            for put in self.kinds[kind](number):
                (self.expected if self.takes(kind) else self.refused).extend(put.arrivals)
                self.put(put.path, put.fields)
        else:
            getattr(self, kind)(number)

    def put(self, path: str, fields: dict[str, Any] | bytes) -> None:
        if isinstance(fields, bytes):
            self.bench.fleet.put(f"r1/@cmd/{path}", fields)
        else:
            self.bench.fleet.put(f"r1/@cmd/{path}", **fields)

    def takes(self, kind: str) -> bool:
        """Tell whether the robot takes commands of this kind."""
        return True

    def stop(self, number: int) -> None:
        """Stop, as anybody may; whoever wants to continue acquires anew, which is refused until the stop was heard."""
        self.put("stop", {})
        time.sleep(self.pace_s)
        until(self._holds, what="the lease after a stop")

    def _holds(self) -> bool:
        with contextlib.suppress(AssertionError):
            self.bench.fleet.hold("r1", "judge")
            return True
        return False

    def end(self) -> None:
        """Stop, and wait until all has arrived."""
        self.put("stop", {})
        time.sleep(1.5)

    def arrivals(self, report: dict[str, Any]) -> list[Arrival]:
        """Give what the robot got."""
        raise NotImplementedError

    def may_miss(self, arrival: Arrival) -> bool:
        """Tell whether a command may be replaced or overtaken."""
        raise NotImplementedError

    def compare(self, report: dict[str, Any]) -> None:
        """Hold what arrived against what had to."""
        judgement = self.judgement
        if report["left"] or not report["alive"]:
            judgement.faults.append("the robot died")
        judgement.disturbed = disturbed(report)
        for text in report["violations"]:
            (judgement.excused if "(this process" in text else judgement.faults).append(text)
        came = self.arrivals(report)
        judgement.arrived = len(came)
        arrived = Counter(came)
        for arrival in self.expected:
            if arrived[arrival]:
                arrived[arrival] -= 1
            else:
                missed = judgement.overtaken if self.may_miss(arrival) else judgement.faults
                missed.append(f"missing: {str(arrival)[:60]}")
        judgement.faults += [f"{one} should have been refused" for one in self.refused if arrived[one]]


def judged(kind: type[Run], name: str, *, commands: int, seed: int) -> Judgement:
    """Run one gateway against one fragile robot; run it again where the robot's own lateness spoilt the handshake."""
    for _ in range(DISTURBED):
        judgement = Judgement(name)
        with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
            bench = Bench(Path(folder), stack)
            robot = stack.enter_context(fragile_robot(kind.robot, seed=seed, **kind.options))
            bench.gateway(device(robot.port, robot.kind.protocol, robot.kind.options))
            until(lambda bench=bench: bench.fleet.state() == "established", what="established")  # type: ignore[misc]
            bench.fleet.hold("r1", "judge")
            run = kind(bench, judgement, seed)
            began, withheld_s = time.monotonic(), bench.withheld_s
            for number in range(commands):
                run.command(number)
                time.sleep(run.pace_s)
            run.end()
            judgement.seconds = time.monotonic() - began
            judgement.late_s = bench.withheld_s - withheld_s
            run.compare(robot.ended())
        if not judgement.disturbed:
            break
    return judgement


def options(doc: str | None) -> argparse.ArgumentParser:
    """Give what all of these judges can be told."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--commands", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    return parser
