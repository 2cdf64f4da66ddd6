"""What the bus's threads bring, carried to the event loop in order, bounded, one wake-up a batch."""

import asyncio
import logging
import threading
from typing import Any

import pytest

from zbridge.bus import Lane
from zbridge.bus.inbox import QUEUE, QUEUE_BYTES, SHARES, Inbox
from zbridge.metrics import Metrics


class Rig:
    def __init__(self) -> None:
        self.metrics = Metrics()
        self.inbox = Inbox(asyncio.get_running_loop(), self.metrics)
        self.seen: list[Any] = []
        self.source = self.inbox.source(self.seen.append, lambda value: value)

    def put(self, raw: Any, *, first: bool = False) -> None:
        self.source.put(raw, Lane.COMMAND if first else Lane.OTHER)

    async def drained(self) -> list[Any]:
        for _ in range(100):
            await asyncio.sleep(0)
        return self.seen


@pytest.fixture
async def rig() -> Rig:
    return Rig()


async def test_items_come_in_order_and_not_before_the_loop_runs(rig: Rig) -> None:
    for number in range(5):
        rig.put(number)
    assert rig.seen == []
    assert await rig.drained() == [0, 1, 2, 3, 4]


async def test_items_are_read_on_the_loops_thread_only(rig: Rig) -> None:
    reader: list[int] = []
    source = rig.inbox.source(rig.seen.append, lambda raw: reader.append(threading.get_ident()) or "read")
    source.put(b"raw", Lane.OTHER)
    assert reader == []
    assert await rig.drained() == ["read"]
    assert reader == [threading.get_ident()]


async def test_a_first_item_that_comes_late_goes_before_the_rest_of_a_long_queue(rig: Rig) -> None:
    for number in range(1000):
        rig.put(number)
    await asyncio.sleep(0)
    before = len(rig.seen)
    assert 0 < before < 1000, "the loop must get its turn between batches"
    rig.put("stop", first=True)
    seen = await rig.drained()
    assert seen[before] == "stop"
    assert [item for item in seen if item != "stop"] == list(range(1000))


async def test_items_of_another_thread_arrive_all_and_in_order(rig: Rig) -> None:
    await asyncio.to_thread(lambda: [rig.put(number) for number in range(3000)])
    assert await rig.drained() == list(range(3000))


async def test_a_full_lane_forgets_its_oldest_item_counts_it_and_costs_no_first_item(rig: Rig) -> None:
    rig.put("stop", first=True)
    for number in range(QUEUE + 3):
        rig.put(number)
    assert rig.metrics.total("bus_in_dropped") == 3
    assert await rig.drained() == ["stop", *range(3, QUEUE + 3)]


async def test_a_flood_of_commands_costs_no_stop(rig: Rig) -> None:
    rig.source.put("stop", Lane.STOP)
    for number in range(2 * QUEUE):
        rig.put(number, first=True)
    assert (await rig.drained())[0] == "stop"


async def test_the_lanes_are_served_in_their_order_whatever_came_first(rig: Rig) -> None:
    for lane in (Lane.OTHER, Lane.COMMAND, Lane.STOP, Lane.COMMAND, Lane.STOP, Lane.OTHER):
        rig.source.put(lane, lane)
    assert await rig.drained() == [Lane.STOP, Lane.STOP, Lane.COMMAND, Lane.COMMAND, Lane.OTHER, Lane.OTHER]


async def test_a_flood_of_commands_costs_no_other_item(rig: Rig) -> None:
    rig.put("other")
    for number in range(QUEUE + 3):
        rig.put(number, first=True)
    assert rig.metrics.total("bus_in_dropped") == 3
    await rig.drained()
    assert rig.seen.index("other") == SHARES[Lane.COMMAND], "a lane that never empties leaves the others their part"
    assert [item for item in rig.seen if item != "other"] == list(range(3, QUEUE + 3))


async def test_a_handler_that_fails_is_logged_and_the_next_item_comes(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:

    def fail(value: Any) -> None:
        raise RuntimeError("our bug")

    rig.inbox.source(fail, lambda value: value).put(1, Lane.OTHER)
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


async def test_attending_serves_stops_and_commands_at_once_and_nothing_else(rig: Rig) -> None:
    rig.put("other")
    rig.put("command", first=True)
    rig.source.put("stop", Lane.STOP)
    rig.inbox.attend()
    assert rig.seen == ["stop", "command"]
    rig.inbox.attend()
    assert await rig.drained() == ["stop", "command", "other"]


async def test_a_flood_of_one_source_costs_no_item_of_another_and_no_more_than_its_turn(rig: Rig) -> None:
    noise = rig.inbox.source(rig.seen.append, lambda value: value)
    for _ in range(2 * QUEUE):
        noise.put("noise", Lane.OTHER)
    rig.put("question")
    await asyncio.sleep(0)
    assert "question" in rig.seen[:2]


async def test_a_stop_that_waits_makes_the_next_ones_count_only(rig: Rig) -> None:
    for number in range(1000):
        rig.source.fold(number, Lane.STOP)
    assert await rig.drained() == [0]
    assert rig.metrics.total("bus_in_folded") == 999
    rig.source.fold("next", Lane.STOP)
    assert await rig.drained() == [0, "next"]


async def test_a_stop_that_comes_while_one_is_carried_out_is_carried_out_after_it(rig: Rig) -> None:

    def stop(number: int) -> None:
        rig.seen.append(number)
        if number < 3:
            source.fold(number + 1, Lane.STOP)

    source = rig.inbox.source(stop, lambda value: value)
    source.fold(1, Lane.STOP)
    assert await rig.drained() == [1, 2, 3]


async def test_stops_of_two_robots_are_two_stops(rig: Rig) -> None:
    other = rig.inbox.source(rig.seen.append, lambda value: value)
    rig.source.fold("one", Lane.STOP)
    other.fold("other", Lane.STOP)
    assert await rig.drained() == ["one", "other"]


async def test_what_waits_has_a_bound_in_bytes_too(rig: Rig) -> None:
    for number in range(10):
        rig.source.put(number, Lane.OTHER, QUEUE_BYTES // 4)
    assert await rig.drained() == [6, 7, 8, 9]
    assert rig.metrics.total("bus_in_dropped") == 6
    for number in range(4):
        rig.source.put(number, Lane.OTHER, QUEUE_BYTES // 4)
    assert (await rig.drained())[4:] == [0, 1, 2, 3], "what was served has made room"


async def test_items_of_many_threads_arrive_all_whatever_the_loop_does_meanwhile(rig: Rig) -> None:
    sources = [rig.inbox.source(rig.seen.append, lambda value: value) for _ in range(4)]

    def bring(source: Any, first: int) -> None:
        for number in range(first, first + 3000):
            source.put(number, Lane(number % len(Lane)))

    await asyncio.gather(*(asyncio.to_thread(bring, source, 3000 * i) for i, source in enumerate(sources)))
    for _ in range(10):  # what is over is served after the loop has had its turn
        await rig.drained()
    assert sorted(rig.seen) == list(range(12_000))


async def test_what_the_holder_says_keeps_its_order_whatever_it_comes_by(rig: Rig) -> None:
    """A release that overtook the neutral before it would have it refused."""
    questions = rig.inbox.source(rig.seen.append, lambda value: value)
    for number in range(3):
        rig.put(number, first=True)
    questions.put("release", Lane.COMMAND)
    rig.put("acquired anew", first=True)
    assert await rig.drained() == [0, 1, 2, "release", "acquired anew"]
