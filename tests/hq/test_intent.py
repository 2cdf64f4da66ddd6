"""What old HQ programs mean: neutral first, standing control modes, deadman, giving back. Times are made up."""

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.hq.scripts import scripts
from zbridge.errors import Refused
from zbridge.hq.intent import LEASE_S, TOGETHER_S, Intent
from zbridge.lease.stick import StickAction

DEADMAN_S = 1.25


BEGINNINGS = {
    "": "",
    "ready": "0 neutral -> nothing",
    "choosing": "0 mode none -> nothing; 0 neutral -> nothing",
    "driving": "0 neutral -> nothing; 0 motion -> acquire; granted 3",
    "driving for 2 s": "0 neutral -> nothing; 0 motion -> acquire; granted 2",
    "on its own": "0 mode none -> nothing; 0 neutral -> nothing; 0 mode autonomous -> acquire; granted 3",
}
"""What a program has said at second 0; whoever chooses must choose a control mode before it drives."""
SAID: dict[str, Callable[[Intent, float], StickAction]] = {
    "motion": lambda intent, now: intent.motion(now),
    "neutral": lambda intent, now: intent.neutral(now),
    "neutral of a part": lambda intent, now: intent.neutral(now, whole=False),
    **{f"mode {mode}": lambda intent, now, m=mode: intent.choose(m, now) for mode in ("none", "manual", "autonomous")},
}
HAPPENED: dict[str, Callable[[Intent, str], object]] = {
    "granted": lambda intent, seconds: intent.granted(float(seconds)),
    "lost": lambda intent, reason: intent.lost(reason),
    "refused": lambda intent, reason: intent.refused(reason),
    "released": lambda intent, _: intent.released(),
    "expire": lambda intent, now: intent.expire(float(now)),
    "heard": lambda intent, now: intent.heard(float(now)),
    "restored": lambda intent, heard_at: intent.restore("manual", "restarted", float(heard_at)),
}
SHOWN: dict[str, Callable[[Intent, str], object]] = {
    "held": lambda intent, _: intent.held,
    "asking": lambda intent, _: intent.active and not intent.held,
    "may steer": lambda intent, _: intent.may_steer,
    "needs neutral": lambda intent, _: intent.needs_neutral is not None,
    "wants release": lambda intent, now: intent.wants_release(float(now)),
}


def played(*scripts: str) -> Intent:
    """Play the steps of scripts, one after the other, separated by semicolons, and return the intent:

    ``0.5 motion -> send``: at second 0.5 the program says so, and that is to be done; ``0.5 motion ! deadman``: that is
    refused, and the reason begins so; ``granted 3``: that happened; ``is held``, ``not asking``: so things stand.
    """
    intent = Intent(DEADMAN_S)
    for step in filter(None, "; ".join(scripts).split("; ")):
        first, _, rest = step.partition(" ")
        if first in HAPPENED:
            HAPPENED[first](intent, rest)
        elif first in ("is", "not"):
            what = next(name for name in SHOWN if rest.startswith(name))
            assert bool(SHOWN[what](intent, rest.removeprefix(what).strip())) is (first == "is"), step
        elif " -> " in rest:
            said, action = rest.split(" -> ")
            assert SAID[said](intent, float(first)).name.lower() == action, step
        else:
            said, reason = rest.split(" ! ")
            with pytest.raises(Refused) as caught:
                SAID[said](intent, float(first))
            assert str(caught.value).startswith(reason), step
    return intent


