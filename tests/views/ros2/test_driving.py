"""Who may drive by cmd_vel, and when: the machine against tables of what happens and what must come of it."""

from __future__ import annotations

import pytest

from tests.bounds import most_kept
from zbridge.views.ros2.driving import PUBLISHERS, REMEMBERED, TABLE, Action, Driving, Event, Standing

A, B = b"a" * 16, b"b" * 16

# What happens, at which second; and what must be done: acquire, send, refuse (why), release (why), or nothing.
STORIES: dict[str, list[tuple[float, str, str]]] = {
    "one that has just come may begin with motion": [
        (0, "A comes", ""),
        (0.1, "A moves", "acquire"),
        (0.2, "A moves", "send"),
    ],
    "one that was there before us owes a second of silence": [
        (0, "A was there", ""),
        (0.2, "A moves", "refuse it was there before"),
        (1.1, "A moves", "refuse it was there before"),
        (2.1, "A moves", "acquire"),
    ],
    "one that was there before us and moves at once owes too": [
        (0, "A was there", ""),
        (0.9, "A moves", "refuse it was there before"),
    ],
    "or a zero": [(0, "A was there", ""), (0.2, "A rests", ""), (0.3, "A moves", "acquire")],
    "silence while it drives stops the robot, and is owed for": [
        (0, "A comes", ""),
        (0, "A moves", "acquire"),
        (0.49, "time", ""),
        (0.5, "time", "release silent for 0.5 s while it drove"),
        (0.9, "A moves", "refuse silent for 0.5 s while it drove"),
        (1.95, "A moves", "acquire"),
    ],
    "a second of silence is enough": [
        (0, "A comes", ""),
        (0, "A moves", "acquire"),
        (0.6, "time", "release silent for 0.5 s while it drove"),
        (1.0, "A moves", "acquire"),
    ],
    "zeros keep the robot for a second, then others may have it": [
        (0, "A comes", ""),
        (0, "B comes", ""),
        (0, "A moves", "acquire"),
        (0.1, "A rests", "send"),
        (0.9, "time", ""),
        (1.0, "time", "release it commands no motion"),
        (1.1, "B moves", "acquire"),
    ],
    "the second of two is refused, and owes after the first has gone": [
        (0, "A comes", ""),
        (0, "B comes", ""),
        (0, "A moves", "acquire"),
        (0.1, "B moves", "refuse r1 is driven by /a"),
        (0.2, "A moves", "send"),
        (0.3, "A goes", "release it is gone"),
        (0.4, "B moves", "refuse r1 is driven by /a"),
        (0.5, "B rests", ""),
        (0.6, "B moves", "acquire"),
    ],
    "a stop is owed for by all who move": [
        (0, "A comes", ""),
        (0, "B comes", ""),
        (0, "A moves", "acquire"),
        (0.1, "stop", "release stopped"),
        (0.2, "A moves", "refuse stopped"),
        (0.3, "B moves", "refuse stopped"),
        (0.4, "B rests", ""),
        (0.5, "B moves", "acquire"),
    ],
    "a lost lease is owed for": [
        (0, "A comes", ""),
        (0, "A moves", "acquire"),
        (0.1, "lost", ""),
        (0.2, "A moves", "refuse held by op1"),
        (0.3, "A rests", ""),
        (0.4, "A moves", "acquire"),
    ],
    "what the robot cannot do is refused, and ends the drive": [
        (0, "A comes", ""),
        (0, "A turns on the spot", "refuse cannot"),
        (0.1, "A rests", ""),
        (0.2, "A moves", "acquire"),
        (0.3, "A turns on the spot", "release cannot"),
        (0.4, "A moves", "refuse cannot"),
    ],
    "one that was cut off while it drove, and is back, owes": [
        (0, "A comes", ""),
        (0, "A moves", "acquire"),
        (0.1, "A goes", "release it is gone"),
        (5, "A comes", ""),
        (5.1, "A moves", "refuse it was cut off, and is back"),
        (5.2, "A rests", ""),
        (5.3, "A moves", "acquire"),
    ],
    "one without a token is refused": [
        (0, "A moves", "refuse a publisher without a token"),
        (1, "A rests", "refuse a publisher without a token"),
    ],
}


def happen(driving: Driving, what: str, now: float):
    gid, name = (A, "/a") if what.startswith("A") else (B, "/b")
    match what.removeprefix("A ").removeprefix("B "):
        case "comes":
            assert driving.came(gid, name, now, early=False)
        case "was there":
            assert driving.came(gid, name, now, early=True)
        case "goes":
            return driving.gone(gid)
        case "moves":
            return driving.heard(gid, True, now)
        case "rests":
            return driving.heard(gid, False, now)
        case "turns on the spot":
            return driving.heard(gid, False, now, "cannot")
        case "time":
            return driving.expire(now)
        case "stop":
            return driving.stopped("stopped")
        case "lost":
            return driving.lost("held by op1")
        case other:
            raise AssertionError(other)
    return None


@pytest.mark.parametrize("story", STORIES)
def test_who_may_drive(story: str) -> None:
    driving = Driving("r1")
    for number, (now, what, expected) in enumerate(STORIES[story]):
        decision = happen(driving, what, now)
        done = ""
        if decision is not None and decision.action is not Action.NOTHING:
            told = decision.action in (Action.REFUSE, Action.RELEASE)
            done = f"{decision.action.name.lower()} {decision.why if told else ''}".strip()
        assert done == expected, f"{number}: {what} at {now}"


def test_a_deadline_is_due_when_it_comes_and_not_before() -> None:
    driving = Driving("r1")
    assert driving.deadline() is None
    driving.came(A, "/a", 0, early=False)
    driving.heard(A, True, 10.0)
    assert driving.deadline() == 10.5
    driving.heard(A, True, 10.2)
    assert driving.deadline() == 10.7
    driving.heard(A, False, 10.3)
    assert driving.deadline() == 11.2
    assert driving.expire(11.1).action is Action.NOTHING
    assert driving.expire(11.2).action is Action.RELEASE
    assert driving.deadline() is None


def test_one_publisher_at_most_holds_the_robot_whatever_happens() -> None:
    for standing, events in TABLE.items():
        for event, (action, following) in events.items():
            assert (action is Action.ACQUIRE) == (standing is not Standing.DRIVES and following is Standing.DRIVES)
            assert event is not Event.TAKEN or following is Standing.OWES
            assert action is not Action.SEND or standing is following is Standing.DRIVES


def test_publishers_and_memories_are_bounded() -> None:
    driving = Driving("r1")
    gids = [number.to_bytes(16, "little") for number in range(1000)]
    came = [driving.came(gid, "/x", 0, early=False) for gid in gids]
    assert came == [True] * PUBLISHERS + [False] * (1000 - PUBLISHERS)
    for gid in gids:
        driving.gone(gid)
        driving.came(gid, "/x", 0, early=False)
        driving.gone(gid)
    assert not driving.publishers
    assert most_kept(driving) == REMEMBERED
