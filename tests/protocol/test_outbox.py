"""The outbox: one frame at a time, spaced, bounded, the newest motion first."""

import math

import pytest

from zbridge.errors import Refused
from zbridge.protocol.outbox import LIMIT, Outbox


def drained(outbox: Outbox, start: float, end: float) -> list[tuple[float, bytes]]:
    """Take what comes from ``start`` to ``end``, asking exactly at the deadlines."""
    taken = []
    now = start
    while now <= end:
        frame = outbox.take(now)
        if frame is not None:
            taken.append((round(now, 6), frame))
            continue
        deadline = outbox.deadline()
        if deadline is None:
            break
        assert deadline > now, "a deadline that has passed must yield a frame"
        now = deadline
    return taken


def frames(taken: list[tuple[float, bytes]]) -> list[bytes]:
    return [frame for _, frame in taken]


def test_an_empty_outbox_has_neither_frame_nor_deadline() -> None:
    outbox = Outbox(0.01)
    assert outbox.take(0.0) is None
    assert outbox.deadline() is None
    assert len(outbox) == 0


def test_queued_frames_leave_in_order_with_the_gap_between_them() -> None:
    outbox = Outbox(0.01)
    for frame in (b"a", b"b", b"c"):
        outbox.put(frame)
    assert len(outbox) == 3
    assert drained(outbox, 5.0, 6.0) == [(5.0, b"a"), (5.01, b"b"), (5.02, b"c")]


def test_nothing_leaves_within_the_gap() -> None:
    outbox = Outbox(0.01)
    outbox.put(b"a")
    outbox.put(b"b")
    assert outbox.take(0.0) == b"a"
    assert outbox.take(0.0) is None
    assert outbox.take(0.0099) is None
    assert outbox.deadline() == 0.01
    assert outbox.take(0.01) == b"b"


def test_the_gap_counts_from_the_frame_before_even_after_the_outbox_was_empty() -> None:
    outbox = Outbox(0.01)
    outbox.put(b"a")
    assert outbox.take(0.0) == b"a"
    outbox.put(b"b")
    assert outbox.take(0.005) is None
    assert outbox.take(0.01) == b"b"


def test_without_a_gap_all_frames_leave_at_once() -> None:
    outbox = Outbox(0.0)
    outbox.put(b"a")
    outbox.put(b"b")
    assert [outbox.take(1.0), outbox.take(1.0), outbox.take(1.0)] == [b"a", b"b", None]


def test_one_frame_too_many_is_refused_and_the_others_stay() -> None:
    outbox = Outbox(0.0, limit=2)
    outbox.put(b"a")
    outbox.put(b"b")
    with pytest.raises(Refused, match="2 packets"):
        outbox.put(b"c")
    assert frames(drained(outbox, 0.0, 1.0)) == [b"a", b"b"]


def test_the_default_limit_is_stated() -> None:
    outbox = Outbox(0.0)
    for _ in range(LIMIT):
        outbox.put(b"a")
    with pytest.raises(Refused):
        outbox.put(b"b")


def test_a_standing_frame_without_period_is_sent_once() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"d",), 1.0)
    assert drained(outbox, 1.0, 100.0) == [(1.0, b"d")]
    assert outbox.deadline() is None


def test_a_standing_frame_is_repeated_every_period_without_end() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"d",), 1.0, period_s=0.25)
    assert drained(outbox, 1.0, 2.1) == [(1.0, b"d"), (1.25, b"d"), (1.5, b"d"), (1.75, b"d"), (2.0, b"d")]
    assert outbox.deadline() == 2.25


def test_a_standing_frame_is_repeated_until_its_end_and_then_forgotten() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"s",), 1.0, period_s=0.25, until=2.0)
    assert drained(outbox, 1.0, 9.0) == [(1.0, b"s"), (1.25, b"s"), (1.5, b"s"), (1.75, b"s"), (2.0, b"s")]
    assert outbox.deadline() is None


