"""Robots for ``tests.benchmarks.top``: each publishes status, control and ``@gateway/stats`` once a second.

``python -m tests.benchmarks.top_robots ENDPOINT COUNT``; says ``{"robots": COUNT}`` once all are on the bus.
"""

from __future__ import annotations

import asyncio
import random
import sys

import uvloop

from tests.benchmarks.peer import tell
from zbridge.bus import Bus, BusSettings, open_bus
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, LinkStatus, Refusal, Status
from zbridge.fleet.processes import DiskSpace, ListenerStats, ProcessStats, Stats
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics

REFUSED = tuple(
    Refusal(who=f"ann{number}", command="drive", code="held", reason="held by bob", count=number) for number in range(3)
)


def stats(number: int) -> Stats:
    """Make figures that are others each time: rows move, and every cell changes."""
    cpu = random.uniform(0.005, 0.1)
    resident = 60_000_000 + number * 1000
    process = ProcessStats("hub-1", number, "0.1.0", 1, 1e5, cpu, resident, resident // 2, 38, 1024, 0.0004)
    rates = {name: round(random.uniform(1, 40), 2) for name in ("pose", "scan", "motion", "sensor", "battery")}
    listeners = (ListenerStats("hq", "tcpudp", "tcp://127.0.0.1:11002", 1),)
    return Stats(process, rates, number % 7, number % 5, 0, listeners, (DiskSpace("audit", "/var/log", 10**10),))


class Gateway:
    """What one gateway publishes."""

    def __init__(self, bus: Bus, number: int) -> None:
        self.number = number
        keys = KeySpace("fleet", f"robot-{number:03}")
        bus.announce(keys.alive("gateway"))
        self.status, self.control, self.stats = (
            bus.publisher(keys.key(topic.path), topic) for topic in (topics.STATUS, topics.CONTROL, topics.STATS)
        )

    def publish(self) -> None:
        link = LinkStatus("tcp", "established", f"tcp://10.0.0.{self.number}:11001")
        status = Status(
            "established", protocol="tcpudp", version="1.3", features=("udp", "map"), links=(link,), host="hub-1"
        )
        control = Control("held", f"bob{self.number}", b"12345678", 0, random.uniform(1, 3), REFUSED)
        for publisher, message in ((self.status, status), (self.control, control), (self.stats, stats(self.number))):
            publisher.put(payloads.encode(message))


async def serve(endpoint: str, count: int) -> None:
    """Publish until the process is ended; the robots' messages are spread over the second."""
    bus = await open_bus(BusSettings(mode="client", connect=(endpoint,), multicast=False), Metrics())
    gateways = [Gateway(bus, number) for number in range(count)]
    loop, due = asyncio.get_running_loop(), asyncio.get_running_loop().time()
    for gateway in gateways:
        gateway.publish()
    tell(robots=count)
    while True:
        for gateway in gateways:
            due += 1.0 / count
            await asyncio.sleep(max(0.0, due - loop.time()))
            gateway.publish()


if __name__ == "__main__":
    uvloop.run(serve(sys.argv[1], int(sys.argv[2])))
