"""The sectors of a scan as distance sensors: their names and values as controllers are shown them. Sans-IO."""

from __future__ import annotations

from zbridge.fleet.messages import Scan, Scanner
from zbridge.protocol import Sectors


class SectorSensors:
    """``count`` sensors named ``sector0`` (ahead) and up, counter-clockwise. unit_m: metres for a value of 1."""

    def __init__(self, count: int, unit_m: float) -> None:
        self.names = [f"sector{number}" for number in range(count)]
        self._unit_m = unit_m
        self._sectors = Sectors(count)

    def __repr__(self) -> str:
        return f"<SectorSensors {len(self.names)}>"

    def covered(self, geometry: Scan | Scanner) -> list[str]:
        """Return the names of the sectors in which a scan, or a scanner, has points."""
        return [self.names[sector] for sector in self._sectors.covered(geometry)]

    def values(self, scan: Scan) -> dict[str, float]:
        """Return the value of each sector that a scan covers: the nearest point, in ``unit_m``."""
        nearest_m = self._sectors.nearest_m(scan)
        return {self.names[sector]: range_m / self._unit_m for sector, range_m in nearest_m.items()}
