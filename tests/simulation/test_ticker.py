"""The rhythm of a simulated peer, on a loop whose sleeps are recorded and whose clock is set by hand."""

from __future__ import annotations

import asyncio
import time

import pytest

from zbridge.simulation.ticker import Ticker


class Clock:
    """Monotonic time that passes in sleeps alone, each ``late_s`` longer than wished."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.late_s = 0.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now)
        monkeypatch.setattr(asyncio, "sleep", self._sleep)

    async def _sleep(self, seconds: float) -> None:
        self.now += max(0.0, seconds) + self.late_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


async def ticks(ticker: Ticker, clock: Clock, count: int) -> list[float]:
    at = []
    for _ in range(count):
        await ticker.tick()
        at.append(round(clock.now - 100.0, 6))
    return at


async def test_it_ticks_every_period(clock: Clock) -> None:
    assert await ticks(Ticker(0.5), clock, 3) == [0.5, 1.0, 1.5]


async def test_the_first_tick_may_come_at_once(clock: Clock) -> None:
    assert await ticks(Ticker(0.5, first_s=0.0), clock, 3) == [0.0, 0.5, 1.0]


async def test_time_spent_between_two_ticks_does_not_put_off_the_next(clock: Clock) -> None:
    ticker = Ticker(0.5)
    await ticker.tick()
    clock.now += 0.4
    await ticker.tick()
    assert clock.now == pytest.approx(101.0)
    assert ticker.passed_s == pytest.approx(0.5)


async def test_a_late_tick_puts_off_the_later_ones_and_says_how_late_it_was(clock: Clock) -> None:
    ticker = Ticker(0.5)
    await ticker.tick()
    clock.now += 2.0
    assert await ticks(ticker, clock, 2) == [2.5, 3.0]
    clock.late_s = 0.25
    await ticker.tick()
    assert (ticker.late_s, ticker.passed_s) == (pytest.approx(0.25), pytest.approx(0.75))


async def test_lost_time_can_be_made_up_for_within_a_bound(clock: Clock) -> None:
    ticker = Ticker(0.5, catch_up_s=1.0)
    await ticker.tick()
    clock.now += 10.0
    assert await ticks(ticker, clock, 4) == [10.5, 10.5, 10.5, 11.0]
