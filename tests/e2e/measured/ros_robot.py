"""A ROS 2 robot that is in motion and whose driver, node or router is lost: how soon is it at rest?

    python -m tests.e2e.measured.ros_robot                          # every way 30 times
    python -m tests.e2e.measured.ros_robot --way stop --repetitions 5

The robot is strict: it believes every command, holds it for ever, and complains about whatever is not as rmw_zenoh has
it. Its router is apart from the bus.
"""

from __future__ import annotations

import argparse
import contextlib
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import zenoh

from tests.e2e.conftest import HOST, Bench, configuration, device, until
from tests.e2e.rigs.processes import Finding, report
from tests.gateways.ros2.strict_robot import HASHES, RELIABLE, StrictRobot, config, gid_of
from tests.ports import free_port

LATE_S = 0.5
"""Seconds within which the robot must be at rest after what the way says, on a machine that is not busy."""
DEADMAN_S, SILENT_S = 0.5, 2.0
FORWARD = 0.4
OPTIONS = "speed_full_mps = 1.0\nturn_full_radps = 2.0"
KEY = f"0/cmd_vel/geometry_msgs::msg::dds_::Twist_/{HASHES['Twist']}"


class Other:
    """Another node of ROS that writes the robot's commands ten times a second, until it is closed."""

    def __init__(self, router: str, forward: float) -> None:
        self._session = zenoh.open(config(router))
        qos = f"%cmd_vel/geometry_msgs::msg::dds_::Twist_/{HASHES['Twist']}/{RELIABLE}"
        token = f"@ros2_lv/0/{self._session.zid()}/0/1/MP/%/%/other/{qos}"
        self._token = self._session.liveliness().declare_token(token)
        self.gid, self._forward = gid_of(token), forward
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def _live(self) -> None:
        publisher, number = self._session.declare_publisher(KEY), 0
        twist = bytes((0, 1, 0, 0)) + struct.pack("<6d", self._forward, 0, 0, 0, 0, 0)
        while not self._ends.wait(0.1):
            number += 1
            publisher.put(twist, attachment=struct.pack("<qqB", number, time.time_ns(), 16) + self.gid)

    def close(self) -> None:
        """Leave."""
        self._ends.set()
        self._thread.join()
        self._session.close()  # type: ignore[no-untyped-call]


class Scene:
    """A ROS router, a strict robot, a gateway, and who drives by the bus."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack, *parts: str, **robot: Any) -> None:
        self.port = free_port()
        self.router_at = f"tcp/{HOST}:{self.port}"
        self.router = self._router()
        stack.callback(lambda: self.router.close())  # type: ignore[no-untyped-call]
        self.bench = Bench(folder, stack)
        self.robot = StrictRobot(self.router_at, **robot)
        stack.callback(lambda: self.robot.close())
        self.gateway = self.bench.gateway(device(self.port, "ros2", OPTIONS), *parts)
        self.await_robot()

    def _router(self) -> zenoh.Session:
        """Open the router, which drops what finds its queue full for a second.

        With 1 ms, as ROS's router has, it loses commands that came during a pause of this process: unlike that router
        it shares its threads with the robot and all programs of the test.
        """
        config = configuration("router", self.router_at)
        config.insert_json5("transport/link/tx/queue/congestion_control/drop/wait_before_drop", "1000000")
        return zenoh.open(config)

    def await_robot(self) -> None:
        """Wait until the gateway has the robot and it takes commands."""
        fleet = self.bench.fleet
        until(lambda: fleet.state() == "established" and not fleet.reason(), 30, "established")

    @contextlib.contextmanager
    def router_away(self) -> Iterator[None]:
        """Take the robot's router away, and bring it back."""
        self.router.close()  # type: ignore[no-untyped-call]
        yield
        self.router = self._router()

    def moves(self, forward: float = FORWARD) -> bool:
        """Whether the robot was told last to move forward so fast."""
        return abs(self.robot.velocity[0] - forward) < 1e-6

    @contextlib.contextmanager
    def driven(self, who: str = "test") -> Iterator[threading.Event]:
        """Drive until the block ends or the event is set; the lease is held as long."""
        fleet, ends = self.bench.fleet, threading.Event()
        until(lambda: fleet.last("r1/control").get("state") in ("free", "stopped"), what="the robot is nobody's")
        fleet.hold("r1", who, deadman_s=DEADMAN_S, lease_s=2.0)

        def drive() -> None:
            while not ends.is_set():
                fleet.put("r1/@cmd/drive", forward=FORWARD)
                ends.wait(0.05)

        thread = threading.Thread(target=drive, daemon=True)
        thread.start()
        try:
            until(self.moves, 30, "the robot moves")
            yield ends
        finally:
            ends.set()
            thread.join()
            fleet.close()

    def rest_since(self, at: float, *, quiet_s: float = 0.6) -> float:
        """Wait until the robot has been at rest for a while; give the seconds from ``at`` to its last motion's end."""
        robot = self.robot
        until(lambda: not any(robot.velocity), 30, "the robot is at rest")
        ends = time.monotonic() + quiet_s
        until(lambda: time.monotonic() > ends, what="a while")
        told = list(robot.commands)
        last = max((number for number, one in enumerate(told) if one.moves), default=-1)
        assert last + 1 < len(told), "the robot's last command is motion"
        return max(0.0, told[last + 1].at - at)


