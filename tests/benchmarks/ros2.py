"""What ``zbridge ros2`` costs, against a bare Python relay in the same run: ``python -m tests.benchmarks.ros2``.

The relay subscribes, copies and puts; it knows no lease and changes no byte. Both ways are measured between the fleet's
bus and ROS's side, where the view or the relay is all that lies between: the gateway's own share, the same for both,
does not flatter the ratio. Scans and Twists go by turns through the one and the other.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any

import msgpack
import numpy as np
import zenoh

from tests.e2e.conftest import configuration, end, start
from tests.e2e.processes import Part
from tests.e2e.robots import Robot
from tests.ports import free_port
from tests.views.ros2.judge import Ros

SCAN, TWIST, TF = "sensor_msgs/msg/LaserScan", "geometry_msgs/msg/Twist", "tf2_msgs/msg/TFMessage"
ROBOTS, RATE_HZ, POINTS = 30, 10.0, 769
_TICK_S = 1 / os.sysconf("SC_CLK_TCK")


def relay(fleet_at: str, ros_at: str, ros_scan: str, ros_twist: str) -> None:
    """Copy scans to ROS's side, and Twists to the fleet's."""
    fleet, ros = zenoh.open(configuration("client", fleet_at)), zenoh.open(configuration("client", ros_at))
    drop = zenoh.CongestionControl.DROP
    to_ros = ros.declare_publisher(ros_scan, congestion_control=drop, express=True)
    to_fleet = fleet.declare_publisher("fleet/relay/@cmd/drive", congestion_control=drop, express=True)
    beside = bytes(16) + b"\x10" + bytes(16)
    kept = [
        fleet.declare_subscriber("fleet/relay/scan", lambda s: to_ros.put(s.payload.to_bytes(), attachment=beside)),
        ros.declare_subscriber(ros_twist, lambda s: to_fleet.put(s.payload.to_bytes(), attachment=beside)),
    ]
    print("ready", flush=True)
    sys.stdin.readline()
    del kept


def router(*endpoints: str) -> None:
    """Be a router at each endpoint."""
    routers = [zenoh.open(configuration("router", endpoint)) for endpoint in endpoints]
    print("ready", flush=True)
    sys.stdin.readline()
    del routers


class Scene:
    """Routers, a robot behind a gateway, the view, the relay; and this process on both sides."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path) -> None:
        self.fleet_at, self.ros_at = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
        self._part(stack, "router", self.fleet_at, self.ros_at)
        self.robot = robot = Robot()
        stack.callback(robot.close)
        file = folder / "r0.toml"
        file.write_text(
            f'[robot]\nname = "r0"\n[device]\nprotocol = "tcpudp"\nconnect = ["tcp://127.0.0.1:{robot.port}"]\n'
            f'[bus]\nconnect = ["{self.fleet_at}"]\nmulticast = false\n'
        )
        self._zbridge(stack, folder, "run", str(file))
        view = ("ros2", "--drive", "--ros", self.ros_at, "--connect", self.fleet_at)
        self.view = self._zbridge(stack, folder, *view).pid
        self.fleet = stack.enter_context(zenoh.open(configuration("client", self.fleet_at)))
        self.ros = Ros(self.ros_at, "bench")
        stack.callback(self.ros.close)
        names = (self.ros._names("/relay/scan", SCAN)[0], self.ros._names("/relay/cmd_vel", TWIST)[0])
        self.relay = self._part(stack, "relay", self.fleet_at, self.ros_at, *names)
        self.tokens = [
            self.fleet.liveliness().declare_token(f"fleet/r{number}/@alive/gateway") for number in range(1, ROBOTS + 1)
        ]
        wait(lambda: sum(parts[5] == "NN" and parts[8] == "zbridge" for parts in self.ros.graph()) > ROBOTS)

    def _part(self, stack: contextlib.ExitStack, *arguments: str) -> int:
        part = Part(stack, sys.executable, "-m", "tests.benchmarks.ros2", *arguments)
        assert part.line() == "ready"
        return part.pid

    def _zbridge(self, stack: contextlib.ExitStack, folder: Path, *arguments: str) -> Any:
        log = stack.enter_context((folder / f"{arguments[0]}.log").open("w"))
        process = start(*arguments, stdout=log)
        stack.callback(end, process)
        return process