def test_a_newer_standing_frame_replaces_the_one_that_waits() -> None:
    outbox = Outbox(0.01)
    outbox.put(b"text")
    assert outbox.take(0.0) == b"text"
    outbox.set("motion", (b"old",), 0.001)
    outbox.set("motion", (b"new",), 0.002)
    assert drained(outbox, 0.002, 1.0) == [(0.01, b"new")]


def test_replacing_a_repeated_frame_ends_its_repetition() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"drive",), 0.0, period_s=0.25)
    assert outbox.take(0.0) == b"drive"
    outbox.set("motion", (b"stop",), 0.125, period_s=0.125, until=0.375)
    assert frames(drained(outbox, 0.125, 9.0)) == [b"stop", b"stop", b"stop"]


def test_a_new_command_is_sent_at_once_although_its_predecessor_was_just_repeated() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"one",), 0.0, period_s=0.25)
    assert outbox.take(0.0) == b"one"
    outbox.set("motion", (b"two",), 0.05, period_s=0.25)
    assert outbox.take(0.05) == b"two"


def test_slots_are_independent() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"m",), 0.0)
    outbox.set("light", (b"l",), 0.0)
    assert sorted(frames(drained(outbox, 0.0, 1.0))) == [b"l", b"m"]


def test_a_cleared_slot_is_forgotten_and_clearing_twice_does_no_harm() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"d",), 0.0, period_s=0.25)
    outbox.clear("motion")
    outbox.clear("motion")
    assert outbox.take(0.0) is None
    assert outbox.deadline() is None


def test_a_group_is_sent_whole_with_the_gap_inside_and_then_repeated() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"move", b"turn"), 0.0, period_s=0.25)
    assert drained(outbox, 0.0, 0.3) == [(0.0, b"move"), (0.01, b"turn"), (0.26, b"move"), (0.27, b"turn")]


def test_an_urgent_frame_goes_before_everything_that_waits_but_keeps_the_gap() -> None:
    outbox = Outbox(0.01)
    for frame in (b"a", b"b", b"c"):
        outbox.put(frame)
    outbox.set("motion", (b"drive",), 0.0, period_s=0.25)
    first = outbox.take(0.0)
    outbox.set("motion", (b"stop",), 0.001, urgent=True)
    assert first in (b"a", b"drive")
    assert outbox.take(0.002) is None
    assert outbox.take(0.01) == b"stop"


def test_an_urgent_frame_beats_the_due_frame_of_another_slot() -> None:
    outbox = Outbox(0.0)
    outbox.set("light", (b"l",), 0.0)
    outbox.set("motion", (b"stop",), 0.5, urgent=True)
    assert outbox.take(1.0) == b"stop"
    assert outbox.take(1.0) == b"l"


def test_an_urgent_frame_leaves_once_before_whatever_replaces_it() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"drive",), 0.0, period_s=0.25)
    assert outbox.take(0.0) == b"drive"
    outbox.set("motion", (b"stop",), 0.001, period_s=0.1, until=1.001, urgent=True)
    outbox.set("motion", (b"neutral",), 0.002)
    outbox.set("motion", (b"drive on",), 0.003)
    assert len(outbox) == 1
    assert drained(outbox, 0.003, 1.0) == [(0.01, b"stop"), (0.02, b"drive on")]


def test_an_urgent_frame_leaves_although_its_slot_is_cleared() -> None:
    outbox = Outbox(0.0)
    outbox.set("motion", (b"stop",), 0.0, period_s=0.1, urgent=True)
    outbox.clear("motion")
    assert drained(outbox, 0.0, 1.0) == [(0.0, b"stop")]


def test_an_urgent_frame_that_waits_already_waits_once() -> None:
    outbox = Outbox(0.01)
    outbox.put(b"a")
    assert outbox.take(0.0) == b"a"
    for _ in range(10):
        outbox.set("motion", (b"stop",), 0.001, urgent=True)
    assert frames(drained(outbox, 0.001, 1.0)) == [b"stop"]


def test_urgent_frames_of_two_slots_both_leave_in_order() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"stop",), 0.0, urgent=True)
    outbox.set("arm", (b"hold",), 0.0, urgent=True)
    outbox.set("motion", (b"stop",), 0.0, urgent=True)
    assert frames(drained(outbox, 0.0, 1.0)) == [b"stop", b"hold"]


