"""How much of a stream is read and passed on; the time is an argument."""

from __future__ import annotations

import pytest

from zbridge.camera.pace import BYTES_S, PICTURES_S, Pace, ReadBudget


def passed(rate_hz: float, every_s: float, count: int) -> tuple[list[int], int]:
    """Offer so many items at equal distances, and look at every deadline; give what was passed on, and the dropped."""
    pace, given = Pace[int](rate_hz), list[int]()

    def look(now: float) -> None:
        item = pace.due(now)
        given.extend([] if item is None else [item])

    for number in range(count):
        now = 100.0 + number * every_s
        while (deadline := pace.deadline()) is not None and deadline < now:
            look(deadline)
        pace.offer(number)
        look(now)
    if (deadline := pace.deadline()) is not None:
        look(deadline)
    return given, pace.dropped


@pytest.mark.parametrize(
    ("rate_hz", "every_s", "count", "given"),
    [(10.0, 0.25, 5, [0, 1, 2, 3, 4]), (10.0, 0.1, 50, list(range(50))), (5.0, 0.08, 5, [0, 1, 2, 4])],
    ids=["slower", "as fast", "faster"],
)
def test_no_more_than_the_rate_is_passed_on_and_the_newest_wins(rate_hz, every_s, count, given) -> None:
    assert passed(rate_hz, every_s, count) == (given, count - len(given))


def test_the_last_one_is_passed_on_also_when_none_follows() -> None:
    given, dropped = passed(1.0, 0.001, 1000)
    assert (given[-1], dropped) == (999, 1000 - len(given))


@pytest.mark.parametrize("flood", [(BYTES_S // 100, 0), (1, PICTURES_S // 100)], ids=["bytes", "pictures"])
def test_a_camera_that_sends_without_end_is_read_at_the_budget(flood: tuple[int, int]) -> None:
    budget, now, reads = ReadBudget(), 1000.0, 0
    while now < 1010.0:
        now += budget.pause_s(*flood, now) + 1e-6
        reads += 1
    per_second = 100 if flood[0] > 1 else PICTURES_S / (PICTURES_S // 100)
    assert reads == pytest.approx(11 * per_second, rel=0.02), "ten seconds, and the one that was saved"


def test_an_honest_camera_is_never_kept_waiting() -> None:
    budget = ReadBudget()
    assert all(budget.pause_s(300_000, 1, 1000.0 + number / 60) == 0 for number in range(600))
