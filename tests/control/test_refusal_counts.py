"""The refusals that ``control`` shows."""

from zbridge.control.refusal_counts import REFUSALS, RefusalCounts
from zbridge.control.wishes import NAMED
from zbridge.errors import Code, NotReady


def test_equal_refusals_are_counted_and_the_last_counted_is_shown_last() -> None:
    counts = RefusalCounts()
    counts.add("drive", NotReady("away"), "ann", None, 1)
    counts.add("mode", NotReady("away"), "ann", None, 1)
    shown = counts.add("drive", NotReady("away"), "ann", None, 3)
    assert (shown.command, shown.count, shown.code) == ("drive", 4, Code.NOT_READY)
    assert [(refusal.command, refusal.count) for refusal in counts.shown()] == [("mode", 1), ("drive", 4)]


def test_what_differs_in_anything_that_is_shown_is_counted_apart() -> None:
    counts = RefusalCounts()
    counts.add("drive", NotReady("away"), "ann", None, 1)
    counts.add("drive", NotReady("away"), "bob", None, 1)
    counts.add("drive", NotReady("away"), "ann", "hq.toy", 1)
    counts.add("drive", NotReady("gone"), "ann", None, 1)
    counts.add("drive", NotReady("away", Code.BUSY), "ann", None, 1)
    assert [refusal.count for refusal in counts.shown()] == [1] * 5


def test_a_new_refusal_replaces_the_one_that_was_counted_least_recently() -> None:
    counts = RefusalCounts()
    for number in range(REFUSALS + 1):
        counts.add(f"c{number}", NotReady("away"), None, None, 1)
    assert [refusal.command for refusal in counts.shown()] == [f"c{number}" for number in range(1, REFUSALS + 1)]


def test_names_and_reasons_are_shortened() -> None:
    shown = RefusalCounts().add("c" * 100, NotReady("r" * 300), "w" * 100, None, 1)
    assert (shown.command, shown.who, shown.reason) == ("c" * NAMED, "w" * NAMED, "r" * 200)
