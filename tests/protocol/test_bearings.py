"""Distance sensors as a scan, and scans as distance sensors."""

import math

import numpy as np
import pytest

from zbridge.fleet.messages import Scan, Scanner
from zbridge.protocol.bearings import BearingScan, Sectors

STAMP = 1_700_000_000_000_000_000
NAN = math.nan


def scan_of(ranges_m: list[float], first_rad: float = 0.0, step_rad: float = math.pi / 4) -> Scan:
    return Scan(first_rad, step_rad, 0.1, 5.0, np.array(ranges_m, np.float32), stamp_ns=STAMP)


def scanner_of(points: int, step_rad: float) -> Scanner:
    return Scanner(0.0, 1.0, step_rad, 0.0, 0.1, 5.0, points, stamp_ns=STAMP)


@pytest.mark.parametrize(
    ("bearings_deg", "readings", "first_deg", "step_deg", "ranges_m"),
    [
        (
            {"right": -90.0, "front": 0.0, "left": 90.0},
            [("left", 1.5), ("left", 1.6), ("front", 1.0), ("right", 0.5)],
            *(-90, 90, [0.5, 1.0, 1.6]),
        ),
        ({"a": 0.0, "b": 0.0}, [("light", 0.5), ("a", 1.0), ("b", 2.0)], 0, 1, [2.0]),
        (
            {"a": 10.0, "b": 8.0, "c": 6.5, "d": 12.0},
            [("a", 1.0), ("b", 1.1), ("c", 1.2), ("d", 1.3)],
            *(6.5, 1, [1.2, NAN, 1.1, NAN, 1.0, NAN, 1.3]),
        ),
        *(({"front": 0.0}, [("front", range_m)], 0, 1, [NAN]) for range_m in (0.09, 2.01, -1.0, NAN, math.inf)),
    ],
    ids=["even", "the same way, and one without a bearing", "uneven", *5 * ["outside is no range, but a reading"]],
)
def test_a_scan_comes_when_every_sensor_has_a_new_reading(bearings_deg, readings, first_deg, step_deg, ranges_m):
    ring = BearingScan(bearings_deg, (0.1, 2.0))
    *early, scan = (ring.take(name, range_m, STAMP + at) for at, (name, range_m) in enumerate(readings))
    assert early == [None] * len(early)
    assert scan is not None
    assert (scan.angle_min, scan.angle_increment) == pytest.approx((math.radians(first_deg), math.radians(step_deg)))
    assert (scan.range_min, scan.range_max, scan.stamp_ns) == (0.1, 2.0, STAMP + len(early))
    for _ in range(2):
        assert scan.ranges.tolist() == pytest.approx(ranges_m, nan_ok=True)
        ring.take(*readings[-1], STAMP)
        assert (ring.take("light", 0.7, STAMP), scan.ranges.dtype) == (None, np.float32)


@pytest.mark.parametrize(
    ("count", "scan", "nearest_m"),
    [
        (4, scan_of([1.0, 0.9, 2.0, 0.8, 3.0, 2.9, 4.0, 0.7]), {0: 0.7, 1: 0.9, 2: 0.8, 3: 2.9}),
        (4, scan_of([NAN, -1.0], step_rad=math.pi), {0: 5.0, 2: 5.0}),  # no valid range: free to the end
        *((4, scan_of([1.0, 2.0], (0.5 + 2 * turns) * math.pi, math.pi), {1: 1.0, 3: 2.0}) for turns in (-1, 0, 3)),
        (8, scan_of([1.0, 2.0, 3.0]), {0: 1.0, 1: 2.0, 2: 3.0}),
        (8, scan_of([]), {}),
        *((8, scan_of([1.0], absurd), {}) for absurd in (1e7, math.inf, NAN)),
    ],
)
def test_a_covered_sector_has_the_nearest_range_in_it(count: int, scan: Scan, nearest_m: dict[int, float]) -> None:
    sectors = Sectors(count)
    assert sectors.nearest_m(scan) == pytest.approx(nearest_m)
    assert sectors.covered(scan) == tuple(nearest_m)


def test_a_scanner_tells_its_sectors_before_any_scan_and_too_many_points_cost_no_more_than_many() -> None:
    assert Sectors(8).covered(scanner_of(3, math.pi / 4)) == (0, 1, 2)
    assert Sectors(8).covered(scanner_of(10**12, 1e-9)) == (0,)
