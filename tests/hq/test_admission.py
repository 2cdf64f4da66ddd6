"""Which connections a listener accepts."""

from hypothesis import given
from hypothesis import strategies as st

from zbridge.hq.admission import Arrivals


def test_so_many_are_let_in_in_a_second_and_no_more() -> None:
    arrivals = Arrivals(20.0)
    assert [arrivals.admit("a", 10.0 + number / 1000) for number in range(25)] == [True] * 20 + [False] * 5
    assert not arrivals.admit("a", 10.999)
    assert arrivals.admit("a", 11.0)
    assert not arrivals.admit("a", 11.0)


def test_each_address_counts_for_itself() -> None:
    arrivals = Arrivals(1.0)
    assert [arrivals.admit(address, 0.0) for address in ("a", "a", "b", "b")] == [True, False, True, False]


def test_a_rate_below_one_is_one_in_so_many_seconds() -> None:
    arrivals = Arrivals(0.5)
    assert [arrivals.admit("a", now) for now in (0.0, 1.0, 1.9, 2.0, 3.9)] == [True, False, False, True, False]


@given(
    rate=st.sampled_from([0.5, 1.0, 3.0, 20.0]),
    waits=st.lists(st.sampled_from([0.0, 0.01, 0.1, 0.5, 1.0, 3.0]), max_size=200),
)
def test_within_no_second_are_there_more_than_so_many(rate: float, waits: list[float]) -> None:
    arrivals, now, admitted = Arrivals(rate), 0.0, []
    for wait in waits:
        now += wait
        if arrivals.admit("a", now):
            admitted.append(now)
    most = max(1, int(rate))
    for first in range(len(admitted) - most):
        assert admitted[first + most] - admitted[first] >= most / rate


def test_the_addresses_that_are_kept_are_bounded_and_a_busy_one_is_not_forgotten() -> None:
    arrivals = Arrivals(1.0, addresses=10)
    assert arrivals.admit("busy", 0.0)
    for number in range(1000):
        arrivals.admit(f"a{number}", 0.0)
        assert not arrivals.admit("busy", 0.5)
    assert repr(arrivals) == "<Arrivals of 10 addresses, 1 in 1 s each>"
