"""How often something may happen."""

import math

from zbridge.protocol.rate_limit import RateLimit


def test_a_seconds_worth_may_happen_at_once_and_then_as_often_as_the_rate_says_and_a_rest_saves_up_no_more() -> None:
    allowance = RateLimit(4.0)
    for now, taken in ((10.0, 4), (10.25, 1), (11.0, 3), (100.0, 4)):
        assert [allowance.take(now) for _ in range(taken + 1)] == [True] * taken + [False]


def test_an_infinite_rate_is_no_limit() -> None:
    allowance = RateLimit(math.inf)
    assert all(allowance.take(0.0) for _ in range(1000))
    assert allowance.fill(5.0) == math.inf
