"""One process of a trace on real Zenoh: an agent or a router; words come as JSON lines, observations go out so."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
import time
from typing import Any

from tests.simulated.bus_validation.agent import Agent
from zbridge.bus import BusSettings, open_bus, open_router
from zbridge.metrics import Metrics
from zbridge.security.router_settings import RouterSettings, plan_router, zenoh_values


async def main(listen: str, connect: str) -> None:
    """Wait for the word ``open``, then be an agent, or (``listen``) a router, until stdin ends."""
    words: asyncio.Queue[list[Any]] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    def read() -> None:
        for line in sys.stdin:
            loop.call_soon_threadsafe(words.put_nowait, json.loads(line))
        loop.call_soon_threadsafe(words.put_nowait, ["end"])

    threading.Thread(target=read, daemon=True).start()
    print("ready", flush=True)
    await words.get()

    def record(what: str, *fields: Any) -> None:
        print(json.dumps([time.monotonic(), what, fields]), flush=True)

    connects = (connect,) if connect else ()
    if listen:
        plan = plan_router(RouterSettings(listen=(listen,), connect=connects, insecure=True))
        bus: Any = await open_router(zenoh_values(plan), Metrics(), lambda neighbour, here: None)
    else:
        settings = BusSettings(mode="client", connect=connects, multicast=False)
        bus = await open_bus(settings, Metrics(), within_s=5.0)
    record("opened")
    agent = Agent(bus, record, time.monotonic)
    while (word := await words.get())[0] != "end":
        if word[0] == "close":
            await bus.close()
            record("closed")
        else:
            agent.do(word[0], *word[1:])
    os._exit(0)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], sys.argv[2]))
