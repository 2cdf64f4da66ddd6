"""The sectors of a scan, which controllers are shown as distance sensors: the nearest point of each. Sans-IO."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from zbridge.fleet.messages import Scan, Scanner

MOST_POINTS = 100_000
"""Points of a scanner of which no scan has come yet, at most."""
_MOST_RAD = 1e6

Indices = npt.NDArray[np.intp]


class Sectors:
    """Cuts scans into ``count`` sectors: sector 0 is centred ahead, the next ones follow counter-clockwise.

    unit_m: what the value 1 of a sector is.
    """

    def __init__(self, count: int, unit_m: float) -> None:
        self.count = count
        self._unit_m = unit_m
        self._nearest: tuple[Scan | None, dict[str, float]] = (None, {})
        """The scan that was cut last, and its nearest points."""
        self._points: tuple[tuple[float, float, int] | None, dict[str, Indices]] = (None, {})
        """The geometry that was cut last, and the points of each sector."""

    def __repr__(self) -> str:
        return f"<Sectors {self.count}>"

    def nearest(self, scan: Scan) -> dict[str, float]:
        """Return the distance of the nearest point of each sector that a scan covers, in ``unit_m``."""
        if self._nearest[0] is not scan:
            ranges_m = np.where(scan.ranges >= 0, scan.ranges, np.float32(np.nan))
            nearest = {
                name: float(np.nanmin(ranges_m[points], initial=scan.range_max)) / self._unit_m
                for name, points in self._points_of(scan).items()
            }
            self._nearest = (scan, nearest)
        return self._nearest[1]

    def covered(self, geometry: Scan | Scanner) -> list[str]:
        """Return the names of the sectors that a scan, or a scanner, covers."""
        return list(self._points_of(geometry))

    @property
    def all(self) -> list[str]:
        """The names of all sectors."""
        return [f"sector{number}" for number in range(self.count)]

    def _points_of(self, source: Scan | Scanner) -> dict[str, Indices]:
        """Return the indices of the points of each sector that is covered."""
        count = len(source.ranges) if isinstance(source, Scan) else min(max(source.points, 0), MOST_POINTS)
        geometry = (source.angle_min, source.angle_increment, count)
        if not abs(source.angle_min) + abs(source.angle_increment) * count < _MOST_RAD:
            return {}
        if self._points[0] != geometry:
            angles = source.angle_min + source.angle_increment * np.arange(count)
            width = 2 * math.pi / self.count
            sectors = np.floor_divide(angles + width / 2, width).astype(np.int64) % self.count
            cut = ((name, np.flatnonzero(sectors == number)) for number, name in enumerate(self.all))
            self._points = (geometry, {name: points for name, points in cut if points.size})
        return self._points[1]
