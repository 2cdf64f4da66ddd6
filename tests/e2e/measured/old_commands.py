"""A driver's network is cut and heals: what it kept arrives at once, and moves no robot.

    python -m tests.e2e.measured.old_commands            # 30 cuts of 1.0, 2.3 and 4.0 s; about ten minutes
    python -m tests.e2e.measured.old_commands --age 0    # the same with max_age_s = 0: how often the robot moved then

The driver (the Python client) is in a network namespace of its own. It pushes its stick, and during the cut says
neutral and pushes again, as a person does who sees a picture that stands still; it says nothing more from half a second
before the cut heals. After that the robot must stay at rest until the driver says neutral and pushes anew.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import random
import sys
import time
from dataclasses import dataclass, field

import zbridge
from tests.e2e.conftest import until
from tests.e2e.rigs.loss import Scene, query
from tests.e2e.rigs.processes import Finding, go_apart, module, report
from zbridge.client.driver import Driver
from zbridge.errors import Refused

CUTS_S = (1.0, 2.3, 4.0)
SILENT_S = 0.5
"""Seconds before the cut heals in which the driver says nothing: what is younger may be obeyed after a neutral."""
REST_S = 1.5
RATE_S = 0.05
DEADMAN_S = 0.5
TRIES = 5
"""Attempts to set the robot in motion: a busy machine may let the deadman come first."""


@dataclass
class Cuts(Finding):
    """What came of the cuts of one length."""

    seconds: float
    count: int = 0
    moved: int = 0
    """Cuts after which the robot moved on what had waited."""
    stale: list[int] = field(default_factory=list)
    """Commands that were refused as stale, after each cut."""

    def __str__(self) -> str:
        stale = f"{min(self.stale)} to {max(self.stale)}" if self.stale else "no"
        return f"cut of {self.seconds:g} s: {self.count} times, moved {self.moved}, {stale} stale commands"


class CutScene(Scene):
    """The scene with a driver at the end of the road, which is told what to do by words."""

    def __init__(self, stack: contextlib.ExitStack, max_age_s: float) -> None:
        control = f"[control]\nlease_s = 60.0\nmax_age_s = {max_age_s}\n"
        super().__init__(stack, cut=True, parts=control, deadman_s=DEADMAN_S)
        self.start_driver(*module("tests.e2e.measured.old_commands", "driver", self.reach))
        assert self.driver.line() == "holds"

    def begins(self, since: float) -> bool:
        """Let the driver say neutral and push until the robot moves."""
        for _ in range(TRIES):
            self.driver.say("push")
            with contextlib.suppress(AssertionError):
                until(lambda: self.moves(since), 2.0, "motion")
                return True
        return False

    def moves(self, since: float) -> bool:
        return any(frame.moves and frame.at >= since for frame in tuple(self.robot.frames))

    @property
    def stale(self) -> int:
        """Count what the gateway refused as stale."""
        refusals = query(self.session, "control")["refusals"]
        return sum(each["count"] for each in refusals if each["code"] == "stale")


def measure(seconds: float, *, repetitions: int, max_age_s: float = 0.4, seed: int = 1) -> Cuts:
    """Cut the driver off so often."""
    cuts, rng = Cuts(seconds), random.Random(f"{seconds} {seed}")
    with contextlib.ExitStack() as stack:
        scene = CutScene(stack, max_age_s)
        assert scene.road is not None
        while cuts.count < repetitions:
            if not scene.begins(time.monotonic()):
                cuts.faults.append("the robot was never driven")
                return cuts
            time.sleep(rng.uniform(0.2, 0.6))
            before = scene.stale
            scene.driver.say("wave")
            scene.road.cut()
            time.sleep(seconds - SILENT_S)
            scene.driver.say("silent")
            time.sleep(SILENT_S)
            healed = time.monotonic()
            scene.road.mend()
            time.sleep(seconds + REST_S)  # the driver's kernel tries again as late as that
            cuts.count += 1
            cuts.moved += scene.moves(healed)
            cuts.stale.append(scene.stale - before)
        if max_age_s and cuts.moved:
            cuts.faults.append(f"moved after {cuts.moved} cuts")
        if max_age_s and not any(cuts.stale):
            cuts.faults.append("nothing was stale: the cuts held nothing up")
    return cuts


# The driver


async def be_driver(endpoint: str) -> None:
    """Hold the robot; obey words: ``push`` (neutral, then motion), ``wave`` (both by turns), ``silent``."""
    words = asyncio.Queue[str]()
    loop = asyncio.get_running_loop()
    loop.add_reader(sys.stdin, lambda: words.put_nowait(sys.stdin.readline().strip()))
    async with zbridge.connect(endpoints=[endpoint]) as fleet:
        while True:  # a renewal may have been lost three times in a row
            async with fleet["r1"].control("driver", deadman_s=DEADMAN_S, lease_s=60.0, wait_s=20.0) as drive:
                print("holds", flush=True)
                await _drive(drive, words)


async def _drive(drive: Driver, words: asyncio.Queue[str]) -> None:
    """Obey until the lease is lost."""
    does, tick = "silent", 0
    while not drive.lost.is_set():
        with contextlib.suppress(asyncio.QueueEmpty):
            does, tick = words.get_nowait(), 0
        tick += 1
        if does != "silent":
            neutral = tick == 1 or (does == "wave" and tick % 10 == 0)
            with contextlib.suppress(Refused):
                await drive(forward=0.0 if neutral else 0.5)
        await asyncio.sleep(RATE_S)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=30)
    parser.add_argument("--cuts", type=lambda text: [float(part) for part in text.split(",")], default=CUTS_S)
    parser.add_argument("--age", type=float, default=0.4, help="max_age_s of the gateway")
    parser.add_argument("--seed", type=int, default=os.getpid(), help="of the moments")
    wanted = parser.parse_args()
    if not go_apart("tests.e2e.measured.old_commands"):
        sys.exit(2)
    report(
        measure(seconds, repetitions=wanted.repetitions, max_age_s=wanted.age, seed=wanted.seed)
        for seconds in wanted.cuts
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["driver"]:
        asyncio.run(be_driver(sys.argv[2]))
    else:
        main()
