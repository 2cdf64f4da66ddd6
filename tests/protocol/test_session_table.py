"""The session table, and the delays between attempts to reach a lost peer."""

import random

import pytest

from tests.protocol.test_session import LIMITS, Toy
from zbridge.protocol.session_table import REMEMBERED, Backoff, ClientIds, SessionTable


def named(name: str) -> Toy:
    return Toy(LIMITS, name=name)


def test_a_new_session_shows_in_the_table_as_it_is_now() -> None:
    manager = SessionTable()
    session = named("robot")
    manager.add(session)
    assert [shown.state for shown in manager.snapshots()] == ["connecting"]
    session.open(0.0)
    assert [shown.state for shown in manager.snapshots()] == ["handshaking"]


def test_an_ended_session_is_remembered_behind_the_live_ones() -> None:
    manager = SessionTable()
    first, second = named("first"), named("second")
    manager.add(first)
    manager.add(second)
    first.lost("closed by peer")
    manager.remove(first)
    assert [(shown.name, shown.reason) for shown in manager.snapshots()] == [
        ("second", None),
        ("first", "closed by peer"),
    ]


def test_an_ended_session_no_longer_changes() -> None:
    manager = SessionTable()
    session = named("robot")
    manager.add(session)
    session.lost("closed by peer")
    manager.remove(session)
    session.name = "changed"
    assert manager.snapshots()[0].name == "robot"


def test_the_table_remembers_a_bounded_number_of_ended_sessions() -> None:
    manager = SessionTable()
    for number in range(REMEMBERED + 5):
        session = named(str(number))
        manager.add(session)
        manager.remove(session)
    shown = manager.snapshots()
    assert len(shown) == REMEMBERED
    assert [shown[0].name, shown[-1].name] == ["5", str(REMEMBERED + 4)]


def test_removing_a_session_twice_or_one_never_added_does_no_harm() -> None:
    manager = SessionTable()
    session = named("robot")
    manager.add(session)
    manager.remove(session)
    manager.remove(session)
    manager.remove(named("stranger"))
    assert len(manager.snapshots()) == 1


def test_a_manager_prints_its_numbers() -> None:
    manager = SessionTable()
    manager.add(named("robot"))
    assert repr(manager) == "<SessionTable 1 live, 0 ended>"


class Middle(random.Random):
    """Always the middle of the range."""

    def uniform(self, a: float, b: float) -> float:
        return (a + b) / 2


def test_delays_double_up_to_the_most_and_stay_there() -> None:
    backoff = Backoff(0.5, 10.0, Middle())
    assert [backoff.delay_s() for _ in range(7)] == [0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0]


def test_a_reset_begins_anew() -> None:
    backoff = Backoff(0.5, 10.0, Middle())
    for _ in range(5):
        backoff.delay_s()
    backoff.reset()
    assert backoff.delay_s() == 0.5


def test_delays_are_spread_by_a_quarter_either_way() -> None:
    backoff = Backoff(1.0, 1.0, random.Random(1))
    delays = [backoff.delay_s() for _ in range(500)]
    assert 0.75 <= min(delays) < 0.8
    assert 1.2 < max(delays) <= 1.25


def test_a_backoff_prints_its_next_delay() -> None:
    assert repr(Backoff(0.5)) == "<Backoff next 0.5 s>"


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
