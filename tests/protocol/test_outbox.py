"""The outbox: one frame at a time, spaced, bounded, the newest motion first."""

import itertools

import pytest

from zbridge.errors import Refused
from zbridge.protocol.exchange import Exchange
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


def play(outbox: Outbox, script: str) -> None:
    """Play the steps of a script, with semicolons between them:

    ``put a b``, ``unqueue a``, ``clear SLOT``; ``set SLOT a b at 1.0 [every 0.25] [until 2.0] [urgent]``: a group that
    stands; ``take 0.0 = a`` or ``= nothing``; ``from 0.0 to 1.0 = 0.0:a 0.01:b``: what is taken, and when;
    ``due 0.01`` or ``due never``; ``waiting 3``.
    """
    for step in script.split(";"):
        said, _, wanted = step.strip().partition(" = ")
        verb, *words = said.split()
        if verb == "put":
            for word in words:
                outbox.put(word.encode())
        elif verb == "unqueue":
            outbox.unqueue(words[0].encode())
        elif verb == "clear":
            outbox.clear(words[0])
        elif verb == "set":
            at = words.index("at")
            times = dict(zip(words[at::2], words[at + 1 :: 2], strict=False))
            group, period_s, until = words[1:at], float(times.get("every", "inf")), float(times.get("until", "inf"))
            frames, urgent = tuple(word.encode() for word in group), "urgent" in words
            outbox.set(words[0], frames, float(times["at"]), period_s=period_s, until=until, urgent=urgent)
        elif verb == "take":
            frame = outbox.take(float(words[0]))
            assert (frame.decode() if frame else "nothing") == wanted, step
        elif verb == "from":
            taken = drained(outbox, float(words[0]), float(words[2]))
            assert " ".join(f"{now:g}:{frame.decode()}" for now, frame in taken) == wanted, step
        elif verb == "due":
            assert outbox.deadline() == (None if words == ["never"] else float(words[0])), step
        else:
            assert verb == "waiting"
            assert len(outbox) == int(words[0]), step


RENEWED = "; ".join(
    f"set motion move{step} turn{step} at {0.01 * step} every 0.25; take {0.01 * step} = {place}{step}"
    for step, place in enumerate(("move", "turn") * 3)
)
TEN_STOPS = "; ".join(10 * ["set motion none stop at 0 urgent"])
SCRIPTS = {
    # The queue, and the gap between frames
    "queued frames leave in order with the gap between": "put a b c; waiting 3; from 5 to 6 = 5:a 5.01:b 5.02:c",
    "the gap counts although the outbox was empty": "put a; take 0 = a; put b; take 0.005 = nothing; take 0.01 = b",
    "a frame that waits can be withdrawn": "put a b a c; unqueue a; unqueue d; from 0 to 1 = 0:b 0.01:c",
    # What stands in a slot
    "without a period it is sent once, when it is due": (
        "set motion d at 9; set light l at 5; due 5; take 4.9 = nothing; from 5 to 100 = 5:l 9:d; due never"
    ),
    "it is repeated every period without end": (
        "set motion d at 1 every 0.25; from 1 to 1.6 = 1:d 1.25:d 1.5:d; due 1.75"
    ),
    "it is repeated until its end and then forgotten": (
        "set motion s at 1 every 0.25 until 1.5; from 1 to 9 = 1:s 1.25:s 1.5:s; due never"
    ),
    "a newer one replaces the one that waits": (
        "put text; take 0 = text; set motion old at 0.001; set motion new at 0.002; from 0.002 to 1 = 0.01:new"
    ),
    "a newer one is sent at once and ends the repetition of the one before": (
        "set motion drive at 0 every 0.25; take 0 = drive; set motion stop at 0.125 every 0.125 until 0.375;"
        "from 0.125 to 9 = 0.125:stop 0.25:stop 0.375:stop"
    ),
    "a cleared slot is forgotten": (
        "set motion d at 0 every 0.25; clear motion; clear motion; take 0 = nothing; due never"
    ),
    "a late driver does not cause a burst of repetitions": (
        "set motion d at 0 every 0.25; take 0 = d; take 10 = d; take 10.01 = nothing; due 10.25"
    ),
    # Groups
    "a group is sent whole with the gap inside and then repeated": (
        "set motion move turn at 0 every 0.25; from 0 to 0.3 = 0:move 0.01:turn 0.26:move 0.27:turn"
    ),
    "a repeated group is whole at its end": (
        "set motion none stop at 1 every 0.1 until 1.25 urgent;"
        "from 1 to 9 = 1:none 1.01:stop 1.1:none 1.11:stop 1.21:none 1.22:stop"
    ),
    "every place of a group has its turn although the group is renewed all the time": RENEWED,
    "a group of another length begins at its beginning": (
        "set motion move turn at 0; take 0 = move; set motion stop at 0.005; from 0.005 to 1 = 0.01:stop"
    ),
    # Urgent frames
    "an urgent frame goes before everything that waits but keeps the gap": (
        "put a b c; take 0 = a; set light l at 0; set motion drive at 0 every 0.25; set motion stop at 0.001 urgent;"
        "take 0.002 = nothing; take 0.01 = stop"
    ),
    "an urgent frame leaves once before whatever replaces it": (
        "set motion drive at 0 every 0.25; take 0 = drive; set motion stop at 0.001 every 0.1 until 1.001 urgent;"
        "set motion neutral at 0.002; set motion on at 0.003; waiting 1; from 0.003 to 1 = 0.01:stop 0.02:on"
    ),
    "an urgent frame leaves although its slot is cleared": (
        "set motion stop at 0 every 0.1 urgent; clear motion; from 0 to 1 = 0:stop"
    ),
    "urgent frames of two slots leave in order, each of them once": (
        "set motion stop at 0 urgent; set arm hold at 0 urgent; set motion stop at 0 urgent;"
        "from 0 to 1 = 0:stop 0.01:hold"
    ),
    "an urgent group that stands until now is sent once, each time": (
        "set motion none stop at 1 every 0.1 until 1 urgent; from 1 to 1.9 = 1:none 1.01:stop; due never;"
        "set motion none stop at 2 every 0.1 until 2 urgent; from 2 to 2.9 = 2:none 2.01:stop; due never"
    ),
    "an urgent group keeps its order whatever waits already": (
        f"set motion stop at 0 urgent; {TEN_STOPS}; from 0 to 9 = 0:stop 0.01:none 0.02:stop"
    ),
    # Deadlines
    "the deadline of a frame that is due within the gap is its end": (
        "set motion d at 1 every 0.005; due 1; take 1 = d; due 1.01"
    ),
    "a queued frame is due although motion stands for later": (
        "set motion d at 0 every 0.25; take 0 = d; put text; due 0.01; take 0.01 = text"
    ),
}


