"""Who watches a camera, and how long it is still fetched for nobody."""

from __future__ import annotations

import asyncio

import pytest

from zbridge.camera.demand import LINGER_S, Demand

pytestmark = pytest.mark.jumping


def test_a_camera_is_wanted_by_listeners_on_the_bus_and_by_clients_of_the_relay() -> None:
    demand = Demand()
    assert not demand.wanted
    demand.listen(True)
    assert demand.wanted
    demand.listen(False)
    demand.join()
    demand.join()
    demand.leave()
    assert demand.wanted, "one client is left"
    demand.leave()
    assert not demand.wanted


async def test_begin_waits_for_the_first_one_who_watches() -> None:
    demand = Demand()
    waiting = asyncio.ensure_future(demand.begin())
    await asyncio.sleep(1.0)
    assert not waiting.done()
    demand.join()
    await waiting
    await demand.begin()


async def test_the_end_comes_when_nobody_has_watched_for_two_seconds_at_a_stretch() -> None:
    demand, loop = Demand(), asyncio.get_running_loop()
    demand.listen(True)
    ending = asyncio.ensure_future(demand.end())
    await asyncio.sleep(100.0)
    demand.listen(False)
    await asyncio.sleep(LINGER_S - 0.1)
    demand.join()  # comes back in time
    await asyncio.sleep(100.0)
    assert not ending.done()
    demand.leave()
    gone_at = loop.time()
    await ending
    assert loop.time() - gone_at == pytest.approx(LINGER_S)
