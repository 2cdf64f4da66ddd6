"""Requests for the lease, and the refusals that ``control`` shows."""

import math

import pytest

from zbridge.control.requests import LEAST_S, REFUSALS, RefusalCounts, capped, name_of
from zbridge.errors import Code, Malformed, NotReady
from zbridge.fleet.lease_messages import Acquire
from zbridge.lease.lease_events import NAMED


@pytest.mark.parametrize(("requested_s", "granted_s"), [(None, 3.0), (LEAST_S, LEAST_S), (1.0, 1.0), (math.inf, 3.0)])
def test_a_time_is_granted_up_to_the_most_which_is_the_default(requested_s: float | None, granted_s: float) -> None:
    assert capped("lease_s", requested_s, 3.0) == granted_s


@pytest.mark.parametrize("requested_s", [0.0, -1.0, math.nextafter(LEAST_S, 0), math.nan, -math.inf])
def test_what_is_no_time_is_malformed(requested_s: float) -> None:
    with pytest.raises(Malformed, match=r"lease_s = .*: expected at least 0.01"):
        capped("lease_s", requested_s, 3.0)


@pytest.mark.parametrize("who", ["", "two\nlines", "\x00\x1b[2J", "\u2028", "\u202e", "a" * 100 + "\n"])
def test_a_name_is_shortened_and_one_that_people_cannot_be_shown_is_refused_without_printing_it(who: str) -> None:
    assert name_of(Acquire(who="a" * 100)) == "a" * NAMED
    with pytest.raises(Malformed, match="expected a name that others are shown") as error:
        name_of(Acquire(who=who))
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 400


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