def cpu_s(pid: int) -> float:
    """Return the processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * _TICK_S


def scan(number: int) -> bytes:
    """Make a scan whose first range is a number."""
    ranges = np.full(POINTS, 2.0, np.float32)
    ranges[0] = number
    fields = {"angle_min": -2.3, "angle_increment": 0.006, "range_min": 0.02, "range_max": 5.6}
    return msgpack.packb({**fields, "ranges": ranges.tobytes(), "stamp_ns": time.time_ns()})


def wait(condition: Callable[[], Any], timeout_s: float = 60.0) -> None:
    """Wait until a condition is true."""
    ends_at = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > ends_at:
            raise TimeoutError
        time.sleep(0.05)


class Clock:
    """Times from a put to its arrival, by number."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self._sent: tuple[int, int] = (-1, 0)
        self._came = threading.Event()

    def go(self, number: int, put: Callable[[], object]) -> None:
        """Put, and wait for the arrival, for a second at most."""
        self._came.clear()
        self._sent = (number, time.perf_counter_ns())
        put()
        self._came.wait(1.0)

    def came(self, number: int) -> None:
        """Note an arrival."""
        sent, at = self._sent
        if number == sent:
            self.times.append((time.perf_counter_ns() - at) / 1e3)
            self._came.set()


def scans(scene: Scene, count: int) -> tuple[Clock, Clock]:
    """Measure scans, by turns through the view and through the relay."""
    view, bare = Clock(), Clock()
    at = scan(7).index(struct.pack("<f", 7.0))
    cdr_at = 0

    def by_view(sample: zenoh.Sample) -> None:
        nonlocal cdr_at
        payload = sample.payload.to_bytes()
        cdr_at = cdr_at or len(payload) - POINTS * 4 - 4
        view.came(int(struct.unpack_from("<f", payload, cdr_at)[0]))

    def by_relay(sample: zenoh.Sample) -> None:
        bare.came(int(struct.unpack_from("<f", sample.payload.to_bytes(), at)[0]))

    kept = [
        scene.ros.session.declare_subscriber(scene.ros._names("/r0/scan", SCAN)[0], by_view),
        scene.ros.session.declare_subscriber(scene.ros._names("/relay/scan", SCAN)[0], by_relay),
    ]
    ways = [
        (clock, scene.fleet.declare_publisher(f"fleet/{robot}/scan", express=True))
        for robot, clock in (("r0", view), ("relay", bare))
    ]
    time.sleep(1.0)
    for number in range(1, count + 1):
        for clock, publisher in ways:
            payload = scan(number)
            clock.go(number, lambda publisher=publisher, payload=payload: publisher.put(payload))
            time.sleep(0.005)
    for subscriber in kept:
        subscriber.undeclare()
    return view, bare


def twists(scene: Scene, count: int) -> tuple[Clock, Clock]:
    """Measure Twists, by turns through the view, with a lease and proofs, and through the relay."""
    view, bare = Clock(), Clock()

    def by_view(sample: zenoh.Sample) -> None:
        view.came(round(msgpack.unpackb(sample.payload.to_bytes())["forward"] * 1e6))

    def by_relay(sample: zenoh.Sample) -> None:
        bare.came(round(struct.unpack_from("<d", sample.payload.to_bytes(), 4)[0] * 1e6))

    kept = [
        scene.fleet.declare_subscriber("fleet/r0/@cmd/drive", by_view),
        scene.fleet.declare_subscriber("fleet/relay/@cmd/drive", by_relay),
    ]
    ways = [(clock, scene.ros.publisher(f"/{name}/cmd_vel", TWIST)) for name, clock in (("r0", view), ("relay", bare))]
    ends_at = time.monotonic() + 3.0
    while time.monotonic() < ends_at:  # the view gets to know the publisher, and the lease is granted
        ways[0][1].twist(0.000_001 if time.monotonic() > ends_at - 1.0 else 0.0)
        time.sleep(0.02)
    for number in range(10, count + 10):
        for clock, publisher in ways:
            clock.go(number, lambda publisher=publisher, number=number: publisher.twist(number / 1e6))
            time.sleep(0.005)
    for declared in (*kept, *(publisher for _, publisher in ways)):
        (getattr(declared, "undeclare", None) or declared.close)()
    return view, bare


