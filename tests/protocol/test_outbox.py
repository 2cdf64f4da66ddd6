"""The outbox: one frame at a time, spaced, bounded, the newest motion first."""

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


def play(outbox: Outbox, script: str) -> None:
    """Play the lines of a script:

    ``put a b``, ``unqueue a``, ``clear SLOT``; ``set SLOT a b at 1.0 [every 0.25] [until 2.0] [urgent]``: a group that
    stands; ``take 0.0 = a`` or ``= nothing``; ``from 0.0 to 1.0 = 0.0:a 0.01:b``: what is taken, and when;
    ``due 0.01`` or ``due never``; ``waiting 3``.
    """
    for line in filter(None, map(str.strip, script.splitlines())):
        said, _, wanted = line.partition(" = ")
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
            outbox.set(
                words[0],
                tuple(word.encode() for word in words[1:at]),
                float(times["at"]),
                period_s=float(times.get("every", "inf")),
                until=float(times.get("until", "inf")),
                urgent="urgent" in words,
            )
        elif verb == "take":
            frame = outbox.take(float(words[0]))
            assert (frame.decode() if frame else "nothing") == wanted, line
        elif verb == "from":
            taken = drained(outbox, float(words[0]), float(words[2]))
            assert " ".join(f"{now:g}:{frame.decode()}" for now, frame in taken) == wanted, line
        elif verb == "due":
            assert outbox.deadline() == (None if words == ["never"] else float(words[0])), line
        else:
            assert verb == "waiting"
            assert len(outbox) == int(words[0]), line


