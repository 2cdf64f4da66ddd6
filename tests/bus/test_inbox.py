"""What the bus's threads bring, carried to the event loop in order, bounded, one wake-up a batch."""

import asyncio
import logging
import threading
from collections.abc import Iterable
from typing import Any

import pytest

from tests.scraped import samples
from zbridge.bus import PriorityClass
from zbridge.bus.inbox import QUEUE, QUEUE_BYTES, SHARES, Inbox, Source
from zbridge.log import current_robot
from zbridge.metrics import Metrics


class Rig:
    def __init__(self) -> None:
        self.metrics = Metrics()
        self.inbox = Inbox(asyncio.get_running_loop(), self.metrics)
        self.seen: list[Any] = []
        self.source = self.another_source()

    def another_source(self) -> Source:
        return self.inbox.source(self.seen.append, lambda value: value)

    def put(self, raws: Iterable[Any], priority: PriorityClass = PriorityClass.OTHER, size: int = 0) -> None:
        for raw in raws:
            self.source.put(raw, priority, size)

    async def drained(self) -> list[Any]:
        for _ in range(100):
            await asyncio.sleep(0)
        return self.seen


@pytest.fixture
async def rig() -> Rig:
    return Rig()


async def test_items_come_in_order_and_are_read_on_the_loops_thread_only(rig: Rig) -> None:
    readers = list[int]()
    source = rig.inbox.source(rig.seen.append, lambda raw: readers.append(threading.get_ident()) or raw)
    await asyncio.to_thread(lambda: [source.put(number, PriorityClass.OTHER) for number in range(3000)])
    assert await rig.drained() == list(range(3000))
    assert set(readers) == {threading.get_ident()}
    rig.put([1])
    assert len(rig.seen) == 3000, "and not before the loop runs"


async def test_input_is_served_by_priority_and_attending_serves_stops_and_commands_at_once(rig: Rig) -> None:
    for priority in (
        PriorityClass.OTHER,
        PriorityClass.COMMAND,
        PriorityClass.STOP,
        PriorityClass.COMMAND,
        PriorityClass.STOP,
        PriorityClass.OTHER,
    ):
        rig.put([priority], priority)
    rig.inbox.attend()
    rig.inbox.attend()
    assert rig.seen == [PriorityClass.STOP, PriorityClass.STOP, PriorityClass.COMMAND, PriorityClass.COMMAND]
    assert (await rig.drained())[4:] == [PriorityClass.OTHER, PriorityClass.OTHER]


async def test_a_command_that_comes_late_goes_before_the_rest_of_a_long_queue(rig: Rig) -> None:
    rig.put(range(1000))
    await asyncio.sleep(0)
    before = len(rig.seen)
    assert 0 < before < 1000, "the loop must get its turn between batches"
    rig.put(["command"], PriorityClass.COMMAND)
    assert await rig.drained() == [*range(before), "command", *range(before, 1000)]


async def test_what_the_holder_says_keeps_its_order_whatever_it_comes_by(rig: Rig) -> None:
    """A release that overtook the neutral before it would have it refused."""
    rig.put(range(3), PriorityClass.COMMAND)
    rig.another_source().put("release", PriorityClass.COMMAND)
    rig.put(["acquired anew"], PriorityClass.COMMAND)
    assert await rig.drained() == [0, 1, 2, "release", "acquired anew"]


# Floods


@pytest.mark.parametrize(
    ("flood", "other"), [(PriorityClass.OTHER, PriorityClass.COMMAND), (PriorityClass.COMMAND, PriorityClass.STOP)]
)
async def test_a_full_queue_drops_its_oldest_item_counts_it_and_costs_no_higher_priority(rig, flood, other) -> None:
    rig.put(["first"], other)
    rig.put(range(QUEUE + 3), flood)
    assert rig.metrics.total("bus_dropped") == 3
    assert await rig.drained() == ["first", *range(3, QUEUE + 3)]


async def test_a_flood_of_commands_leaves_the_others_their_share(rig: Rig) -> None:
    rig.put(["other"])
    rig.put(range(QUEUE), PriorityClass.COMMAND)
    assert (await rig.drained()).index("other") == SHARES[PriorityClass.COMMAND]


