"""What a program may ask for with a lease."""

import math

import pytest

from zbridge.control.wishes import LEAST_S, capped, name_of
from zbridge.errors import Malformed
from zbridge.fleet.messages import Acquire
from zbridge.lease.lease_events import NAMED


@pytest.mark.parametrize(("wish_s", "granted_s"), [(None, 3.0), (LEAST_S, LEAST_S), (1.0, 1.0), (math.inf, 3.0)])
def test_a_wish_is_granted_up_to_the_most_which_is_also_the_default(wish_s: float | None, granted_s: float) -> None:
    assert capped("lease_s", wish_s, 3.0) == granted_s


@pytest.mark.parametrize("wish_s", [0.0, -1.0, math.nextafter(LEAST_S, 0), math.nan, -math.inf])
def test_what_is_no_time_is_malformed(wish_s: float) -> None:
    with pytest.raises(Malformed, match=r"lease_s = .*: expected at least 0.01"):
        capped("lease_s", wish_s, 3.0)


@pytest.mark.parametrize("who", ["", "two\nlines", "\x00\x1b[2J", "\u2028", "\u202e", "a" * 100 + "\n"])
def test_a_name_is_shortened_and_one_that_people_cannot_be_shown_is_refused_without_printing_it(who: str) -> None:
    assert name_of(Acquire(who="a" * 100)) == "a" * NAMED
    with pytest.raises(Malformed, match="expected a name that others are shown") as error:
        name_of(Acquire(who=who))
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 400
