"""``zbridge ros2`` between two real routers: robots behind real gateways on one side, a node of ROS on the other.

That node is the judge of :mod:`tests.views.ros2.judge`, which shares no code with the view. Robots are fragile
ones of every protocol, each a process of its own that tells what it obeys (:mod:`tests.e2e.rigs.fragile`).
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zenoh

from tests.e2e.conftest import WAIT_S, Fleet, Gateway, configuration, device, end, repeated, start, until
from tests.e2e.rigs.fragile import DISTURBED, ROBOTS, charges
from tests.e2e.rigs.moving_robot import HELD_UP_S, TOLERANCE, MovingRobot
from tests.machine import Withheld
from tests.ports import free_port
from tests.views.ros2.judge import Heard, Publisher, Ros, Subscriber

SCAN, GRID = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/OccupancyGrid"
TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
DIAGNOSED = "diagnostic_msgs/msg/DiagnosticArray"
FULL_MPS, FULL_RADPS, WHEELBASE_M = 0.5, 1.0, 0.3
FRAGILE = {"tcpudp": "tcpudp-1.3", "alf": "alf", "wc2ec": "wc2ec"}
"""The fragile robot of each protocol; the protocol is its name in the fleet, too."""
SENSORS = range(8)
OPTIONS = {
    "wc2ec": f"bearings_deg = {{ {', '.join(f'ds{number} = {45.0 * number}' for number in SENSORS)} }}\n"
    f"tables = {{ {', '.join(f'ds{number} = [[0.0, 0.0], [1000.0, 2.0]]' for number in SENSORS)} }}\n"
    "scan_range_m = [0.0, 2.0]\n"
}
"""What a gateway is told besides: of the Webots robot, where its sensors look, and that they read 1000 at 2 m."""
SPEEDS = f"speed_full_mps = {FULL_MPS}\nturn_full_radps = {FULL_RADPS}\n"
SETTINGS = f"""
[others]
{SPEEDS}
[robot.alf]
{SPEEDS}
wheelbase_m = {WHEELBASE_M}
"""
REST_S = 0.5
"""Seconds that a robot must stay at rest."""
ATTEMPTS = 4
"""Attempts to move a robot, each of HELD_UP_S."""


class RosScene:
    """The routers, ``zbridge ros2 --drive`` with these settings, and a session on each side."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path, settings: str = SETTINGS) -> None:
        self.stack, self.folder = stack, folder
        self.fleet_at, self.ros_at = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
        self.fleet = zenoh.open(configuration("router", self.fleet_at))
        stack.callback(self.fleet.close)
        self.ros_router = zenoh.open(configuration("router", self.ros_at))
        stack.callback(lambda: self.ros_router.close())
        file = folder / "ros2.toml"
        file.write_text(f'drive = true\nros = ["{self.ros_at}"]\n{settings}')
        log = stack.enter_context((folder / "ros2.log").open("w"))
        self.view = start("ros2", str(file), "--connect", self.fleet_at, stdout=log)
        stack.callback(lambda: end(self.view))
        self.ros = Ros(self.ros_at, "teleop")
        stack.callback(self.ros.close)
        self._diagnosed: dict[str, Subscriber] = {}

    def shows(self, name: str, text: str) -> str:
        """Give the newest diagnostic of this name if it holds a text, in its message or values; else nothing."""
        heard = self._diagnostics(name).heard
        entries = [entry for entry in heard[-1].message.status if entry.name == name] if heard else []
        texts = [" ".join([each.message, *(f"{v.key}={v.value}" for v in each.values)]) for each in entries]
        return next((each for each in texts if text in each), "")

    def told(self, name: str, text: str) -> str:
        """Wait until a diagnostic of this name holds a text; give them."""
        told = ""

        def shown(heard: list[Heard]) -> str:
            nonlocal told
            told = self.shows(name, text)
            return told

        self._diagnostics(name).until(shown)
        return told

    def _diagnostics(self, name: str) -> Subscriber:
        robot = name.partition(":")[0]
        if robot not in self._diagnosed:
            self._diagnosed[robot] = self.ros.subscribe(f"/{robot}/diagnostics", DIAGNOSED)
        return self._diagnosed[robot]

    @contextlib.contextmanager
    def publishing(self, robot: str, type_name: str = TWIST) -> Iterator[Publisher]:
        """Have a publisher on a robot's cmd_vel that the view knows and that may drive."""
        publisher = self.ros.publisher(f"/{robot}/cmd_vel", type_name)
        try:
            with repeated(publisher.twist):
                self.told(f"{robot}: cmd_vel", "/teleop=may drive")
            yield publisher
        finally:
            publisher.close()


