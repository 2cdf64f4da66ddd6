"""When simulated peers act and read, and how late they were: a clock set by hand, and pairs of sockets."""

import asyncio
import queue
import socket
import time
from typing import Any

import pytest

from zbridge.simulation.timing import PollingReader, Read, ReadingThread, Ticker

SOON_S = 5.0


class Clock:
    """Monotonic time that passes in sleeps alone, each ``late_s`` longer than wished."""

    now, late_s = 100.0, 0.0

    async def sleep(self, seconds: float) -> None:
        self.now += max(0.0, seconds) + self.late_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", lambda: clock.now)
    monkeypatch.setattr(asyncio, "sleep", clock.sleep)
    return clock


@pytest.mark.parametrize(
    ("options", "spent_s", "ticks_s"),
    [
        ({}, 0.0, [0.5, 1.0, 1.5]),
        ({"first_s": 0.0}, 0.0, [0.0, 0.5, 1.0]),
        ({}, 0.4, [0.5, 1.0, 1.5]),
        ({}, 2.0, [0.5, 2.5, 3.0]),
        ({"catch_up_s": 1.0}, 10.0, [0.5, 10.5, 10.5, 10.5, 11.0]),
    ],
    ids=[
        *("every period", "the first at once", "time spent does not put off the next"),
        *("a late one puts off the later ones", "lost time is made up for within a bound"),
    ],
)
async def test_it_ticks_although_time_is_spent_after_the_first(clock: Clock, options: Any, spent_s, ticks_s) -> None:
    ticker, at = Ticker(0.5, **options), []
    for _ in ticks_s:
        await ticker.tick()
        at.append(round(clock.now - 100.0, 6))
        clock.now += spent_s if len(at) == 1 else 0.0
    assert at == ticks_s


async def test_it_says_how_late_it_was_and_how_much_time_passed(clock: Clock) -> None:
    ticker = Ticker(0.5)
    await ticker.tick()
    clock.now, clock.late_s = clock.now + 0.4, 0.25
    await ticker.tick()
    assert (ticker.late_s, ticker.passed_s) == (pytest.approx(0.25), pytest.approx(0.75))


def test_each_read_is_given_up_to_the_end_of_the_stream_and_data_that_waited_unread_makes_the_reader_late() -> None:
    reads: queue.Queue[Read] = queue.Queue()
    ours, theirs = socket.socketpair()
    with ours, theirs:
        reader = ReadingThread(ours, time.time() - 0.5, reads.put)
        theirs.send(b"one")
        reader.start()
        first = reads.get(timeout=SOON_S)
        assert first.data == b"one"
        assert first.late_s >= 0.5
        theirs.send(b"two")
        second = reads.get(timeout=SOON_S)
        assert (second.data, second.why) == (b"two", "")
        theirs.close()
        assert reads.get(timeout=SOON_S).data == b""
        reader.join(SOON_S)
        assert not reader.is_alive()


def test_a_reader_that_polls_tells_since_when_it_had_not_looked(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setblocking(False)
        reader = PollingReader(ours, 4)
        now = 100.5
        assert reader.poll() is None
        theirs.send(b"sixsix")
        now = 100.75
        assert (reader.poll(), reader.unread_s) == (b"sixs", 0.25)
        now = 101.0
        assert (reader.poll(), reader.unread_s) == (b"ix", 0.5), "after a full read nothing was known to be empty"
        theirs.close()
        now = 101.25
        assert (reader.poll(), reader.unread_s) == (b"", 0.25)
