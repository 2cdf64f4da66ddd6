"""How often something may happen."""

import math

from zbridge.protocol.rate_limit import RateLimit


def test_a_seconds_worth_may_happen_at_once_and_then_as_often_as_the_rate_says() -> None:
    allowance = RateLimit(4.0)
    assert [allowance.take(10.0) for _ in range(5)] == [True, True, True, True, False]
    assert [allowance.take(10.25) for _ in range(2)] == [True, False]
    assert [allowance.take(11.0) for _ in range(4)] == [True, True, True, False]


def test_a_long_rest_saves_up_no_more_than_a_second() -> None:
    allowance = RateLimit(2.0)
    assert [allowance.take(0.0) for _ in range(3)] == [True, True, False]
    assert [allowance.take(100.0) for _ in range(3)] == [True, True, False]


def test_an_infinite_rate_is_no_limit() -> None:
    allowance = RateLimit(math.inf)
    assert all(allowance.take(0.0) for _ in range(1000))
    assert allowance.fill(5.0) == math.inf