SCRIPTS = """
a new program must say neutral before motion
    0 motion ! connected: release the stick first; 100 motion ! connected: release the stick first; not asking
    101 neutral -> nothing; 101.5 motion -> acquire
motion asks once, waits for the answer and is then sent [ready]
    0.0 motion -> acquire; 0.1 motion -> wait; 0.2 neutral -> wait; not wants release 1e9; granted 3
    0.3 motion -> send; 0.4 neutral -> send
whoever lost the robot must say neutral, and not of a part only [driving]
    lost stop; not held; 0.1 motion ! stop: release the stick first; 0.1 neutral of a part -> nothing; 0.2 motion ! stop
    0.6 neutral -> nothing; 0.7 motion -> acquire; lost held by bob; not asking; 0.8 motion ! held by bob
    0.9 neutral -> nothing; 1.0 motion -> acquire
a refused motion makes neutral necessary and leaves the lease [driving]
    is may steer; refused busy: map; is held; not may steer; 0.5 motion ! busy: map: release the stick first
    0.6 neutral -> send; 0.7 motion -> send
a program that gave the robot back need not say neutral anew [driving]
    0.5 neutral -> send; released; not may steer; 5 motion -> acquire
# A robot that drives itself
neutral while a robot that will drive itself is asked for, or drives itself, does not stop it [choosing]
    0.0 mode autonomous -> acquire; 0.1 neutral -> nothing; granted 3; 0.5 neutral -> nothing; 50 neutral -> nothing
neutral after motion by the stick stops a robot that drives itself [on its own]
    1.0 motion -> send; 1.5 neutral -> send; 2.0 neutral -> nothing
a neutral that is owed is sent in mode 3 too [on its own]
    refused robot lost; 1.0 neutral -> send; 1.5 neutral -> nothing
a robot on its own has no deadman and is used as long as anything is heard [on its own]
    expire 1000; not needs neutral; heard 1000; not wants release 1002.6; is wants release 1002.8
a robot taken back from driving itself is not given away at once [on its own]
    heard 9.5; 10 mode manual -> send; not wants release 12.6; is wants release 12.8
# Deadman
motion that is not repeated within the deadman has ended, noticed by itself or by a message [driving]
    expire 1.249; is may steer; expire 1.25; not may steer; is held; 1.3 motion ! deadman: release the stick first
    1.35 neutral -> send; 1.45 motion -> send; 2.69 motion -> send; 4 motion ! deadman
silence after neutral is no deadman [driving]
    0.1 neutral -> send; 2.9 motion -> send
the deadman counts from the motion and not from the grant [ready]
    0 motion -> acquire; granted 3; expire 1.25; is needs neutral
neutral of one part, or a mode, does not put the deadman of the others off [driving]
    0.1 neutral of a part -> send; 1 mode autonomous -> send; 1.1 mode manual -> send; expire 1.25; is needs neutral
# What may have waited in the network
a push right behind the neutral that ends a silence moves nothing, however often both come [driving]
    heard 0.1; 0.1 motion -> send; expire 1.4; heard 2.4; 2.4 neutral -> send; 2.4 motion ! deadman: release the stick
    2.45 neutral -> send; 2.5 motion ! deadman; heard 2.7; 2.7 motion ! deadman; is needs neutral
a neutral after a silence counts once three tenths of a second pass without motion [driving]
    heard 0.1; 0.1 motion -> send; expire 1.4; heard 2.4; 2.4 neutral -> send; heard 2.6; 2.6 neutral -> send
    is needs neutral; heard 2.71; 2.71 neutral -> send; not needs neutral; 2.72 motion -> send
it counts without another one, too [driving]
    heard 0.1; 0.1 motion -> send; expire 1.4; heard 2.4; 2.4 neutral -> send; expire 2.69; is needs neutral
    expire 2.71; not needs neutral; heard 2.8; 2.8 motion -> send
mode autonomous behind it is motion [choosing]
    heard 0.1; 0.1 mode autonomous -> acquire; granted 3; lost stop; heard 2.0; 2.0 neutral -> nothing
    2.1 mode autonomous ! stop: release the stick first; 2.4 mode autonomous ! stop; 2.5 neutral -> nothing
    2.81 mode autonomous -> acquire
a neutral still ends motion at once, and one without a silence before it counts at once [driving]
    heard 0.1; 0.1 motion -> send; heard 1.3; 1.3 motion -> send; heard 2.6; 2.6 neutral -> send; 2.61 motion ! deadman
    heard 2.7; 2.7 neutral -> send; heard 3.1; 3.1 neutral -> send; not needs neutral; refused busy; 3.2 neutral -> send
    not needs neutral; 3.21 motion -> send
a neutral that was said before a stop does not count after it [driving]
    heard 0.1; 0.1 motion -> send; heard 2.0; 2.0 neutral -> send; lost stop; expire 2.4; is needs neutral
    2.4 motion ! stop
a neutral and motion that waited in the kernel during a long restart move nothing
    restored 0; heard 2; 2 neutral -> nothing; 2 motion ! restarted; heard 2.1; 2.1 neutral -> nothing; is needs neutral
    heard 2.5; 2.5 motion -> acquire
after a short restart a neutral counts at once
    restored 1; heard 2; 2 neutral -> nothing; 2 motion -> acquire
a new program was not silent
    heard 0; 0 neutral -> nothing; 0.1 motion -> acquire
# Control modes
a stick that was pushed while the mode was none moves nothing when the mode is chosen [choosing]
    0.5 motion ! control mode is none; not asking; 0.61 mode manual -> nothing
    0.7 motion ! control mode is none: release the stick first; 0.8 neutral -> nothing; 0.9 motion -> acquire
a mode that motion has overtaken is no mode that came too late [choosing]
    1 motion ! control mode is none; 1.05 mode manual -> nothing; not needs neutral; 1.5 motion -> acquire
a mode after motion that came twice is one that came too late [choosing]
    1 motion ! control mode is none; 1.5 motion ! control mode is none; 1.55 mode manual -> nothing
    2 motion ! control mode is none: release the stick
a mode stands through release, loss and neutral, and alone moves nothing [choosing]
    0.1 mode manual -> nothing; 0.2 motion -> acquire; granted 3; lost stop; 0.3 neutral -> nothing
    0.4 motion -> acquire; granted 3; 0.5 neutral -> send; released; 0.6 motion -> acquire
mode none gives the robot back, had or only asked for, and ends motion [choosing]
    0.0 mode manual -> nothing; 0.1 motion -> acquire; 0.2 mode none -> release; released; 0.3 mode manual -> nothing
    0.4 motion -> acquire; granted 3; 0.5 mode none -> release; released; 0.6 mode none -> nothing; expire 9
    not needs neutral
a mode while the robot is held is sent and while it is asked for waits [choosing]
    0 mode manual -> nothing; 0.1 motion -> acquire; 0.2 mode autonomous -> wait; 0.3 mode manual -> wait; granted 3
    0.4 mode autonomous -> send; 0.5 mode manual -> send
mode autonomous is motion, and stands although it was refused: programs say it once
    0 mode none -> nothing; 0 mode autonomous ! connected: release the stick first; not asking; 0.1 neutral -> nothing
    0.2 mode autonomous -> acquire; lost stop; 0.3 neutral -> nothing; 0.4 mode autonomous -> acquire; granted 3
# Giving back
neutral for the time of the lease gives the robot back [driving for 2 s]
    1.0 motion -> send; 2.0 neutral -> send; 2.6 neutral -> send; not wants release 2.69; is wants release 2.71
motion that was refused is no sign of life, nor is anything else that is heard of who drives by hand [driving]
    expire 1.4; 2.6 motion ! deadman; heard 2.6; not wants release 2.69; is wants release 2.71
"""


