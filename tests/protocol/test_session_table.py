"""The session table, the delays between attempts to reach a lost peer, and the ids of clients."""

import random

import pytest

from tests.protocol.test_session import LIMITS, Toy
from zbridge.protocol.session import Role
from zbridge.protocol.session_table import REMEMBERED, Backoff, ClientIds, SessionTable


def test_a_session_shows_in_the_table_as_it_is_now_and_is_remembered_as_it_ended_behind_the_live_ones() -> None:
    table, first, second = SessionTable(), Toy(LIMITS, name="first"), Toy(LIMITS, name="second")
    table.add(first)
    table.add(second)
    first.open(0.0)
    assert [shown.state for shown in table.snapshots()] == ["handshaking", "connecting"]
    first.fail("closed by peer")
    for removed in (first, first, Toy(LIMITS, name="stranger")):
        table.remove(removed)
    first.name = "changed"
    shown = [(entry.name, entry.reason) for entry in table.snapshots()]
    assert shown == [("second", None), ("first", "closed by peer")]


def test_the_table_remembers_a_bounded_number_of_ended_sessions() -> None:
    table = SessionTable()
    for number in range(REMEMBERED + 5):
        session = Toy(LIMITS, name=str(number))
        table.add(session)
        table.remove(session)
    assert [shown.name for shown in table.snapshots()] == [str(number) for number in range(5, REMEMBERED + 5)]


def test_what_sessions_carried_is_summed_but_for_what_they_had_carried_in_another_process() -> None:
    table, ours, taken_over = SessionTable(), Toy(LIMITS), Toy(LIMITS)
    taken_over.traffic.bytes_in = 1000
    for session in (ours, taken_over):
        table.add(session)
        session.traffic.bytes_in += 5
    other = {Role.HQ: Role.ROBOT, Role.ROBOT: Role.HQ}[ours.role]
    assert [table.carried(role).bytes_in for role in (ours.role, other)] == [10, 0]
    table.remove(taken_over)
    table.remove(taken_over)
    ours.traffic.bytes_in += 1
    assert table.carried(ours.role).bytes_in == 11


def test_delays_double_up_to_the_most_and_a_reset_begins_anew() -> None:
    backoff = Backoff(0.5, 10.0, lambda: 0.5)
    assert [backoff.delay_s() for _ in range(7)] == [0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0]
    backoff.reset()
    assert backoff.delay_s() == 0.5


def test_delays_are_spread_by_a_quarter_either_way_and_two_backoffs_do_not_march_in_step() -> None:
    backoff = Backoff(1.0, 1.0, random.Random(1).random)
    delays = [backoff.delay_s() for _ in range(500)]
    assert 0.75 <= min(delays) < 0.8
    assert 1.2 < max(delays) <= 1.25
    assert Backoff().delay_s() != pytest.approx(Backoff().delay_s(), abs=1e-12)


def test_a_client_gets_the_lowest_id_that_is_free_and_has_rested_and_the_255th_gets_none() -> None:
    ids = ClientIds(range(2, 256), quiet_s=2.0)
    assert [ids.take(0.0) for _ in range(254)] == list(range(2, 256))
    assert ids.take(0.0) is None
    ids.release(77, 1.0)
    ids.release(3, 1.0)
    ids.release(5, 1.0, rests=False)
    assert [ids.take(now) for now in (2.9, 2.9, 3.0, 3.0, 3.0)] == [5, None, 3, 77, None]
