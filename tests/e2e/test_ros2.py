"""``zbridge ros2`` between a real gateway and a participant of ROS 2 that shares no code with it; two real routers."""

from __future__ import annotations

import contextlib
import json
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgpack
import pytest
import zenoh

from tests.e2e.conftest import Gateway, configuration, device, repeated, start, until
from tests.e2e.rigs.robots import STOP, Robot
from tests.e2e.rigs.ros2_scene import GRID, SCAN, STAMPED, TWIST, RosScene, pushed
from tests.ports import free_port
from tests.views.ros2.judge import Publisher, Ros

TRIGGER, SET_BOOL = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
TRIGGERS = ("stop", "latch", "unlatch")


class Scene(RosScene):
    """A scripted robot behind a real gateway, and the view."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path) -> None:
        self.robot = Robot()
        stack.callback(self.robot.close)
        super().__init__(stack, folder, "[robot.r1]\nspeed_full_mps = 0.5\n")
        Gateway(stack, folder / "r1.toml", self.fleet_at, device(self.robot.port))
        self.told("r1: state", "established")

    def moves(self, since: float = 0.0) -> list[float]:
        """Give the speeds of the frames that moved the robot after a moment, in the order they came."""
        frames = [frame for frame in tuple(self.robot.frames) if frame.moves and frame.at > since]
        return [frame.number / 1e6 for frame in frames]

    def rests(self) -> bool:
        """Whether the newest frame that moves or stops the robot is a stop."""
        newest = [frame for frame in tuple(self.robot.frames) if frame.moves or frame.packet_id == STOP]
        return not newest or newest[-1].packet_id == STOP


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    with contextlib.ExitStack() as stack:
        yield Scene(stack, tmp_path_factory.mktemp("ros2"))


@contextlib.contextmanager
def publishing(scene: Scene, type_name: str = TWIST) -> Iterator[Publisher]:
    """Have a publisher on cmd_vel that may drive; at the end the robot is nobody's again."""
    with scene.publishing("r1", type_name) as publisher:
        yield publisher
    until(scene.rests, what="rest")
    scene.told("r1: control", "free" if "stopped" not in scene.told("r1: control", "") else "stopped")


def test_the_graph_shows_a_node_for_the_robot_and_what_it_offers(scene: Scene) -> None:
    def offered() -> set[tuple[str, str]]:
        tokens = [parts[5:] for parts in scene.ros.graph() if parts[7:9] == ["%r1", "zbridge"]]
        return {(token[0], token[4].replace("%", "/") if len(token) > 4 else "") for token in tokens}

    expected = {("MP", f"/r1/{name}") for name in ("scan", "odom", "pose", "map", "imu", "tf", "robot_description")}
    expected |= {("MP", "/tf"), ("MP", "/tf_static"), ("MS", "/r1/cmd_vel"), ("NN", "")}
    expected |= {("SS", f"/r1/{name}") for name in (*TRIGGERS, "set_light", "set_lidar", "set_camera")}
    until(lambda: expected <= offered(), what="graph")


def test_a_scan_comes_while_somebody_listens_and_a_late_joiner_gets_the_map(scene: Scene) -> None:
    fleet, now_ns = scene.fleet, time.time_ns()
    token = fleet.liveliness().declare_token("fleet/r2/@alive/gateway")
    until(lambda: any(parts[7] == "%r2" for parts in scene.ros.graph()), what="r2")
    ranges = struct.pack("<3f", 1.0, 2.0, 3.0)
    scan = {"angle_min": -1.0, "angle_increment": 1.0, "range_min": 0.1, "range_max": 9.0, "ranges": ranges}
    grid = {"rows": 1, "columns": 3, "cell": 0.5, "origin": [0.0, 0.0], "cells": bytes([0, 1, 2])}

    def put(name: str, fields: dict[str, object]) -> Callable[[], None]:
        return lambda: fleet.put(f"fleet/r2/{name}", msgpack.packb({**fields, "stamp_ns": now_ns}))

    scans = scene.ros.subscribe("/r2/scan", SCAN)
    first = scene.ros.subscribe("/r2/map", GRID, latched=True)
    with repeated(put("scan", scan)), repeated(put("map", grid)):
        heard = scans.until(lambda heard: len(heard) > 2)
        first.until(bool)
    laser = heard[-1].message
    assert laser.ranges.tolist() == [1.0, 2.0, 3.0]
    assert (laser.header.frame_id, laser.angle_max) == ("r2/laser", 1.0)
    assert laser.header.stamp.sec * 10**9 + laser.header.stamp.nanosec == now_ns
    numbers = [each.number for each in heard]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    late = scene.ros.subscribe("/r2/map", GRID, latched=True)
    assert late.until(bool)[0].message.data.tolist() == [-1, 0, 100]
    fixed = scene.ros.subscribe("/tf_static", "tf2_msgs/msg/TFMessage", latched=True)
    robots = {"r1/laser", "r2/laser"}
    fixed.until(lambda heard: robots <= {at.child_frame_id for each in heard for at in each.message.transforms})
    token.undeclare()
    until(lambda: not any(parts[7] == "%r2" for parts in scene.ros.graph()), what="no r2")


