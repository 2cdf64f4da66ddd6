"""The simulated ROS 2 robot: how it moves, what it measures, and what its node puts on the router."""

from __future__ import annotations

import asyncio
import math
import struct
from typing import Any

import numpy as np
import pytest

from gateways.ros2.messages import TWIST, TWIST_STAMPED
from gateways.ros2.simulator import (
    CELL_M,
    CELLS,
    EMPTY_S,
    EMPTY_V,
    FASTEST_M_S,
    FASTEST_RAD_S,
    FULL_V,
    RANGE_M,
    TIMEOUT_S,
    NodeRole,
    RosMachine,
    simulate,
)
from tests.gateways.rig import drained
from tests.gateways.ros2.scene import TYPES, key
from zbridge.errors import ConfigError, ProtocolError
from zbridge.protocol import KeyedSample, SampleKind, Simulation, read_sample, write_sample
from zbridge.protocol.address import Address
from zbridge.ros2.rmw_zenoh import gid_of

make = TYPES.message
HEADER = make("std_msgs/msg/Header", frame_id="laser")


def machine(x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> RosMachine:
    made = RosMachine(1, TYPES)
    made.body.x, made.body.y, made.body.heading = x, y, heading
    return made


def twist(forward: float, turn: float = 0.0) -> Any:
    linear, angular = (make("geometry_msgs/msg/Vector3", **each) for each in ({"x": forward}, {"z": turn}))
    return make(TWIST, linear=linear, angular=angular)


def live(moved: RosMachine, seconds: float, command: Any = None) -> None:
    """Let it live in steps of 20 ms; a command is repeated at each."""
    for _ in range(round(seconds / 0.02)):
        if command is not None:
            moved.take(command)
        moved.step(0.02)


# How it moves


def test_it_moves_as_it_is_told_in_metres_and_radians_a_second() -> None:
    moved = machine()
    live(moved, 1.0, twist(0.5))
    assert (moved.body.x, moved.body.y) == (pytest.approx(0.5), 0.0)
    live(moved, 1.0, twist(-0.5))
    assert moved.body.x == pytest.approx(0.0)
    live(moved, 1.0, twist(0.0, turn=-1.0))
    assert moved.body.heading == pytest.approx(-1.0)


def test_it_stands_still_when_no_command_came_for_half_a_second() -> None:
    moved = machine()
    moved.take(twist(0.5))
    live(moved, 5.0)
    assert moved.body.x == pytest.approx(0.5 * TIMEOUT_S, rel=0.05)
    assert (moved.forward, moved.turn) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("command", "obeyed"),
    [
        (twist(5.0, turn=5.0), (FASTEST_M_S, FASTEST_RAD_S)),
        (twist(-5.0, turn=-5.0), (-FASTEST_M_S, -FASTEST_RAD_S)),
        (twist(math.nan, turn=1.0), (0.0, 0.0)),
        (twist(0.5, turn=math.inf), (0.0, 0.0)),
    ],
)
def test_it_is_never_faster_than_it_can_be_and_obeys_numbers_only(command: Any, obeyed: tuple[float, float]) -> None:
    moved = machine()
    moved.take(command)
    assert (moved.forward, moved.turn) == obeyed


def test_a_seed_is_a_place_and_another_seed_another() -> None:
    assert repr(RosMachine(3, TYPES)) == repr(RosMachine(3, TYPES)) != repr(RosMachine(4, TYPES))


# What it measures; the walls of the room are 5 m from its middle


def test_a_scan_begins_behind_the_robot_and_turns_left_and_what_is_too_far_is_infinite() -> None:
    scan = machine(x=-3.0, heading=math.pi / 2).scan(HEADER)
    assert (scan.header.frame_id, scan.range_max, len(scan.ranges)) == ("laser", RANGE_M, 360)
    angles = scan.angle_min + scan.angle_increment * np.arange(360)
    assert scan.angle_max == pytest.approx(angles[-1])
    assert (angles[0], angles[-1] + scan.angle_increment) == (pytest.approx(-math.pi), pytest.approx(math.pi))
    assert scan.ranges[270] == pytest.approx(2.0), "the wall to the left of a robot that looks up"
    far = machine(x=-4.5).scan(HEADER)
    assert math.isinf(far.ranges[180]), "the other wall is 9.5 m ahead"
    assert far.ranges[0] == pytest.approx(0.5)


def test_odometry_and_imu_say_where_it_is_and_how_it_moves() -> None:
    moved = machine(x=1.0, y=-1.0, heading=math.pi / 2)
    moved.take(twist(0.25, turn=0.5))
    told, measured = moved.odometry(HEADER), moved.imu(HEADER)
    place, turned = told.pose.pose.position, told.pose.pose.orientation
    assert (place.x, place.y) == (1.0, -1.0)
    assert (turned.z, turned.w) == (pytest.approx(math.sqrt(0.5)), pytest.approx(math.sqrt(0.5)))
    assert (told.twist.twist.linear.x, told.twist.twist.angular.z) == (0.25, 0.5)
    assert (measured.angular_velocity.z, measured.linear_acceleration.z) == (0.5, pytest.approx(9.81, abs=0.01))


def test_the_battery_is_empty_after_two_hours_and_never_more_than_that() -> None:
    moved = machine()
    full = moved.battery(HEADER)
    assert (full.percentage, full.voltage, full.present) == (1.0, FULL_V, True)
    moved.step(EMPTY_S / 2)
    half = moved.battery(HEADER)
    assert (half.percentage, half.voltage) == (0.5, pytest.approx((FULL_V + EMPTY_V) / 2))
    moved.step(2 * EMPTY_S)
    assert (moved.battery(HEADER).percentage, moved.battery(HEADER).voltage) == (0.0, EMPTY_V)


