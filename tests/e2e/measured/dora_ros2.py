"""A foreign judge of ``zbridge ros2``: dora-rs, in an environment of its own. Not of the suite.

    python3 -m venv DIR && DIR/bin/pip install dora-rs==1.1.0 pyarrow rosbags
    python -m tests.e2e.measured.dora_ros2 DIR/bin/python

A fragile robot of each protocol stands behind a gateway of its own. dora-rs receives what each protocol has of scan,
odometry, frames and, as a late joiner, a map; its Twists move each robot and its calls stop them. What the robots say
themselves is looked at: they moved as told, were at rest after each stop and after the end of dora's node, and have
nothing to complain of. Exit code 1 if not.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from tests.e2e.measured.stalls import LIMIT_S
from tests.e2e.rigs.moving_robot import TOLERANCE
from tests.e2e.rigs.processes import ROOT
from tests.e2e.rigs.ros2_scene import FRAGILE, GRID, FragileInFleet, RosScene

SPEEDS = {"tcpudp": 0.5, "alf": 0.5, "wc2ec": 0.65}
"""What each robot tells of 0.25 m/s, in a curve of 0.5 rad/s those that can: of wheels the speed of the faster one."""
PATIENCE_S = 90.0


class Run:
    """What one run of dora's node printed, by its first word."""

    def __init__(self) -> None:
        self.told: dict[str, list[dict[str, Any]]] = {"first": [], "drove": [], "stopped": [], "counts": []}
        self.ended = 0.0

    def hear(self, line: str) -> None:
        """Take a line."""
        print(line, end="", flush=True)
        if line.startswith("{"):
            told = json.loads(line)
            self.told[next(iter(told))].append(told)


def run(python: str, scene: RosScene) -> Run:
    """Let dora's node run."""
    heard = Run()
    command = [python, "-m", "tests.e2e.measured.dora_node", scene.ros_at, str(scene.folder / "types")]
    node = subprocess.Popen(command, text=True, stdout=subprocess.PIPE, cwd=ROOT)  # warnings go to our own stderr
    scene.stack.callback(node.kill)
    alarm = threading.Timer(PATIENCE_S, node.kill)
    alarm.start()
    scene.stack.callback(alarm.cancel)
    assert node.stdout is not None
    for line in node.stdout:
        heard.hear(line)
    node.wait()
    heard.ended = time.monotonic()
    return heard


def faults_of(robot: FragileInFleet, heard: Run) -> list[str]:
    """List what a robot did otherwise than it was told, once it is at rest."""
    with contextlib.suppress(AssertionError):  # then it is late, or never at rest
        robot.rests(PATIENCE_S / 10)
    faults, rested = list[str](), []
    moves = heard.told["drove"]
    stops = [told for told in heard.told["stopped"] if told["stopped"] == robot.name]
    ends = [*(stop["until"] for stop in stops), heard.ended]
    if len(moves) != len(ends):
        return [f"{robot.name}: {len(moves)} moves and {len(stops)} stops were told of"]
    for move, end in zip(moves, ends, strict=True):
        speeds = [speed for at, speed in robot.changes if move["since"] < at < move["until"]]
        if not speeds or abs(speeds[-1] - SPEEDS[robot.name]) > TOLERANCE:
            faults.append(f"{robot.name} at {speeds[-3:]} while it was driven by {move['drove']}")
        rest = next((at for at, speed in robot.changes if at > move["until"] and not speed), None)
        rested.append(rest - end if rest is not None else None)
    faults += [f"{robot.name}: {stop['answer']}" for stop in stops if not stop["answer"]["success"]]
    shown = ", ".join("never" if late_s is None else f"{late_s:+.3f}" for late_s in rested)
    print(f"{robot.name}: at rest after answered stops and after the node's end: {shown} s")
    if None in rested or max(late_s for late_s in rested if late_s is not None) > LIMIT_S:
        faults.append(f"{robot.name} at rest after {shown} s")
    return faults


def complaints_of(robot: FragileInFleet) -> list[str]:
    """End a robot; list what it complains of."""
    try:
        robot.judged()
    except AssertionError as error:
        return [f"{robot.name}: {error}"]
    return []


def main() -> int:
    """Start the scene and the judge; say what came."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        scene = RosScene(stack, folder)
        robots = [FragileInFleet(scene, protocol) for protocol in FRAGILE]
        first = scene.ros.subscribe("/tcpudp/map", GRID, latched=True)
        first.until(bool)  # from now on nothing is asked for again when somebody comes late
        heard = run(sys.argv[1], scene)
        faults = [fault for robot in robots for fault in faults_of(robot, heard)]
        faults += [fault for robot in robots for fault in complaints_of(robot)]
        counts = next((told["counts"] for told in heard.told["counts"]), {"anything": 0})
        faults += [f"nothing came of {name}" for name, count in counts.items() if not count]
        print("\n".join(faults) if faults else "agreed")
        return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
