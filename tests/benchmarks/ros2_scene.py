"""What ``tests.benchmarks.ros2`` measures: routers, robots behind their gateways, the view, and a bare relay.

``python -m tests.benchmarks.ros2_scene relay|router ...`` is one of these processes. The relay subscribes, copies and
puts: it knows no type, no lease and changes no byte.
"""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zenoh

from tests.benchmarks import alf_wire
from tests.e2e.conftest import Gateway, configuration, device, end, start
from tests.e2e.rigs.processes import Part
from tests.ports import free_port
from tests.views.ros2.judge import Ros

SCAN, TWIST = "sensor_msgs/msg/LaserScan", "geometry_msgs/msg/Twist"
ROBOTS, POINTS = 30, alf_wire.POINTS
PLACE, LEAST_MM, NUMBERS = 100, 1000, 4000
"""A scan bears its number in this range, which is so many millimetres and the number, of which there are so many."""
VIEWED, RELAYED = "v", "b"
"""What the names of robots begin with that ROS sees through the view and through the bare relay."""


_GEOMETRY = {
    "angle_min": -2.3,
    "angle_max": 2.3,
    "angle_increment": 0.006,
    "time_increment_s": 0.0001,
    "range_min": 0.02,
    "range_max": 5.6,
}


class Vehicle:
    """An ALF vehicle that sends scans when it is told; what it is sent is read and thrown away."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self._link: socket.socket | None = None
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        link, _ = self._server.accept()
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.sendall(alf_wire.geometry("text"))
        self._link = link
        with contextlib.suppress(OSError):
            while link.recv(4096):
                pass

    def send(self, data: bytes) -> None:
        """Send bytes."""
        assert self._link is not None
        self._link.sendall(data)

    def close(self) -> None:
        """End it."""
        for each in (self._server, self._link):
            if each is not None:
                each.close()


def vehicles_scan(number: int) -> bytes:
    """Write a vehicle's scan with a number."""
    points = list(alf_wire.SWEEP)
    points[PLACE] = LEAST_MM + number % NUMBERS
    written = b"|".join(b"%d" % point for point in points)
    return b"1|%d|%d|%b|%d|%d;" % (number, number, written, alf_wire.FIRST, alf_wire.LAST)


def fleets_scan(number: int) -> bytes:
    """Write what a gateway publishes of a scan with a number."""
    ranges = np.full(POINTS, 2.0, np.float32)
    ranges[PLACE] = (LEAST_MM + number % NUMBERS) / 1000
    fields = {"angle_min": -2.3, "angle_increment": 0.006, "range_min": 0.02, "range_max": 5.6}
    written: bytes = msgpack.packb({**fields, "ranges": ranges.tobytes(), "stamp_ns": time.time_ns()})
    return written


def number_in_cdr(payload: bytes) -> int:
    """Read the number of a LaserScan: its ranges are last, but for the number of intensities, 0."""
    return _number(payload, len(payload) - 4 - 4 * POINTS)


def number_in_msgpack(payload: bytes) -> int:
    """Read the number of a fleet's scan."""
    return _number(msgpack.unpackb(payload)["ranges"], 0)


def _number(data: bytes, at: int) -> int:
    return round(struct.unpack_from("<f", data, at + 4 * PLACE)[0] * 1000) - LEAST_MM


