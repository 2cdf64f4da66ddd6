"""What an idle gateway declares on the bus: every router pays for each declaration of each gateway."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from tests.bus import SOON_S
from tests.simulated_robot import simulated
from zbridge.app import Gateway, plan
from zbridge.bus import BusSettings
from zbridge.bus.zenoh import ZenohBus, zenoh_config
from zbridge.bus.zenoh.opening import open_session
from zbridge.fleet import topics
from zbridge.fleet.topics import Delivery
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import find_protocol

MOST = 12
ALONE = BusSettings(multicast=False, listen=("tcp/127.0.0.1:0",))
KINDS = {
    "declare_subscriber": "subscriber",
    "declare_queryable": "queryable",
    "declare_publisher": "publisher",
    "declare_querier": "querier",
    "declare_token": "token",
}


class Counted:
    """A Zenoh session, or its liveliness, that notes what is declared on it."""

    def __init__(self, real: Any, declared: Counter[tuple[str, str]]) -> None:
        self._real, self._declared = real, declared

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._real, name)
        if name == "liveliness":
            return lambda: Counted(found(), self._declared)
        return self._noting(name, found) if name in KINDS else found

    def _noting(self, name: str, declare: Callable[..., Any]) -> Callable[..., Any]:
        def noted(key_expr: str, *args: Any, **options: Any) -> Any:
            self._declared[KINDS[name], str(key_expr)] += 1
            return declare(key_expr, *args, **options)

        return noted


@pytest.mark.parametrize("protocol", ["alf", "tcpudp", "wc2ec"])
async def test_a_gateway_declares_twelve_things_at_most_and_streams_when_they_come(protocol: str) -> None:
    declared: Counter[tuple[str, str]] = Counter()
    async with contextlib.AsyncExitStack() as stack:
        raw = {
            "robot": {"name": "r1"},
            "device": {
                "protocol": protocol,
                "connect": await simulated(protocol, stack),
                "options": find_protocol(protocol).simulated,
            },
        }
        session: Any = Counted(await open_session(zenoh_config(ALONE)), declared)
        bus = ZenohBus(session, asyncio.get_running_loop(), Metrics())
        stack.push_async_callback(bus.close)
        serving = asyncio.create_task(Gateway(plan(raw)).run_on(bus))
        async with asyncio.timeout(SOON_S):
            while not any(map(is_stream, declared)):  # noqa: ASYNC110 - it is established, and its robot sends
                await asyncio.sleep(0.01)
        serving.cancel()
        await asyncio.wait((serving,))
    streams = list(filter(is_stream, declared))
    idle = declared - Counter({entry: declared[entry] for entry in streams})
    assert idle.total() <= MOST, idle
    assert {kind for kind, _ in streams} == {"publisher"}
    queryables = {key for kind, key in idle if kind == "queryable"}
    assert queryables == {"fleet/r1/*", "fleet/r1/@gateway/*", "fleet/r1/@rpc/**"}


def is_stream(entry: tuple[str, str]) -> bool:
    topic = topics.find(entry[1].removeprefix("fleet/r1/"))
    return topic is not None and topic.delivery is Delivery.STREAM
