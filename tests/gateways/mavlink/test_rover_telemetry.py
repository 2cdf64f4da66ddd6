"""What a rover tells, as fleet messages."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest

from gateways.mavlink.messages import MavlinkMessage, telemetry
from gateways.mavlink.numbers import RoverMode
from gateways.mavlink.rover.options import RoverOptions
from gateways.mavlink.rover.translate import RoverRobot
from gateways.mavlink.texts import chunks_of
from zbridge.errors import ProtocolError

S_NS = 1_000_000_000


class Shown:
    """A robot side that is fed messages."""

    def __init__(self, **options: Any) -> None:
        self.robot = RoverRobot(RoverOptions(**options))

    def take(self, *messages: MavlinkMessage, at_s: float = 0.0) -> dict[str, Any]:
        """Return what these messages show."""
        shown: dict[str, Any] = {}
        for message in messages:
            shown |= {topic.path: each for topic, each in self.robot.telemetry(message, round(at_s * S_NS))}
        return shown


def words(*values: int, count: int) -> bytes:
    return struct.pack(f"<{count}H", *values, *(count - len(values)) * [65535])


def test_a_local_position_is_east_and_north_and_headings_are_counter_clockwise_from_east() -> None:
    shown = Shown()
    assert shown.take(telemetry.LocalPositionNed(x=2.0, y=-3.0)) == {}  # no heading yet
    pose = shown.take(telemetry.Attitude(yaw=math.pi / 2), telemetry.LocalPositionNed(x=2.0, y=-3.0))["pose"]
    assert (pose.x, pose.y, pose.heading) == pytest.approx((-3.0, 2.0, 0.0))
    pose = shown.take(telemetry.Attitude(yaw=-2.0), telemetry.LocalPositionNed())["pose"]
    assert pose.heading == pytest.approx(math.pi / 2 + 2.0 - 2 * math.pi)


def test_global_positions_show_the_pose_only_where_no_local_one_comes() -> None:
    home = telemetry.HomePosition(470000000, 80000000)
    north_east = telemetry.GlobalPositionInt(lat=470000000 + 1000, lon=80000000 + 1000, alt=488500, hdg=9000)
    shown = Shown()
    first = shown.take(home, north_east)
    assert (first["sensor/gps_lat"].value, first["sensor/gps_lon"].value) == pytest.approx((47.0001, 8.0001))
    assert (first["sensor/gps_alt"].value, "pose" in first) == (488.5, False)
    pose = shown.take(north_east, at_s=2.0)["pose"]  # 1e-4 degrees are 11.13 m, to the east less
    assert (pose.x, pose.y, pose.heading) == pytest.approx((11.132 * math.cos(math.radians(47)), 11.132, 0.0), abs=1e-3)
    local = Shown()
    local.take(home, telemetry.Attitude(), telemetry.LocalPositionNed(), north_east)
    assert "pose" not in local.take(north_east, at_s=9.0)


def test_without_a_home_the_first_fix_is_the_origin_and_an_unknown_heading_is_that_of_the_attitude() -> None:
    shown, here = Shown(), telemetry.GlobalPositionInt(lat=1, lon=1799999999, hdg=65535)
    shown.take(here)
    assert "pose" not in shown.take(here, at_s=2.0)
    pose = shown.take(telemetry.Attitude(yaw=0.0), here, at_s=3.0)["pose"]
    assert (pose.x, pose.y, pose.heading) == pytest.approx((0.0, 0.0, math.pi / 2))
    beyond = telemetry.GlobalPositionInt(lat=1, lon=-1799999999, hdg=0)  # over the date line
    assert shown.take(beyond, at_s=4.0)["pose"].x == pytest.approx(0.0222, abs=1e-3)


def test_a_position_before_the_first_fix_is_none_and_a_home_that_is_told_replaces_a_first_fix() -> None:
    shown, here = Shown(), telemetry.GlobalPositionInt(lat=473977420, lon=85455940, hdg=0)
    assert shown.take(telemetry.GlobalPositionInt(hdg=0), telemetry.HomePosition()) == {}
    shown.take(here)
    assert shown.take(here, at_s=3.0)["pose"].x == pytest.approx(0.0)
    shown.take(telemetry.HomePosition(473977420 - 1000, 85455940))
    assert shown.take(here, at_s=4.0)["pose"].y == pytest.approx(11.132, abs=1e-3)
    shown.take(telemetry.HomePosition(473977420, 85455940))  # of another arming
    assert shown.take(here, at_s=5.0)["pose"].y == pytest.approx(11.132, abs=1e-3)


def test_motion_is_a_fraction_of_full_speed_with_the_gyro_turned_to_our_axes() -> None:
    shown = Shown(speed_full_m_s=2.0)
    motion = shown.take(
        telemetry.VfrHud(groundspeed=1.0), telemetry.Attitude(rollspeed=0.1, pitchspeed=0.2, yawspeed=0.3)
    )["motion"]
    assert (motion.speed, motion.gyro) == (0.5, pytest.approx((0.1, -0.2, -0.3)))
    assert shown.take(telemetry.VfrHud(groundspeed=9.0), telemetry.Attitude())["motion"].speed == 1.0
    with pytest.raises(ProtocolError):
        shown.take(telemetry.Attitude(yaw=math.nan))


def test_obstacles_are_turned_counter_clockwise() -> None:
    around = words(100, 200, 801, count=72)  # ahead, 5 degrees to the right, nothing at 10
    message = telemetry.ObstacleDistance(0, around, 20, 800, increment=9, increment_f=5.0, frame=12)
    scan = Shown().take(message)["scan"]
    angles = np.degrees(scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges)))
    known = {
        round(angle): float(value) for angle, value in zip(angles, scan.ranges, strict=True) if not np.isnan(value)
    }
    assert known == {0: 1.0, -5: 2.0}
    assert (len(scan.ranges), scan.range_min, scan.range_max) == (72, 0.2, 8.0)


def test_an_unknown_distance_is_unknown_whatever_the_range() -> None:
    scan = Shown().take(telemetry.ObstacleDistance(0, words(100, count=72), 20, 65535, increment=5, frame=12))["scan"]
    assert np.isnan(scan.ranges).sum() == 71


def test_obstacles_in_another_frame_or_without_an_angle_are_no_scan() -> None:
    for message in (
        telemetry.ObstacleDistance(increment=5, frame=0),
        telemetry.ObstacleDistance(frame=12),
        telemetry.ObstacleDistance(increment_f=math.nan, frame=12),
        telemetry.ObstacleDistance(increment=5, angle_offset=math.inf, frame=12),
    ):
        with pytest.raises(ProtocolError):
            Shown().take(message)


def test_a_scan_has_no_more_points_than_a_turn() -> None:
    scan = Shown().take(telemetry.ObstacleDistance(0, words(100, count=72), 20, 800, increment=10, frame=12))["scan"]
    assert len(scan.ranges) == 36


def test_a_distance_has_the_name_of_its_direction() -> None:
    shown = Shown().take(
        telemetry.DistanceSensor(0, 20, 700, 250, orientation=2), telemetry.DistanceSensor(0, 20, 700, 701)
    )
    assert (shown["sensor/distance_right"].value, shown["sensor/distance_right"].fault) == (2.5, False)
    assert shown["sensor/distance_forward"].fault
    assert "sensor/distance_39" in Shown().take(telemetry.DistanceSensor(orientation=39))


def test_a_battery_is_the_sum_of_its_cells_and_the_system_status_only_where_there_is_no_other() -> None:
    shown, cells = Shown(), words(4000, 4000, count=10)
    system = telemetry.SysStatus(voltage_battery=11000, current_battery=-1, battery_remaining=-1)
    battery = shown.take(system)["battery"]
    assert (battery.voltage, battery.current, battery.level) == (11.0, None, None)
    battery = shown.take(telemetry.BatteryStatus(voltages=cells, current_battery=150, battery_remaining=80))["battery"]
    assert (battery.voltage, battery.current, battery.level) == (8.0, -1.5, 0.8)
    assert shown.take(system) == {}
    assert shown.take(telemetry.BatteryStatus(voltages=cells, battery_id=1)) == {}
    unknown = words(count=10)
    battery = shown.take(telemetry.BatteryStatus(voltages=unknown, current_battery=-1, battery_remaining=-1))["battery"]
    assert (battery.voltage, battery.current, battery.level) == (None, None, None)


def test_mode_and_arming_are_told_when_they_change() -> None:
    shown = Shown()
    texts = [
        shown.take(telemetry.MavlinkHeartbeat(mode, 10, 3, base)).get("text")
        for mode, base in ((RoverMode.HOLD, 1), (RoverMode.HOLD, 1), (RoverMode.GUIDED, 129), (99, 129))
    ]
    assert [text and text.text for text in texts] == [
        "mode HOLD, disarmed",
        None,
        "mode GUIDED, armed",
        "mode 99, armed",
    ]


def test_a_text_is_shown_once_it_is_whole() -> None:
    shown, (one, two) = Shown(), chunks_of("PreArm: the compass is not calibrated, turn it around once", 4, 3)
    assert shown.take(one) == {}
    assert shown.take(two)["text"].text == "PreArm: the compass is not calibrated, turn it around once"
