"""Robots for ``tests.benchmarks.console``: each publishes scans, poses, a map and its states.

``python -m tests.benchmarks.console_robots ENDPOINT COUNT``; says ``{"robots": COUNT}`` once all are on the bus.
"""

from __future__ import annotations

import asyncio
import sys

import numpy as np
import uvloop

from tests.benchmarks.peer import tell
from tests.benchmarks.top_robots import Gateway
from zbridge.bus import Bus, BusSettings, open_bus
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, Map, Motion, Pose, Scan
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.metrics import Metrics

STEP_S = 1 / 60
SCAN_EVERY, POSE_EVERY, SLOW_EVERY = 4, 3, 60
"""Steps: 15 scans, 20 poses and a map a second."""
POINTS, CELLS = 769, 200


class MovingRobot(Gateway):
    """What one robot publishes."""

    def __init__(self, bus: Bus, number: int) -> None:
        super().__init__(bus, number)
        self._keys = KeySpace("fleet", f"robot-{number:03}")
        self._bus = bus
        self._publishers = {
            topic: bus.publisher(self._keys.key(topic.path), topic)
            for topic in (topics.SCAN, topics.POSE, topics.MOTION, topics.MAP)
        }
        self._ranges = np.linspace(1.0, 9.0, POINTS, dtype=np.float32)
        self._cells = np.zeros((CELLS, CELLS), np.uint8)

    def step(self, step: int) -> None:
        due = step + self.number
        if due % SCAN_EVERY == 0:
            self._put(topics.SCAN, Scan(-2.0, 4.0 / POINTS, 0.1, 10.0, self._ranges))
        if due % POSE_EVERY == 0:
            self._put(topics.POSE, Pose(step * 0.001, 0.0, 0.0))
        if due % SLOW_EVERY == 0:
            self._put(topics.MOTION, Motion(speed=0.1))
            self._put(topics.MAP, Map(CELLS, CELLS, 0.05, (0.0, 0.0), self._cells))
            self.publish()

    def _put(self, topic: Topic, message: FleetMessage) -> None:
        self._publishers[topic].put(payloads.encode(message))


async def serve(endpoint: str, count: int) -> None:
    """Publish until the process is ended."""
    bus = await open_bus(BusSettings(mode="client", connect=(endpoint,), multicast=False), Metrics())
    robots = [MovingRobot(bus, number) for number in range(count)]
    tell(robots=count)
    loop, due, step = asyncio.get_running_loop(), asyncio.get_running_loop().time(), 0
    while True:
        step, due = step + 1, due + STEP_S
        await asyncio.sleep(max(0.0, due - loop.time()))
        for robot in robots:
            robot.step(step)


if __name__ == "__main__":
    uvloop.run(serve(sys.argv[1], int(sys.argv[2])))