class Scene:
    """Routers, the view, the relay; and this process on both sides. Robots that only publish are this process too."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path) -> None:
        self.stack, self._folder = stack, folder
        self.fleet_at, self.ros_at = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
        self._part("router", self.fleet_at, self.ros_at)
        shown = [word for number in range(ROBOTS + 1) for word in ("--robot", f"{VIEWED}{number}")]
        view = ("ros2", "--drive", "--ros", self.ros_at, "--connect", self.fleet_at, *shown)
        log = stack.enter_context((folder / "view.log").open("w"))
        process = start(*view, stdout=log)
        stack.callback(end, process)
        self.view = process.pid
        self.fleet = stack.enter_context(opened("client", self.fleet_at))
        self.ros = Ros(self.ros_at, "bench")
        stack.callback(self.ros.close)
        relayed = {f"{RELAYED}{number}": self.key(f"{RELAYED}{number}") for number in range(ROBOTS + 1)}
        self.relay = self._part("relay", self.fleet_at, self.ros_at, json.dumps(relayed), self.twists(f"{RELAYED}0"))
        geometry = msgpack.packb({**_GEOMETRY, "points": POINTS})
        self.scanners = self.fleet.declare_queryable(
            "fleet/*/scanner", lambda query: query.reply(str(query.key_expr), geometry)
        )
        self.tokens = [self._token(f"{VIEWED}{number}") for number in range(1, ROBOTS + 1)]
        wait(lambda: self.shown() >= ROBOTS)

    def _token(self, robot: str) -> Any:
        return self.fleet.liveliness().declare_token(f"fleet/{robot}/@alive/gateway")

    def key(self, robot: str, kind: str = SCAN, name: str = "scan") -> str:
        """Give the key of a topic of a robot on ROS's side."""
        return self.ros.names(f"/{robot}/{name}", kind)[0]

    def twists(self, robot: str) -> str:
        """Give the key of a robot's cmd_vel."""
        return self.key(robot, TWIST, "cmd_vel")

    def shown(self) -> int:
        """Count the robots that ROS sees."""
        return sum(parts[5] == "NN" and parts[8] == "zbridge" for parts in self.ros.graph())

    @contextlib.contextmanager
    def robots(self, make: Callable[[], Any], protocol: str, options: str = "") -> Any:
        """Run two robots alike, each behind its gateway: give the one that the view shows, and the relay's."""
        with contextlib.ExitStack() as stack:
            made = []
            for name in (f"{VIEWED}0", f"{RELAYED}0"):
                robot = make()
                stack.callback(robot.close)
                file = self._folder / f"{name}-{protocol}.toml"
                gateway = Gateway(stack, file, self.fleet_at, device(robot.port, protocol, options), robot=name)
                wait(lambda gateway=gateway: "established" in gateway.log)
                made.append(robot)
            wait(lambda: self.shown() > ROBOTS)
            yield made

    def _part(self, *arguments: str) -> int:
        part = Part(self.stack, sys.executable, "-m", __name__, *arguments)
        assert part.line() == "ready"
        return part.pid


def wait(condition: Callable[[], Any], timeout_s: float = 60.0) -> None:
    """Wait until a condition is true."""
    ends_at = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > ends_at:
            raise TimeoutError
        time.sleep(0.05)


def opened(mode: str, endpoint: str) -> zenoh.Session:
    """Open a session; without shared memory, as gateways, the view and ROS's middleware are by default."""
    config = configuration(mode, endpoint)
    config.insert_json5("transport/shared_memory/enabled", "false")
    return zenoh.open(config)


def relay(fleet_at: str, ros_at: str, scans: str, twists: str) -> None:
    """Copy the scans of robots to ROS's side, and what comes as a Twist to the drives of the first one."""
    fleet, ros = opened("client", fleet_at), opened("client", ros_at)
    options: Any = {"congestion_control": zenoh.CongestionControl.DROP, "express": True}
    beside = bytes(16) + b"\x10" + bytes(16)
    kept: list[Any] = []
    for robot, key in json.loads(scans).items():
        to_ros = ros.declare_publisher(key, **options)
        copy = lambda s, put=to_ros.put: put(s.payload.to_bytes(), attachment=beside)  # noqa: E731
        kept += [to_ros, fleet.declare_subscriber(f"fleet/{robot}/scan", copy)]
    to_fleet = fleet.declare_publisher(f"fleet/{RELAYED}0/@cmd/drive", **options)
    copy = lambda s: to_fleet.put(s.payload.to_bytes(), attachment=s.attachment.to_bytes())  # noqa: E731
    kept.append(ros.declare_subscriber(twists, copy))
    print("ready", flush=True)
    sys.stdin.readline()


def router(*endpoints: str) -> None:
    """Be a router at each endpoint."""
    routers = [opened("router", endpoint) for endpoint in endpoints]
    print("ready", flush=True)
    sys.stdin.readline()
    del routers


if __name__ == "__main__":
    {"relay": relay, "router": router}[sys.argv[1]](*sys.argv[2:])
