"""What old HQ programs mean: neutral first, standing control modes, deadman, giving back. Times are made up."""

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from tests.tables import documented, executed
from zbridge.errors import Refused
from zbridge.hq.intent import EARLY_S, LEASE_S, TOGETHER_S, Action, Intent

DEADMAN_S = 1.25


def connected(*, modes: bool = False) -> Intent:
    """A program that has just connected. modes: it must choose a control mode before it drives."""
    intent = Intent(DEADMAN_S)
    if modes:
        assert intent.choose("none", 0.0) is Action.NOTHING
    return intent


def choosing() -> Intent:
    """A program that has just connected and must choose a control mode."""
    return connected(modes=True)


def ready(*, modes: bool = False) -> Intent:
    """A program that has said neutral."""
    intent = connected(modes=modes)
    assert intent.neutral(0.0) is Action.NOTHING
    return intent


def ready_to_choose() -> Intent:
    """A program that has said neutral and must choose a control mode."""
    return ready(modes=True)


def driving(*, lease_s: float = LEASE_S) -> Intent:
    """A program that holds the robot and moves it since second 0."""
    intent = ready()
    assert intent.motion(0.0) is Action.ACQUIRE
    intent.granted(lease_s)
    return intent


def driving_for_2_s() -> Intent:
    """The same with a lease of 2 s."""
    return driving(lease_s=2.0)


def on_its_own() -> Intent:
    """A program whose robot drives itself since second 0."""
    intent = ready(modes=True)
    assert intent.choose("autonomous", 0.0) is Action.ACQUIRE
    intent.granted(LEASE_S)
    return intent


SAID: dict[str, Callable[[Intent, float], Action]] = {
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
}
SHOWN: dict[str, Callable[[Intent, str], object]] = {
    "held": lambda intent, _: intent.held,
    "asking": lambda intent, _: intent.asking,
    "may steer": lambda intent, _: intent.may_steer,
    "mode is": lambda intent, mode: intent.mode == mode,
    "held back": lambda intent, reason: intent.held_back == reason,
    "free to go": lambda intent, _: intent.held_back is None,
    "wants release": lambda intent, now: intent.wants_release(float(now)),
}


def play(intent: Intent, script: str) -> None:
    """Play the steps of a script, one after the other, separated by semicolons:

    ``0.5 motion -> send``: at second 0.5 the program says so, and that is to be done; ``0.5 motion ! deadman``: that is
    refused, and the reason begins so; ``granted 3.0``: that happened; ``is held``, ``not asking``: so things stand.
    """
    for step in script.split("; "):
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


