"""Bearings: converts distance sensors of known directions to a scan, and a scan to distance sensors. Sans-IO.

Bearings are counter-clockwise from ahead (REP 103); ranges are metres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar

from zbridge.fleet.messages import Floats, Scan, Scanner
from zbridge.protocol.kept import Form, Kept

MOST_POINTS = 100_000
"""Most points accepted of a scanner before its first scan."""
_MOST_RAD = 1e6
"""A geometry with angles beyond this is invalid, and covers no sector."""

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    _Indices = npt.NDArray[np.intp]


class BearingScan(Kept):
    """Makes one scan of the readings of several distance sensors.

    ``bearings_deg``: the direction of each sensor, degrees; at least one. ``range_m``: the least and the greatest valid
    range; a reading outside is NaN. Evenly spread sensors give a point each, others a point a degree.
    """

    kept: ClassVar[dict[str, Any]] = {
        "_ranges_m": Form(lambda ranges: ranges.tolist(), lambda raw: _floats(raw)),
        "_fresh": set[str],
    }

    def __init__(self, bearings_deg: Mapping[str, float], range_m: tuple[float, float]) -> None:
        import numpy as np

        bearings = sorted(bearings_deg.values())
        steps = {round(high - low, 6) for low, high in pairwise(bearings)}
        step_deg = steps.pop() if len(steps) == 1 and min(steps) > 0 else 1.0
        self._range_m = range_m
        self._first_deg, self._step_deg = bearings[0], step_deg
        count = round((bearings[-1] - bearings[0]) / step_deg) + 1
        self._ranges_m = np.full(count, np.nan, np.float32)
        self._places = {name: round((at - bearings[0]) / step_deg) for name, at in bearings_deg.items()}
        self._fresh: set[str] = set()

    def __repr__(self) -> str:
        return f"<BearingScan of {len(self._places)} sensors, {len(self._fresh)} fresh>"

    def take(self, name: str, range_m: float, stamp_ns: int) -> Scan | None:
        """Add one reading (metres; NaN: none); return the scan when every sensor has a new one.

        The reading of a sensor without a bearing is ignored. The stamp of a scan is that of its last reading.
        """
        place = self._places.get(name)
        if place is None:
            return None
        low, high = self._range_m
        self._ranges_m[place] = range_m if low <= range_m <= high else math.nan
        self._fresh.add(name)
        if len(self._fresh) < len(self._places):
            return None
        self._fresh.clear()
        first_rad, step_rad = math.radians(self._first_deg), math.radians(self._step_deg)
        return Scan(first_rad, step_rad, low, high, self._ranges_m.copy(), stamp_ns=stamp_ns)


def _floats(raw: list[float]) -> Floats:
    import numpy as np

    return np.array(raw, np.float32)


class Sectors:
    """Cuts scans into ``count`` sectors of equal width: sector 0 is ahead, the others follow counter-clockwise."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._geometry: tuple[float, float, int] | None = None
        self._points: dict[int, _Indices] = {}
        self._scan: Scan | None = None
        self._nearest_m: dict[int, float] = {}

    def __repr__(self) -> str:
        return f"<Sectors {self._count}>"

    def covered(self, scan: Scan | Scanner) -> tuple[int, ...]:
        """List the sectors in which a scan, or a scanner, has points; none if its geometry is invalid."""
        return tuple(self._cut(scan))

    def nearest_m(self, scan: Scan) -> dict[int, float]:
        """Return the nearest range of each covered sector, metres; ``range_max`` where it has no valid one.

        The sectors of the last scan are kept: asking again for the same object costs nothing.
        """
        if self._scan is not scan:
            import numpy as np

            measured = np.where(scan.ranges >= 0, scan.ranges, np.float32(np.nan))
            self._nearest_m = {
                sector: float(np.nanmin(measured[points], initial=scan.range_max))
                for sector, points in self._cut(scan).items()
            }
            self._scan = scan
        return self._nearest_m

    def _cut(self, scan: Scan | Scanner) -> dict[int, _Indices]:
        """Return the indices of the points of each covered sector; kept until the geometry changes."""
        count = len(scan.ranges) if isinstance(scan, Scan) else min(max(scan.points, 0), MOST_POINTS)
        geometry = (scan.angle_min, scan.angle_increment, count)
        if not abs(scan.angle_min) + abs(scan.angle_increment) * count < _MOST_RAD:
            return {}
        if self._geometry != geometry:
            import numpy as np

            angles = scan.angle_min + scan.angle_increment * np.arange(count)
            width = 2 * math.pi / self._count
            sectors = np.floor_divide(angles + width / 2, width).astype(np.int64) % self._count
            cut = {sector: np.flatnonzero(sectors == sector) for sector in range(self._count)}
            self._geometry, self._points = geometry, {at: points for at, points in cut.items() if points.size}
        return self._points
