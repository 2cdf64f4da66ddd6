"""Since when bytes have waited for their acknowledgement."""

from zbridge.transport.backlog import ENTRIES, Backlog


def test_nothing_written_waits_for_nothing() -> None:
    backlog = Backlog()
    assert backlog.since is None
    backlog.settle(0)
    assert backlog.since is None


def test_the_oldest_unacknowledged_write_counts_and_a_part_of_it_too() -> None:
    backlog = Backlog()
    backlog.written(6, 1.0)
    backlog.written(10, 2.0)
    backlog.written(6, 3.0)
    backlog.settle(22)
    assert backlog.since == 1.0
    backlog.settle(17)  # a byte of the first is acknowledged
    assert backlog.since == 1.0
    backlog.settle(16)
    assert backlog.since == 2.0
    backlog.settle(7)
    assert backlog.since == 2.0
    backlog.settle(6)
    assert backlog.since == 3.0
    backlog.settle(0)
    assert backlog.since is None


def test_a_steady_stream_that_is_acknowledged_late_is_never_old() -> None:
    backlog = Backlog()
    for number in range(100):
        now = number * 0.02
        backlog.written(10, now)
        backlog.settle(20)  # the last two are always under way
        assert backlog.since is not None
        assert now - backlog.since <= 0.0201


def test_what_is_kept_is_bounded_and_the_oldest_stays_true() -> None:
    backlog = Backlog()
    for number in range(10 * ENTRIES):
        backlog.written(1, float(number))
    assert backlog.since == 0.0
    backlog.settle(10 * ENTRIES - 1)
    assert backlog.since == 1.0
    backlog.settle(1)
    assert backlog.since == float(ENTRIES - 1)
    backlog.settle(0)
    assert backlog.since is None
