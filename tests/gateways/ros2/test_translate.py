"""ROS messages to fleet messages, and drives to velocities: units, axes, what is not valid, and clocks."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest

from tests.gateways.ros2.scene import TYPES, RosScene, header
from zbridge.errors import NotReady, ProtocolError, Unsupported
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Image, Mode, Motion, Pose, Scanner, Switch
from zbridge.protocol import KeyedSample, SampleKind

make = TYPES.message
QUARTER = {"z": math.sin(math.pi / 4), "w": math.cos(math.pi / 4)}
SCAN: dict[str, Any] = {
    "angle_min": -1.0,
    "angle_increment": 0.5,
    "range_min": 0.1,
    "range_max": 8.0,
    "ranges": np.array([1.0, math.inf, 0.05, math.nan, 8.0], np.float32),
}


@pytest.fixture
def scene() -> RosScene:
    scene = RosScene(speed_full_mps=2.0, turn_full_radps=4.0)
    scene.establish()
    return scene


def received(scene: RosScene, topic: str, **fields: Any) -> dict[str, Any]:
    by = scene.appears(topic)
    return scene.hears(topic, by, header=fields.pop("header", header(scene.time_ns)), **fields)


def ranges(scan: Any) -> list[float | None]:
    return [None if math.isnan(value) else round(float(value), 3) for value in scan.ranges]


def test_a_scan_keeps_its_geometry_and_what_is_out_of_range_is_no_measurement(scene: RosScene) -> None:
    told = received(scene, "scan", **SCAN)
    assert ranges(told["scan"]) == [1.0, None, None, None, 8.0]
    scan, scanner = told["scan"], told["scanner"]
    assert (scan.angle_min, scan.angle_increment, scan.range_max) == (-1.0, 0.5, 8.0)
    assert isinstance(scanner, Scanner)
    assert (scanner.angle_max, scanner.points) == (1.0, 5)
    assert "scanner" not in received(scene, "scan", **SCAN), "told once"


def test_a_scan_of_a_lidar_that_turns_clockwise_is_turned_round(scene: RosScene) -> None:
    told = received(scene, "scan", **{**SCAN, "angle_min": 1.0, "angle_increment": -0.5})
    assert ranges(told["scan"]) == [8.0, None, None, None, 1.0]
    assert (told["scan"].angle_min, told["scan"].angle_increment) == (-1.0, 0.5)


def test_a_lidar_that_looks_to_the_left_is_told_in_the_options() -> None:
    scene = RosScene(scan_yaw_deg=90.0)
    scene.establish()
    assert received(scene, "scan", **SCAN)["scan"].angle_min == pytest.approx(math.pi / 2 - 1.0)


def odometry(x: float, speed: float, turn: float) -> dict[str, Any]:
    pose = make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=-2.0),
        orientation=make("geometry_msgs/msg/Quaternion", **QUARTER),
    )
    twist = make(
        "geometry_msgs/msg/Twist",
        linear=make("geometry_msgs/msg/Vector3", x=speed),
        angular=make("geometry_msgs/msg/Vector3", z=turn),
    )
    return {
        "pose": make("geometry_msgs/msg/PoseWithCovariance", pose=pose),
        "twist": make("geometry_msgs/msg/TwistWithCovariance", twist=twist),
    }


def test_odometry_is_pose_and_motion_and_speed_is_a_fraction_of_full_scale(scene: RosScene) -> None:
    told = received(scene, "odom", **odometry(1.5, -1.0, 0.3))
    assert told["pose"] == Pose(
        1.5, -2.0, told["pose"].heading, stamp_ns=scene.time_ns, device_ms=scene.time_ns // 10**6
    )
    assert told["pose"].heading == pytest.approx(math.pi / 2)
    motion = told["motion"]
    assert isinstance(motion, Motion)
    assert (motion.speed, motion.gyro) == (-0.5, (0.0, 0.0, 0.3))
    assert received(scene, "odom", **odometry(0.0, 9.0, 0.0))["motion"].speed == 1.0
    assert scene.robot.known(topics.POSE) is not None


def test_an_imu_gives_motion_with_the_speed_of_the_odometry_and_no_measurement_is_none(scene: RosScene) -> None:
    received(scene, "odom", **odometry(0.0, 1.0, 0.3))
    told = received(
        scene,
        "imu",
        linear_acceleration=make("geometry_msgs/msg/Vector3", x=0.5, z=9.8),
        angular_velocity_covariance=np.array([-1.0] + [0.0] * 8),
    )
    assert (told["motion"].speed, told["motion"].acceleration, told["motion"].gyro) == (0.5, (0.5, 0.0, 9.8), None)
    assert "motion" not in received(scene, "odom", **odometry(0.0, 1.0, 0.3)), "the imu knows better"


def grid(data: list[int], width: int = 3, height: int = 2, **origin: float) -> dict[str, Any]:
    pose = make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=-1.0, y=-2.0),
        orientation=make("geometry_msgs/msg/Quaternion", **({"w": 1.0} | origin)),
    )
    info = make("nav_msgs/msg/MapMetaData", resolution=0.5, width=width, height=height, origin=pose)
    return {"info": info, "data": np.array(data, np.int8)}


def test_a_map_has_unknown_free_and_occupied_cells_row_by_row(scene: RosScene) -> None:
    told = received(scene, "map", **grid([-1, 0, 25, 26, 65, 100]))["map"]
    assert told.cells.tolist() == [[0, 1, 1], [0, 2, 2]]
    assert (told.rows, told.columns, told.cell, told.origin) == (2, 3, 0.5, (-1.0, -2.0))
    assert scene.robot.known(topics.MAP) is told


def test_a_battery_and_a_picture(scene: RosScene) -> None:
    told = received(scene, "battery_state", percentage=0.5, voltage=12.0, current=math.nan, power_supply_status=2)
    assert (told["battery"].level, told["battery"].voltage) == (0.5, 12.0)
    assert (told["battery"].current, told["battery"].charging) == (None, False)
    told = received(
        scene, "image/compressed", format="rgb8; jpeg compressed bgr8", data=np.frombuffer(b"\xff\xd8x", np.uint8)
    )
    assert isinstance(told["image"], Image)
    assert (told["image"].format, told["image"].data) == ("jpeg", b"\xff\xd8x")


ABSURD: dict[str, tuple[str, dict[str, Any]]] = {
    "a scan without points": ("scan", {**SCAN, "ranges": np.zeros(0, np.float32)}),
    "a scan without steps": ("scan", {**SCAN, "angle_increment": 0.0}),
    "a scan from nowhere": ("scan", {**SCAN, "angle_min": math.nan}),
    "a scan without range": ("scan", {**SCAN, "range_max": 0.1}),
    "odometry that is no number": ("odom", odometry(math.nan, 0.0, 0.0)),
    "a map of another size": ("map", grid([0, 0, 0])),
    "a map that is turned": ("map", grid([0] * 6, **QUARTER)),
    "a battery fuller than full": ("battery_state", {"percentage": 80.0}),
    "an image of raw pixels": ("image/compressed", {"format": "rgb8"}),
    "an imu that measures no numbers": (
        "imu",
        {"linear_acceleration": make("geometry_msgs/msg/Vector3", x=math.inf)},
    ),
}


@pytest.mark.parametrize("case", ABSURD)
def test_absurd_messages_are_no_telemetry(scene: RosScene, case: str) -> None:
    topic, fields = ABSURD[case]
    with pytest.raises(ProtocolError):
        received(scene, topic, **fields)


# Clocks

STAMPS = {
    "just now": (-5_000_000, -5_000_000, ()),
    "a second ago": (-1_000_000_000, -1_000_000_000, ()),
    "an hour ago": (-3_600_000_000_000, 0, ("stamps_astray",)),
    "in a moment": (50_000_000, 0, ()),
    "in an hour": (3_600_000_000_000, 0, ("stamps_ahead",)),
}


@pytest.mark.parametrize("case", STAMPS)
def test_a_stamp_is_believed_if_it_fits_its_arrival_else_counted(scene: RosScene, case: str) -> None:
    measured, believed, counts = STAMPS[case]
    told = received(scene, "scan", header=header(scene.time_ns + measured), **SCAN)
    assert told["scan"].stamp_ns == scene.time_ns + believed
    assert told["scan"].device_ms == (scene.time_ns + measured) // 10**6
    assert [name for name in ("stamps_ahead", "stamps_astray") if scene.metrics.total(name)] == list(counts)


def test_a_simulated_clock_that_begins_anew_breaks_nothing(scene: RosScene) -> None:
    for stamp_ns in (10_000_000_000, 10_100_000_000, 0, 100_000_000):
        told = received(scene, "scan", header=header(stamp_ns), **SCAN)
        assert told["scan"].stamp_ns == scene.time_ns
        assert told["scan"].device_ms == stamp_ns // 10**6


# Commands


def velocity(scene: RosScene) -> tuple[float, float, float]:
    """Give metres a second forward and left, and radians a second, of the Twist that the session writes."""
    (sample,) = scene.write()
    forward, left, _, _, _, turn = struct.unpack("<6d", sample.payload[4:])
    return forward, left, turn


def test_a_drive_is_metres_and_radians_a_second_and_sideways_only_where_configured(scene: RosScene) -> None:
    outcome = scene.robot.command(topics.CMD_DRIVE, Drive(0.5, 0.25, -0.5, light=True), scene.now)
    assert outcome.left_out == "left and light: this robot has none"
    assert scene.session.moving
    assert velocity(scene) == (1.0, 0.0, -2.0)
    crab = RosScene(sideways=True)
    crab.establish()
    crab.robot.command(topics.CMD_DRIVE, Drive(left=1.0), crab.now)
    assert velocity(crab) == (0.0, 0.5, 0.0)


REFUSED = {
    "sideways": (topics.CMD_DRIVE, Drive(left=1.0), "does not move sideways"),
    "light": (topics.CMD_LIGHT, Switch(on=True), "drives only"),
    "camera": (topics.CMD_CAMERA, Switch(on=True), "drives only"),
    "mode": (topics.CMD_MODE, Mode("manual"), "drives only"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_the_robot_cannot_do_is_refused(scene: RosScene, case: str) -> None:
    topic, command, reason = REFUSED[case]
    with pytest.raises(Unsupported, match=reason):
        scene.robot.command(topic, command, scene.now)


def test_it_cannot_be_asked(scene: RosScene) -> None:
    with pytest.raises(Unsupported, match="cannot be asked"):
        scene.robot.ask(topics.MAP)


def test_one_of_two_gateways_may_leave_it_since_each_is_a_session_of_a_router_that_takes_many(scene: RosScene) -> None:
    assert scene.robot.closing_harmless


# Stops


@pytest.mark.parametrize(("shared", "told"), [(False, True), (True, False)])
def test_a_stop_is_told_to_a_robot_that_does_not_move_unless_others_may_drive_it(shared: bool, told: bool) -> None:
    scene = RosScene(shared=shared)
    scene.establish()
    scene.robot.stop(scene.now, scene.now)
    assert bool(scene.write()) is told
    scene.robot.command(topics.CMD_DRIVE, Drive(0.5), scene.now)
    scene.write()
    scene.robot.stop(scene.now, scene.now)
    assert len(scene.write()) == 1
    assert not scene.session.moving
    scene.robot.stop(scene.now, scene.now + 0.25)
    assert scene.write(), "one that lasts is told in any case"


def test_a_robot_that_is_away_takes_nothing() -> None:
    scene = RosScene()
    scene.establish()
    scene.session.close("gone", scene.now)
    with pytest.raises(NotReady, match=r"^offline$"):
        scene.robot.command(topics.CMD_DRIVE, Drive(0.5), scene.now)


def test_a_new_session_remembers_nothing_of_the_one_before(scene: RosScene) -> None:
    received(scene, "odom", **odometry(0.0, 1.0, 0.3))
    received(scene, "imu")
    received(scene, "scan", **SCAN)
    assert scene.robot.known(topics.POSE) is not None
    scene.session = scene.robot.session("router", "tcp://h:1")
    scene.session.open(scene.now)
    scene.feed(KeyedSample(SampleKind.OPENED, payload=b"cafe", stamp_ns=scene.time_ns))
    assert scene.robot.known(topics.POSE) is None
    assert scene.robot.driving is scene.session
    assert "scanner" in received(scene, "scan", **SCAN)
    assert received(scene, "imu")["motion"].speed is None


@pytest.mark.parametrize(("status", "charging"), [(0, None), (1, True), (2, False), (3, False), (4, False)])
def test_whether_a_battery_is_charged_is_told_where_the_robot_knows(
    scene: RosScene, status: int, charging: bool | None
) -> None:
    assert received(scene, "battery_state", percentage=1.0, power_supply_status=status)["battery"].charging is charging


def test_a_drive_says_nothing_of_what_was_left_out_where_nothing_was(scene: RosScene) -> None:
    assert scene.robot.command(topics.CMD_DRIVE, Drive(0.5, turn=1.0), scene.now).left_out is None
    assert scene.robot.command(topics.CMD_DRIVE, Drive(0.5, 0.1), scene.now).left_out == "left: this robot has none"
