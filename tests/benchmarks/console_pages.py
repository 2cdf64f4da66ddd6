"""Pages for ``tests.benchmarks.console``: sockets that look at robots as browsers do, and throw away what they get.

``python -m tests.benchmarks.console_pages ADDRESS PAGES ROBOTS``; tells each second how many bytes and messages came.
``... ADDRESS PAGES ROBOTS churn``: pages that come, look for a second, and go.
"""

from __future__ import annotations

import asyncio
import json
import sys

import uvloop
from websockets.asyncio.client import connect

from tests.benchmarks.peer import tell

counts = {"bytes": 0, "messages": 0, "pages": 0}


async def page(at: str, robot: str, seconds: float | None) -> None:
    """Look at a robot, for so long."""
    options = {"origin": at, "proxy": None, "max_size": None, "compression": None}
    async with connect(f"ws{at.removeprefix('http')}/socket", **options) as opened:  # type: ignore[arg-type]
        counts["pages"] += 1
        await opened.send(json.dumps({"do": "look", "robot": robot}))
        async with asyncio.timeout(seconds):
            async for message in opened:
                counts["bytes"] += len(message)
                counts["messages"] += 1


async def pages(at: str, robot: str, churn: bool) -> None:
    while True:
        try:
            await page(at, robot, 1.0 if churn else None)
        except TimeoutError:
            continue


async def report() -> None:
    while True:
        await asyncio.sleep(1.0)
        tell(**counts)


async def run(at: str, count: int, robots: int, churn: bool) -> None:
    names = [f"robot-{number % robots:03}" for number in range(count)]
    await asyncio.gather(report(), *(pages(at, name, churn) for name in names))


if __name__ == "__main__":
    uvloop.run(run(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), "churn" in sys.argv))
