"""Scans of the bus as simulated lidar data for a robot (packet 61). Sans-IO.

Source: "Packets" (61) and "Translation" of the protocol page.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from zbridge.fleet.messages import Scan

if TYPE_CHECKING:
    import numpy as np

SCAN_POINTS = 360
"""Points deployed robots take in simulated lidar data, one a degree."""


def polar_ranges(scan: Scan, unit_m: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Resample a scan to float32[360] in the robot's unit, index = degree counter-clockwise from straight ahead.

    Each degree takes the nearest point of the scan, 0 where the scan has none or it is invalid or out of range.
    """
    import numpy as np

    with np.errstate(all="ignore"):  # a point with an absurd number counts as not measured
        return _polar(scan, unit_m)


def _polar(scan: Scan, unit_m: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    import numpy as np

    count = len(scan.ranges)
    polar = np.zeros(SCAN_POINTS, np.float32)
    if count == 0 or not scan.angle_increment or not math.isfinite(scan.angle_increment + scan.angle_min):
        return polar
    step = abs(scan.angle_increment)
    circle = 2 * math.pi / step
    offsets = np.radians(np.arange(SCAN_POINTS)) - scan.angle_min
    nearest = np.rint(np.mod(math.copysign(1.0, scan.angle_increment) * offsets, 2 * math.pi) / step)
    nearest = np.where(nearest >= circle - 0.5, 0.0, nearest)  # after the last point comes the first
    covered = nearest < count
    indices = nearest[covered].astype(np.int64)
    ranges = np.asarray(scan.ranges, np.float32)
    values = ranges[indices]
    usable = np.isfinite(values) & (values >= scan.range_min) & (values <= scan.range_max)
    lengths = values / np.float32(unit_m)
    polar[covered] = np.where(usable & np.isfinite(lengths), lengths, 0)
    return polar