def test_the_map_is_what_it_has_seen_row_by_row_from_the_lower_left_corner() -> None:
    moved = machine(x=-3.0, y=-4.0)
    assert set(moved.map(HEADER).data.tolist()) == {-1}
    moved.scan(HEADER)
    told = moved.map(HEADER)
    assert (told.info.width, told.info.height, told.info.resolution) == (CELLS, CELLS, pytest.approx(CELL_M))
    assert (told.info.origin.position.x, told.info.origin.orientation.w) == (-CELLS * CELL_M / 2, 1.0)
    rows = told.data.reshape(CELLS, CELLS)

    def cell(x: float, y: float) -> int:
        return int(rows[int((y + 6.0) / CELL_M), int((x + 6.0) / CELL_M)])

    assert (cell(-3.0, -4.5), cell(-5.9, -5.9)) == (0, -1)
    assert 100 in (cell(-3.0, -4.95), cell(-3.0, -5.05)), "the wall is between them"


# Its node


class Node:
    """The session of the robot's node, and what it writes."""

    def __init__(self, kind: str = TWIST, **where: Any) -> None:
        self.session = NodeRole(TYPES, kind, **where)
        self.session.open(0.0)
        self.feed(KeyedSample(SampleKind.OPENED, payload=b"cafe"))
        self.written = self.write()

    def feed(self, sample: KeyedSample) -> list[Any]:
        return list(self.session.receive(write_sample(sample), 0.0))

    def write(self) -> list[KeyedSample]:
        return [read_sample(frame) for frame in drained(self.session)]


def test_the_node_shows_itself_and_each_of_its_topics_once() -> None:
    node = Node(domain=7, namespace="/r1")
    subscribed, *announced = node.written
    assert subscribed.kind is SampleKind.SUBSCRIBE
    assert subscribed.key.startswith("7/r1/cmd_vel/geometry_msgs::msg::dds_::Twist_/RIHS01_9c45bf16")
    assert {each.kind for each in announced} == {SampleKind.ANNOUNCE}
    tokens = [each.key.split("/") for each in announced]
    assert {token[1] for token in tokens} == {"7"}
    assert [(token[5], token[9] if len(token) > 9 else "") for token in tokens] == [
        ("NN", ""),
        ("MS", "%r1%cmd_vel"),
        *(("MP", f"%r1%{name}") for name in ("scan", "odom", "imu", "battery_state", "map")),
    ]
    assert len({token[4] for token in tokens}) == len(tokens), "numbers within the session"
    node.feed(KeyedSample(SampleKind.OPENED, payload=b"cafe"))
    assert node.write() == []


def test_messages_have_rising_numbers_and_the_gid_of_their_publisher_and_the_map_is_kept() -> None:
    node = Node()
    for name in ("odom", "odom", "map"):
        kind = {"odom": "nav_msgs/msg/Odometry", "map": "nav_msgs/msg/OccupancyGrid"}[name]
        node.session.publish(name, make(kind))
    sent = node.write()
    assert [each.kind for each in sent] == [SampleKind.PUT, SampleKind.PUT, SampleKind.KEEP]
    assert sent[0].key == key("odom", "nav_msgs/msg/Odometry")
    token = next(each.key for each in node.written if "/MP/" in each.key and "%odom" in each.key)
    attachments = [struct.unpack("<qqB16s", each.attachment or b"") for each in sent]
    assert [number for number, *_ in attachments] == [1, 2, 1]
    assert (attachments[0][2], attachments[0][3]) == (16, gid_of(token))


def test_nothing_is_published_before_the_router_is_there() -> None:
    session = NodeRole(TYPES, TWIST)
    session.open(0.0)
    with pytest.raises(ProtocolError, match="odom: not announced yet"):
        session.publish("odom", make("nav_msgs/msg/Odometry"))


@pytest.mark.parametrize("kind", [TWIST, TWIST_STAMPED])
def test_commands_are_taken_as_their_type_has_them(kind: str) -> None:
    node, command = Node(kind), twist(0.5, turn=-1.0)
    payload = TYPES.encode(command if kind == TWIST else make(kind, twist=command))
    attachment = struct.pack("<qqB", 1, 1, 16) + bytes(16)
    (taken,) = node.feed(KeyedSample(SampleKind.SAMPLE, key("cmd_vel", kind), payload, attachment))
    assert (taken.linear.x, taken.angular.z) == (0.5, -1.0)
    assert node.feed(KeyedSample(SampleKind.SAMPLE, key("cmd_vel", kind), payload, b"")) == []
    assert node.session.traffic.malformed == 1


CANNOT: dict[str, tuple[dict[str, Any], str]] = {
    "datagrams": ({"udp": True}, "no datagrams"),
    "a fragile twin": ({"fragile": True}, "no fragile twin"),
    "a version": ({"version": "foxy"}, "foxy, twist: expected one of humble"),
    "a dialect": ({"dialect": "binary"}, "jazzy, binary: expected one of .*, and of twist, stamped"),
    "two links": ({"addresses": (Address("127.0.0.1", 0),) * 2}, "one router"),
}


@pytest.mark.parametrize("what", CANNOT)
def test_what_a_ros_2_robot_does_not_have_is_told(what: str) -> None:
    fields, told = CANNOT[what]
    with pytest.raises(ConfigError, match=told):
        asyncio.run(simulate(Simulation(**{"addresses": (Address("127.0.0.1", 0),), **fields})))