def test_an_urgent_frame_is_the_first_of_its_repetitions() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"stop",), 1.0, period_s=0.25, until=2.0, urgent=True)
    assert [at for at, _ in drained(outbox, 1.0, 9.0)] == [1.0, 1.25, 1.5, 1.75, 2.0]
    assert outbox.deadline() is None


@pytest.mark.parametrize("group", [(b"stop",), (b"none", b"stop")])
def test_an_urgent_group_that_stands_until_now_is_sent_exactly_once(group: tuple[bytes, ...]) -> None:
    outbox = Outbox(0.01)
    for now in (1.0, 2.0):
        outbox.set("motion", group, now, period_s=0.1, until=now, urgent=True)
        assert drained(outbox, now, now + 0.9) == [(now + 0.01 * place, frame) for place, frame in enumerate(group)]
        assert outbox.idle
        assert outbox.deadline() is None


def test_an_urgent_group_ends_what_stood_in_its_slot() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"drive",), 0.0, period_s=0.25)
    outbox.set("motion", (b"none", b"stop"), 0.0, period_s=0.1, until=0.0, urgent=True)
    assert frames(drained(outbox, 0.0, 9.0)) == [b"none", b"stop"]


def test_an_urgent_group_keeps_its_order_whatever_waits_already() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"stop",), 0.0, urgent=True)
    for _ in range(10):
        outbox.set("motion", (b"none", b"stop"), 0.0, urgent=True)
    assert frames(drained(outbox, 0.0, 9.0)) == [b"stop", b"none", b"stop"]


def test_a_flood_of_urgent_groups_leaves_group_by_group() -> None:
    """Neither does the second frame starve, nor does the flood grow."""
    outbox = Outbox(0.01)
    taken = []
    for step in range(1000):
        now = step / 1000
        outbox.set("motion", (b"none", b"stop"), now, period_s=0.1, until=now + 1.0, urgent=True)
        if (frame := outbox.take(now)) is not None:
            taken.append(frame)
        assert len(outbox) <= 4
    assert taken == ([b"none", b"stop"] * 50)[: len(taken)]
    assert len(taken) >= 90


def test_a_repeated_group_is_whole_at_its_end() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"none", b"stop"), 1.0, period_s=0.1, until=1.25, urgent=True)
    assert frames(drained(outbox, 1.0, 9.0)) == [b"none", b"stop"] * 3


def test_a_frame_that_waits_can_be_withdrawn_and_one_that_does_not_is_no_error() -> None:
    outbox = Outbox(0.01)
    for frame in (b"a", b"b", b"a", b"c"):
        outbox.put(frame)
    outbox.unqueue(b"a")
    outbox.unqueue(b"d")
    assert frames(drained(outbox, 0.0, 1.0)) == [b"b", b"c"]


def test_an_outbox_tells_whether_anything_stands_in_a_slot() -> None:
    outbox = Outbox(0.01)
    assert not outbox.is_set("again")
    outbox.set("again", (b"m",), 0.3)
    assert outbox.is_set("again")
    assert drained(outbox, 0.0, 1.0) == [(0.3, b"m")]
    assert not outbox.is_set("again")


def test_every_place_of_a_group_has_its_turn_although_the_group_is_renewed_all_the_time() -> None:
    outbox = Outbox(0.01)
    taken = []
    for step in range(6):
        group = (b"move %d" % step, b"turn %d" % step)
        outbox.set("motion", group, 0.01 * step, period_s=0.25)
        taken.append(outbox.take(0.01 * step))
    assert taken == [b"move 0", b"turn 1", b"move 2", b"turn 3", b"move 4", b"turn 5"]


def test_a_group_of_another_length_begins_at_its_beginning() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"move", b"turn"), 0.0, period_s=0.25)
    assert outbox.take(0.0) == b"move"
    outbox.set("motion", (b"stop",), 0.005)
    assert drained(outbox, 0.005, 1.0) == [(0.01, b"stop")]