@pytest.mark.parametrize("script", SCRIPTS.values(), ids=SCRIPTS)
def test_frames_leave_as_they_should(script: str) -> None:
    play(Outbox(0.01), script)


def test_an_outbox_tells_whether_anything_stands_in_a_slot_and_whether_anything_is_due() -> None:
    outbox = Outbox(0.01)
    for script, stands in (("due never", False), ("set again m at 0.3", True), ("from 0 to 1 = 0.3:m", False)):
        play(outbox, script)
        assert (outbox.is_set("again"), outbox.deadline() is not None) == (stands, stands)


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


def test_slots_that_are_always_due_starve_neither_each_other_nor_the_queue() -> None:
    outbox = Outbox(0.0)
    for slot in ("motion", "scan", "light"):
        outbox.set(slot, (slot.encode(),), 0.0, period_s=0.0)
    play(outbox, "put text text text text text text")
    taken = [outbox.take(now / 100) for now in range(1, 13)]
    assert {frame: taken.count(frame) for frame in taken} == {b"motion": 2, b"scan": 2, b"light": 2, b"text": 6}


# Bounds


def test_a_full_queue_refuses_the_next_and_delays_motion_by_one_frame_at_most_and_the_handshake_by_none() -> None:
    outbox = Outbox(0.01)
    play(outbox, "put" + LIMIT * " text")
    outbox.put_exempt(b"first")
    with pytest.raises(Refused, match="64 packets wait for the robot"):
        outbox.put(b"text")
    play(outbox, f"waiting {LIMIT + 1}; take 0 = first; set motion drive at 0.005")
    assert b"drive" in (outbox.take(0.01), outbox.take(0.02))


def test_frames_that_go_first_are_bounded_too() -> None:
    outbox = Outbox(0.0)
    for number in range(LIMIT):
        outbox.put_exempt(b"%d" % number)
    with pytest.raises(Refused, match="64 packets of the handshake wait"):
        outbox.put_exempt(b"one too many")
    play(outbox, f"waiting {LIMIT}; take 0 = 0")
    outbox.put_exempt(b"there is room again")
    assert drained(outbox, 0.0, 1.0)[-1][1] == b"there is room again"


def test_a_frame_that_goes_first_may_be_taken_back_until_it_was_given_out() -> None:
    outbox = Outbox(0.01)
    first, second, third = bytes(4), bytes(5), bytes(4)
    for frame in (first, second, third):
        outbox.put_exempt(frame)
    assert outbox.withdraw(third)
    assert not outbox.withdraw(third)
    assert outbox.take(0.0) is first
    assert not outbox.withdraw(first)
    assert drained(outbox, 0.01, 1.0) == [(0.01, second)]


