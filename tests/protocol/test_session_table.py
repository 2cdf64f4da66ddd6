"""The session table, and the delays between attempts to reach a lost peer."""

import random

import pytest

from tests.protocol.test_session import LIMITS, Toy
from zbridge.protocol.session_table import REMEMBERED, Backoff, ClientIds, SessionTable


def named(name: str) -> Toy:
    return Toy(LIMITS, name=name)


def test_a_session_shows_in_the_table_as_it_is_now_and_is_remembered_as_it_ended_behind_the_live_ones() -> None:
    table, first, second = SessionTable(), named("first"), named("second")
    table.add(first)
    table.add(second)
    assert [shown.state for shown in table.snapshots()] == ["connecting"] * 2
    first.open(0.0)
    assert table.snapshots()[0].state == "handshaking"
    first.lost("closed by peer")
    for removed in (first, first, named("stranger")):
        table.remove(removed)
    first.name = "changed"
    assert [(shown.name, shown.reason) for shown in table.snapshots()] == [
        ("second", None),
        ("first", "closed by peer"),
    ]
    assert repr(table) == "<SessionTable 1 live, 1 ended>"


def test_the_table_remembers_a_bounded_number_of_ended_sessions() -> None:
    table = SessionTable()
    for number in range(REMEMBERED + 5):
        session = named(str(number))
        table.add(session)
        table.remove(session)
    shown = table.snapshots()
    assert len(shown) == REMEMBERED
    assert [shown[0].name, shown[-1].name] == ["5", str(REMEMBERED + 4)]


class Middle(random.Random):
    """Always the middle of the range."""

    def uniform(self, a: float, b: float) -> float:
        return (a + b) / 2


def test_delays_double_up_to_the_most_and_a_reset_begins_anew() -> None:
    backoff = Backoff(0.5, 10.0, Middle())
    assert repr(backoff) == "<Backoff next 0.5 s>"
    assert [backoff.delay_s() for _ in range(7)] == [0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0]
    backoff.reset()
    assert backoff.delay_s() == 0.5


def test_delays_are_spread_by_a_quarter_either_way() -> None:
    backoff = Backoff(1.0, 1.0, random.Random(1))
    delays = [backoff.delay_s() for _ in range(500)]
    assert 0.75 <= min(delays) < 0.8
    assert 1.2 < max(delays) <= 1.25


def test_two_backoffs_do_not_march_in_step() -> None:
    assert Backoff().delay_s() != pytest.approx(Backoff().delay_s(), abs=1e-12)


def test_a_client_gets_the_lowest_id_that_is_free() -> None:
    ids = ClientIds(range(2, 256), quiet_s=2.0)
    assert [ids.take(0.0) for _ in range(3)] == [2, 3, 4]
    ids.release(3, 1.0)
    assert ids.take(2.9) == 5, "3 rests for two seconds"
    assert ids.take(3.0) == 3


def test_the_255th_client_gets_no_id() -> None:
    ids = ClientIds(range(2, 256), quiet_s=0.0)
    taken = [ids.take(0.0) for _ in range(254)]
    assert sorted(taken) == list(range(2, 256))
    assert ids.take(0.0) is None
    ids.release(77, 1.0)
    assert ids.take(1.0) == 77
