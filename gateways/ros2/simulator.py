"""A simulated ROS 2 robot: two wheels, a lidar, an IMU, a battery and a map it makes, and ROS's router beside it.

Its node does on Zenoh what nodes with rmw_zenoh do. Deterministic with a seed. Like ROS's own controllers it stops
when no command came for :data:`TIMEOUT_S`.
"""

from __future__ import annotations

import asyncio
import math
import random
import socket
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec
import numpy as np

from gateways.ros2.messages import TWIST, TWIST_STAMPED, LinkEvent
from zbridge.protocol import (
    SAMPLE_BYTES,
    Address,
    ConfigError,
    KeyedSample,
    Limits,
    ProtocolError,
    Role,
    SampleKind,
    Session,
    Simulation,
    State,
    Truth,
    read_sample,
    sample_end,
    subscription,
    write_sample,
)
from zbridge.ros2.rmw_zenoh import KEEP_LAST_10, LATCHED, SENSOR_DATA, Attachment, Endpoint, Kind, Node, read_attachment
from zbridge.ros2.types import DISTROS, Types, types_of
from zbridge.simulation.simulator import STEP_S, live
from zbridge.simulation.world import Body, Grid, cast
from zbridge.transport import Conversation, ConversationHooks
from zbridge.transport.zenoh_link import serve

TIMEOUT_S = 0.5
"""Seconds after which a command counts no more (``cmd_vel_timeout`` of ros2_controllers)."""
FASTEST_M_S, FASTEST_RAD_S = 1.0, 2.0
POINTS, RANGE_M = 360, 8.0
CELL_M, CELLS = 0.1, 120
FULL_V, EMPTY_V, EMPTY_S = 12.6, 10.5, 7200.0
_SCAN_EVERY, _ODOM_EVERY, _IMU_EVERY, _SLOW_EVERY = 5, 2, 2, 50
"""Steps between two messages of a topic: 10, 25, 25 and 1 a second."""
_BEARINGS = -math.pi + np.arange(POINTS) * 2 * math.pi / POINTS
_NS_PER_S = 1_000_000_000
_TOPICS = {
    "scan": ("sensor_msgs/msg/LaserScan", SENSOR_DATA),
    "odom": ("nav_msgs/msg/Odometry", KEEP_LAST_10),
    "imu": ("sensor_msgs/msg/Imu", SENSOR_DATA),
    "battery_state": ("sensor_msgs/msg/BatteryState", SENSOR_DATA),
    "map": ("nav_msgs/msg/OccupancyGrid", LATCHED),
}


