"""Mixed commands through a real gateway against the fragile robot: no violation, and everything arrives.

    python -m tests.e2e.judge                     # every version, with and without UDP, 2000 commands each
    python -m tests.e2e.judge --commands 300 --version 1.4 --udp

A command that the robot's version or features exclude must be refused and never arrive. The judge holds the robot's
lease, and acquires it anew after each stop. A "1.4" robot sends its map in parts all the time, which changes nothing.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import struct
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tests.e2e.conftest import Bench, until
from tests.e2e.fragile import DISTURBED, disturbed, ended, fragile_robot

VERSIONS = ("1.1", "1.2", "1.3", "1.4")
PACE_S = 0.03
"""Seconds between two commands: more than the gap, so that no drive has a reason to replace another."""
GAP_S = 0.01
"""Seconds between two packets: of two drives that the gateway is given within it, the newer wins."""
DRIVES = {11, 12}
LEASED = {*DRIVES, 10, 40}
BEFORE_STOP = 4
"""How many of the last commands before a stop it may overtake where the machine was late: those of a burst."""
ASKED = {"no map": 52, "no pose": 54}
HAS_LIDAR_SIM = {"1.2", "1.3", "1.4"}


@dataclass
class Judgement:
    """What came of one run."""

    version: str
    udp: bool
    sent: Counter[str] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)
    excused: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    overtaken: list[str] = field(default_factory=list)
    """Commands that did not arrive, as far as the machine was late enough: a newer drive replaced them, or a stop that
    came after them went before them and ended their lease."""
    late_s: float = 0.0
    answered: Counter[str] = field(default_factory=Counter)
    alive: bool = False
    disturbed: bool = False
    """The robot lost a packet of the handshake because its own process was late: it understands nothing after that."""
    seconds: float = 0.0

    @property
    def clean(self) -> bool:
        """Whether the robot has nothing to complain of and everything arrived."""
        return self.alive and not self.violations and not self.missing

    def __str__(self) -> str:
        commands = sum(self.sent.values())
        return (
            f"{self.version} {'udp' if self.udp else 'tcp'}: {commands} commands in {self.seconds:.0f} s, "
            f"{len(self.violations)} violations, {len(self.excused)} excused (the robot's process was late), "
            f"{len(self.missing)} missing, {len(self.overtaken)} overtaken, answered {dict(self.answered)}"
        )


def judge(version: str, *, udp: bool, commands: int, seed: int = 1) -> Judgement:
    """Run one gateway against one fragile robot; run it again where the robot's own lateness spoilt the handshake."""
    for _ in range(DISTURBED):
        judgement = _judged(version, udp=udp, commands=commands, seed=seed)
        if not judgement.disturbed:
            break
    return judgement


def _judged(version: str, *, udp: bool, commands: int, seed: int) -> Judgement:
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), stack)
        robot = stack.enter_context(fragile_robot(f"tcpudp-{version}{'-udp' * udp}", seed=seed))
        assert robot.stdout is not None
        bench.gateway("r1", int(robot.stdout.readline()))
        until(lambda: bench.fleet.state("r1") == "established", what="established")
        bench.fleet.hold("r1", "judge")
        run = _Run(bench, Judgement(version, udp), random.Random(seed))
        began, withheld_s = time.monotonic(), bench.withheld_s
        for number in range(commands):
            run.command(number)
            time.sleep(PACE_S)
        run.end()
        run.judgement.seconds = time.monotonic() - began
        run.judgement.late_s = bench.withheld_s - withheld_s
        report = ended(robot)
    run.compare(report)
    return run.judgement


