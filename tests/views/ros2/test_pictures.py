"""Each fleet message field by field as ROS's, through CDR written by us and read by rosbags."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from rosbags.typesys import Stores, get_typestore

from zbridge.fleet.messages import (
    Battery,
    Control,
    Device,
    Fault,
    Image,
    Latch,
    Map,
    Motion,
    Pose,
    Reading,
    Refusal,
    Scan,
    Scanner,
    Status,
)
from zbridge.metrics import Metrics
from zbridge.ros2.types import DISTROS, types_of
from zbridge.views.ros2.pictures import TOPICS, RosPictures
from zbridge.views.ros2.settings import Mount, RobotBody

NOW_NS = 1_800_000_000_500_000_000
STAMP_NS = NOW_NS - 20_000_000
EVERYTHING = {topic.name for topic in TOPICS} | {"range/front_left", "joint_states"}
TYPES = {topic.name: topic.type_name for topic in TOPICS}
BODY = RobotBody(speed_full_mps=2.0, laser=Mount(0.1, 0.0, 0.3, math.pi / 2))
BOTH = (np.array([1.0, 2.0], np.float32), np.array([1.0, 2.0], "<f4").tobytes())
"""The ranges of a scan as an array, and as the bytes of a payload."""
STORES = {distro: get_typestore(Stores(f"ros2_{distro}")) for distro in DISTROS}


def robot(distro: str = "jazzy", body: RobotBody = BODY) -> RosPictures:
    return RosPictures("r1", types_of(distro), body, Metrics())


def cdr(made: Any, distro: str = "jazzy", name: str = "scan") -> Any:
    """Give what rosbags reads of a message that we wrote, of the topic of this name if it is bytes already."""
    if isinstance(made, bytes):
        return STORES[distro].deserialize_cdr(made, TYPES[name])
    return STORES[distro].deserialize_cdr(types_of(distro).encode(made), made.__msgtype__)


def made(pictures: RosPictures, message: Any, path: str = "", now_ns: int = NOW_NS) -> dict[str, Any]:
    return {name: cdr(shape, name=name) for name, shape in pictures.make(path, message, now_ns, EVERYTHING)}


def stamp(header: Any) -> int:
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def scan(ranges: list[float], **more: Any) -> Scan:
    fields = {"angle_min": -1.0, "angle_increment": 0.5, "range_min": 0.02, "range_max": 5.6} | more
    return Scan(**fields, ranges=np.array(ranges, np.float32), stamp_ns=STAMP_NS)


def test_a_scan_has_as_many_ranges_as_its_angles_say() -> None:
    pictures = robot()
    pictures.make("scanner", Scanner(-1, 1, 0.5, 0.001, 0.02, 5.6, 5), NOW_NS, EVERYTHING)
    list(pictures.make("scanner", Scanner(-1, 1, 0.5, 0.001, 0.02, 5.6, 5), NOW_NS, EVERYTHING))
    laser = made(pictures, scan([1.0, math.nan, 3.0, math.inf, 5.0]))["scan"]
    assert (laser.header.frame_id, stamp(laser.header)) == ("r1/laser", STAMP_NS)
    assert (laser.angle_min, laser.angle_max, laser.angle_increment) == (-1.0, 1.0, 0.5)
    assert round((laser.angle_max - laser.angle_min) / laser.angle_increment) + 1 == len(laser.ranges)
    assert laser.ranges.tolist() == pytest.approx([1.0, math.nan, 3.0, math.inf, 5.0], nan_ok=True)
    assert (laser.range_min, laser.range_max) == pytest.approx((0.02, 5.6))
    assert laser.time_increment == pytest.approx(0.001)
    assert laser.intensities.tolist() == []


def test_a_scan_that_runs_clockwise_is_turned_round() -> None:
    laser = made(robot(), scan([1.0, 2.0, 3.0], angle_min=1.0, angle_increment=-0.5))["scan"]
    assert (laser.angle_min, laser.angle_max, laser.angle_increment) == (0.0, 1.0, 0.5)
    assert laser.ranges.tolist() == [3.0, 2.0, 1.0]


@pytest.mark.parametrize("name", ["r", "r1", "r12", "r123", "a_robot_with_a_long_name"])
def test_a_scan_is_the_bytes_that_rosbags_writes(name: str) -> None:
    pictures = RosPictures(name, types_of("jazzy"), BODY, Metrics())
    for number in range(2):  # the second one knows its period
        fields = {"stamp_ns": STAMP_NS + number * 100_000_000}
        ((_, written),) = pictures.make("scan", replace(scan([1.0, math.nan, 3.0]), **fields), NOW_NS, {"scan"})
    read = cdr(written)
    assert (read.header.frame_id, read.scan_time) == (f"{name}/laser", pytest.approx(0.1))
    assert written == bytes(STORES["jazzy"].serialize_cdr(read, "sensor_msgs/msg/LaserScan"))


def test_ranges_may_be_the_bytes_that_came() -> None:
    arrays, plain = (made(robot(), replace(scan([1.0, 2.0]), ranges=ranges))["scan"] for ranges in BOTH)
    assert arrays.ranges.tolist() == plain.ranges.tolist() == [1.0, 2.0]
    turned = replace(scan([], angle_min=1.0, angle_increment=-0.5), ranges=BOTH[1])
    assert made(robot(), turned)["scan"].ranges.tolist() == [2.0, 1.0]


def test_rays_that_would_take_longer_than_the_scan_have_no_time() -> None:
    pictures = robot()
    list(pictures.make("scanner", Scanner(-1, 1, 0.5, 0.1, 0.02, 5.6, 5), NOW_NS, EVERYTHING))
    assert made(pictures, scan([1.0] * 769))["scan"].time_increment == 0.0


WRONG = (
    scan([]),
    scan([1.0], angle_increment=0.0),
    scan([1.0], range_max=math.inf),
    scan([1.0], angle_min=math.nan),
    scan([1.0], range_max=1e39),
    replace(scan([]), ranges=b"abc"),
)


@pytest.mark.parametrize("wrong", WRONG)
def test_a_scan_without_sense_is_counted_and_left_out(wrong: Scan) -> None:
    metrics = Metrics()
    pictures = RosPictures("r1", types_of("jazzy"), BODY, metrics)
    assert list(pictures.make("scan", wrong, NOW_NS, EVERYTHING)) == []
    assert metrics.total("ros2_unusable") == 1


def test_a_pose_is_a_pose_an_odometry_and_a_frame() -> None:
    pictures = robot()
    list(pictures.make("motion", Motion(speed=-0.5, gyro=(0.0, 0.0, 0.25)), NOW_NS, ()))
    shown = made(pictures, Pose(1.0, -2.0, math.pi / 2, stamp_ns=STAMP_NS))
    assert set(shown) == {"pose", "odom", "tf"}
    pose, odom, (moved,) = shown["pose"], shown["odom"], shown["tf"].transforms
    half = math.sqrt(0.5)
    for header, place, frame in (
        (pose.header, pose.pose, "r1/map"),
        (odom.header, odom.pose.pose, "r1/odom"),
    ):
        assert (header.frame_id, stamp(header)) == (frame, STAMP_NS)
        assert (place.position.x, place.position.y, place.position.z) == (1.0, -2.0, 0.0)
        turned = (place.orientation.x, place.orientation.y, place.orientation.z, place.orientation.w)
        assert turned == pytest.approx((0, 0, half, half))
    assert odom.child_frame_id == "r1/base_link"
    assert (odom.twist.twist.linear.x, odom.twist.twist.angular.z) == (-1.0, 0.25)
    deviations = np.sqrt(np.diag(odom.pose.covariance.reshape(6, 6)))
    assert deviations.tolist() == pytest.approx([0.05, 0.05, 1e3, 1e3, 1e3, 0.05])
    assert np.sqrt(np.diag(odom.twist.covariance.reshape(6, 6))).tolist() == pytest.approx(
        [0.2, 1e3, 1e3, 1e3, 1e3, 0.05]
    )
    assert (moved.header.frame_id, moved.child_frame_id, stamp(moved.header)) == ("r1/odom", "r1/base_link", STAMP_NS)
    assert (moved.transform.translation.x, moved.transform.translation.y) == (1.0, -2.0)
    assert (moved.transform.rotation.z, moved.transform.rotation.w) == pytest.approx((half, half))


@pytest.mark.parametrize("unknown", ["x", "y", "heading"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_pose_with_a_part_that_is_no_number_makes_nothing(unknown: str, value: float) -> None:
    assert made(robot(), replace(Pose(1.0, -2.0, 0.5), **{unknown: value})) == {}


def test_what_nobody_measured_has_a_variance_that_says_so() -> None:
    odom = made(robot(), Pose(0.0, 0.0, 0.0))["odom"]
    assert np.diag(odom.twist.covariance.reshape(6, 6)).tolist() == [1e6] * 6
    moving = made(robot(), Motion(speed=0.5))
    assert set(moving) == {"odom"}, "no frame: without a turn rate nobody knows where the robot is"
    assert np.diag(moving["odom"].pose.covariance.reshape(6, 6)).tolist() == [1e6] * 6
    assert moving["odom"].twist.twist.linear.x == 1.0


def test_speed_and_turn_rate_are_added_up_where_no_pose_comes_and_the_variance_grows() -> None:
    pictures, second = robot(), 1_000_000_000
    for number in range(11):  # 10 s at 1 m/s and 0.1 rad/s: a tenth of a circle of radius 10 m per radian
        motion = Motion(speed=0.5, gyro=(0.0, 0.0, 0.1), stamp_ns=STAMP_NS + number * second)
        shown = made(pictures, motion, now_ns=NOW_NS + number * second)
    place = shown["odom"].pose.pose.position
    assert (place.x, place.y) == pytest.approx((10 * math.sin(1.0), 10 * (1 - math.cos(1.0))), rel=1e-3)
    (moved,) = shown["tf"].transforms
    assert (moved.transform.translation.x, moved.transform.translation.y) == (place.x, place.y)
    assert shown["odom"].pose.covariance[0] > 0.05**2 * 40


def test_a_map_is_a_grid_with_rows_along_y() -> None:
    cells = np.array([[0, 1, 2], [2, 9, 0]], np.uint8)
    grid = made(robot(), Map(2, 3, 0.5, (-1.0, -2.0), cells, stamp_ns=STAMP_NS))["map"]
    assert (grid.header.frame_id, stamp(grid.header), stamp(type("H", (), {"stamp": grid.info.map_load_time}))) == (
        "r1/map",
        STAMP_NS,
        STAMP_NS,
    )
    assert (grid.info.width, grid.info.height, grid.info.resolution) == (3, 2, 0.5)
    assert (grid.info.origin.position.x, grid.info.origin.position.y, grid.info.origin.orientation.w) == (
        -1.0,
        -2.0,
        1.0,
    )
    assert grid.data.tolist() == [-1, 0, 100, 100, -1, -1]


def test_a_map_whose_cells_are_not_as_many_as_it_says_is_left_out() -> None:
    assert made(robot(), Map(3, 3, 0.5, (0.0, 0.0), np.zeros(6, np.uint8))) == {}


def test_an_imu_says_what_it_does_not_have() -> None:
    imu = made(robot(), Motion(gyro=(0.1, 0.2, 0.3), stamp_ns=STAMP_NS))["imu"]
    assert (imu.header.frame_id, stamp(imu.header)) == ("r1/base_link", STAMP_NS)
    assert (imu.angular_velocity.x, imu.angular_velocity.y, imu.angular_velocity.z) == (0.1, 0.2, 0.3)
    assert imu.orientation_covariance[0] == imu.linear_acceleration_covariance[0] == -1
    assert imu.angular_velocity_covariance.tolist() == [0.0] * 9
    still = made(robot(), Motion(acceleration=(1.0, 2.0, 9.8)))["imu"]
    assert (still.linear_acceleration.x, still.linear_acceleration.y, still.linear_acceleration.z) == (1.0, 2.0, 9.8)
    assert still.angular_velocity_covariance[0] == -1
    assert "imu" not in made(robot(), Motion(speed=0.1))


def test_distance_sensors_have_a_topic_each_and_joints_have_one() -> None:
    pictures = robot()
    devices = (Device("front left", 1, "distance"), Device("wheel", 2, "rotational"), Device("eye", 3, "light"))
    assert [topic.name for topic in pictures.sensors(devices)] == ["range/front_left", "joint_states"]
    reading = Reading(0.75, "distance", 1, stamp_ns=STAMP_NS)
    seen = made(pictures, reading, "sensor/front%20left")["range/front_left"]
    assert (seen.header.frame_id, seen.range, seen.min_range, seen.max_range) == ("r1/front_left", 0.75, 0.0, 10.0)
    fault = made(pictures, Reading(-1.0, "distance", 1, fault=True), "sensor/front%20left")["range/front_left"]
    assert math.isnan(fault.range)
    joints = made(pictures, Reading(1.5, "rotational", 2, stamp_ns=STAMP_NS), "sensor/wheel")["joint_states"]
    assert (joints.name, joints.position.tolist(), stamp(joints.header)) == (["wheel"], [1.5], STAMP_NS)
    assert made(pictures, Reading(1.0, "light", 3), "sensor/eye") == {}


def test_a_joint_that_is_at_fault_or_gone_is_not_told_of() -> None:
    pictures = robot()
    pictures.sensors((Device("wheel", 1, "rotational"), Device("lift", 2, "linear")))
    assert made(pictures, Reading(math.inf, "rotational", 1, fault=True), "sensor/wheel") == {}
    made(pictures, Reading(0.5, "rotational", 1), "sensor/wheel")
    joints = made(pictures, Reading(0.1, "linear", 2), "sensor/lift")["joint_states"]
    assert (joints.name, joints.position.tolist()) == (["wheel", "lift"], [0.5, 0.1])
    made(pictures, Reading(9.0, "rotational", 1, fault=True), "sensor/wheel")
    assert made(pictures, Reading(0.1, "linear", 2), "sensor/lift")["joint_states"].name == ["lift"]
    made(pictures, Reading(0.5, "rotational", 1), "sensor/wheel")
    pictures.sensors((Device("lift", 2, "linear"),))
    assert made(pictures, Reading(0.2, "linear", 2), "sensor/lift")["joint_states"].name == ["lift"]


def test_fixed_frames_and_the_description_know_the_scanner() -> None:
    fixed = {name: cdr(shape) for name, shape in robot().fixed(NOW_NS)}
    frames = {(at.header.frame_id, at.child_frame_id): at.transform for at in fixed["tf_static"].transforms}
    assert set(frames) == {("r1/base_link", "r1/laser"), ("r1/map", "r1/odom")}
    laser = frames["r1/base_link", "r1/laser"]
    assert (laser.translation.x, laser.translation.z) == (0.1, 0.3)
    assert laser.rotation.z == pytest.approx(math.sqrt(0.5))
    assert '<link name="r1/base_link">' in fixed["robot_description"].data
    assert 'rpy="0 0 1.5708"' in fixed["robot_description"].data
    alone = {name: cdr(shape) for name, shape in robot(body=RobotBody(map_to_odom=False)).fixed(NOW_NS)}
    assert [at.child_frame_id for at in alone["tf_static"].transforms] == ["r1/laser"]


def test_sensors_and_the_camera_have_the_frames_of_their_messages_where_it_is_known_where_they_are() -> None:
    body = RobotBody(sensors={"front left": Mount(0.2, 0.1, 0.05, math.pi / 2), "camera": Mount(z=0.4)})
    pictures = robot(body=body)
    fixed = {name: cdr(shape) for name, shape in pictures.fixed(NOW_NS)}
    frames = {at.child_frame_id: (at.header.frame_id, at.transform) for at in fixed["tf_static"].transforms}
    pictures.sensors((Device("front left", 1, "distance"),))
    seen = made(pictures, Reading(0.5, "distance", 1), "sensor/front%20left")["range/front_left"].header.frame_id
    image = made(pictures, Image("jpeg", b"picture"))["image/compressed"].header.frame_id
    assert {seen, image} <= set(frames)
    parent, place = frames[seen]
    assert (parent, place.translation.x, place.translation.y, place.translation.z) == ("r1/base_link", 0.2, 0.1, 0.05)
    assert place.rotation.z == pytest.approx(math.sqrt(0.5))


def test_diagnostics_tell_state_links_control_and_refusals() -> None:
    pictures = robot()
    before = {entry.name: entry.level for entry in cdr(pictures.diagnostics([], NOW_NS)).status}
    assert before == {"r1: state": 3, "r1: links": 3, "r1: faults": 3, "r1: control": 3, "r1: refusals": 0}
    list(pictures.make("status", Status("connecting", "refused\x07", protocol="alf"), NOW_NS, ()))
    assert {e.message for e in cdr(pictures.diagnostics([], NOW_NS)).status if e.name == "r1: faults"} == {"none"}
    fault = Fault("deadman", "no command for 0.5 s (ann)", NOW_NS, 2)
    list(pictures.make("status", Status("connecting", "refused\x07", protocol="alf", faults=(fault,)), NOW_NS, ()))
    refusal = Refusal(who="op1", command="drive", code="held", reason="held by op2", count=3)
    list(pictures.make("control", Control("held", "op2", refusals=(refusal,)), NOW_NS, ()))
    told = cdr(pictures.diagnostics([], NOW_NS))
    shown = {entry.name: (entry.level, entry.message, {v.key: v.value for v in entry.values}) for entry in told.status}
    assert shown["r1: state"] == (1, "connecting: refused?", {"protocol": "alf"})
    assert shown["r1: faults"] == (1, "deadman", {"deadman": "no command for 0.5 s (ann) (2)"})
    assert shown["r1: control"] == (0, "held by op2", {"holder": "op2"})
    assert shown["r1: refusals"] == (1, "3 commands refused lately", {"drive of op1": "held by op2 (3)"})
    assert stamp(told.header) == NOW_NS
    latches = tuple(Latch(bytes([number]) * 16, "ann", why) for number, why in enumerate(("a cable", "rain")))
    list(pictures.make("control", Control("latched", latches=latches), NOW_NS, ()))
    (shown_control,) = (e for e in cdr(pictures.diagnostics([], NOW_NS)).status if e.name == "r1: control")
    assert (shown_control.level, shown_control.message) == (1, "latched by ann (rain)")
    assert {value.key: value.value for value in shown_control.values} == {
        "latch 00000000": "latched by ann (a cable)",
        "latch 01010101": "latched by ann (rain)",
    }


STAMPS = {
    STAMP_NS: STAMP_NS,
    NOW_NS + 10**9 - 1: NOW_NS + 10**9 - 1,
    NOW_NS + 10**9: NOW_NS,
    -1: NOW_NS,
    2**62: NOW_NS,
    0: 0,
}


@pytest.mark.parametrize(("given", "shown"), STAMPS.items())
def test_stamps_from_the_far_future_become_now_and_are_counted(given: int, shown: int) -> None:
    metrics = Metrics()
    pictures = RosPictures("r1", types_of("jazzy"), BODY, metrics)
    (pose,) = (made for name, made in pictures.make("pose", Pose(0, 0, 0, stamp_ns=given), NOW_NS, {"pose"}))
    assert stamp(cdr(pose, name="pose").header) == shown
    assert metrics.total("ros2_stamps_clamped") == (given != shown)


@pytest.mark.parametrize("distro", DISTROS)
def test_every_message_is_written_for_every_distro(distro: str) -> None:
    pictures = robot(distro)
    pictures.sensors((Device("front left", 1, "distance"), Device("wheel", 2, "rotational")))
    messages = [
        ("scan", scan([1.0, 2.0])),
        ("pose", Pose(0, 0, 0)),
        ("motion", Motion(speed=0.1, gyro=(0, 0, 0))),
        ("map", Map(1, 1, 1.0, (0, 0), np.zeros((1, 1), np.uint8))),
        ("sensor/front%20left", Reading(1.0, "distance", 1)),
        ("sensor/wheel", Reading(1.0, "rotational", 2)),
        ("battery", Battery(level=1.0)),
        ("image", Image("jpeg", b"picture")),
    ]
    shown = {
        name: cdr(made, distro, name)
        for path, message in messages
        for name, made in pictures.make(path, message, NOW_NS, EVERYTHING)
    }
    fixed = {name: cdr(made, distro) for name, made in pictures.fixed(NOW_NS)}
    assert shown.keys() | fixed.keys() | {"diagnostics"} == EVERYTHING


def test_only_what_is_listened_to_is_made() -> None:
    assert [name for name, _ in robot().make("pose", Pose(0, 0, 0), NOW_NS, {"tf"})] == ["tf"]


@pytest.mark.parametrize(("charging", "status"), [(None, 0), (True, 1), (False, 2)])
def test_a_battery_tells_what_the_robot_tells_and_no_more(charging: bool | None, status: int) -> None:
    shown = made(robot(), Battery(level=0.5, voltage=24.5, charging=charging, stamp_ns=STAMP_NS))["battery_state"]
    assert (shown.header.frame_id, stamp(shown.header)) == ("r1/base_link", STAMP_NS)
    assert (shown.percentage, shown.voltage, shown.power_supply_status, shown.present) == (0.5, 24.5, status, True)
    unknown = (shown.current, shown.temperature, shown.charge, shown.capacity, shown.design_capacity)
    assert all(map(math.isnan, unknown))


def test_a_picture_is_the_same_bytes() -> None:
    shown = made(robot(), Image("jpeg", b"\xff\xd8picture\xff\xd9", stamp_ns=STAMP_NS))["image/compressed"]
    assert (shown.header.frame_id, stamp(shown.header)) == ("r1/camera", STAMP_NS)
    assert (shown.format, shown.data.tobytes()) == ("jpeg", b"\xff\xd8picture\xff\xd9")
    assert made(robot(), Image("jpeg", b"")) == {}