SCRIPTS: dict[str, tuple[Callable[[], Intent], str]] = {
    # A robot that drives itself
    "neutral while a robot that will drive itself is asked for does not stop it": (
        ready_to_choose,
        "0.0 mode autonomous -> acquire; 0.1 neutral -> nothing; granted 3.0; 0.5 neutral -> nothing",
    ),
    "neutral after motion by the stick stops a robot that drives itself": (
        on_its_own,
        "1.0 motion -> send; 1.5 neutral -> send; 2.0 neutral -> nothing",
    ),
    "a neutral that is owed is sent in mode 3 too": (
        on_its_own,
        "refused robot lost; 1.0 neutral -> send; 1.5 neutral -> nothing",
    ),
    # Neutral first
    "a new program must say neutral before motion": (
        connected,
        "0.0 motion ! connected: release the stick first; 0.5 motion ! connected: release the stick first; "
        "100.0 motion ! connected: release the stick first; not asking; "
        "101.0 neutral -> nothing; 101.5 motion -> acquire",
    ),
    "motion asks once, waits for the answer and is then sent": (
        ready,
        "0.0 motion -> acquire; 0.1 motion -> wait; 0.2 neutral -> wait; granted 3.0; "
        "0.3 motion -> send; 0.4 neutral -> send",
    ),
    "neutral of a program that holds nothing is nothing": (
        ready,
        "1.0 neutral -> nothing; 2.0 neutral -> nothing; not asking",
    ),
    **{
        f"whoever lost the robot or was refused it must say neutral: {why}": (
            driving,
            f"lost {why}; not held; 0.5 motion ! {why}: release the stick first; "
            "0.6 neutral -> nothing; 0.7 motion -> acquire",
        )
        for why in ("held by operator (priority 0)", "stop", "lease expired")
    },
    "whoever is refused while asking may ask again after neutral": (
        ready,
        "0.0 motion -> acquire; lost held by operator (priority 0); not asking; 0.1 motion ! held by operator; "
        "0.2 neutral -> nothing; 0.3 motion -> acquire",
    ),
    "a refused motion holds back and leaves the lease": (
        driving,
        "refused busy: map; is held; not may steer; 0.5 motion ! busy: map: release the stick first; "
        "0.6 neutral -> send; 0.7 motion -> send",
    ),
    "a program that gave the robot back need not say neutral anew": (
        driving,
        "0.5 neutral -> send; released; 5.0 motion -> acquire",
    ),
    "steering needs the robot and neutral": (
        connected,
        "not may steer; 0.0 neutral -> nothing; not may steer; 0.1 motion -> acquire; not may steer; granted 3.0; "
        "is may steer; refused busy; not may steer",
    ),
    "neutral of one part of several does not end the wait for neutral": (
        driving,
        "lost stop; 0.1 neutral of a part -> nothing; 0.2 motion ! stop; 0.3 neutral -> nothing; 0.4 motion -> acquire",
    ),
    # Deadman
    "motion that is not repeated within the deadman has ended": (
        driving,
        "1.25 motion ! deadman: release the stick first; 1.35 neutral -> send; 1.45 motion -> send",
    ),
    "silence after neutral is no deadman": (driving, "0.1 neutral -> send; 2.9 motion -> send"),
    "the deadman needs no message to be noticed": (
        driving,
        "expire 1.249; is may steer; expire 1.25; not may steer; is held",
    ),
    "the deadman counts from the motion and not from the grant": (
        ready,
        "0.0 motion -> acquire; granted 3.0; expire 1.25; is held back deadman",
    ),
    "neutral of one part does not end the deadman of the others": (
        driving,
        "0.1 neutral of a part -> send; expire 1.25; is held back deadman",
    ),
    "choosing a mode does not put the deadman of the stick off": (
        driving,
        "1.0 mode autonomous -> send; 1.1 mode manual -> send; expire 1.25; is held back deadman",
    ),
    "a robot on its own has no deadman": (on_its_own, "expire 1000000; is free to go"),
    # Control modes
    "without modes motion suffices": (connected, "is mode is manual"),
    "motion before a control mode is refused": (ready_to_choose, "0.5 motion ! control mode is none; not asking"),
    "a stick that was pushed while the mode was none moves nothing when the mode is chosen": (
        ready_to_choose,
        "0.5 motion ! control mode is none; 0.61 mode manual -> nothing; "
        "0.7 motion ! control mode is none: release the stick first; 0.8 neutral -> nothing; 0.9 motion -> acquire",
    ),
    "a mode stands through release, loss and neutral, and alone moves nothing": (
        ready_to_choose,
        "0.1 mode manual -> nothing; 0.2 motion -> acquire; granted 3.0; lost stop; 0.3 neutral -> nothing; "
        "0.4 motion -> acquire; granted 3.0; 0.5 neutral -> send; released; 0.6 motion -> acquire; is mode is manual",
    ),
    "mode none gives the robot back, had or only asked for, and ends motion": (
        ready_to_choose,
        "0.0 mode manual -> nothing; 0.1 motion -> acquire; 0.2 mode none -> release; released; "
        "0.3 mode manual -> nothing; 0.4 motion -> acquire; granted 3.0; 0.5 mode none -> release; released; "
        "0.6 mode none -> nothing",
    ),
    "a mode while the robot is held is sent and while it is asked for waits": (
        ready_to_choose,
        "0.0 mode manual -> nothing; 0.1 motion -> acquire; 0.2 mode autonomous -> wait; 0.3 mode manual -> wait; "
        "granted 3.0; 0.4 mode autonomous -> send; 0.5 mode manual -> send",
    ),
    "a mode that motion has overtaken is no mode that came too late": (
        ready_to_choose,
        "1.0 motion ! control mode is none; 1.05 mode manual -> nothing; is free to go; 1.5 motion -> acquire; "
        "granted 3.0; is may steer",
    ),
    "a mode after motion that came twice is one that came too late": (
        ready_to_choose,
        "1.0 motion ! control mode is none; 1.5 motion ! control mode is none; 1.55 mode manual -> nothing; "
        "2.0 motion ! control mode is none: release the stick",
    ),
    "mode autonomous is motion, and stands although it was refused: programs say it once": (
        choosing,
        "0.0 mode autonomous ! connected: release the stick first; is mode is autonomous; not asking; "
        "0.1 neutral -> nothing; 0.2 mode autonomous -> acquire",
    ),
    # Giving back
    "neutral for the time of the lease gives the robot back": (
        driving_for_2_s,
        "1.0 motion -> send; 1.1 neutral -> send; not wants release 1.1; 2.0 neutral -> send; not wants release 2.0; "
        "2.6 neutral -> send; not wants release 2.6; is wants release 3.0",
    ),
    "silence for the time of the lease gives the robot back": (
        driving_for_2_s,
        f"not wants release {2.0 - EARLY_S - 0.001}; is wants release {2.0 - EARLY_S + 0.001}",
    ),
    "who holds nothing has nothing to give back": (
        ready,
        "not wants release 1e9; 0.0 motion -> acquire; not wants release 1e9",
    ),
    "what is heard does not keep a robot that is driven by hand": (driving, f"heard 2.9; is wants release {LEASE_S}"),
}


