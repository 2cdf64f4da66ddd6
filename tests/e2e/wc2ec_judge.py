"""Mixed commands through a real gateway against the fragile Webots controller: no violation, and everything arrives.

    python -m tests.e2e.wc2ec_judge                     # both dialects, 2000 commands each
    python -m tests.e2e.wc2ec_judge --commands 300 --dialect draft

What a robot of the dialect cannot do must be refused and never arrive. The judge holds the robot's lease, and acquires
it anew after each stop. Of drives the newest wins, so a few that were overtaken are excused; nothing else is.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.e2e.conftest import Bench, until
from tests.e2e.fragile import ended, fragile_robot

DIALECTS = ("deployed", "draft")
PACE_S = 0.01
"""Seconds between two commands."""
LEFT, RIGHT, LIFT = 8, 9, 10
"""Numbers of the fragile robot's motors."""
LIGHTS, VALUES = 4, 3
FORBIDDEN = 1e6
"""Every value of a command that must be refused is greater."""
OPTIONS = {
    "deployed": """
[device.options]
dialect = "deployed"
bounds_default = [0.0, 1000.0]
[device.options.differential]
left = ["left wheel motor"]
right = ["right wheel motor"]
wheel_radius_m = 0.05
track_m = 0.3
speed_full_m_s = 0.5
turn_full_rad_s = 1.0
""",
    "draft": """
[device.options]
dialect = "draft"
values = 3
pinned = ["light3"]
devices = [
  { name = "light0", number = 0 }, { name = "light1", number = 1 },
  { name = "light2", number = 2 }, { name = "light3", number = 3 },
]
""",
}
Arrival = tuple[int, int, tuple[float, ...]]
"""Command, device number, values rounded."""


def rounded(value: Any) -> tuple[float, ...]:
    values = value if isinstance(value, list | tuple) else [] if value is None else [value]
    return tuple(round(float(one), 6) for one in values)


@dataclass
class Judgement:
    """What came of one run."""

    dialect: str
    sent: Counter[str] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    overtaken: list[str] = field(default_factory=list)
    alive: bool = False
    arrived: int = 0
    refused: int = 0
    seconds: float = 0.0

    @property
    def clean(self) -> bool:
        """Whether the robot has nothing to complain of and everything arrived."""
        excused = len(self.overtaken) <= max(3, self.sent["drive"] // 20)
        return self.alive and excused and not self.violations and not self.missing

    def __str__(self) -> str:
        return (
            f"{self.dialect}: {sum(self.sent.values())} commands in {self.seconds:.0f} s, {self.arrived} arrived, "
            f"{self.refused} kinds refused, {len(self.violations)} violations, {len(self.missing)} missing, "
            f"{len(self.overtaken)} drives overtaken"
        )


def judge(dialect: str, *, commands: int, seed: int = 1) -> Judgement:
    """Run one gateway against one fragile controller."""
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), stack)
        robot = stack.enter_context(fragile_robot(f"wc2ec-{dialect}", seed=seed, values=VALUES))
        assert robot.stdout is not None
        file = bench.folder / "r1.toml"
        file.write_text(
            f'[robot]\nname = "r1"\n[device]\nprotocol = "wc2ec"\n'
            f'connect = ["tcp://127.0.0.1:{int(robot.stdout.readline())}"]\n{OPTIONS[dialect]}\n'
            f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n'
        )
        bench.zbridge("run", str(file))
        until(lambda: bench.fleet.state("r1") == "established", what="established")
        bench.fleet.hold("r1", "judge")
        run = _Deployed(bench, seed) if dialect == "deployed" else _Draft(bench, seed)
        began = time.monotonic()
        for number in range(commands):
            run.command(number)
            time.sleep(PACE_S)
        run.end()
        run.judgement.seconds = time.monotonic() - began
        report = ended(robot)
    run.compare(report)
    return run.judgement