class _Run:
    """Sends commands and remembers which bodies must arrive, by packet id."""

    def __init__(self, bench: Bench, judgement: Judgement, rng: random.Random) -> None:
        self.judgement = judgement
        self._bench = bench
        self._rng = rng
        self._expected: list[tuple[int, str]] = []
        self._forbidden: list[tuple[int, str]] = []
        self._before_stop: set[int] = set()
        """The places of the last commands before each stop among those expected."""
        self._kinds = [
            *(self.drive,) * 6,
            *(self.turn, self.neutral, self.text, self.mode, self.lidar, self.scan, self.chat, self.stop),
            *(self.undefined, self.pose, self.burst),
        ]

    def command(self, number: int) -> None:
        if number % 100 == 50:
            self.map()
            return
        kind = self._rng.choice(self._kinds)
        self.judgement.sent[kind.__name__] += 1
        kind(number)

    def end(self) -> None:
        self.map()
        self._put("stop")
        time.sleep(1.5)

    def compare(self, report: dict[str, Any]) -> None:
        """Hold what arrived against what had to."""
        judgement = self.judgement
        judgement.alive = report["alive"]
        for text in report["violations"]:
            (judgement.excused if "(this process" in text else judgement.violations).append(text)
        came = [row[1:] for row in report["received"] + report["piled"]]
        piled = Counter(packet_id for _, _, packet_id, _ in report["piled"])
        judgement.disturbed = disturbed(report)
        for what, packet_id in ASKED.items():  # what the robot itself lost it cannot answer
            judgement.answered[what] = max(0, judgement.answered[what] - piled[packet_id])
        arrived = Counter((packet_id, body) for _, packet_id, body in came)
        for place, (packet_id, body) in enumerate(self._expected):
            replaced = packet_id in DRIVES or (packet_id in LEASED and place in self._before_stop)
            if arrived[packet_id, body]:
                arrived[packet_id, body] -= 1
            elif replaced and (len(judgement.overtaken) + 1) * (PACE_S - GAP_S) < judgement.late_s:
                judgement.overtaken.append(f"packet {packet_id} {body[:40]}")
            else:
                judgement.missing.append(f"packet {packet_id} {body[:40]}")
        stops = sum(packet_id == 13 for _, packet_id, _ in came)
        wanted = judgement.sent["stop"] + judgement.sent["neutral"]
        if stops < wanted:
            judgement.missing.append(f"stops: {stops} came of {wanted} at least")
        for packet_id, body in self._forbidden:
            if arrived[packet_id, body]:
                judgement.violations.append(f"packet {packet_id} {body[:40]} should have been refused")

    # One method a command; each value is used once, so that every body is its own

    def drive(self, number: int) -> None:
        forward = (number % 997 + 1) / 1000
        self._put("drive", forward=forward)
        self._expect(11, struct.pack("<fff", 0.0, 1.0, forward))

    def turn(self, number: int) -> None:
        turn = (number % 997 + 1) / 1000
        self._put("drive", turn=turn)
        self._expect(12, struct.pack("<f", -turn))

    def neutral(self, number: int) -> None:
        self._put("drive")

    def stop(self, number: int) -> None:
        """Stop, as anybody may; whoever wants to go on acquires anew."""
        self._before_stop |= set(range(len(self._expected))[-BEFORE_STOP:])
        self._put("stop")
        time.sleep(PACE_S)
        self._bench.fleet.hold("r1", "judge")

    def text(self, number: int) -> None:
        text = f"command {number}".encode()
        self._put("text", text=text.decode())
        self._expect(1, struct.pack("<i", len(text)) + text)

    def mode(self, number: int) -> None:
        mode = ("none", "manual", "autonomous")[number % 3]
        self._put("mode", mode=mode)
        self._expect(10, struct.pack("<i", number % 3 + 1))

    def lidar(self, number: int) -> None:
        self._put("lidar", on=bool(number % 2))
        self._expect(50, struct.pack("<i", 1 if number % 2 else 2))

    def scan(self, number: int) -> None:
        ranges = np.full(360, 1.0 + number / 1000, "<f4")
        self._put(
            "scan",
            angle_min=0.0,
            angle_increment=float(np.radians(1.0)),
            range_min=0.0,
            range_max=100.0,
            ranges=ranges.tobytes(),
        )
        body = struct.pack("<i", 360) + (ranges / np.float32(0.01)).astype("<f4").tobytes()
        if self.judgement.version in HAS_LIDAR_SIM:
            self._expect(61, body)
        else:
            self._forbidden.append((61, body.hex()))

    def chat(self, number: int) -> None:
        body = struct.pack("<i", number)
        self._put("raw/tcpudp", id=40, body=body)
        self._expect(40, body)

    def burst(self, number: int) -> None:
        """Several at once: the gateway has to space them."""
        for part in range(3):
            self.text(10_000 * (part + 1) + number)
        self.mode(number)

    def undefined(self, number: int) -> None:
        body = struct.pack("<i", number)
        self._put("raw/tcpudp", id=70 + number % 10, body=body)
        self._forbidden.append((70 + number % 10, body.hex()))

    def pose(self, number: int) -> None:
        self._ask("pose")

    def map(self) -> None:
        self._ask("map")

    def _ask(self, what: str) -> None:
        replies = self._bench.fleet.get(f"fleet/r1/@rpc/{what}")
        self.judgement.answered[what if replies and isinstance(replies[0], dict) else f"no {what}"] += 1

    def _put(self, what: str, **fields: Any) -> None:
        self._bench.fleet.put(f"r1/@cmd/{what}", **fields)

    def _expect(self, packet_id: int, body: bytes) -> None:
        self._expected.append((packet_id, body.hex()))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--commands", type=int, default=2000)
    parser.add_argument("--version", choices=VERSIONS)
    parser.add_argument("--udp", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    wanted = parser.parse_args()
    cases = [(wanted.version, wanted.udp)] if wanted.version else [(v, udp) for v in VERSIONS for udp in (False, True)]
    failed = False
    for version, udp in cases:
        judgement = judge(version, udp=udp, commands=wanted.commands, seed=wanted.seed)
        print(judgement, flush=True)
        for line in [*judgement.violations[:10], *judgement.missing[:10]]:
            print("   ", line)
        failed = failed or not judgement.clean
    sys.exit(failed)


if __name__ == "__main__":
    main()
