"""A fragile robot in a process of its own that reports its commanded motion, and waiting for what it does."""

from __future__ import annotations

import contextlib
import json
import queue
import time
from collections.abc import Callable, Sequence
from typing import Any

from tests.e2e.rigs.fragile import GOES_ON
from tests.e2e.rigs.processes import LINE_S, Part, module
from tests.e2e.rigs.robots import SCALE

REST_S = 1.5
"""Seconds that a robot must stay at rest."""
HELD_UP_S = 3.0
"""A driver that has moved nothing for so long begins again."""
TOLERANCE = 0.02


class MovingRobot:
    """A fragile robot's process, and what it tells of its motion."""

    def __init__(
        self, stack: contextlib.ExitStack, name: str, host: str, enter: Sequence[str], seed: int, **options: Any
    ) -> None:
        self.changes: list[tuple[float, float]] = [(0.0, 0.0)]
        """When it told a speed, and which."""
        self.report: dict[str, Any] = {}
        self.went_on = 0.0
        """When its program last continued after its own send held it up."""
        self._ports: queue.Queue[int] = queue.Queue()
        told = json.dumps({"seed": seed, "tells": True, **options})
        self.part = Part(stack, *enter, *module("tests.e2e.rigs.fragile", name, host, told), heard=self._hear)
        self.port = self._ports.get(timeout=LINE_S)

    def _hear(self, line: str) -> None:
        at, _, what = line.partition(" ")
        if line.startswith("{"):
            self.report = json.loads(line)
        elif what == GOES_ON:
            self.went_on = float(at)
        elif what:
            self.changes.append((float(at), float(what)))
        else:
            self._ports.put(int(line))

    @property
    def speed(self) -> float:
        """The speed of the last command that it obeyed."""
        return self.changes[-1][1]

    def moving(self, speed: float, timeout_s: float) -> bool:
        """Wait until it moves at a speed; tell whether it does."""
        return waited(lambda: abs(self.speed - speed) <= TOLERANCE, timeout_s)

    def begins(self, speed: float, driver: Part) -> bool:
        """Wait until a driver has set it in motion. One that was held up met its deadman, and owes a neutral."""
        deadline = time.monotonic() + LINE_S
        while not self.moving(speed, HELD_UP_S):
            if time.monotonic() > deadline:
                return False
            driver.say(f"again {round(speed * SCALE)}")
        return True

    def rest(self, since: float, patience_s: float) -> float | None:
        """Wait until it has been at rest for REST_S; give when it came to rest, None if it did not in time."""
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline + REST_S:
            came = max(since, self.changes[-1][0])
            if self.speed and time.monotonic() > deadline:
                return None
            if not self.speed and time.monotonic() - came >= REST_S:
                return came
            time.sleep(0.02)
        return None


def waited(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Wait until a condition holds; tell whether it does."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True
