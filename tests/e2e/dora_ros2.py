"""A foreign judge of ``zbridge ros2``: dora-rs, in an environment of its own. Not of the suite.

    python3 -m venv DIR && DIR/bin/pip install dora-rs==1.1.0 pyarrow rosbags
    python -m tests.e2e.dora_ros2 DIR/bin/python

It receives scan, odometry, frames and, as a late joiner, a map; its Twists drive a fragile robot. Exit code 1 if not.
"""

from __future__ import annotations

import contextlib
import json
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import msgpack

from tests.e2e.test_ros2 import Scene, repeated


def main() -> int:
    """Start the scene and the judge; say what came."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        scene = Scene(stack, folder)
        ranges = struct.pack("<769f", *range(769))
        scan = {"angle_min": -2.3, "angle_increment": 0.006, "range_min": 0.02, "range_max": 5.6, "ranges": ranges}
        grid = {"rows": 1, "columns": 3, "cell": 0.5, "origin": [0.0, 0.0], "cells": bytes([0, 1, 2])}
        shown = {"scan": scan, "pose": {"x": 1.0, "y": 2.0, "heading": 0.5}, "map": grid}

        def publish() -> None:
            for name, fields in shown.items():
                scene.fleet.put(f"fleet/r1/{name}", msgpack.packb({**fields, "stamp_ns": time.time_ns()}))

        stack.enter_context(repeated(publish, 0.1))
        begun = time.monotonic()
        command = [sys.argv[1], str(Path(__file__).with_name("dora_node.py")), scene.ros_at, str(folder / "types")]
        watched: list[str] = []
        judge = subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        stack.callback(judge.kill)
        alarm = threading.Timer(90.0, judge.kill)
        alarm.start()
        stack.callback(alarm.cancel)
        assert judge.stdout is not None
        for line in judge.stdout:
            print(line, end="", flush=True)
            watched.append(line)
        told = scene.told("r1: cmd_vel", "")
        moves = scene.moves(begun)
        print(f"the robot moved {len(moves)} times, at {sorted(set(moves))}; then: {told}")
        counts = next((json.loads(line.removeprefix("counts ")) for line in watched if line.startswith("counts")), {})
        good = bool(counts) and all(counts.values()) and bool(moves) and all(abs(m - 0.5) < 1e-3 for m in moves)
        print("agreed" if good else "NOT agreed")
        return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