def _stop(scene: Scene) -> float:
    with scene.driven():
        at = time.monotonic()
        scene.bench.fleet.put("r1/@cmd/stop")
        return scene.rest_since(at)


def _deadman(scene: Scene) -> float:
    with scene.driven() as ends:
        ends.set()
        return scene.rest_since(time.monotonic()) - DEADMAN_S


def _silent(scene: Scene) -> float:
    """The nodes that measure hang; the one that drives does not."""
    with scene.driven():
        scene.robot.hang(True)
        at = time.monotonic()
        took_s = scene.rest_since(at) - SILENT_S
        scene.robot.hang(False)
    scene.await_robot()
    return took_s


def _publishers(scene: Scene) -> float:
    """The nodes that measure end; the one that drives does not."""
    with scene.driven():
        tokens = [token for token in scene.robot.tokens if "/MP/" in token]
        for token in tokens:
            scene.robot.tokens.pop(token).undeclare()
        at = time.monotonic()
        took_s = scene.rest_since(at)
    for token in tokens:
        scene.robot.tokens[token] = scene.robot.session.liveliness().declare_token(token)
    scene.await_robot()
    return took_s


def _router(scene: Scene) -> float:
    """At rest as soon as the router is back, and it stays so: whoever drives owes neutral."""
    with scene.driven():
        with scene.router_away():
            until(lambda: scene.bench.fleet.state() != "established", what="the loss")
        scene.await_robot()
        return scene.rest_since(time.monotonic())


def _other(scene: Scene) -> float:
    """Another node drives on: what it says is answered, so it never moves the robot for long."""
    with scene.driven() as ends, contextlib.closing(Other(scene.router_at, 0.7)) as other:
        until(lambda: "other" in scene.bench.fleet.reason(), what="the other is shown")
        ends.set()
        scene.bench.fleet.put("r1/@cmd/stop")
        at = time.monotonic()
        until(lambda: time.monotonic() > at + 1.0, what="a while")
        told = [one for one in list(scene.robot.commands) if one.at > at]
    after = [one for one in list(scene.robot.commands) if one.at > at]
    assert any(one.gid == other.gid for one in told), "the other said nothing"
    longest = 0.0
    for one, following in pairwise(after):
        longest = max(longest, following.at - one.at if one.moves else 0.0)
    return max(longest, scene.rest_since(at + 1.0))


WAYS: dict[str, Callable[[Scene], float]] = {
    "stop": _stop,
    "deadman": _deadman,
    "silent": _silent,
    "publishers": _publishers,
    "router": _router,
    "other": _other,
}


@dataclass
class Result(Finding):
    """What came of one way."""

    way: str = ""
    took_s: list[float] = field(default_factory=list)
    excused: int = 0

    def __str__(self) -> str:
        took = sorted(self.took_s)
        middle = took[len(took) // 2] if took else 0.0
        return (
            f"{self.way}: at rest {len(took)} times, p50 {middle * 1000:.0f} ms, most "
            f"{max(took, default=0.0) * 1000:.0f} ms, {self.excused} late with the machine, {len(self.faults)} faults"
        )


def measure(way: str, *, repetitions: int) -> Result:
    """Lose what the way says, again and again."""
    result = Result(way=way)
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        scene = Scene(Path(folder), stack)
        for _ in range(repetitions):
            withheld_s = scene.bench.withheld_s
            try:
                took_s = WAYS[way](scene)
            except AssertionError as error:
                result.faults.append(str(error))
                continue
            result.took_s.append(took_s)
            late_s = scene.bench.withheld_s - withheld_s
            if took_s > LATE_S:
                result.excused += took_s <= LATE_S + late_s
                if took_s > LATE_S + late_s:
                    result.faults.append(f"at rest after {took_s:.3f} s, the machine was late for {late_s:.3f} s")
        result.faults += scene.robot.violations
        scene.gateway.end()
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--way", choices=WAYS)
    parser.add_argument("--repetitions", type=int, default=30)
    wanted = parser.parse_args()
    report(measure(way, repetitions=wanted.repetitions) for way in ([wanted.way] if wanted.way else WAYS))


if __name__ == "__main__":
    main()