@pytest.mark.parametrize("type_name", [TWIST, STAMPED])
def test_a_twist_drives_and_silence_stops(scene: Scene, type_name: str) -> None:
    with publishing(scene, type_name) as publisher:
        begun = time.monotonic()
        with pushed(publisher, 0.125, lambda: scene.moves(begun)):
            scene.told("r1: cmd_vel", "driven by /teleop")
            scene.told("r1: control", "held by ros2.teleop")
        assert scene.moves(begun)[-1] == pytest.approx(0.25), "0.125 m/s of 0.5 m/s"
        until(scene.rests, what="rest")
        scene.told("r1: cmd_vel", "nobody drives")


def test_of_two_publishers_the_second_is_refused_and_told_by_whom(scene: Scene) -> None:
    other = Ros(scene.ros_at, "nav", namespace="/planner")
    with contextlib.closing(other), publishing(scene) as publisher:
        begun = time.monotonic()
        second = other.publisher("/r1/cmd_vel", TWIST)

        def refused() -> str:
            return scene.moves(begun) and scene.shows("r1: cmd_vel", "/planner/nav=r1 is driven by /teleop")

        with pushed(publisher, 0.125, lambda: scene.moves(begun)):
            second.twist(-0.5)  # from now on it owes a zero, also where the first one is held up
        with repeated(lambda: second.twist(-0.5)), pushed(publisher, 0.125, refused):
            pass
        assert all(speed > 0 for speed in scene.moves(begun))


def test_a_publisher_that_is_gone_stops_the_robot_although_it_was_just_heard(scene: Scene) -> None:
    begun = time.monotonic()
    with publishing(scene) as publisher, pushed(publisher, 0.25, lambda: scene.moves(begun), 0.2):
        publisher.hide()
        until(scene.rests, what="rest")
        scene.told("r1: cmd_vel", "nobody drives")


def test_a_called_stop_stops_and_a_pushed_stick_does_not_move_the_robot_anew(scene: Scene) -> None:
    with publishing(scene) as publisher:
        begun = time.monotonic()
        with pushed(publisher, 0.25, lambda: scene.moves(begun)):
            response, _ = scene.ros.call("/r1/stop", TRIGGER, scene.ros.request(TRIGGER, none=0))
            assert (response.success, response.message) == (True, "")
            stopped = time.monotonic()
            scene.told("r1: cmd_vel", "the robot was stopped: send a zero")
            assert scene.rests()
            assert not [frame for frame in scene.robot.frames if frame.moves and frame.at > stopped + 0.2]
        with repeated(publisher.twist):
            scene.told("r1: cmd_vel", "/teleop=may drive")
        with pushed(publisher, 0.25, lambda: scene.moves(stopped)):
            pass


def test_a_latched_robot_is_driven_by_no_publisher_before_it_is_unlatched(scene: Scene) -> None:
    with publishing(scene) as publisher:
        begun = time.monotonic()
        with pushed(publisher, 0.25, lambda: scene.moves(begun)):
            assert scene.ros.call("/r1/latch", TRIGGER, scene.ros.request(TRIGGER, none=0))[0].success
            latched = time.monotonic()
            scene.told("r1: control", "latched by ")
        with repeated(publisher.twist):
            scene.told("r1: cmd_vel", "/teleop=may drive")
        with repeated(lambda: publisher.twist(0.25)):
            scene.told("r1: cmd_vel", "latched by ")
        assert scene.rests()
        assert not [frame for frame in scene.robot.frames if frame.moves and frame.at > latched + 0.2]
        assert scene.ros.call("/r1/unlatch", TRIGGER, scene.ros.request(TRIGGER, none=0))[0].success
        with repeated(publisher.twist):
            scene.told("r1: cmd_vel", "/teleop=may drive")
        with pushed(publisher, 0.25, lambda: scene.moves(latched)):
            pass


