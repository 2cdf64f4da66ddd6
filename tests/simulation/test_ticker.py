"""The rhythm of a simulated peer, on a loop whose sleeps are recorded and whose clock is set by hand."""

import asyncio
import time
from typing import Any

import pytest

from zbridge.simulation.ticker import Ticker


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
