"""A session that does not connect again is left, and the bus joined with a new one."""

from __future__ import annotations

import asyncio
import logging

import pytest

from tests.fake_bus import FakeBus
from zbridge.app.config import GatewayPlan, plan
from zbridge.app.gateway import Gateway
from zbridge.app.joining import RECONNECTS_S, STUCK_S, SessionUseless, watch_session
from zbridge.app.runtime import Runtime
from zbridge.bus import Bus
from zbridge.metrics import Metrics

pytestmark = pytest.mark.jumping

ROUTER = {"connect": ["tcp/127.0.0.1:1"]}
WHILE_S = 600.0


def planned(**bus: object) -> GatewayPlan:
    device = {"protocol": "tcpudp", "connect": ["tcp://127.0.0.1:1"]}
    return plan({"robot": {"name": "r1"}, "device": device, "bus": {**ROUTER, **bus}})


class Scene:
    """A session that is watched, and whether a second one would connect."""

    def __init__(self, *, router: bool) -> None:
        self.bus, self.router, self.tried = FakeBus(), router, 0
        self.watching = asyncio.create_task(watch_session(planned(), self.bus, self.try_second))

    async def try_second(self, _: GatewayPlan) -> bool:
        self.tried += 1
        return self.router


async def test_a_session_that_stays_away_where_a_second_one_connects_is_useless() -> None:
    scene = Scene(router=True)
    await asyncio.sleep(WHILE_S)
    assert scene.tried == 0, "it is connected"
    scene.bus.connection(False)
    await asyncio.sleep(STUCK_S + RECONNECTS_S - 1.0)
    assert (scene.tried, scene.watching.done()) == (1, False)
    with pytest.raises(SessionUseless, match="does not reconnect, but a new one connects"):
        await asyncio.wait_for(scene.watching, 2.0)


async def test_while_no_session_connects_the_first_one_is_kept_and_tried_for() -> None:
    scene = Scene(router=False)
    scene.bus.connection(False)
    await asyncio.sleep(10 * STUCK_S + 1.0)
    assert scene.tried == 10
    scene.bus.connection(True)
    await asyncio.sleep(WHILE_S)
    assert (scene.tried, scene.watching.done()) == (10, False)
    scene.watching.cancel()


@pytest.mark.parametrize("after_s", [STUCK_S - 1.0, STUCK_S + RECONNECTS_S - 1.0])
async def test_a_session_that_connects_in_time_is_kept(after_s: float) -> None:
    scene = Scene(router=True)
    for _ in range(3):
        scene.bus.connection(False)
        await asyncio.sleep(after_s)
        scene.bus.connection(True)
        await asyncio.sleep(1.0)
    assert not scene.watching.done()
    scene.watching.cancel()


@pytest.mark.parametrize(("mode", "joined"), [("client", 2), ("peer", 1)])
async def test_a_gateway_leaves_a_useless_session_and_serves_on_a_new_one(
    mode: str, joined: int, caplog: pytest.LogCaptureFixture
) -> None:
    buses: list[FakeBus] = []

    async def join(_: GatewayPlan, __: Metrics) -> Bus:
        buses.append(FakeBus(f"{len(buses)}"))
        return buses[-1]

    async def can_connect(_: GatewayPlan) -> bool:
        return True

    gateway = Gateway(planned(mode=mode), runtime=Runtime(join=join, can_connect=can_connect))
    running = asyncio.create_task(gateway.run())
    await asyncio.sleep(STUCK_S)
    buses[0].connection(False)
    with caplog.at_level(logging.ERROR):
        await asyncio.sleep(STUCK_S + RECONNECTS_S + 2.0)
    assert len(buses) == joined
    assert sum("joining the bus anew" in message for message in caplog.messages) == joined - 1
    assert await buses[-1].alive("fleet/r1/@alive/gateway") == ["fleet/r1/@alive/gateway"]
    running.cancel()
    await asyncio.wait([running])
