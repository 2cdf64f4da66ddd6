"""Mixed commands through a real gateway against the fragile TCP/UDP robot: no violation, and everything arrives.

    python -m tests.e2e.measured.judge                     # every version, with and without UDP, 2000 commands each
    python -m tests.e2e.measured.judge --commands 300 --version 1.4 --udp

A command that the robot's version or features exclude must be refused and never arrive. A "1.4" robot sends its map in
parts all the time, which changes nothing.
"""

from __future__ import annotations

import struct
from collections import Counter
from typing import Any, ClassVar

import numpy as np

from tests.e2e.measured import mixed
from tests.e2e.measured.mixed import Arrival, Judgement, Put, Run
from tests.e2e.rigs.fragile import lost
from tests.e2e.rigs.processes import report

VERSIONS = ("1.1", "1.2", "1.3", "1.4")
GAP_S = 0.01
"""Seconds between two packets: of two drives that the gateway is given within it, the newer wins."""
LEASED = {10, 11, 12, 40}
"""Where the machine was late, a newer drive may replace these, and a stop overtake them."""
ASKED = {"map": 52, "pose": 54}
MODES = ("none", "manual", "autonomous")


def came(packet_id: int, form: str, *values: Any) -> tuple[Arrival]:
    return ((packet_id, struct.pack(form, *values).hex()),)


def share(number: int) -> float:
    """Give a fraction of full scale that is this number's own."""
    return (number % 997 + 1) / 1000


def text(number: int) -> Put:
    said = f"command {number}"
    return Put("text", {"text": said}, came(1, f"<i{len(said)}s", len(said), said.encode()))


def mode(number: int) -> Put:
    return Put("mode", {"mode": MODES[number % 3]}, came(10, "<i", number % 3 + 1))


def scan(number: int) -> Put:
    ranges = np.full(360, 1.0 + number / 1000, "<f4")
    geometry = {"angle_min": 0.0, "angle_increment": float(np.radians(1.0)), "range_min": 0.0, "range_max": 100.0}
    in_cm = (ranges / np.float32(0.01)).astype("<f4").tobytes()
    return Put("scan", {**geometry, "ranges": ranges.tobytes()}, came(61, "<i1440s", 360, in_cm))


def raw(packet_id: int, number: int) -> Put:
    return Put("raw/tcpudp", {"id": packet_id, "body": struct.pack("<i", number)}, came(packet_id, "<i", number))


class Mixture(Run):
    """For a robot of one version. A burst is several commands at once: the gateway has to space them."""

    pace_s = 0.03
    """More than the gap, so that no drive has a reason to replace another."""
    version: str
    kinds: ClassVar = {
        "drive": lambda n: [Put("drive", {"forward": share(n)}, came(11, "<fff", 0.0, 1.0, share(n)))],
        "turn": lambda n: [Put("drive", {"turn": share(n)}, came(12, "<f", -share(n)))],
        "neutral": lambda n: [Put("drive", {})],
        "text": lambda n: [text(n)],
        "mode": lambda n: [mode(n)],
        "lidar": lambda n: [Put("lidar", {"on": n % 2 == 1}, came(50, "<i", 2 - n % 2))],
        "scan": lambda n: [scan(n)],
        "chat": lambda n: [raw(40, n)],
        "undefined": lambda n: [raw(70 + n % 10, n)],
        "burst": lambda n: [*(text(10_000 * part + n) for part in (1, 2, 3)), mode(n)],
    }
    weights: ClassVar = {**dict.fromkeys((*kinds, "stop", "pose"), 1), "drive": 6}

    def takes(self, kind: str) -> bool:
        return kind != "undefined" and (kind != "scan" or self.version != "1.1")

    def command(self, number: int) -> None:
        if number % 100 == 50:
            self.ask("map")
        else:
            super().command(number)

    def end(self) -> None:
        self.ask("map")
        super().end()

    def pose(self, number: int) -> None:
        self.ask("pose")

    def ask(self, what: str) -> None:
        replies = self.bench.fleet.get(f"fleet/r1/@rpc/{what}")
        self.judgement.unanswered[what] += not replies or "code" in replies[0]

    def arrivals(self, report: dict[str, Any]) -> list[Arrival]:
        return [(packet_id, body) for _, _, packet_id, body in report["received"] + lost(report)]

    def may_miss(self, arrival: Arrival) -> bool:
        return (
            arrival[0] in LEASED and (len(self.judgement.overtaken) + 1) * (self.pace_s - GAP_S) < self.judgement.late_s
        )

    def compare(self, report: dict[str, Any]) -> None:
        super().compare(report)
        judgement = self.judgement
        unread = Counter(packet_id for _, _, packet_id, _ in lost(report))
        for what, packet_id in ASKED.items():
            if judgement.unanswered[what] > unread[packet_id]:  # what the robot itself lost it cannot answer
                judgement.faults.append(f"{judgement.unanswered[what]} answers: {what}")
        stops = sum(packet_id == 13 for packet_id, _ in self.arrivals(report))
        wanted = judgement.sent["stop"] + judgement.sent["neutral"]
        if stops < wanted:
            judgement.faults.append(f"stops: {stops} came of {wanted} at least")


def judge(version: str, *, udp: bool, commands: int, seed: int = 1) -> Judgement:
    """Judge one version."""
    told = {"version": version, "robot": f"tcpudp-{version}{'-udp' * udp}"}
    kind = type("Mixture", (Mixture,), told)
    return mixed.judged(kind, f"{version} {'udp' if udp else 'tcp'}", commands=commands, seed=seed)


def main() -> None:
    parser = mixed.options(__doc__)
    parser.add_argument("--version", choices=VERSIONS)
    parser.add_argument("--udp", action="store_true")
    wanted = parser.parse_args()
    cases = [(wanted.version, wanted.udp)] if wanted.version else [(v, udp) for v in VERSIONS for udp in (False, True)]
    report(judge(version, udp=udp, commands=wanted.commands, seed=wanted.seed) for version, udp in cases)


if __name__ == "__main__":
    main()
