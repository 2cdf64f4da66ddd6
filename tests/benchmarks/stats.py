"""What ``@gateway/stats`` costs a gateway: ``python -m tests.benchmarks.stats [--messages 400]``.

Messages are read, encoded and put on a real bus, 500 a second; an idle loop is subtracted. The clock advances a second
with each, so that the slow readings are begun as often as in a gateway. Goal: 0.1 % of a core, 1 ms a message.
"""

from __future__ import annotations

import argparse
import asyncio
import statistics
import time

from zbridge.app.process_usage import ProcessUsage
from zbridge.app.stats import GatewayStats
from zbridge.bus import BusSettings, open_bus
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics

COUNTERS = 80
"""Counters of a gateway that serves a robot and a listener."""
TURNS = 5


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=400)
    options = parser.parse_args()
    metrics = Metrics()
    for number in range(COUNTERS):
        metrics.count(f"counter_{number % 40}", listener=str(number // 40)).value = number
    for key in ("pose", "map", "status", "sensor"):
        metrics.count("bus_messages", direction="out", kind=key)
    now = [0.0]
    usage = ProcessUsage(lambda: now[0])
    stats = GatewayStats("r1", metrics, usage, (), lambda: now[0], time.time_ns)
    bus = await open_bus(BusSettings(mode="peer", multicast=False), Metrics())
    publisher = bus.publisher(KeySpace("fleet", "r1").key(topics.STATS.path), topics.STATS)
    costs = []
    try:
        for _ in range(TURNS):
            begun = time.process_time()
            for _ in range(options.messages):
                now[0] += 1.0  # every fifth message begins the slow readings on their thread
                metrics.count("bus_messages", direction="out", kind="pose").value += 20
                publisher.put(payloads.encode(stats.read()))
                await asyncio.sleep(0.002)
            costs.append((time.process_time() - begun) / options.messages)
        idle = time.process_time()
        for _ in range(options.messages):
            await asyncio.sleep(0.002)
        idle_s = (time.process_time() - idle) / options.messages
    finally:
        await bus.close()
    cost_s = statistics.median(costs) - idle_s
    print(f"a message: {1e6 * cost_s:.0f} us of processor time, {100 * cost_s:.3f} % of a core at one a second")


if __name__ == "__main__":
    asyncio.run(main())
