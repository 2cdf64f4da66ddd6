"""Distance sensors as a scan, and scans as distance sensors."""

import math

import numpy as np
import pytest

from zbridge.fleet.messages import Scan, Scanner
from zbridge.protocol.bearings import BearingScan, Sectors

STAMP = 1_700_000_000_000_000_000
THREE = {"right": -90.0, "front": 0.0, "left": 90.0}


def scan_of(ranges_m: list[float], first_rad: float = 0.0, step_rad: float = math.pi / 4) -> Scan:
    return Scan(first_rad, step_rad, 0.1, 5.0, np.array(ranges_m, np.float32), stamp_ns=STAMP)


def test_a_scan_comes_when_every_sensor_has_a_new_reading() -> None:
    ring = BearingScan(THREE, (0.1, 2.0))
    assert ring.take("left", 1.5, STAMP) is None
    assert ring.take("left", 1.6, STAMP) is None
    assert ring.take("front", 1.0, STAMP) is None
    scan = ring.take("right", 0.5, STAMP + 1)
    assert scan is not None
    assert (scan.angle_min, scan.angle_increment) == pytest.approx((-math.pi / 2, math.pi / 2))
    assert (scan.range_min, scan.range_max, scan.stamp_ns) == (0.1, 2.0, STAMP + 1)
    assert scan.ranges.dtype == np.float32
    assert scan.ranges.tolist() == pytest.approx([0.5, 1.0, 1.6])
    assert ring.take("front", 0.7, STAMP) is None
    assert scan.ranges.tolist() == pytest.approx([0.5, 1.0, 1.6]), "a scan that was given does not change"


@pytest.mark.parametrize("range_m", [0.09, 2.01, -1.0, math.nan, math.inf])
def test_a_range_outside_is_no_range_but_a_reading(range_m: float) -> None:
    scan = BearingScan({"front": 0.0}, (0.1, 2.0)).take("front", range_m, STAMP)
    assert scan is not None
    assert math.isnan(scan.ranges[0])


def test_a_sensor_without_a_bearing_is_ignored_and_sensors_that_look_the_same_way_share_a_point() -> None:
    ring = BearingScan({"a": 0.0, "b": 0.0}, (0.0, 9.0))
    assert ring.take("light", 0.5, STAMP) is None
    assert ring.take("a", 1.0, STAMP) is None
    scan = ring.take("b", 2.0, STAMP)
    assert scan is not None
    assert scan.ranges.tolist() == [2.0]


def test_uneven_bearings_are_a_point_a_degree() -> None:
    ring = BearingScan({"a": 10.0, "b": 0.0, "c": -20.0, "d": 12.0}, (0.0, 9.0))
    scans = [ring.take(name, range_m, STAMP) for name, range_m in (("a", 1.0), ("b", 2.0), ("c", 3.0), ("d", 4.0))]
    scan = scans[-1]
    assert scan is not None
    assert (scan.angle_min, scan.angle_increment) == pytest.approx((math.radians(-20), math.radians(1)))
    there = {place: float(range_m) for place, range_m in enumerate(scan.ranges) if not math.isnan(range_m)}
    assert (len(scan.ranges), there) == (33, {0: 3.0, 20: 2.0, 30: 1.0, 32: 4.0})


def test_a_sector_has_the_nearest_range_in_it() -> None:
    sectors = Sectors(4)
    scan = scan_of([1.0, 0.9, 2.0, 0.8, 3.0, 2.9, 4.0, 0.7])
    assert sectors.nearest_m(scan) == pytest.approx({0: 0.7, 1: 0.9, 2: 0.8, 3: 2.9})
    assert sectors.covered(scan) == (0, 1, 2, 3)


def test_a_sector_without_a_valid_range_is_free_to_the_end() -> None:
    assert Sectors(4).nearest_m(scan_of([math.nan, -1.0], step_rad=math.pi)) == {0: 5.0, 2: 5.0}


@pytest.mark.parametrize("turns", [-1, 0, 1, 3])
def test_a_full_turn_more_changes_nothing(turns: int) -> None:
    scan = scan_of([1.0, 2.0], first_rad=math.pi / 2 + turns * 2 * math.pi, step_rad=math.pi)
    assert Sectors(4).nearest_m(scan) == {1: 1.0, 3: 2.0}


def test_only_covered_sectors_are_there_and_a_scanner_tells_them_before_any_scan() -> None:
    sectors = Sectors(8)
    scanner = Scanner(0.0, math.pi / 2, math.pi / 4, 0.0, 0.1, 5.0, 3, stamp_ns=STAMP)
    assert sectors.covered(scanner) == (0, 1, 2)
    assert tuple(sectors.nearest_m(scan_of([1.0, 2.0, 3.0]))) == (0, 1, 2)
    assert sectors.covered(scan_of([])) == ()


@pytest.mark.parametrize("first_rad", [1e7, math.inf, math.nan])
def test_an_absurd_geometry_covers_nothing(first_rad: float) -> None:
    assert Sectors(8).nearest_m(scan_of([1.0], first_rad=first_rad)) == {}


def test_a_scanner_that_claims_too_many_points_costs_no_more_than_many() -> None:
    scanner = Scanner(0.0, 1.0, 1e-9, 0.0, 0.1, 5.0, 10**12, stamp_ns=STAMP)
    assert Sectors(8).covered(scanner) == (0,)
