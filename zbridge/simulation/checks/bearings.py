"""Conformance of scans: an obstacle on the left is shown on the left, as far away as it is."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from zbridge.fleet.messages import Scan
from zbridge.protocol.plugin import Protocol, Truth
from zbridge.simulation.checks.finding import CheckFinding
from zbridge.simulation.checks.stage import Stage
from zbridge.simulation.checks.truth import NO_TRUTH
from zbridge.simulation.world import cast

PLACE = (1.1, 1.75, -0.75)
"""Where the robot begins: a box is ahead, and its face is on the left of the robot when that touches it."""
FORWARD, DRIVE_S, STAND_S = 0.6, 2.5, 0.8
FAR_M, SCALE = 1.0, 0.25
"""Ranges beyond this are compared with the room; the tolerance leaves room for where sensors sit."""
WITHIN_RAD = 0.8
"""Tolerance of a bearing: single sensors are wide apart."""
LEFT = "an obstacle on the left is shown on the left, at its distance"
_GUIDE = "5. Telemetry: Units and axes"


async def check_bearings(protocol: Protocol, stage: Stage) -> list[CheckFinding]:
    """Drive into the face of a box that is then on the left, and compare the scan with the room."""
    stage.prepare()
    await stage.watch(0.1)
    begun = stage.truth
    if begun is None:
        return [CheckFinding.not_checked(LEFT, NO_TRUTH, _GUIDE)]
    if math.hypot(begun.x - PLACE[0], begun.y - PLACE[1]) > 0.1:
        return [CheckFinding.not_checked(LEFT, "the simulated robot does not begin at Simulation.place", _GUIDE)]
    await stage.drive(DRIVE_S, forward=FORWARD)
    stage.forget()
    await stage.stop(STAND_S)
    truth, scan = stage.truth, stage.scans[-1] if stage.scans else None
    if scan is None or truth is None or not _known(scan).any():
        return [CheckFinding.not_checked(LEFT, "it shows no scan, or none with a range", _GUIDE)]
    return [CheckFinding.of(LEFT, _contradictions(scan, truth), guide=_GUIDE)]


def _known(scan: Scan) -> npt.NDArray[np.bool_]:
    """Return which points measured something; some scanners say their greatest range for nothing."""
    known: npt.NDArray[np.bool_] = np.isfinite(scan.ranges) & (scan.ranges < 0.99 * scan.range_max)
    return known


def _contradictions(scan: Scan, truth: Truth) -> list[str]:
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges), dtype=np.float64)
    known = _known(scan)
    nearest = float(angles[known][np.argmin(scan.ranges[known])])
    around = np.radians(np.arange(-180, 180))
    room = cast(truth.x, truth.y, truth.heading + around, 100.0)
    expected = float(around[np.argmin(room)])
    problems = []
    if abs(math.remainder(nearest - expected, 2 * math.pi)) > WITHIN_RAD:
        where = f"{math.degrees(expected):.0f} degrees"
        problems.append(f"the nearest range is at {math.degrees(nearest):.0f} degrees, the obstacle is at {where}")
    true = cast(truth.x, truth.y, truth.heading + angles, 100.0)
    far = known & (true > FAR_M)
    if far.sum() >= 3:
        ratio = float(np.median(scan.ranges[far] / true[far]))
        if not 1 - SCALE <= ratio <= 1 + SCALE / 2:
            problems.append(f"ranges are {ratio:.2f} times the distances, in the middle")
    return problems
