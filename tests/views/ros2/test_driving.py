"""Who may drive by cmd_vel, and when: tables of what happens and what must come of it."""

from __future__ import annotations

import pytest

from tests.bounds import most_kept
from zbridge.errors import Held, Refused
from zbridge.lease.stick import StickAction
from zbridge.views.ros2.driving import PUBLISHERS, REMEMBERED, Driving, TwistPublisher

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
        (0.2, "A moves", "refuse it existed before"),
        (1.1, "A moves", "refuse it existed before"),
        (2.2, "A moves", "acquire"),
    ],
    "one that was there before us and moves at once owes too": [
        (0, "A was there", ""),
        (0.9, "A moves", "refuse it existed before"),
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


def happen(driving: Driving, what: str, now: float) -> str:
    """Let something happen, carry out what a pilot does, and say what that was; a lease is granted within the call."""
    gid, name = (A, "/a") if what.startswith("A") else (B, "/b")
    driver = driving.driver
    match what.removeprefix("A ").removeprefix("B "):
        case "comes" | "was there" as how:
            assert driving.came(gid, name, now, early=how == "was there")
        case "goes":
            driving.gone(gid)
            return released(driver, "it is gone") if driver is not None and gid not in driving.publishers else ""
        case "moves":
            return say(driving, gid, True, now)
        case "rests":
            return say(driving, gid, False, now)
        case "turns on the spot":
            return say(driving, gid, False, now, "cannot")
        case "time":
            due = [p for p in driving.publishers.values() if p.stick.expire(now) or p.stick.wants_release(now)]
            assert due in ([], [driver])
            return released(driver, (due[0].stick.needs_neutral or "it commands no motion")) if due else ""
        case "stop":
            for publisher in driving.publishers.values():
                publisher.stick.refused("stopped")
            return released(driver, "stopped")
        case "lost":
            driver.stick.lost("held by op1")
        case other:
            raise AssertionError(other)
    return ""


def released(publisher: TwistPublisher, why: str) -> str:
    publisher.stick.released()
    return f"release {why}"


def say(driving: Driving, gid: bytes, moving: bool, now: float, wrong: str = "") -> str:
    publisher = driving.publishers.get(gid)
    try:
        driving.heard(gid, moving, now, wrong)
        assert publisher is not None
        action = publisher.stick.motion(now) if moving else publisher.stick.neutral(now)
    except Refused as refusal:
        if publisher is not None and publisher.stick.active:
            return released(publisher, str(refusal))
        return f"refuse {str(refusal).partition(': send a zero')[0]}"
    if action is StickAction.ACQUIRE:
        publisher.stick.granted()
    return "" if action is StickAction.NOTHING else action.value


def test_who_moves_beside_the_driver_is_told_that_another_one_holds_the_robot() -> None:
    driving = Driving("r1")
    for gid, name in ((A, "/a"), (B, "/b")):
        driving.came(gid, name, 0.0, early=False)
    assert say(driving, A, True, 0.0) == "acquire"
    with pytest.raises(Held, match="r1 is driven by /a"):
        driving.heard(B, True, 0.1)
    assert driving.driver is driving.publishers[A]


@pytest.mark.parametrize("story", STORIES)
def test_who_may_drive(story: str) -> None:
    driving = Driving("r1")
    for number, (now, what, expected) in enumerate(STORIES[story]):
        assert happen(driving, what, now) == expected, f"{number}: {what} at {now}"
        assert sum(publisher.stick.active for publisher in driving.publishers.values()) <= 1


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