class NodeRole(Session[Any]):
    """We play the robot's node. Gives the twists that others write to its topic of commands."""

    role = Role.ROBOT
    frame_end = staticmethod(sample_end)
    handled = frozenset({LinkEvent})

    def __init__(self, types: Types, command_type: str, *, domain: int = 0, namespace: str = "/") -> None:
        super().__init__(Limits(frame_bytes=SAMPLE_BYTES, handshake_s=5.0))
        self._types, self._domain, self._namespace = types, domain, namespace
        self._command_type = command_type
        self._publishers: dict[str, Endpoint] = {}
        self._numbers: dict[str, int] = {}

    def encode(self, message: KeyedSample) -> bytes:
        return write_sample(message)

    def decode(self, frame: bytes) -> Any:
        sample = read_sample(frame)
        if sample.kind is not SampleKind.SAMPLE:
            return LinkEvent(sample)
        read_attachment(sample.attachment)
        command = self._types.decode(self._command_type, sample.payload)
        return command.twist if self._command_type == TWIST_STAMPED else command

    def accept(self, message: Any, now: float) -> bool:
        if isinstance(message, LinkEvent) and message.sample.kind is SampleKind.OPENED and not self._publishers:
            self._begin(message.sample.payload.decode())
            self.establish(self._types.distro, ())
        return False

    def _begin(self, zid: str) -> None:
        node = Node(self._domain, zid, 0, self._namespace, "robot")
        prefix, types = self._namespace.rstrip("/"), self._types
        subscriber = Endpoint(
            node, 1, Kind.SUBSCRIBER, f"{prefix}/cmd_vel", self._command_type, types.hash(self._command_type)
        )
        for number, (name, (type_name, qos)) in enumerate(_TOPICS.items(), 2):
            self._publishers[name] = Endpoint(
                node, number, Kind.PUBLISHER, f"{prefix}/{name}", type_name, types.hash(type_name), qos
            )
        self.send_first(subscription(subscriber.key))
        endpoints = (subscriber, *self._publishers.values())
        for token in (node.token(), *(endpoint.token() for endpoint in endpoints)):
            self.send_first(KeyedSample(SampleKind.ANNOUNCE, token))

    def publish(self, name: str, message: Any) -> None:
        publisher = self._publishers.get(name)
        if publisher is None:
            raise ProtocolError(f"{name}: not announced yet")
        number = self._numbers[name] = self._numbers.get(name, 0) + 1
        attachment = Attachment(number, time.time_ns(), publisher.gid()).encode()
        kind = SampleKind.KEEP if publisher.qos == LATCHED else SampleKind.PUT
        self.send(KeyedSample(kind, publisher.key, self._types.encode(message), attachment))


class RosMachine:
    """The robot itself: what commands make it do, and what it measures. Knows no Zenoh."""

    def __init__(self, seed: int, types: Types) -> None:
        self.body = Body.somewhere(random.Random(seed))
        self.grid = Grid(CELLS, CELL_M)
        self.forward = self.turn = 0.0
        self._types = types
        self._lived_s = self._commanded_s = 0.0

    def __repr__(self) -> str:
        return f"<RosMachine {self.body} {self.forward:+.2f} m/s {self.turn:+.2f} rad/s>"

    def truth(self) -> Truth:
        body = self.body
        return Truth(body.x, body.y, body.heading, neutral=not (self.forward or self.turn))

    def take(self, twist: Any) -> None:
        forward, turn = float(twist.linear.x), float(twist.angular.z)
        if math.isfinite(forward) and math.isfinite(turn):
            self.forward = max(-FASTEST_M_S, min(FASTEST_M_S, forward))
            self.turn = max(-FASTEST_RAD_S, min(FASTEST_RAD_S, turn))
            self._commanded_s = self._lived_s

    def step(self, dt: float) -> None:
        self._lived_s += dt
        if self._lived_s - self._commanded_s > TIMEOUT_S:
            self.forward = self.turn = 0.0
        self.body.step(self.forward, 0.0, self.turn, dt)

    def scan(self, header: Any) -> Any:
        """Measure all around; what is too far is infinite."""
        body = self.body
        ranges = cast(body.x, body.y, body.heading + _BEARINGS, RANGE_M)
        self.grid.see(body.x, body.y, body.heading + _BEARINGS, ranges, RANGE_M)
        ranges[ranges >= RANGE_M] = np.inf
        return self._types.message(
            "sensor_msgs/msg/LaserScan",
            header=header,
            angle_min=-math.pi,
            angle_max=float(_BEARINGS[-1]),
            angle_increment=2 * math.pi / POINTS,
            scan_time=_SCAN_EVERY * STEP_S,
            range_min=0.05,
            range_max=RANGE_M,
            ranges=ranges.astype(np.float32),
        )

    def odometry(self, header: Any) -> Any:
        position = {"x": self.body.x, "y": self.body.y}
        return self._types.message(
            "nav_msgs/msg/Odometry",
            header=header,
            child_frame_id="base_link",
            pose={"pose": {"position": position, "orientation": self._heading()}},
            twist={"twist": {"linear": {"x": self.forward}, "angular": {"z": self.turn}}},
        )

    def imu(self, header: Any) -> Any:
        return self._types.message(
            "sensor_msgs/msg/Imu",
            header=header,
            orientation=self._heading(),
            angular_velocity={"z": self.turn},
            linear_acceleration={"z": 9.80665},
        )

    def battery(self, header: Any) -> Any:
        level = max(0.0, 1.0 - self._lived_s / EMPTY_S)
        voltage = EMPTY_V + level * (FULL_V - EMPTY_V)
        return self._types.message(
            "sensor_msgs/msg/BatteryState", header=header, voltage=voltage, percentage=level, present=True
        )

    def map(self, header: Any) -> Any:
        """Return the map of what was seen so far."""
        percents = np.array([-1, 0, 100], np.int8)[self.grid.cells.T].reshape(-1)
        corner = {"x": -CELLS * CELL_M / 2, "y": -CELLS * CELL_M / 2}
        origin = {"position": corner, "orientation": {"w": 1.0}}
        info = {"resolution": CELL_M, "width": CELLS, "height": CELLS, "origin": origin}
        return self._types.message("nav_msgs/msg/OccupancyGrid", header=header, info=info, data=percents)

    def _heading(self) -> dict[str, float]:
        half = self.body.heading / 2
        return {"z": math.sin(half), "w": math.cos(half)}


