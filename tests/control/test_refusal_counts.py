"""The refusals that ``control`` shows."""

from zbridge.control.refusal_counts import REFUSALS, RefusalCounts
from zbridge.errors import Code, NotReady
from zbridge.lease.lease_events import NAMED


def test_equal_refusals_are_counted_what_differs_in_anything_is_counted_apart_and_the_newest_is_last() -> None:
    counts, away = RefusalCounts(), NotReady("away")
    for command, refusal, who, by, count in (
        ("drive", away, "ann", None, 1),
        ("mode", away, "ann", None, 1),
        ("drive", away, "bob", None, 1),
        ("drive", away, "ann", "hq.toy", 1),
        ("drive", NotReady("gone"), "ann", None, 1),
        ("drive", NotReady("away", Code.BUSY), "ann", None, 1),
        ("drive", away, "ann", None, 3),
    ):
        shown = counts.add(command, refusal, who, by, count)
    assert (shown.command, shown.count, shown.code) == ("drive", 4, Code.NOT_READY)
    assert [refusal.count for refusal in counts.shown()] == [1, 1, 1, 1, 1, 4]
    assert counts.shown()[-1] == shown


def test_a_new_refusal_replaces_the_one_that_was_counted_least_recently() -> None:
    counts = RefusalCounts()
    for number in range(2 * REFUSALS):
        counts.add("always", NotReady("away"), None, None, 1)
        counts.add(f"c{number}", NotReady("away"), None, None, 1)
    last = [f"c{number}" for number in range(REFUSALS + 1, 2 * REFUSALS)]
    assert [refusal.command for refusal in counts.shown()] == [*last[:-1], "always", last[-1]]


def test_names_and_reasons_are_shortened() -> None:
    shown = RefusalCounts().add("c" * 100, NotReady("r" * 300), "w" * 100, None, 1)
    assert (shown.command, shown.who, shown.reason) == ("c" * NAMED, "w" * NAMED, "r" * 200)
