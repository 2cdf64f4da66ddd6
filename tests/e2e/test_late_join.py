"""No late joiner and no reconnection misses a last value: real sessions, and a router that restarts in between."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable

import pytest
import zenoh

from tests.ports import free_port
from zbridge.bus import BusSettings, Sample, open_bus
from zbridge.bus.zenoh import ZenohBus
from zbridge.fleet import topics
from zbridge.metrics import Metrics

LONG_S = 20.0


class Seen(list[bytes]):
    def take(self, sample: Sample) -> None:
        self.append(sample.payload)


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(LONG_S):
        while not condition():  # noqa: ASYNC110 - other threads change it
            await asyncio.sleep(0.01)


def router(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    return zenoh.open(config)


@contextlib.asynccontextmanager
async def client(endpoint: str) -> AsyncIterator[ZenohBus]:
    settings = BusSettings(mode="client", multicast=False, connect=(endpoint,))
    bus = await open_bus(settings, Metrics())
    try:
        yield bus
    finally:
        await bus.close()


@pytest.mark.parametrize("down_s", [0.0, 0.3, 1.4])
async def test_what_was_published_while_the_router_was_away_is_had_when_it_is_back(down_s: float) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    routing = await asyncio.to_thread(router, endpoint)
    seen = Seen()
    try:
        async with client(endpoint) as gateway, client(endpoint) as joiner:
            token = gateway.announce("fleet/r1/@alive/gateway")
            publisher = gateway.publisher("fleet/r1/map", topics.MAP)
            publisher.put(b"before")
            await gateway.flush()
            joiner.subscribe("fleet/r1/map", seen.take, history=True)
            await until(lambda: seen)
            assert set(seen) == {b"before"}
            for value in (b"first", b"second"):
                await asyncio.to_thread(routing.close)
                await asyncio.sleep(down_s / 2)
                publisher.put(value)
                await asyncio.sleep(down_s / 2)
                routing = await asyncio.to_thread(router, endpoint)
                await until(lambda value=value: value in seen)
                assert seen[-1] == value
            token.close()
    finally:
        await asyncio.to_thread(routing.close)


async def test_who_comes_before_the_gateway_has_its_values_too() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    routing = await asyncio.to_thread(router, endpoint)
    seen = Seen()
    try:
        async with client(endpoint) as joiner:
            joiner.subscribe("fleet/*/map", seen.take, history=True)
            async with client(endpoint) as gateway:
                gateway.announce("fleet/r1/@alive/gateway")
                gateway.publisher("fleet/r1/map", topics.MAP).put(b"one")
                await until(lambda: b"one" in seen)
    finally:
        await asyncio.to_thread(routing.close)
