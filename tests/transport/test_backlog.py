"""Since when bytes have waited for their acknowledgement."""

from zbridge.transport.backlog import ENTRIES, Backlog


def test_the_oldest_unacknowledged_write_counts_and_a_part_of_it_too() -> None:
    backlog = Backlog()
    backlog.settle(0)
    assert backlog.since is None
    for size, now in ((6, 1.0), (10, 2.0), (6, 3.0)):
        backlog.written(size, now)
    for outstanding, since in ((22, 1.0), (17, 1.0), (16, 2.0), (7, 2.0), (6, 3.0), (0, None)):
        backlog.settle(outstanding)
        assert backlog.since == since


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
    for outstanding, since in ((10 * ENTRIES - 1, 1.0), (1, float(ENTRIES - 1)), (0, None)):
        backlog.settle(outstanding)
        assert backlog.since == since


def test_a_write_has_waited_though_the_clock_has_not_moved_since() -> None:
    backlog = Backlog()
    assert backlog.waited_s(5.0) == 0.0
    backlog.written(6, 5.0)
    assert backlog.waited_s(5.0) > 0.0
    backlog.settle(0)
    assert backlog.waited_s(6.0) == 0.0
