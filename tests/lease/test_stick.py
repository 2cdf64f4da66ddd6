"""A stick: what its positions become, cell by cell and in stories, under the rules of each kind. Times are made up."""

from __future__ import annotations

import math

import pytest

from tests.hq.scripts import scripts
from tests.tables import documented, executed
from zbridge.errors import Refused
from zbridge.lease.stick import Stick, StickAction, StickInput, StickRules, StickState

RULES = {
    "": StickRules(),
    "by hand": StickRules(deadman_s=0.5),
    "by motion": StickRules(deadman_s=0.5, keeps=False, idle_s=1.0, quiet_s=1.0, lapsed="silent", advice=": let go"),
    "by pulses": StickRules(keeps=False, idle_s=0.5, neutral_counts=True, quiet_s=1.0),
}


def play(stick: Stick, step: str) -> None:
    """Play one step:

    ``0.5 motion -> send``: at second 0.5 the stick says so, and that is to be done; ``0.5 motion ! silent``: that is
    refused, and the reason begins so; ``0.5 time -> release``: at second 0.5 that is due; ``lost stop``: that happened;
    ``due 0.5``: then the caller must wake; ``needs neutral stop``, ``needs neutral None``: so it stands.
    """
    first, _, rest = step.partition(" ")
    match first:
        case "granted" | "released" | "clear":
            getattr(stick, first)()
        case "lost" | "refused":
            getattr(stick, first)(rest)
        case "in" | "out":
            stick.in_use = first == "in"
        case "due":
            assert stick.deadline() == float(rest), step
        case "needs":
            assert str(stick.needs_neutral) == rest.removeprefix("neutral "), step
        case _:
            say(stick, float(first), rest, step)


def say(stick: Stick, now: float, rest: str, step: str) -> None:
    if rest.startswith("time"):
        done = "release" if stick.expire(now) or stick.wants_release(now) else "nothing"
        assert f"time -> {done}" == rest, step
        return
    stick.heard(now)
    said, expected = rest.split(" -> ") if " -> " in rest else (rest.split(" ! ", maxsplit=1)[0], "")
    if expected:
        assert getattr(stick, said)(now).value == expected, step
    else:
        with pytest.raises(Refused) as caught:
            getattr(stick, said)(now)
        assert str(caught.value).startswith(rest.split(" ! ")[1]), step


