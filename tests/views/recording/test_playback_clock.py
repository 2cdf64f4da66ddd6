"""The time of a recording: runs at its speed, rests, jumps, ends."""

from zbridge.views.recording.player import PlaybackClock

S = 10**9


def test_it_rests_at_the_begin_and_runs_at_the_speed_it_is_told() -> None:
    clock = PlaybackClock(10 * S, 30 * S)
    assert clock.now_ns(5.0) == 10 * S
    clock.play(2.0, 100.0)
    assert clock.now_ns(101.5) == 13 * S
    assert clock.wait_s(15 * S, 101.5) == 1.0
    clock.play(0.5, 102.0)
    assert clock.now_ns(104.0) == 15 * S


def test_it_rests_where_it_is_paused_and_jumps_where_it_is_told() -> None:
    clock = PlaybackClock(10 * S, 30 * S)
    clock.play(1.0, 0.0)
    clock.pause(3.0)
    assert clock.now_ns(50.0) == 13 * S
    clock.seek(20 * S, 60.0)
    assert (clock.now_ns(70.0), clock.playing) == (20 * S, False)
    clock.play(1.0, 70.0)
    clock.seek(5 * S, 71.0)
    assert clock.now_ns(72.0) == 11 * S
    clock.seek(99 * S, 73.0)
    assert clock.now_ns(74.0) == 30 * S


def test_it_ends_at_the_end_and_begins_anew_when_it_is_played_again() -> None:
    clock = PlaybackClock(10 * S, 12 * S)
    clock.play(1.0, 0.0)
    assert clock.now_ns(9.0) == 12 * S
    clock.pause(9.0)
    assert clock.ended
    clock.play(1.0, 20.0)
    assert clock.now_ns(21.0) == 11 * S