SCRIPTS: dict[str, tuple[float, str]] = {
    # The queue, and the gap between frames
    "an empty outbox has neither frame nor deadline": (0.01, "take 0.0 = nothing\n due never\n waiting 0"),
    "queued frames leave in order with the gap between them": (
        0.01,
        "put a b c\n waiting 3\n from 5 to 6 = 5:a 5.01:b 5.02:c",
    ),
    "nothing leaves within the gap": (
        0.01,
        "put a b\n take 0 = a\n take 0 = nothing\n take 0.0099 = nothing\n due 0.01\n take 0.01 = b",
    ),
    "the gap counts from the frame before even after the outbox was empty": (
        0.01,
        "put a\n take 0 = a\n put b\n take 0.005 = nothing\n take 0.01 = b",
    ),
    "without a gap all frames leave at once": (0.0, "put a b\n take 1 = a\n take 1 = b\n take 1 = nothing"),
    "a frame that waits can be withdrawn and one that does not is no error": (
        0.01,
        "put a b a c\n unqueue a\n unqueue d\n from 0 to 1 = 0:b 0.01:c",
    ),
    # What stands in a slot
    "a standing frame without period is sent once": (0.01, "set motion d at 1\n from 1 to 100 = 1:d\n due never"),
    "a standing frame is not sent before it is due": (0.0, "set motion d at 5\n take 4.9 = nothing\n take 5 = d"),
    "a standing frame is repeated every period without end": (
        0.01,
        "set motion d at 1 every 0.25\n from 1 to 2.1 = 1:d 1.25:d 1.5:d 1.75:d 2:d\n due 2.25",
    ),
    "a standing frame is repeated until its end and then forgotten": (
        0.01,
        "set motion s at 1 every 0.25 until 2\n from 1 to 9 = 1:s 1.25:s 1.5:s 1.75:s 2:s\n due never",
    ),
    "a newer standing frame replaces the one that waits": (
        0.01,
        "put text\n take 0 = text\n set motion old at 0.001\n set motion new at 0.002\n from 0.002 to 1 = 0.01:new",
    ),
    "replacing a repeated frame ends its repetition": (
        0.01,
        """set motion drive at 0 every 0.25
        take 0 = drive
        set motion stop at 0.125 every 0.125 until 0.375
        from 0.125 to 9 = 0.125:stop 0.25:stop 0.375:stop""",
    ),
    "a new command is sent at once although its predecessor was just repeated": (
        0.01,
        "set motion one at 0 every 0.25\n take 0 = one\n set motion two at 0.05 every 0.25\n take 0.05 = two",
    ),
    "slots are independent": (0.01, "set motion m at 0\n set light l at 0\n from 0 to 1 = 0:m 0.01:l"),
    "a cleared slot is forgotten and clearing twice does no harm": (
        0.01,
        "set motion d at 0 every 0.25\n clear motion\n clear motion\n take 0 = nothing\n due never",
    ),
    "a late driver does not cause a burst of repetitions": (
        0.01,
        "set motion d at 0 every 0.25\n take 0 = d\n take 10 = d\n take 10.01 = nothing\n due 10.25",
    ),
    # Groups
    "a group is sent whole with the gap inside and then repeated": (
        0.01,
        "set motion move turn at 0 every 0.25\n from 0 to 0.3 = 0:move 0.01:turn 0.26:move 0.27:turn",
    ),
    "a repeated group is whole at its end": (
        0.01,
        """set motion none stop at 1 every 0.1 until 1.25 urgent
        from 1 to 9 = 1:none 1.01:stop 1.1:none 1.11:stop 1.21:none 1.22:stop""",
    ),
    "every place of a group has its turn although the group is renewed all the time": (
        0.01,
        "\n".join(
            f"set motion move{step} turn{step} at {0.01 * step} every 0.25\n take {0.01 * step} = {place}{step}"
            for step, place in enumerate(("move", "turn") * 3)
        ),
    ),
    "a group of another length begins at its beginning": (
        0.01,
        "set motion move turn at 0 every 0.25\n take 0 = move\n set motion stop at 0.005\n from 0.005 to 1 = 0.01:stop",
    ),
    # Urgent frames
    "an urgent frame goes before everything that waits but keeps the gap": (
        0.01,
        """put a b c
        take 0 = a
        set motion drive at 0 every 0.25
        set motion stop at 0.001 urgent
        take 0.002 = nothing
        take 0.01 = stop""",
    ),
    "an urgent frame beats the due frame of another slot": (
        0.0,
        "set light l at 0\n set motion stop at 0.5 urgent\n take 1 = stop\n take 1 = l",
    ),
    "an urgent frame leaves once before whatever replaces it": (
        0.01,
        """set motion drive at 0 every 0.25
        take 0 = drive
        set motion stop at 0.001 every 0.1 until 1.001 urgent
        set motion neutral at 0.002
        set motion on at 0.003
        waiting 1
        from 0.003 to 1 = 0.01:stop 0.02:on""",
    ),
    "an urgent frame leaves although its slot is cleared": (
        0.0,
        "set motion stop at 0 every 0.1 urgent\n clear motion\n from 0 to 1 = 0:stop",
    ),
    "an urgent frame that waits already waits once": (
        0.01,
        "put a\n take 0 = a\n" + "set motion stop at 0.001 urgent\n" * 10 + "from 0.001 to 1 = 0.01:stop",
    ),
    "urgent frames of two slots both leave in order": (
        0.01,
        """set motion stop at 0 urgent
        set arm hold at 0 urgent
        set motion stop at 0 urgent
        from 0 to 1 = 0:stop 0.01:hold""",
    ),
    "an urgent frame is the first of its repetitions": (
        0.01,
        """set motion stop at 1 every 0.25 until 2 urgent
        from 1 to 9 = 1:stop 1.25:stop 1.5:stop 1.75:stop 2:stop
        due never""",
    ),
    "an urgent frame that stands until now is sent exactly once": (
        0.01,
        """set motion stop at 1 every 0.1 until 1 urgent
        from 1 to 1.9 = 1:stop
        due never
        set motion stop at 2 every 0.1 until 2 urgent
        from 2 to 2.9 = 2:stop
        due never""",
    ),
    "an urgent group that stands until now is sent exactly once": (
        0.01,
        """set motion none stop at 1 every 0.1 until 1 urgent
        from 1 to 1.9 = 1:none 1.01:stop
        due never
        set motion none stop at 2 every 0.1 until 2 urgent
        from 2 to 2.9 = 2:none 2.01:stop
        due never""",
    ),
    "an urgent group ends what stood in its slot": (
        0.01,
        """set motion drive at 0 every 0.25
        set motion none stop at 0 every 0.1 until 0 urgent
        from 0 to 9 = 0:none 0.01:stop""",
    ),
    "an urgent group keeps its order whatever waits already": (
        0.01,
        "set motion stop at 0 urgent\n"
        + "set motion none stop at 0 urgent\n" * 10
        + "from 0 to 9 = 0:stop 0.01:none 0.02:stop",
    ),
    # Deadlines
    "the deadline of a waiting frame, due though it is at 1.1, is the end of the gap": (
        0.5,
        "set motion d at 1 every 0.1\n due 1\n take 1 = d\n due 1.5",
    ),
    "the deadline is that of the slot that is due first": (0.0, "set late l at 9\n set early e at 3\n due 3"),
    "a queued frame is due although motion stands for later": (
        0.01,
        "set motion d at 0 every 0.25\n take 0 = d\n put text\n due 0.01\n take 0.01 = text",
    ),
}


