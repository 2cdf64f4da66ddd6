"""Who drives in the ALF benchmark: the Python client with a lease, at a steady pace, until it is told to end.

``python -m tests.benchmarks.alf_driver ENDPOINT RATE_HZ``; any word begins, the next one ends.
"""

from __future__ import annotations

import asyncio
import sys
import time

from tests.benchmarks.peer import ROBOT, hear, tell
from zbridge.client import connect
from zbridge.errors import Refused

_SPEEDS = 50


async def run(endpoint: str, rate_hz: float) -> None:
    """Get the lease; drive, each command at another speed than the one before."""
    loop = asyncio.get_running_loop()
    async with connect(endpoints=[endpoint]) as fleet, fleet[ROBOT].control() as drive:
        tell(ready=True)
        await loop.run_in_executor(None, hear)
        ending = loop.run_in_executor(None, hear)
        begun_s, sent, refused = time.monotonic(), 0, 0
        while not ending.done():
            try:
                await drive(forward=(1 + sent % _SPEEDS) / 100)
            except Refused:  # a machine that was busy for longer than the deadman waits
                refused += 1
                await drive()
            sent += 1
            await asyncio.sleep(max(0.0, begun_s + sent / rate_hz - time.monotonic()))
        tell(sent=sent, refused=refused)


if __name__ == "__main__":
    asyncio.run(run(sys.argv[1], float(sys.argv[2])))