@contextlib.contextmanager
def published(scene: Scene, robots: list[str], kinds: dict[str, Callable[[], bytes]]) -> Iterator[list[int]]:
    """Let robots publish at RATE_HZ; the list holds how often each has."""
    ended, rounds = threading.Event(), [0]
    ways = [(scene.fleet.declare_publisher(f"fleet/{robot}/{kind}"), kinds[kind]) for robot in robots for kind in kinds]

    def go_on() -> None:
        while not ended.wait(1 / RATE_HZ):
            payloads = {make: make() for make in kinds.values()}
            for publisher, make in ways:
                publisher.put(payloads[make])
            rounds[0] += 1

    thread = threading.Thread(target=go_on, daemon=True)
    thread.start()
    try:
        yield rounds
    finally:
        ended.set()
        thread.join()


def cost(
    scene: Scene, pid: int, robots: list[str], kinds: dict[str, Callable[[], bytes]], keys: list[str], seconds: float
) -> tuple[float, float]:
    """Return a process's share of a core, and its processor time for each round of a robot in microseconds."""
    kept = [scene.ros.session.declare_subscriber(key, lambda sample: None) for key in keys]
    with published(scene, robots, kinds) as rounds:
        time.sleep(2.0)
        before, at, made = cpu_s(pid), time.monotonic(), rounds[0]
        time.sleep(seconds)
        used, passed, made = cpu_s(pid) - before, time.monotonic() - at, rounds[0] - made
    for subscriber in kept:
        subscriber.undeclare()
    return used / passed, used / (made * len(robots)) * 1e6


def costs(scene: Scene, seconds: float) -> None:
    """Print what 30 robots cost."""
    pose = msgpack.packb({"x": 1.0, "y": 2.0, "heading": 0.5})
    motion = msgpack.packb({"speed": 0.5, "gyro": [0.0, 0.0, 0.1], "acceleration": [0.0, 0.0, 9.8]})
    scans_alone = {"scan": lambda: scan(1)}
    everything = {**scans_alone, "pose": lambda: pose, "motion": lambda: motion}
    robots = [f"r{number}" for number in range(1, ROBOTS + 1)]
    watched = {SCAN: "scan", "nav_msgs/msg/Odometry": "odom", "sensor_msgs/msg/Imu": "imu", TF: "tf"}
    keys = {name: [scene.ros._names(f"/{robot}/{name}", kind)[0] for robot in robots] for kind, name in watched.items()}
    share, each = cost(scene, scene.view, robots, scans_alone, keys["scan"], seconds)
    print(f"scans of {ROBOTS} robots at {RATE_HZ:g} Hz: {share:.1%} of a core, {each:.0f} us a scan")
    relayed = scene.ros._names("/relay/scan", SCAN)[0]
    share, each = cost(scene, scene.relay, ["relay"] * ROBOTS, scans_alone, [relayed], seconds)
    print(f"as many through the relay: {share:.1%} of a core, {each:.0f} us a scan")
    all_keys = [key for some in keys.values() for key in some]
    share, _ = cost(scene, scene.view, robots, everything, all_keys, seconds)
    print(f"{ROBOTS} robots at {RATE_HZ:g} Hz, scan, odom, imu and tf watched: {share:.1%} of a core")
    share, _ = cost(scene, scene.view, robots, everything, [], seconds)
    print(f"{ROBOTS} robots at {RATE_HZ:g} Hz, nobody listens: {share:.2%} of a core")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="scans and Twists each way")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement of costs")
    given = parser.parse_args()
    with contextlib.ExitStack() as stack:
        scene = Scene(stack, Path(stack.enter_context(tempfile.TemporaryDirectory())))
        for name, measure in (("scan", scans), ("Twist", twists)):
            view, bare = measure(scene, given.count)
            if not view.times or not bare.times:
                print(f"{name}: {len(view.times)} through the view and {len(bare.times)} through the relay came")
                continue
            mine, other = median(view.times), median(bare.times)
            print(f"{name}: p50 {mine:.0f} us, relay {other:.0f} us, ratio {mine / other:.2f}")
        costs(scene, given.seconds)


if __name__ == "__main__":
    if sys.argv[1:2] == ["router"]:
        router(*sys.argv[2:])
    elif sys.argv[1:2] == ["relay"]:
        relay(*sys.argv[2:])
    else:
        main()