class _Run:
    """Sends commands and remembers what must arrive; each value is used once, so that every command is its own."""

    dialect: str

    def __init__(self, bench: Bench, seed: int) -> None:
        self.judgement = Judgement(self.dialect)
        self._bench = bench
        self._rng = random.Random(seed)
        self._expected: list[Arrival] = []
        self._drives: list[Arrival] = []
        self._kinds = self.kinds()

    def kinds(self) -> list[Any]:
        """List the kinds of commands, as often as they are to come."""
        raise NotImplementedError

    def command(self, number: int) -> None:
        kind = self._rng.choice(self._kinds)
        self.judgement.sent[kind.__name__] += 1
        kind(number)

    def end(self) -> None:
        self._put("stop")
        time.sleep(0.5)
        control = self._bench.fleet.last("r1/control")
        self.judgement.refused = len(control.get("refusals", []))

    def compare(self, report: dict[str, Any]) -> None:
        """Hold what arrived against what had to."""
        judgement = self.judgement
        judgement.alive = report["alive"] and not report["left"]
        judgement.violations += report["violations"]
        received = [(command, number, rounded(value)) for _, command, _, number, value in report["received"]]
        judgement.arrived = len(received)
        arrived = Counter(received)
        for wanted, missing in ((self._expected, judgement.missing), (self._drives, judgement.overtaken)):
            for one in wanted:
                if arrived[one]:
                    arrived[one] -= 1
                else:
                    missing.append(f"command {one[0]} to device {one[1]}: {one[2]}")
        for one in received:
            if any(abs(value) >= FORBIDDEN or value != value for value in one[2]):
                judgement.violations.append(f"{one} should have been refused")
        self.look(received)

    def look(self, received: list[Arrival]) -> None:
        """Look at what arrived once more."""

    def stop(self, number: int) -> None:
        """Stop, as anybody may; whoever wants to go on acquires anew, which is refused until the stop was heard."""
        self._put("stop")
        until(self._holds, what="the lease after a stop")

    def _holds(self) -> bool:
        try:
            self._bench.fleet.hold("r1", "judge")
        except AssertionError:
            return False
        return True

    # What neither dialect has

    def mode(self, number: int) -> None:
        self._put("mode", mode=("none", "manual", "autonomous")[number % 3])

    def light(self, number: int) -> None:
        self._put("light", on=True)

    def text(self, number: int) -> None:
        self._put("text", text=f"command {number}")

    def raw(self, number: int) -> None:
        self._put("raw/wc2ec", id=130, body=b"\x35\x63" + bytes(8))

    def rubbish(self, number: int) -> None:
        self._bench.fleet.put_payload("r1/@cmd/drive", b"\xff\x00rubbish")
        self._bench.fleet.put_payload("r1/@cmd/motor/lift", b"\x81\xa5value\xa3abc")
        self._bench.fleet.put_payload("r1/@cmd/sensor/light0", b"\xc1")

    def _put(self, what: str, **fields: Any) -> None:
        self._bench.fleet.put(f"r1/@cmd/{what}", **fields)

    def _expect(self, command: int, device: int, *values: float) -> None:
        self._expected.append((command, device, rounded(values)))