class FragileInFleet:
    """A fragile robot behind a real gateway, from when it is established until it is judged; named by its protocol."""

    def __init__(self, scene: RosScene, protocol: str) -> None:
        self.name = protocol
        self._withheld = Withheld()
        fleet = Fleet(scene.fleet, f"fleet/{protocol}/status")
        for seed in range(DISTURBED):  # one that was late itself in the handshake understands nothing after it
            with contextlib.ExitStack() as stack:
                self._begin(stack, scene, seed)
                with contextlib.suppress(AssertionError):
                    until(lambda: fleet.state(protocol) == "established", what="established")
                    scene.stack.enter_context(stack.pop_all())
                    break
        else:
            raise AssertionError(f"{protocol} was never established: {fleet.last(f'{protocol}/status')}")
        fleet.subscriber.undeclare()

    def _begin(self, stack: contextlib.ExitStack, scene: RosScene, seed: int) -> None:
        kind = ROBOTS[FRAGILE[self.name]]
        self._robot = MovingRobot(stack, FRAGILE[self.name], "127.0.0.1", (), seed)
        told = device(self._robot.port, kind.protocol, OPTIONS.get(self.name, "") + kind.options)
        self._gateway = Gateway(stack, scene.folder / f"{self.name}.toml", scene.fleet_at, told, robot=self.name)
        self._pids = (self._robot.part.pid, self._gateway.process.pid)
        self._withheld_s = self._withheld.seconds(self._pids)

    @property
    def changes(self) -> list[tuple[float, float]]:
        """When it obeyed another speed, and which: a fraction of full scale."""
        return self._robot.changes

    @property
    def speed(self) -> float:
        """The speed that it was told last; of a robot on wheels that of the fastest one."""
        return self._robot.speed

    def moves(self, speed: float) -> None:
        """Wait until it moves at a speed."""
        until(lambda: abs(self.speed - speed) <= TOLERANCE, what=f"{self.name} at {speed:g}, not {self.speed:g}")

    def rests(self, within_s: float = WAIT_S) -> float:
        """Wait until it has been at rest for REST_S; give when it came to rest."""

        def rested() -> bool:
            at, speed = self.changes[-1]
            return not speed and time.monotonic() - at >= REST_S

        until(rested, within_s + REST_S, f"{self.name} at rest")
        return self.changes[-1][0]

    def judged(self) -> dict[str, Any]:
        """End it; give what it received. What it complains of is an error."""
        late_s = self._withheld.seconds(self._pids) - self._withheld_s
        self._robot.part.say("end")
        until(lambda: self._robot.report, what="its report")
        report = self._robot.report
        assert report["alive"], report["violations"][-3:]
        assert charges(report["violations"], late_s) == []
        assert not report["moving"], "it moves at the end"
        return report


@contextlib.contextmanager
def pushed(publisher: Publisher, speed_mps: float, moved: Callable[[], Any], every_s: float = 0.05) -> Iterator[None]:
    """Push a stick until the robot has moved, and on to the end. One that a busy machine held up owes zeros first."""
    with contextlib.ExitStack() as stack:
        for _ in range(ATTEMPTS):
            with contextlib.ExitStack() as attempt:
                attempt.enter_context(repeated(lambda: publisher.twist(speed_mps), every_s))
                with contextlib.suppress(AssertionError):
                    until(moved, HELD_UP_S, "motion")
                    stack.enter_context(attempt.pop_all())
                    break
            with repeated(publisher.twist):
                time.sleep(0.5)
        else:
            raise AssertionError("the robot does not move")
        yield
