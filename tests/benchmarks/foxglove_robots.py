"""Robots that only publish, with a router for the others: ``foxglove_robots ENDPOINT ROBOTS SCANS_HZ``."""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import zenoh

from zbridge.fleet.messages import Control, Pose, Scan, Status
from zbridge.fleet.payload import encode

RANGES = np.linspace(0.5, 12, 769).astype("<f4")


def main(endpoint: str, robots: int, scans_hz: float) -> None:
    """Publish until killed. Scans begin a period, poses come twice in it; robots take turns within it."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        names = [f"r{number}" for number in range(robots)]
        tokens = [session.liveliness().declare_token(f"fleet/{name}/@alive/gateway") for name in names]
        put = {
            (name, path): session.declare_publisher(f"fleet/{name}/{path}", express=True)
            for name in names
            for path in ("scan", "pose", "status", "control")
        }
        print("publishing", flush=True)
        began, number = time.monotonic(), 0
        while tokens:
            for turn, name in enumerate(names):
                due = began + (number + turn / robots) / scans_hz / 2
                time.sleep(max(0.0, due - time.monotonic()))
                if number % 2 == 0:
                    stamp_ns = time.time_ns()
                    scan = Scan(
                        angle_min=-2.0,
                        angle_increment=0.005,
                        range_min=0.1,
                        range_max=30.0,
                        ranges=RANGES,
                        stamp_ns=stamp_ns,
                    )
                    put[name, "scan"].put(encode(scan))
                put[name, "pose"].put(encode(Pose(number * 0.01, 1.0, 0.5, stamp_ns=time.time_ns())))
                if number % int(2 * scans_hz) == 0:
                    put[name, "status"].put(encode(Status("established")))
                    put[name, "control"].put(encode(Control("free")))
            number += 1


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