class _Deployed(_Run):
    dialect = "deployed"

    def kinds(self) -> list[Any]:
        often = (self.drive, self.turn, self.wheel, self.lift, self.burst)
        once = (self.neutral, self.stop, self.sideways, self.unknown, self.sensor, self.no_number, self.setting)
        return [*often * 3, *once, self.mode, self.light, self.text, self.raw, self.rubbish]

    def drive(self, number: int) -> None:
        forward = (number % 9973 + 1) / 10_000
        self._put("drive", forward=forward)
        self._drives += [(130, wheel, rounded(forward * 10)) for wheel in (LEFT, RIGHT)]

    def turn(self, number: int) -> None:
        turn = (number % 9973 + 1) / 10_000
        self._put("drive", turn=turn)
        self._drives += [(130, LEFT, rounded(-turn * 3)), (130, RIGHT, rounded(turn * 3))]

    def wheel(self, number: int) -> None:
        value = 20 + number / 1000
        self._put("motor/right%20wheel%20motor", value=value)
        self._expect(130, RIGHT, value)

    def lift(self, number: int) -> None:
        value = 0.001 + number / 100_000
        self._put("motor/lift", value=value)
        self._expect(130, LIFT, value)

    def burst(self, number: int) -> None:
        """Several at once, which arrive joined."""
        for part in range(5):
            self.lift(10_000 * (part + 1) + number)
        self.wheel(100_000 + number)

    def neutral(self, number: int) -> None:
        self._put("drive")

    def sideways(self, number: int) -> None:
        self._put("drive", left=0.5)

    def unknown(self, number: int) -> None:
        for name in ("nobody", "%", "lift%20", "left%20wheel%20motor%239", "rotational-9", "99"):
            self._put(f"motor/{name}", value=FORBIDDEN + number)

    def sensor(self, number: int) -> None:
        self._put(f"motor/ds{number % 8}", value=FORBIDDEN + number)

    def no_number(self, number: int) -> None:
        for value in (float("nan"), float("inf"), -float("inf"), 1e300):
            self._put("motor/lift", value=value)

    def setting(self, number: int) -> None:
        self._put(f"sensor/ds{number % 8}", index=0, value=FORBIDDEN + number)
        self._put(f"sensor/ds{number % 8}", enable=True)

    def look(self, received: list[Arrival]) -> None:
        """The last word to each wheel was the stop; the lift was left where it is."""
        for wheel in (LEFT, RIGHT):
            values = [values for _, number, values in received if number == wheel]
            if not values or values[-1] != (0.0,):
                self.judgement.missing.append(f"the stop of device {wheel}: {values[-1:]}")
        if any(values == (0.0,) for _, number, values in received if number == LIFT):
            self.judgement.violations.append("the lift was set to 0 by a stop")


class _Draft(_Run):
    dialect = "draft"

    def kinds(self) -> list[Any]:
        often = (self.change, self.set, self.enable, self.disable)
        once = (self.unknown, self.beyond, self.too_many, self.drive, self.motor, self.stop)
        return [*often * 4, *once, self.mode, self.light, self.text, self.raw, self.rubbish]

    def change(self, number: int) -> None:
        value = 1 + number / 1000
        self._put(f"sensor/light{number % LIGHTS}", index=number % VALUES, value=value)
        self._expect(130, number % LIGHTS, number % VALUES, value)

    def set(self, number: int) -> None:
        values = [1 + number / 1000, -2.0, 0.5]
        self._put(f"sensor/light{number % LIGHTS}", values=values)
        self._expect(131, number % LIGHTS, *values)

    def enable(self, number: int) -> None:
        self._put(f"sensor/light{number % LIGHTS}", enable=True)
        self._expect(128, number % LIGHTS)

    def disable(self, number: int) -> None:
        self._put(f"sensor/light{number % LIGHTS}", enable=False)
        self._expect(129, number % LIGHTS)

    def unknown(self, number: int) -> None:
        for name in ("light4", "nobody", "%", "light-0"):
            self._put(f"sensor/{name}", enable=True)
            self._put(f"sensor/{name}", values=[FORBIDDEN + number] * VALUES)

    def beyond(self, number: int) -> None:
        for index in (VALUES, 255, 256, -1):
            self._put("sensor/light0", index=index, value=FORBIDDEN + number)

    def too_many(self, number: int) -> None:
        for count in (0, VALUES - 1, VALUES + 1, 300):
            self._put("sensor/light0", values=[FORBIDDEN + number] * count)

    def drive(self, number: int) -> None:
        self._put("drive", forward=0.5)

    def motor(self, number: int) -> None:
        self._put("motor/light0", value=FORBIDDEN + number)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--commands", type=int, default=2000)
    parser.add_argument("--dialect", choices=DIALECTS)
    parser.add_argument("--seed", type=int, default=1)
    wanted = parser.parse_args()
    failed = False
    for dialect in [wanted.dialect] if wanted.dialect else DIALECTS:
        judgement = judge(dialect, commands=wanted.commands, seed=wanted.seed)
        print(judgement, flush=True)
        for line in [*judgement.violations[:10], *judgement.missing[:10]]:
            print("   ", line)
        failed = failed or not judgement.clean
    sys.exit(failed)


if __name__ == "__main__":
    main()
