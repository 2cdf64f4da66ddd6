"""Conformance of values: what a healthy robot shows is plausible, and in the units of the bus."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase

from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.protocol.plugin import Protocol
from zbridge.simulation.checks.examples import numbers
from zbridge.simulation.checks.finding import CheckFinding

GUIDE = "8. The protocol: Plausible values"
FIXED = {
    "pose.x": (-100.0, 100.0),
    "pose.y": (-100.0, 100.0),
    "pose.heading": (-math.pi - 1e-6, math.pi + 1e-6),
    "motion.speed": (-1.0, 1.0),
    "battery.level": (0.0, 1.0),
    "scan.angle_min": (-2 * math.pi, 2 * math.pi),
    "scan.angle_increment": (-math.pi, math.pi),
}
"""What holds for every robot of the simulated room."""
DECLARED = ("battery.voltage", "battery.current", "sensor/*.value", "motion.temperature")
"""What only the protocol knows."""


def check_values(protocol: Protocol, telemetry: Iterable[tuple[Topic, FleetMessage]]) -> Iterator[CheckFinding]:
    """Compare every number that was shown with its range."""
    ranges, problems, unknown = FIXED | protocol.plausible, dict[str, str](), set[str]()
    for name, value in numbers(telemetry):
        found = next((pair for pattern, pair in ranges.items() if fnmatchcase(name, pattern)), None)
        if found is None:
            unknown |= {name} if any(fnmatchcase(name, pattern) for pattern in DECLARED) else set()
        elif not (found[0] <= value <= found[1] or math.isnan(value)):
            problems.setdefault(name, f"{name} = {value:g}, expected {found[0]:g} to {found[1]:g}")
    yield CheckFinding.of("what it shows is plausible, in SI units", list(problems.values()), guide=GUIDE)
    if unknown:
        claim = f"these numbers are plausible: {', '.join(sorted(unknown))}"
        yield CheckFinding.not_checked(claim, "Protocol.plausible declares no range", GUIDE)
