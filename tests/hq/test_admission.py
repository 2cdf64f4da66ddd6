"""Which connections a listener accepts."""

from hypothesis import given
from hypothesis import strategies as st

from tests.bounds import most_kept
from zbridge.hq.admission import Arrivals


@given(
    rate=st.sampled_from([0.5, 1.0, 3.0, 20.0]),
    waits=st.lists(st.sampled_from([0.0, 0.01, 0.1, 0.5, 1.0, 3.0]), max_size=200),
)
def test_so_many_are_let_in_within_a_second_and_no_more(rate: float, waits: list[float]) -> None:
    arrivals, now, admitted, most = Arrivals(rate), 0.0, list[float](), max(1, int(rate))
    for wait in waits:
        now += wait
        lately = sum(now - at < most / rate for at in admitted)
        assert arrivals.admit("a", now) is (lately < most)
        admitted += [now] * (lately < most)
    assert arrivals.admit("b", now)


def test_the_addresses_that_are_kept_are_bounded_and_a_busy_one_is_not_forgotten() -> None:
    arrivals = Arrivals(1.0, addresses=10)
    assert arrivals.admit("busy", 0.0)
    for number in range(1000):
        arrivals.admit(f"a{number}", 0.0)
        assert not arrivals.admit("busy", 0.5)
    assert most_kept(arrivals) == 10