@pytest.mark.parametrize(("gap_s", "script"), SCRIPTS.values(), ids=SCRIPTS)
def test_frames_leave_as_they_should(gap_s: float, script: str) -> None:
    play(Outbox(gap_s), script)


def test_an_outbox_tells_whether_anything_stands_in_a_slot_and_whether_it_is_idle() -> None:
    outbox = Outbox(0.01)
    assert (outbox.is_set("again"), outbox.idle) == (False, True)
    outbox.set("again", (b"m",), 0.3)
    assert (outbox.is_set("again"), outbox.idle) == (True, False)
    assert drained(outbox, 0.0, 1.0) == [(0.3, b"m")]
    assert (outbox.is_set("again"), outbox.idle) == (False, True)


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


def test_motion_that_is_always_due_does_not_starve_the_queue() -> None:
    outbox = Outbox(1.0)
    for _ in range(5):
        outbox.put(b"text")
    taken = []
    for now in range(10):
        outbox.set("motion", (b"drive",), now)
        taken.append(outbox.take(now))
    assert sorted(taken, key=str) == [b"drive"] * 5 + [b"text"] * 5


# Bounds


def test_one_frame_too_many_is_refused_and_the_others_stay() -> None:
    outbox = Outbox(0.0, limit=2)
    play(outbox, "put a b")
    with pytest.raises(Refused, match="2 packets"):
        outbox.put(b"c")
    play(outbox, "from 0 to 1 = 0:a 0:b")


def test_a_full_queue_delays_motion_by_one_frame_at_most_and_the_handshake_by_none() -> None:
    outbox = Outbox(0.01)
    for _ in range(LIMIT):
        outbox.put(b"text")
    outbox.put_exempt(b"first")
    with pytest.raises(Refused, match="64 packets wait for the robot"):
        outbox.put(b"text")
    play(outbox, "take 0 = first\n set motion drive at 0.005")
    assert b"drive" in (outbox.take(0.01), outbox.take(0.02))


def test_frames_that_go_first_are_bounded_too() -> None:
    outbox = Outbox(0.0)
    for number in range(LIMIT):
        outbox.put_exempt(b"%d" % number)
    with pytest.raises(Refused, match="64 packets of the handshake wait"):
        outbox.put_exempt(b"one too many")
    assert len(outbox) == LIMIT
    assert outbox.take(0.0) == b"0"
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


def test_an_outbox_prints_what_waits() -> None:
    outbox = Outbox(0.0)
    play(outbox, "put a\n set motion d at 0")
    assert repr(outbox) == "<Outbox 1 waiting, slots ['motion']>"