def test_a_call_switches_and_a_malformed_one_has_an_error(scene: Scene) -> None:
    response, _ = scene.ros.call("/r1/set_lidar", SET_BOOL, scene.ros.request(SET_BOOL, data=True))
    assert response.success, response.message
    response, _ = scene.ros.call("/r1/set_light", SET_BOOL, scene.ros.request(SET_BOOL, data=True))
    assert (response.success, response.message.partition(";")[0]) == (False, "r1 does not accept light")
    key, _ = scene.ros.names("/r1/set_light", SET_BOOL)
    for payload, attachment in ((b"\x00\x01\x00\x00\x01", None), (b"\xff" * 300, bytes(33)), (b"", b"\x10" * 33)):
        replies = scene.ros.session.get(key, payload=payload, attachment=attachment, timeout=10.0)
        errors = [reply.err.payload.to_bytes() for reply in replies if reply.err is not None]
        assert errors, payload
        assert b"malformed" in errors[0]


def test_a_request_without_fields_may_be_empty_as_dora_rs_writes_it(scene: Scene) -> None:
    response, _ = scene.ros.call("/r1/stop", TRIGGER, b"\x00\x01\x00\x00")
    assert (response.success, response.message) == (True, "")


def test_garbage_wrong_types_and_strangers_are_counted_and_move_nothing(scene: Scene) -> None:
    begun = time.monotonic()
    stranger = Ros(scene.ros_at, "stranger")
    with contextlib.closing(stranger), publishing(scene) as publisher:
        wrong = stranger.publisher("/r1/cmd_vel", "std_msgs/msg/String")
        twist = struct.pack("<6d", 0.5, 0, 0, 0, 0, 0)
        good = b"\x00\x01\x00\x00" + twist
        key = publisher.key
        attachments = [
            None,
            b"",
            bytes(32),
            bytes(33),
            bytes(64),
            b"\xff" * 33,
            b"\x01" + bytes(15) + b"\x10" + b"x" * 16,
        ]
        for attachment in attachments:
            stranger.session.put(key, good, attachment=attachment)
        for payload in (b"", b"\x00", good[:-1], b"\x09" + good, b"\xff" * 60, b"\xff" * 5000):
            publisher.put_payload(payload)
        nan = b"\x00\x01\x00\x00" + struct.pack("<6d", float("nan"), 0, 0, 0, 0, 0)
        publisher.put_payload(nan)
        wrong.put_payload(good)
        told = scene.told("r1: cmd_vel", "/stranger publishes std_msgs/msg/String")
        told = scene.told("r1: cmd_vel", "malformed=")
        told = scene.told("r1: cmd_vel", "strangers=")
        assert told
        for number in range(3000):
            stranger.session.put(key, good, attachment=number.to_bytes(16, "little") + b"\x10" + bytes(16))
        for parts in (
            "0/0/NN/%/%/x",
            "0/7/MP/%/%/x/%r1%cmd_vel/y/z/::",
            "0/8/MP/%/%/x/%r1%cmd_vel/a::msg::dds_::B_/c/::,9:,:,:,,",
        ):
            stranger.declare(f"{stranger.session.zid()}/{parts}")
        with pushed(publisher, 0.125, lambda: scene.moves(begun)):
            pass
        assert all(speed == pytest.approx(0.25) for speed in scene.moves(begun))


def test_both_routers_at_one_address_is_an_error_that_says_so(scene: Scene, tmp_path: Path) -> None:
    process = start("ros2", "--ros", scene.fleet_at, "--connect", scene.fleet_at)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "the same router as the fleet's" in output
    assert json.dumps(output).count("Traceback") == 0


def test_no_router_of_ros_is_an_error_that_says_how_to_start_one(scene: Scene) -> None:
    process = start("ros2", "--ros", f"tcp/127.0.0.1:{free_port()}", "--connect", scene.fleet_at)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "rmw_zenohd" in output


def test_a_restart_of_ros_s_router_stops_the_robot_and_whoever_pushes_on_owes(scene: Scene) -> None:
    with publishing(scene) as publisher:
        begun = time.monotonic()
        with pushed(publisher, 0.125, lambda: scene.moves(begun)):
            scene.ros_router.close()
            until(scene.rests, what="rest")
            stopped = time.monotonic()
            scene.ros_router = zenoh.open(configuration("router", scene.ros_at))
            scene.told("r1: cmd_vel", "/teleop=it was cut off, and is back: send a zero")
            assert scene.moves(stopped + 0.2) == []
        with repeated(publisher.twist):
            scene.told("r1: cmd_vel", "/teleop=may drive")
        with pushed(publisher, 0.125, lambda: scene.moves(stopped)):
            pass
    scene.ros_router.close()