STORIES = """
motion acquires, waits for the lease, and is sent with it
    0 neutral -> nothing; 0 motion -> acquire; 0.1 motion -> wait; 0.2 neutral -> wait; granted; 0.3 motion -> send
    0.4 neutral -> send; due inf
who lost the lease must be centred once
    0 motion -> acquire; granted; lost taken by bob; needs neutral taken by bob
    0.1 motion ! taken by bob: centre the joystick first; 0.2 neutral -> nothing; 0.3 motion -> acquire
    lost held by bob; 0.4 motion ! held by bob
who released it need not
    0 motion -> acquire; granted; released; 0.1 motion -> acquire
a stop that is on its way withdraws motion, with the lease and without
    refused stop; 0 motion ! stop; 0.1 neutral -> nothing; 0.2 motion -> acquire; refused stop; 0.3 motion ! stop
    granted; 0.4 motion ! stop; 0.5 neutral -> send; 0.6 motion -> send; refused stop; 0.7 motion ! stop
    released; 0.8 motion ! stop
the lease is had without motion, and kept however long the stick rests
    0 want -> acquire; 0.1 want -> nothing; granted; 0.2 want -> nothing; due inf; 900 time -> nothing
    901 motion -> send; 999 time -> nothing
the lease is had without motion by who needs neutral, and moves nothing before it
    lost stop; 0 want -> acquire; granted; 0.1 motion ! stop; 0.2 neutral -> send; 0.3 motion -> send
motion that is not repeated ends, and the lease outlasts it [by hand]
    0 motion -> acquire; granted; due 0.5; 0.4 motion -> send; due 0.9; 0.8 time -> nothing; 0.9 time -> nothing
    needs neutral deadman; due inf; 1.0 motion ! deadman: centre the joystick first; 1.1 neutral -> send
    1.2 motion -> send
a late motion is noticed by itself [by hand]
    0 motion -> acquire; granted; 0.5 motion ! deadman
motion that lapses before the grant is not sent by it [by hand]
    0 motion -> acquire; 0.5 time -> nothing; granted; needs neutral deadman; 0.6 motion ! deadman
motion that is not repeated ends with the lease [by motion]
    0 motion -> acquire; granted; 0.49 time -> nothing; 0.5 time -> release; released
    0.6 motion ! silent: let go; needs neutral silent
the same before the grant [by motion]
    0 motion -> acquire; due 0.5; 0.5 time -> release; released; 0.6 motion ! silent
neutral has no deadman, and the lease is released when nothing moved for a while [by motion]
    0 motion -> acquire; granted; 0.1 neutral -> send; due 1.0; 0.9 neutral -> send; 0.99 time -> nothing
    1.0 time -> release; released; 1.1 motion -> acquire
silence is as good as neutral, pushing is not [by motion]
    refused stop; 0 neutral -> nothing; refused stop; 0.9 motion ! stop; 1.8 motion ! stop; 2.9 motion -> acquire
a lease that is in use is kept without motion [by motion]
    0 want -> acquire; granted; in use; due inf; 900 time -> nothing; out of use; due 1.0; 900 time -> release
silence alone releases [by pulses]
    0 motion -> acquire; granted; due 0.5; 0.4 neutral -> send; due 0.9; 0.9 time -> release; released
    1.0 motion -> acquire; granted; lost stop; 1.1 motion ! stop
what is refused keeps nothing [by pulses]
    0 motion -> acquire; granted; refused stop; 0.3 motion ! stop; due 0.5; 0.5 time -> release
"""


@scripts(STORIES)
def test_what_a_stick_says_becomes_of_it(special: str, script: str) -> None:
    stick = Stick(RULES[special])
    for step in script.split("; "):
        play(stick, step)


def test_a_stick_may_need_neutral_from_the_beginning() -> None:
    stick = Stick(StickRules(), "connected")
    play(stick, "0 motion ! connected: centre the joystick first")
    play(stick, "0.1 neutral -> nothing")
    play(stick, "0.2 motion -> acquire")


def test_the_table_of_the_documentation_is_the_one_that_is_executed() -> None:
    assert documented("reference/state-tables.md", "the stick, or its lease") == executed(Stick.TABLE)


BARRED = (StickState.IDLE_NEEDS_NEUTRAL, StickState.ASKING_NEEDS_NEUTRAL, StickState.HOLDING_NEEDS_NEUTRAL)
HELD = (StickState.HOLDING, StickState.HOLDING_NEEDS_NEUTRAL)


@pytest.mark.parametrize("state", StickState)
def test_no_cell_moves_who_needs_neutral_or_has_no_lease_nor_asks_twice(state: StickState) -> None:
    for said, (action, after) in Stick.TABLE[state].items():
        after = after or state
        assert (action is StickAction.REFUSE) == (said is StickInput.MOTION and state in BARRED)
        assert action is not StickAction.SEND or state in HELD
        assert action is not StickAction.WAIT or state in (StickState.ASKING, StickState.ASKING_NEEDS_NEUTRAL)
        assert (action is StickAction.ACQUIRE) <= (state in (StickState.IDLE, StickState.IDLE_NEEDS_NEUTRAL))
        if state in BARRED and after not in BARRED:
            assert said in (StickInput.NEUTRAL, StickInput.CLEARED)
        if after in HELD and state not in HELD:
            assert said is StickInput.GRANTED


def test_nothing_is_due_before_anything_was_said() -> None:
    for rules in RULES.values():
        stick = Stick(rules)
        assert stick.deadline() == math.inf
        assert not stick.expire(1e9)
        assert not stick.wants_release(1e9)
