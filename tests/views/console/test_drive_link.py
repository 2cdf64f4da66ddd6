"""What a page commands counts once, while it is fresh, and after neutral where something happened in between."""

from __future__ import annotations

import math
import random

import pytest

from zbridge.views.console.drive_link import (
    BRIDGE_S,
    FRESH_S,
    GAP_S,
    SILENT_S,
    TICK_S,
    UNANSWERED,
    DriveLink,
    Drop,
    Due,
    PageCommand,
    PageVerdict,
)

NOTHING = PageVerdict()
STALLED = PageVerdict(Drop.STALE, "the connection to this page stalled")


class Page:
    """A page that answers ticks, and whose time a test says."""

    def __init__(self) -> None:
        self.now, self.seq = 100.0, 0
        self.link = DriveLink(self.now)
        self.last_tick = self.tick()

    def tick(self) -> int:
        number = self.link.tick(self.now)
        assert number is not None
        return number

    def command(self, forward: float = 0.5, *, tick: int | None = None, **fields: object) -> PageCommand:
        self.seq += 1
        return PageCommand(self.seq, self.last_tick if tick is None else tick, forward=forward, **fields)  # type: ignore[arg-type]

    def send(self, forward: float = 0.5, **fields: object) -> PageVerdict:
        """Send a command, which the robot is sent if it is accepted."""
        self.link.heard(self.now)
        command = self.command(forward, **fields)  # type: ignore[arg-type]
        verdict = self.link.take(command, self.now)
        if verdict == NOTHING:
            self.link.sent(moving=command.moving)
        return verdict

    def pass_time(self, seconds: float) -> None:
        """Let time pass, with ticks and commands as usual."""
        for _ in range(round(seconds / TICK_S)):
            self.now += TICK_S
            self.last_tick = self.tick()
            self.send()


def test_fresh_commands_in_order_are_accepted() -> None:
    page = Page()
    page.pass_time(5.0)
    assert page.send() == NOTHING
    assert page.link.acknowledged == (page.seq, page.now)


def test_a_command_is_as_old_as_the_tick_that_it_names() -> None:
    page = Page()
    first = page.last_tick
    page.pass_time(FRESH_S)
    assert page.send(tick=first) == NOTHING
    page.now += 0.001
    assert page.send(tick=first) == STALLED
    page.pass_time(10.0)
    assert page.send(tick=first) == STALLED, "a tick that was forgotten is old"


def test_a_burst_after_a_stall_is_dropped_whole() -> None:
    page = Page()
    burst = [page.command() for _ in range(60)]
    page.now += 3.0
    assert {page.link.take(command, page.now) for command in burst} == {STALLED}


def test_a_command_counts_once_and_in_order() -> None:
    page = Page()
    one, other = page.command(), page.command()
    assert page.link.take(other, page.now) == NOTHING
    for late in (one, other):
        assert page.link.take(late, page.now) == PageVerdict(Drop.REPEATED)


def test_a_tick_that_was_never_sent_is_refused() -> None:
    page = Page()
    verdict = page.send(tick=page.last_tick + 1)
    assert (verdict.drop, bool(verdict.centre)) == (Drop.UNKNOWN_TICK, True)


def test_ticks_do_not_collect_in_a_connection_that_stalls() -> None:
    page = Page()
    sent = [page.link.tick(page.now) for _ in range(100)]
    assert sum(number is not None for number in sent) == UNANSWERED - 1
    newest = max(number for number in sent if number is not None)
    page.send(tick=newest)
    assert page.link.tick(page.now) == newest + 1


def test_a_moving_robot_is_sent_neutral_after_the_bridge_and_once() -> None:
    page = Page()
    page.send()
    assert page.link.deadline() == page.now + BRIDGE_S
    assert page.link.expire(page.now + BRIDGE_S - 0.001) is None
    assert page.link.expire(page.now + BRIDGE_S) is Due.NEUTRAL
    page.link.sent(moving=False)
    assert page.link.expire(page.now + BRIDGE_S + 0.1) is None
    assert page.link.deadline() == page.now + SILENT_S


def test_a_robot_that_stands_is_sent_nothing_and_a_silent_page_loses_control() -> None:
    page = Page()
    page.send(forward=0.0)
    assert page.link.expire(page.now + SILENT_S - 0.001) is None
    assert page.link.expire(page.now + SILENT_S) is Due.SILENT


@pytest.mark.parametrize(("silence_s", "centre"), [(GAP_S, False), (GAP_S + 0.01, True)])
def test_after_a_gap_neutral_comes_first(silence_s: float, centre: bool) -> None:
    page = Page()
    page.send()
    page.now += silence_s
    page.last_tick = page.tick()
    verdict = page.send()
    assert (verdict.drop, verdict.centre is not None) == (None, centre)


@pytest.mark.parametrize(
    ("why", "text"), [("focus", "the page was out of focus"), ("gamepad", "the gamepads have changed")]
)
def test_regained_focus_and_changed_gamepads_need_neutral_once(why: str, text: str) -> None:
    page = Page()
    page.send(epoch=3)
    assert page.send(epoch=4, why=why) == PageVerdict(centre=text)
    assert page.send(epoch=4, why=why) == NOTHING


def test_dropped_commands_are_no_sign_of_a_page_that_steers() -> None:
    page = Page()
    page.send()
    began, old = page.now, page.last_tick
    page.now += FRESH_S
    for _ in range(20):
        page.now += 0.1
        page.send(tick=old)
    assert page.link.deadline() == began + BRIDGE_S


def test_random_commands_never_count_twice_nor_while_old() -> None:
    chance = random.Random(1)
    link, now, sent, seen = DriveLink(0.0), 0.0, dict[int, float](), set[int]()
    for _ in range(10_000):
        now += chance.expovariate(20.0)
        if (tick := link.tick(now)) is not None:
            sent[tick] = now
        command = PageCommand(chance.randrange(5000), chance.randrange(len(sent) + 2), forward=0.1)
        verdict = link.take(command, now)
        if verdict.drop is None:
            assert command.seq not in seen
            assert command.seq > max(seen, default=-1)
            assert now - sent[command.tick] <= FRESH_S
            seen.add(command.seq)
        link.sent(moving=verdict.drop is None)
        link.expire(now)
        assert link.deadline() > -math.inf
    assert seen