async def test_a_flood_of_one_source_costs_no_item_of_another_and_no_more_than_its_turn(rig: Rig) -> None:
    rig.put(["noise"] * 2 * QUEUE)
    rig.another_source().put("question", PriorityClass.OTHER)
    await asyncio.sleep(0)
    assert "question" in rig.seen[:2]


async def test_what_waits_has_a_bound_in_bytes_too(rig: Rig) -> None:
    rig.put(range(10), size=QUEUE_BYTES // 4)
    assert await rig.drained() == [6, 7, 8, 9]
    assert rig.metrics.total("bus_dropped") == 6
    rig.put(range(4), size=QUEUE_BYTES // 4)
    assert (await rig.drained())[4:] == [0, 1, 2, 3], "what was served has made room"


async def test_items_of_many_threads_arrive_all_whatever_the_loop_does_meanwhile(rig: Rig) -> None:
    def bring(source: Source, first: int) -> None:
        for number in range(first, first + 3000):
            source.put(number, PriorityClass(number % len(PriorityClass)))

    sources = [rig.another_source() for _ in range(4)]
    await asyncio.gather(*(asyncio.to_thread(bring, source, 3000 * i) for i, source in enumerate(sources)))
    for _ in range(10):  # what is over is served after the loop has had its turn
        await rig.drained()
    assert sorted(rig.seen) == list(range(12_000))


# Stops


async def test_a_stop_that_waits_makes_the_next_ones_of_its_robot_count_only(rig: Rig) -> None:
    for number in range(1000):
        rig.source.fold(number, PriorityClass.STOP)
    rig.another_source().fold("another robot's", PriorityClass.STOP)
    assert await rig.drained() == [0, "another robot's"]
    assert rig.metrics.total("bus_stops_folded") == 999

    def stop(number: int) -> None:
        rig.seen.append(number)
        if number < 3:
            source.fold(number + 1, PriorityClass.STOP)

    source = rig.inbox.source(stop)
    source.fold(1, PriorityClass.STOP)
    assert (await rig.drained())[2:] == [1, 2, 3], "one that comes while one is carried out is carried out after it"


# Failure and end


async def test_a_handler_that_fails_is_logged_and_the_next_item_comes(rig: Rig, caplog) -> None:
    rig.inbox.source(lambda value: 1 / value).put(0, PriorityClass.OTHER)
    rig.put([2])
    with caplog.at_level(logging.ERROR):
        assert await rig.drained() == [2]
    assert "ZeroDivisionError" in caplog.text


async def test_handlers_run_as_code_of_the_gateway_that_made_the_inbox_whoever_serves_it() -> None:
    robots, seen = ("r1", "r2"), list[str]()
    rigs = {}
    for robot in robots:
        token = current_robot.set(robot)
        rigs[robot] = Rig()
        current_robot.reset(token)
    for robot, made in rigs.items():
        source = made.inbox.source(lambda raw: seen.append(f"{raw} {current_robot.get()}"))
        source.put(f"stop of {robot}", PriorityClass.STOP)
    token = current_robot.set("r3")
    for made in rigs.values():
        made.inbox.attend()
    assert current_robot.get() == "r3"
    current_robot.reset(token)
    assert seen == ["stop of r1 r1", "stop of r2 r2"]


async def test_how_long_a_command_waits_and_is_handled_is_measured(rig: Rig) -> None:
    rig.put([1, 2], PriorityClass.OTHER)
    rig.put([3], PriorityClass.COMMAND)
    rig.put([4], PriorityClass.STOP)
    await rig.drained()
    counts = {name: value for (name, _), value in samples(rig.metrics.exposition()).items()}
    assert counts["zbridge_bus_to_socket_seconds_count"] == 2
    assert 0 < counts["zbridge_bus_to_socket_seconds_sum"] < 10


def test_an_item_for_a_loop_that_has_ended_is_no_error() -> None:
    async def make() -> Rig:
        return Rig()

    rig = asyncio.run(make())
    rig.put([1])
    assert rig.seen == []
