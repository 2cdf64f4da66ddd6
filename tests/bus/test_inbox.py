"""What the bus's threads bring, carried to the event loop in order, bounded, one wake-up a batch."""

import asyncio
import logging
import threading
from typing import Any

import pytest

from zbridge.bus import Lane
from zbridge.bus.inbox import LANE, Inbox
from zbridge.metrics import Metrics


class Rig:
    def __init__(self) -> None:
        self.metrics = Metrics()
        self.inbox = Inbox(asyncio.get_running_loop(), self.metrics)
        self.seen: list[Any] = []

    def put(self, raw: Any, *, first: bool = False) -> None:
        self.inbox.put(self.seen.append, raw, lambda value: value, Lane.COMMAND if first else Lane.OTHER)

    async def drained(self) -> list[Any]:
        for _ in range(100):
            await asyncio.sleep(0)
        return self.seen


async def test_items_come_in_order_and_not_before_the_loop_runs() -> None:
    rig = Rig()
    for number in range(5):
        rig.put(number)
    assert rig.seen == []
    assert await rig.drained() == [0, 1, 2, 3, 4]


async def test_items_are_read_on_the_loops_thread_only() -> None:
    rig = Rig()
    reader: list[int] = []
    rig.inbox.put(rig.seen.append, b"raw", lambda raw: reader.append(threading.get_ident()) or "read", Lane.OTHER)
    assert reader == []
    assert await rig.drained() == ["read"]
    assert reader == [threading.get_ident()]


async def test_first_items_go_before_all_others_that_wait() -> None:
    rig = Rig()
    for number in range(3):
        rig.put(number)
    rig.put("stop", first=True)
    rig.put("stop again", first=True)
    assert await rig.drained() == ["stop", "stop again", 0, 1, 2]


async def test_a_first_item_that_comes_late_goes_before_the_rest_of_a_long_queue() -> None:
    rig = Rig()
    for number in range(1000):
        rig.put(number)
    await asyncio.sleep(0)
    before = len(rig.seen)
    assert 0 < before < 1000, "the loop must get its turn between batches"
    rig.put("stop", first=True)
    seen = await rig.drained()
    assert seen[before] == "stop"
    assert [item for item in seen if item != "stop"] == list(range(1000))


async def test_items_of_another_thread_arrive_all_and_in_order() -> None:
    rig = Rig()
    await asyncio.to_thread(lambda: [rig.put(number) for number in range(3000)])
    assert await rig.drained() == list(range(3000))


async def test_a_full_lane_forgets_its_oldest_item_and_counts_it() -> None:
    rig = Rig()
    rig.put("stop", first=True)
    for number in range(LANE + 3):
        rig.put(number)
    assert rig.metrics.total("bus_in_dropped") == 3
    assert await rig.drained() == ["stop", *range(3, LANE + 3)]


async def test_a_flood_of_other_items_costs_no_first_item() -> None:
    rig = Rig()
    for number in range(10):
        rig.put(number, first=True)
    for _ in range(2 * LANE):
        rig.put("other")
    assert (await rig.drained())[:10] == list(range(10))


async def test_a_flood_of_commands_costs_no_stop() -> None:
    rig = Rig()
    rig.inbox.put(rig.seen.append, "stop", lambda value: value, Lane.STOP)
    for number in range(2 * LANE):
        rig.put(number, first=True)
    assert (await rig.drained())[0] == "stop"


async def test_the_lanes_are_served_in_their_order_whatever_came_first() -> None:
    rig = Rig()
    for lane in (Lane.OTHER, Lane.COMMAND, Lane.STOP, Lane.COMMAND, Lane.STOP, Lane.OTHER):
        rig.inbox.put(rig.seen.append, lane, lambda value: value, lane)
    assert await rig.drained() == [Lane.STOP, Lane.STOP, Lane.COMMAND, Lane.COMMAND, Lane.OTHER, Lane.OTHER]


async def test_a_flood_of_commands_costs_no_other_item() -> None:
    rig = Rig()
    rig.put("other")
    for number in range(LANE + 3):
        rig.put(number, first=True)
    assert rig.metrics.total("bus_in_dropped") == 3
    for _ in range(20):
        await rig.drained()
    assert rig.seen == [*range(3, LANE + 3), "other"]


async def test_a_handler_that_fails_is_logged_and_the_next_item_comes(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig()

    def fail(value: Any) -> None:
        raise RuntimeError("our bug")

    rig.inbox.put(fail, 1, lambda value: value, Lane.OTHER)
    rig.put(2)
    with caplog.at_level(logging.ERROR):
        assert await rig.drained() == [2]
    assert "our bug" in caplog.text


def test_an_item_for_a_loop_that_has_ended_is_no_error() -> None:
    async def make() -> Rig:
        return Rig()

    rig = asyncio.run(make())
    rig.put(1)
    assert rig.seen == []


async def test_attending_serves_stops_and_commands_at_once_and_nothing_else() -> None:
    rig = Rig()
    rig.put("other")
    rig.put("command", first=True)
    rig.inbox.put(rig.seen.append, "stop", lambda value: value, Lane.STOP)
    rig.inbox.attend()
    assert rig.seen == ["stop", "command"]
    rig.inbox.attend()
    assert await rig.drained() == ["stop", "command", "other"]