@scripts(SCRIPTS)
def test_what_a_program_says_has_its_meaning(special: str, script: str) -> None:
    played(BEGINNINGS[special], script)


@given(st.lists(st.floats(0.0, 1.24), max_size=20), st.floats(1.26, 1e6))
def test_motion_lives_and_keeps_the_robot_as_long_as_no_gap_reaches_the_deadman(gaps: list[float], end: float) -> None:
    intent, now = played(BEGINNINGS["driving for 2 s"]), 0.0
    for gap in gaps:
        now += gap
        assert intent.motion(now) is StickAction.SEND
        assert not intent.wants_release(now)
    with pytest.raises(Refused, match="deadman"):
        intent.motion(now + end)


STEPS = st.sampled_from([*SAID, "neutral", "grant", "lose", "refuse"])


@given(st.lists(st.tuples(st.sampled_from([0.0, 0.0625, 0.125, 1.0, 1.25, 64.0]), STEPS), min_size=20, max_size=60))
def test_whatever_is_said_in_any_order_nothing_moves_that_owes_neutral(steps: list[tuple[float, str]]) -> None:
    intent, now, owes, moving_until, overtaken = Intent(DEADMAN_S), 0.0, True, math.inf, -math.inf
    for wait, step in steps:
        now += wait
        owes = owes or now >= moving_until
        if step == "grant" and intent.active and not intent.held:
            intent.granted(LEASE_S)
        elif step == "lose" and intent.active:
            intent.lost("stop")
            owes, overtaken = True, -math.inf
        elif step == "refuse":
            intent.refused("busy: map")
            owes, overtaken = True, -math.inf
        elif step in SAID:
            modeless = step == "motion" and intent.mode == "none"
            try:
                done = SAID[step](intent, now)
            except Refused:
                assert owes or modeless
                overtaken = now + TOGETHER_S if modeless and not owes else overtaken
                owes = True
                continue
            if step in ("mode manual", "mode autonomous") and now < overtaken:
                owes = False
            assert not (owes and step in ("motion", "mode autonomous")), "it moves"
            owes, overtaken = (False, -math.inf) if step == "neutral" else (owes, overtaken)
            moving_until = now + DEADMAN_S if step == "motion" else moving_until
            moving_until = math.inf if owes or step in ("neutral", "mode none") else moving_until
            if done is StickAction.RELEASE:
                intent.released()