def test_motion_that_is_always_due_does_not_starve_the_queue() -> None:
    outbox = Outbox(1.0)
    for _ in range(5):
        outbox.put(b"text")
    taken = []
    for now in range(10):
        outbox.set("motion", (b"drive",), now)
        taken.append(outbox.take(now))
    assert taken.count(b"text") == 5
    assert taken.count(b"drive") == 5


def test_a_full_queue_does_not_delay_motion_by_more_than_one_frame() -> None:
    outbox = Outbox(0.01)
    for _ in range(LIMIT):
        outbox.put(b"text")
    assert outbox.take(0.0) == b"text"
    outbox.set("motion", (b"drive",), 0.005)
    assert b"drive" in (outbox.take(0.01), outbox.take(0.02))


def test_the_deadline_of_a_waiting_frame_is_the_end_of_the_gap() -> None:
    outbox = Outbox(0.5)
    outbox.set("motion", (b"d",), 1.0, period_s=0.1)
    assert outbox.deadline() == 1.0
    outbox.take(1.0)
    assert outbox.deadline() == 1.5, "due at 1.1, but the gap has not passed"


def test_the_deadline_is_that_of_the_slot_that_is_due_first() -> None:
    outbox = Outbox(0.0)
    outbox.set("late", (b"l",), 9.0)
    outbox.set("early", (b"e",), 3.0)
    assert outbox.deadline() == 3.0


def test_a_queued_frame_is_due_although_motion_stands_for_later() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"d",), 0.0, period_s=0.25)
    outbox.take(0.0)
    outbox.put(b"text")
    assert outbox.deadline() == 0.01
    assert outbox.take(0.01) == b"text"


def test_a_standing_frame_is_not_sent_before_it_is_due() -> None:
    outbox = Outbox(0.0)
    outbox.set("motion", (b"d",), 5.0)
    assert outbox.take(4.9) is None
    assert outbox.take(5.0) == b"d"


def test_a_late_driver_does_not_cause_a_burst_of_repetitions() -> None:
    outbox = Outbox(0.01)
    outbox.set("motion", (b"d",), 0.0, period_s=0.25, until=math.inf)
    assert outbox.take(0.0) == b"d"
    assert outbox.take(10.0) == b"d"
    assert outbox.take(10.01) is None
    assert outbox.deadline() == 10.25


def test_frames_that_go_first_are_bounded_too() -> None:
    outbox = Outbox(0.0)
    for number in range(LIMIT):
        outbox.put_exempt(b"%d" % number)
    with pytest.raises(Refused, match="64 packets of the handshake wait"):
        outbox.put_exempt(b"one too many")
    assert len(outbox) == LIMIT
    assert outbox.take(0.0) == b"0"
    outbox.put_exempt(b"there is room again")
    assert [frame for _, frame in drained(outbox, 0.0, 1.0)][-1] == b"there is room again"


def test_a_frame_that_goes_first_may_be_taken_back_until_it_was_given_out() -> None:
    outbox = Outbox(0.01)
    frames_of_handshake = bytes(4), bytes(5), bytes(4)
    for frame in frames_of_handshake:
        outbox.put_exempt(frame)
    assert outbox.withdraw(frames_of_handshake[2])
    assert not outbox.withdraw(frames_of_handshake[2])
    assert outbox.take(0.0) is frames_of_handshake[0]
    assert not outbox.withdraw(frames_of_handshake[0])
    assert frames(drained(outbox, 0.01, 1.0)) == [frames_of_handshake[1]]


def test_the_two_queues_are_bounded_each_for_itself() -> None:
    outbox = Outbox(0.0)
    for _ in range(LIMIT):
        outbox.put(b"text")
    outbox.put_exempt(b"first")
    with pytest.raises(Refused, match="64 packets wait for the robot"):
        outbox.put(b"text")
    assert outbox.take(0.0) == b"first"


def test_an_outbox_prints_what_waits() -> None:
    outbox = Outbox(0.0)
    outbox.put(b"a")
    outbox.set("motion", (b"d",), 0.0)
    assert repr(outbox) == "<Outbox 1 waiting, slots ['motion']>"