@pytest.mark.parametrize(("begin", "script"), SCRIPTS.values(), ids=SCRIPTS)
def test_what_a_program_says_has_its_meaning(begin: Callable[[], Intent], script: str) -> None:
    play(begin(), script)


def test_neutral_does_not_stop_a_robot_that_drives_itself() -> None:
    """Deployed programs say it every half second while nobody touches the stick, in mode 3 too."""
    intent = on_its_own()
    for step in range(1, 100):
        assert intent.neutral(0.5 * step) is Action.NOTHING


def test_motion_that_is_repeated_just_in_time_goes_on_and_keeps_the_robot() -> None:
    intent, now = driving(lease_s=2.0), 0.0
    for _ in range(100):
        now += DEADMAN_S - 0.001
        assert intent.motion(now) is Action.SEND
        assert not intent.wants_release(now)


def test_motion_refused_is_no_sign_of_life() -> None:
    intent = driving()
    intent.expire(1.4)
    for step in range(30):
        with pytest.raises(Refused):
            intent.motion(1.5 + step / 10)
    assert intent.wants_release(3.0)


def test_a_robot_on_its_own_is_used_as_long_as_anything_is_heard() -> None:
    intent = on_its_own()
    for step in range(100):
        intent.heard(step * 2.0)
        assert not intent.wants_release(step * 2.0 + 1.9)
    assert not intent.wants_release(198.0 + LEASE_S - EARLY_S - 0.001)
    assert intent.wants_release(198.0 + LEASE_S - EARLY_S + 0.001)


def test_a_robot_taken_back_from_driving_itself_is_not_given_away_at_once() -> None:
    intent = on_its_own()
    for step in range(20):
        intent.heard(step * 0.5)
    assert intent.choose("manual", 10.0) is Action.SEND
    assert not intent.wants_release(10.0 + LEASE_S - EARLY_S - 0.001)
    assert intent.wants_release(10.0 + LEASE_S - EARLY_S + 0.001)


def test_an_intent_prints_itself() -> None:
    assert repr(connected(modes=True)) == "<Intent none idle connected>"
    assert repr(driving()) == "<Intent manual held None>"


# All orders of everything