_SENT = {
    "scan": (RosMachine.scan, "laser", _SCAN_EVERY),
    "odom": (RosMachine.odometry, "odom", _ODOM_EVERY),
    "imu": (RosMachine.imu, "base_link", _IMU_EVERY),
    "battery_state": (RosMachine.battery, "base_link", _SLOW_EVERY),
    "map": (RosMachine.map, "map", _SLOW_EVERY),
}
"""For each topic: what is measured, in which frame, and after how many steps."""


async def simulate(simulation: Simulation) -> None:
    """Run a simulated robot and its router until cancelled."""
    if simulation.udp or simulation.fragile:
        raise ConfigError("a ROS 2 robot has no datagrams, and no fragile twin")
    distro, dialect = simulation.version or "jazzy", simulation.dialect or "twist"
    if distro not in DISTROS or dialect not in _DIALECTS:
        raise ConfigError(f"{distro}, {dialect}: expected one of {', '.join(DISTROS)}, and of {', '.join(_DIALECTS)}")
    if len(simulation.addresses) != 1:
        raise ConfigError("a ROS 2 robot has one router")
    address = _with_port(simulation.addresses[0])
    types = types_of(distro)
    machine, session = RosMachine(simulation.seed, types), NodeRole(types, _DIALECTS[dialect])

    def deliver(twists: list[Any]) -> None:
        for twist in twists:
            machine.take(twist)

    conversation = Conversation(session, asyncio.get_running_loop(), ConversationHooks(deliver=deliver))
    machine.body.place(simulation.place)
    async with serve(address, conversation):
        simulation.ready((address,))
        try:
            await live(partial(_step, machine, session, conversation, simulation.report))
        finally:
            conversation.close("simulator ended")


def _with_port(address: Address) -> Address:
    """Find a free port where none is set: Zenoh does not report the one it binds."""
    if address.port:
        return address
    with socket.create_server((address.host, 0)) as free:
        return Address(address.host, int(free.getsockname()[1]))


def _step(
    machine: RosMachine, session: NodeRole, conversation: Conversation, report: Callable[[Truth], None], steps: int
) -> None:
    machine.step(STEP_S)
    report(msgspec.structs.replace(machine.truth(), lived_s=steps * STEP_S))
    if session.state is not State.ESTABLISHED:
        return
    seconds, nanoseconds = divmod(time.time_ns(), _NS_PER_S)
    for name, (measure, frame, every) in _SENT.items():
        if steps % every == 0:
            header = {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}
            session.publish(name, measure(machine, header))
    conversation.pump()


_DIALECTS = {"twist": TWIST, "stamped": TWIST_STAMPED}
