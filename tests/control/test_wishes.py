"""What a program may ask for with a lease."""

import pytest

from zbridge.control.wishes import LEAST_S, NAMED, capped, name_of
from zbridge.errors import Malformed
from zbridge.fleet.messages import Acquire


@pytest.mark.parametrize(
    ("wish_s", "granted_s"), [(None, 3.0), (LEAST_S, LEAST_S), (1.0, 1.0), (3.0, 3.0), (10.0, 3.0), (float("inf"), 3.0)]
)
def test_a_wish_is_granted_up_to_the_most_which_is_also_the_default(wish_s: float | None, granted_s: float) -> None:
    assert capped("lease_s", wish_s, 3.0) == granted_s


@pytest.mark.parametrize("wish_s", [0.0, -1.0, LEAST_S / 2, float("nan"), float("-inf")])
def test_what_is_no_time_is_malformed(wish_s: float) -> None:
    with pytest.raises(Malformed, match=r"lease_s = .*: expected at least 0.01"):
        capped("lease_s", wish_s, 3.0)


def test_a_name_is_shortened() -> None:
    assert name_of(Acquire(who="a" * 100)) == "a" * NAMED


@pytest.mark.parametrize("who", ["", "a\nb", "\x00"])
def test_a_name_that_people_cannot_be_shown_is_malformed(who: str) -> None:
    with pytest.raises(Malformed, match="expected a name that others are shown"):
        name_of(Acquire(who=who))
