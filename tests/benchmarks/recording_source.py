"""Robots for the benchmark of recordings: a Zenoh peer that publishes scans and poses, paced or as fast as it can.

    python -m tests.benchmarks.recording_source ENDPOINT ROBOTS SECONDS      # SECONDS < 0: as fast as it can

A line on stdin begins; one line of JSON tells what was sent.
"""

from __future__ import annotations

import json
import sys
import time

import msgpack
import numpy as np
import zenoh

from tests.e2e.conftest import configuration

POINTS = 769
SCAN_HZ, POSE_HZ = 10, 20
_BLOCK = zenoh.CongestionControl.BLOCK
_ENCODING = zenoh.Encoding("application/msgpack")


def scans(count: int) -> list[bytes]:
    """Encode scans of a room, with noise as a scanner's."""
    rng = np.random.default_rng(1)
    room = rng.uniform(0.5, 5.0, POINTS)
    head = {"angle_min": -2.36, "angle_increment": 0.00614, "range_min": 0.02, "range_max": 5.6}
    return [
        msgpack.packb(
            {
                "stamp_ns": time.time_ns(),
                "seq": number,
                **head,
                "ranges": np.round(room + rng.normal(0, 0.01, POINTS), 3).astype("<f4").tobytes(),
            }
        )
        for number in range(count)
    ]


def _pose(number: int) -> bytes:
    payload: bytes = msgpack.packb({"stamp_ns": time.time_ns(), "x": number / 100, "y": 1.0, "heading": 0.1})
    return payload


def paced(session: zenoh.Session, robots: int, seconds: float) -> dict[str, float]:
    """Publish scans and poses of all robots, each robot at another moment of a period."""
    sent, payloads = 0, scans(200)
    ports = [
        tuple(
            session.declare_publisher(f"fleet/b{robot}/{name}", congestion_control=_BLOCK, encoding=_ENCODING)
            for name in ("scan", "pose")
        )
        for robot in range(robots)
    ]
    slots = robots * POSE_HZ
    began = time.monotonic()
    for slot in range(int(seconds * slots)):
        time.sleep(max(0.0, began + slot / slots - time.monotonic()))
        scan, pose = ports[slot % robots]
        turn = slot // robots
        pose.put(_pose(turn))
        sent += 1
        if not turn % (POSE_HZ // SCAN_HZ):
            scan.put(payloads[turn // (POSE_HZ // SCAN_HZ) % len(payloads)])
            sent += 1
    return {"sent": sent, "seconds": time.monotonic() - began}


def saturated(session: zenoh.Session, seconds: float) -> dict[str, float]:
    """Publish the scans of one robot as fast as they are taken."""
    sent, payloads = 0, scans(200)
    publisher = session.declare_publisher("fleet/b0/scan", congestion_control=_BLOCK, encoding=_ENCODING)
    began = time.monotonic()
    while time.monotonic() - began < seconds:
        for payload in payloads:
            publisher.put(payload)
        sent += len(payloads)
    return {"sent": sent, "seconds": time.monotonic() - began}


def main() -> None:
    endpoint, robots, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    with zenoh.open(configuration("router", endpoint)) as session:
        print(json.dumps({"ready": True}), flush=True)
        sys.stdin.readline()
        done = saturated(session, -seconds) if seconds < 0 else paced(session, robots, seconds)
        print(json.dumps(done), flush=True)
        sys.stdin.readline()


if __name__ == "__main__":
    main()
