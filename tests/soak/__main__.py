"""Soak: hours of faults, and whether anything grew, slowed down, got lost, or moved that should not have.

    python -m tests.soak --hours 1 --seed 1
    python -m tests.soak --minutes 5 --log soak.log

Minutes of faults (:mod:`tests.soak.faults`) while drivers and HQ programs take turns, then a quiet time in which what
is used and how long messages take are measured (:mod:`tests.soak.gates`). The end is a table; the exit code is 1 where
a row of it is not good. The machine's wall clock is never touched, and a namespace gives a process another monotonic
clock only at its start: jumps of clocks are left to :mod:`tests.simulated`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import sys
import tempfile
import time
from pathlib import Path

from tests.e2e.rigs.processes import NotHereError, apart, ip
from tests.soak.faults import Faults
from tests.soak.gates import Gate, Measured, loss_gates, quantile
from tests.soak.network import missing
from tests.soak.recorder import Recorder
from tests.soak.scene import ROBOT_PLANS, Scene
from tests.soak.turns import Disturbances, Tally, Turns

STORM_S = 40.0
"""Seconds of faults between two quiet times."""
CALM_S = 5.0
"""Seconds after which what waited on the links has come."""
_APART = "ZBRIDGE_SOAK_APART"
_SHOWN = 20


class Soak:
    """One run."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path, seed: int) -> None:
        self.tally, self.measured = Tally(), Measured()
        disturbances, rng = Disturbances(), random.Random(f"faults {seed}")
        self.scene = Scene(stack, folder, seed)
        self.recorder = Recorder(stack, self.scene.reach, random.Random(f"recorder {seed}"))
        self.faults = Faults(self.scene, self.recorder, disturbances, rng)
        self.turns = [Turns(self.scene, name, disturbances, self.tally, seed) for name in ROBOT_PLANS]

    def run(self, seconds: float) -> list[Gate]:
        """Run for so long; give the rows of the table."""
        self.faults.calm()
        self.scene.settle()
        began = time.monotonic()
        for turns in self.turns:
            turns.start()
        while time.monotonic() - began < seconds:
            try:
                self._cycle()
                print(self._progress(time.monotonic() - began), file=sys.stderr, flush=True)
            except (AssertionError, OSError) as error:
                self.scene.faults.append(f"a cycle failed: {error}")
        for turns in self.turns:
            turns.ended.set()
        self.recorder.end()
        gates = [
            *self.measured.gates(began, seconds),
            *loss_gates(self.scene, self.faults.bus_faults),
        ]
        for name in ROBOT_PLANS:
            self.scene.judge(name)
        return [*gates, *self._fault_gates()]

    def _cycle(self) -> None:
        """Let things fail, then measure in peace."""
        for turns in self.turns:
            turns.go.set()
        self.faults.storm(STORM_S)
        self.faults.calm()
        for turns in self.turns:
            turns.go.clear()
        for turns in self.turns:
            turns.idle.wait(60.0)
        time.sleep(CALM_S)
        self.scene.settle()
        self.measured.measure(self.scene)

    def _progress(self, passed_s: float) -> str:
        window = self.measured.windows[-1]
        pose, drive = (quantile(values, 0.5) * 1000 for values in (window.pose_s, window.drive_s))
        used = {name: f"{use['kB']} kB, {use['files']}" for name, use in window.use.items()}
        faults = self.tally.faults + self.scene.faults + self.recorder.faults
        return (
            f"{passed_s:.0f} s: {self.faults.done.total()} faults, {self.tally.turns.total()} turns; "
            f"p50 {pose:.2f} and {drive:.2f} ms; {used}; {faults[-3:]}"
        )

    def _fault_gates(self) -> list[Gate]:
        """Judge what the robots, the recorder and the logs say."""
        tally, scene = self.tally, self.scene
        print("\nFaults:", dict(self.faults.done + self.recorder.done))
        print("Turns:", dict(tally.turns), "driven:", tally.driven, "programs started again:", dict(scene.replaced))
        print(f"Rest after the driver's deadman: median {quantile(tally.rest_s, 0.5):.2f} s, p99 "
              f"{quantile(tally.rest_s, 0.99):.2f} s, most {max(tally.rest_s, default=0.0):.2f} s")  # fmt: skip
        traces = scene.supervisor.log.count("Traceback")
        undriven = sum(window.undriven for window in self.measured.windows)
        found = {
            "motion without a holder, or too late": tally.faults,
            "what robots say of their gateways": scene.faults,
            "recordings": self.recorder.faults,
            "exceptions in the log": ["see the log"] * traces,
            "quiet commands that did not arrive": ["they are not counted"] * undriven,
        }
        for faults in found.values():
            print(*(f"  {fault}" for fault in faults[:_SHOWN]), sep="\n")
        return [Gate(what, str(len(faults)), "", "0", not faults) for what, faults in found.items()]


def _go_apart() -> str:
    """Become the same program in a network namespace of its own; say why that is not possible."""
    if _APART in os.environ:
        ip("link set lo up")
        return missing()
    try:
        prefix = apart()
    except NotHereError as error:
        return str(error)
    return os.execvpe(
        prefix[0], [*prefix, sys.executable, "-m", "tests.soak", *sys.argv[1:]], {**os.environ, _APART: "1"}
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=0.0)
    parser.add_argument("--minutes", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=1, help="of what fails and who drives")
    parser.add_argument("--log", type=Path, help="where the log of the gateways goes in the end")
    wanted = parser.parse_args()
    if reason := _go_apart():
        print(f"Skipped: this machine does not allow it: {reason}")
        return 0
    seconds = 3600 * wanted.hours + 60 * wanted.minutes or 3600.0
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        soak = Soak(stack, Path(folder), wanted.seed)
        try:
            gates = soak.run(seconds)
        finally:
            if wanted.log:
                wanted.log.write_text(soak.scene.supervisor.log)
    print(f"\n{seconds:.0f} s, seed {wanted.seed}\n\n| what | before | after | limit | good |\n|---|---|---|---|---|")
    print(*gates, sep="\n")
    return 0 if all(gate.good for gate in gates) else 1


if __name__ == "__main__":
    sys.exit(main())