class Program(RuleBasedStateMachine):
    """Says, in any order, what can be said; beside it stands what the design asks of it."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.intent = Intent(DEADMAN_S)
        self.mode = "manual"
        self.owed = True
        self.moving_until = math.inf
        """When motion ends that is not repeated."""
        self.used_at = -math.inf

    @initialize(modes=st.booleans())
    def begin(self, modes: bool) -> None:
        self.intent = connected(modes=modes)
        self.mode = "none" if modes else "manual"
        self.overtaken_until = -math.inf

    @rule(seconds=st.sampled_from([0.0, 0.0625, 0.125, 1.0, 1.25, 3.0, 64.0]))
    def wait(self, seconds: float) -> None:
        self.now += seconds

    def _age(self) -> None:
        if self.now >= self.moving_until:
            self._owe()

    def _owe(self) -> None:
        self.owed, self.moving_until = True, math.inf
        self.overtaken_until = -math.inf

    @rule()
    def push(self) -> None:
        self._age()
        held, asking = self.intent.held, self.intent.asking
        try:
            do = self.intent.motion(self.now)
        except Refused:
            assert self.owed or self.mode == "none"
            if not self.owed:
                self._owe()
                self.overtaken_until = self.now + TOGETHER_S
            return
        assert not self.owed, "motion although neutral is owed"
        assert self.mode != "none", "motion in mode none"
        assert do is (Action.SEND if held else Action.WAIT if asking else Action.ACQUIRE)
        self.used_at, self.moving_until = self.now, self.now + DEADMAN_S

    @rule(whole=st.booleans())
    def let_go(self, whole: bool) -> None:
        self._age()
        held, asking = self.intent.held, self.intent.asking
        drives_itself = self.mode == "autonomous" and not self.owed and self.moving_until == math.inf
        do = (
            Action.NOTHING
            if drives_itself and whole
            else Action.SEND
            if held
            else Action.WAIT
            if asking
            else Action.NOTHING
        )
        assert self.intent.neutral(self.now, whole=whole) is do
        assert self.intent.asking is asking, "neutral asks for nothing"
        if whole:
            self.owed, self.moving_until = False, math.inf

    @rule(mode=st.sampled_from(["none", "manual", "autonomous"]))
    def choose(self, mode: str) -> None:
        self._age()
        held, asking = self.intent.held, self.intent.asking
        if mode != "none" and self.now < self.overtaken_until:
            self.owed = False
        try:
            do = self.intent.choose(mode, self.now)
        except Refused:
            assert mode == "autonomous"
            assert self.owed
            assert self.intent.mode == mode, "a mode that was refused stands all the same"
            self.mode = mode
            return
        if mode == "autonomous":
            assert not self.owed, "motion although neutral is owed"
            assert do is (Action.SEND if held else Action.WAIT if asking else Action.ACQUIRE)
        elif mode == "none":
            assert do is (Action.RELEASE if held or asking else Action.NOTHING)
        else:
            assert do is (Action.SEND if held else Action.WAIT if asking else Action.NOTHING)
        if "autonomous" in (mode, self.mode):
            self.used_at = self.now
        self.mode = mode
        if do is Action.RELEASE:
            self.intent.released()
        if mode == "none":
            self.moving_until = math.inf

    @rule()
    def say_something(self) -> None:
        self.intent.heard(self.now)
        if self.mode == "autonomous":
            self.used_at = max(self.used_at, self.now)

    @precondition(lambda self: self.intent.asking)
    @rule()
    def grant(self) -> None:
        self.intent.granted(LEASE_S)

    @precondition(lambda self: self.intent.asking or self.intent.held)
    @rule()
    def lose(self) -> None:
        self.intent.lost("stop")
        self._owe()

    @precondition(lambda self: self.intent.held)
    @rule()
    def refuse(self) -> None:
        self.intent.refused("busy: map")
        self._owe()

    @precondition(lambda self: self.intent.held)
    @rule()
    def look_at_the_time(self) -> None:
        self._age()
        self.intent.expire(self.now)
        if self.intent.wants_release(self.now):
            assert self.now - self.used_at >= LEASE_S - EARLY_S, "in use"
            self.intent.released()
            self.moving_until = math.inf
        else:
            assert self.now - self.used_at < LEASE_S or self.mode == "autonomous", "not used for long"

    @invariant()
    def what_may_be_is_told(self) -> None:
        assert not (self.intent.held and self.intent.asking)
        assert self.intent.mode == self.mode
        if self.intent.may_steer:
            assert self.intent.held
            assert not self.owed


TestProgram = Program.TestCase
TestProgram.settings = settings(max_examples=4 * settings().max_examples, stateful_step_count=30)


@given(st.lists(st.floats(0.0, 1.24), max_size=20), st.floats(1.26, 1e6))
def test_motion_lives_as_long_as_no_gap_reaches_the_deadman(gaps: list[float], silence: float) -> None:
    intent, now = ready(), 0.0
    intent.motion(now)
    intent.granted(3.0)
    for gap in gaps:
        now += gap
        assert intent.motion(now) is Action.SEND
    with pytest.raises(Refused, match="deadman"):
        intent.motion(now + silence)


# The table


def test_the_table_of_the_documentation_is_the_one_that_is_executed() -> None:
    assert documented("control.md", "the program, or its lease") == executed(Intent.TABLE)
