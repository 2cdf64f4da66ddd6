"""Viewers that subscribe to everything: ``foxglove_viewers PORT VIEWERS ROBOTS``; ``count`` asks how much came."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys

from websockets.asyncio.client import connect
from websockets.typing import Subprotocol


async def view(port: int, robots: int, counts: list[int], number: int, ready: asyncio.Event) -> None:
    """Subscribe to all channels of all robots, and count."""
    url = f"ws://127.0.0.1:{port}"
    async with connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], compression=None, max_size=None) as socket:
        channels: dict[str, int] = {}
        while len({topic.split("/")[1] for topic in channels}) < robots:
            message = await socket.recv()
            if isinstance(message, str) and '"advertise"' in message:
                channels |= {entry["topic"]: entry["id"] for entry in json.loads(message)["channels"]}
        wishes = [{"id": channel_id, "channelId": channel_id} for channel_id in channels.values()]
        await socket.send(json.dumps({"op": "subscribe", "subscriptions": wishes}))
        ready.set()
        async for message in socket:
            counts[number] += isinstance(message, bytes)


async def main(port: int, viewers: int, robots: int) -> None:
    """View until killed."""
    counts, events = [0] * viewers, [asyncio.Event() for _ in range(viewers)]
    tasks = [asyncio.create_task(view(port, robots, counts, number, event)) for number, event in enumerate(events)]
    for event in events:
        await event.wait()
    print("subscribed", flush=True)
    while await asyncio.to_thread(sys.stdin.readline):
        print(sum(counts), flush=True)
    for task in tasks:
        task.cancel()


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(main(*map(int, sys.argv[1:4])))