def test_while_it_is_muted_nothing_but_the_handshake_leaves_or_waits() -> None:
    outbox = Outbox(gap_s=0.0)
    outbox.put(b"waits")
    outbox.set("motion", (b"push",), 0.0, period_s=0.1)
    outbox.mute(True)
    outbox.put(b"comes")
    outbox.set("motion", (b"push",), 0.0, period_s=0.1)
    outbox.set("stop", (b"stop",), 0.0, until=1.0, urgent=True)
    outbox.put_exempt(b"hello")
    assert drained(outbox, 0.0, 5.0) == [(0.0, b"hello")]
    outbox.mute(False)
    assert drained(outbox, 5.0, 9.0) == [], "what came meanwhile is forgotten"
    outbox.put(b"after")
    assert drained(outbox, 9.0, 9.0) == [(9.0, b"after")]


def test_a_group_that_replaces_another_one_halfway_is_sent_whole_and_at_once() -> None:
    outbox = Outbox(0.1)
    play(
        outbox,
        "set wheels a1 b1 at 0 every 5; take 0 = a1; set wheels a2 b2 at 0.05 every 5;"
        " from 0.1 to 6 = 0.1:b2 0.2:a2 5.2:a2 5.3:b2",
    )


def test_groups_that_are_replaced_faster_than_they_are_written_starve_no_frame() -> None:
    outbox = Outbox(0.1)
    taken = []
    for step in range(6):
        outbox.set("wheels", (b"a%d" % step, b"b%d" % step), step * 0.1)
        taken.append(outbox.take(step * 0.1))
    assert taken == [b"a0", b"b1", b"a2", b"b3", b"a4", b"b5"]


def test_motion_that_a_program_repeats_keeps_its_turn_among_polls_that_fill_the_line() -> None:
    exchange = Exchange(0.2)
    for name in ("a", "b", "c"):
        exchange.set(name, (name.encode(),), 0.0, period_s=0.05, lasting=True)
    written, now, answered_at = [], 0.0, 0.0
    for step in range(1000):
        now = step / 100
        if step % 5 == 0:
            exchange.set("drive", (b"drive%d" % step,), now)
        if exchange.awaited is not None and now >= answered_at:
            exchange.answered()
        frame = exchange.take(now)
        if frame is not None:
            answered_at = now + 0.04
            written.append((now, frame))
    drives = [at for at, frame in written if frame.startswith(b"drive")]
    assert len(drives) > 50
    assert max(later - before for before, later in itertools.pairwise(drives)) < 0.3


def test_polls_are_written_while_muted_and_survive_what_forgets_motion() -> None:
    outbox = Outbox(0.0)
    outbox.set("poll", (b"p",), 0.0, period_s=1.0, lasting=True)
    outbox.set("drive", (b"d",), 0.0, period_s=1.0)
    outbox.mute(True)
    outbox.forget()
    play(outbox, "from 0 to 2.5 = 0:p 1:p 2:p")
    outbox.mute(False)
    play(outbox, "from 3 to 3.5 = 3:p")


def test_a_stop_waits_while_an_answer_is_awaited() -> None:
    exchange = Exchange(0.2)
    exchange.put(b"question")
    assert exchange.take(0.0) == b"question"
    assert not exchange.waits(0.0)
    exchange.set("drive", (b"stop",), 0.0, until=0.0, urgent=True)
    assert exchange.waits(0.0)


def test_another_process_sends_the_rest_of_a_group_that_replaced_one_halfway() -> None:
    outbox, heir = Outbox(0.1), Outbox(0.1)
    play(outbox, "set wheels a b at 0; take 0 = a; set wheels c d at 0.01")
    heir.restore(outbox.export())
    for each in (outbox, heir):
        play(each, "from 0.1 to 1 = 0.1:d 0.2:c; due never")


def test_the_slots_of_a_gateway_of_0_2_are_taken_over() -> None:
    """A group of two, of which one had left: slot, frames, position, due, period, until, spacing."""
    heir = Outbox(0.0)
    heir.restore(heir.export() | {"_slots": [["motion", [["", b"none"], ["", b"stop"]], 1, 5.0, 0.25, 5.4, 0.0]]})
    play(heir, "from 5 to 9 = 5:stop 5.25:none 5.25:stop")


def test_a_state_keeps_what_a_poll_is() -> None:
    outbox, heir = Outbox(0.0), Outbox(0.0)
    outbox.set("poll", (b"p",), 0.0, period_s=1.0, lasting=True)
    heir.restore(outbox.export())
    heir.forget()
    play(heir, "take 0 = p; due 1")
