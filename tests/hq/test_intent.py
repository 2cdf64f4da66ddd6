"""What old HQ programs mean: neutral first, standing control modes, deadman, giving back. Times are made up."""

import math

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


def ready(*, modes: bool = False) -> Intent:
    """A program that has said neutral."""
    intent = connected(modes=modes)
    assert intent.neutral(0.0) is Action.NOTHING
    return intent


def driving(*, lease_s: float = LEASE_S) -> Intent:
    """A program that holds the robot and moves it since second 0."""
    intent = ready()
    assert intent.motion(0.0) is Action.ACQUIRE
    intent.granted(lease_s)
    return intent


def on_its_own() -> Intent:
    """A program whose robot drives itself since second 0."""
    intent = ready(modes=True)
    assert intent.choose("autonomous", 0.0) is Action.ACQUIRE
    intent.granted(LEASE_S)
    return intent


# A robot that drives itself


def test_neutral_does_not_stop_a_robot_that_drives_itself() -> None:
    """Deployed programs say it every half second while nobody touches the stick, in mode 3 too."""
    intent = ready(modes=True)
    assert intent.choose("autonomous", 0.0) is Action.ACQUIRE
    assert intent.neutral(0.1) is Action.NOTHING
    intent.granted(LEASE_S)
    for step in range(1, 100):
        assert intent.neutral(0.5 * step) is Action.NOTHING


def test_neutral_after_motion_by_the_stick_stops_a_robot_that_drives_itself() -> None:
    intent = on_its_own()
    assert intent.motion(1.0) is Action.SEND
    assert intent.neutral(1.5) is Action.SEND
    assert intent.neutral(2.0) is Action.NOTHING


def test_a_neutral_that_is_owed_is_sent_in_mode_3_too() -> None:
    intent = on_its_own()
    intent.refused("robot lost")
    assert intent.neutral(1.0) is Action.SEND
    assert intent.neutral(1.5) is Action.NOTHING


# Neutral first


def test_a_new_program_must_say_neutral_before_motion() -> None:
    intent = Intent(DEADMAN_S)
    for now in (0.0, 0.5, 100.0):
        with pytest.raises(Refused, match="connected: release the stick first"):
            intent.motion(now)
    assert not intent.asking
    assert intent.neutral(101.0) is Action.NOTHING
    assert intent.motion(101.5) is Action.ACQUIRE


def test_motion_asks_once_waits_for_the_answer_and_is_then_sent() -> None:
    intent = ready()
    assert intent.motion(0.0) is Action.ACQUIRE
    assert intent.motion(0.1) is Action.WAIT
    assert intent.neutral(0.2) is Action.WAIT
    intent.granted(3.0)
    assert intent.motion(0.3) is Action.SEND
    assert intent.neutral(0.4) is Action.SEND


def test_neutral_of_a_program_that_holds_nothing_is_nothing() -> None:
    intent = ready()
    for now in (1.0, 2.0):
        assert intent.neutral(now) is Action.NOTHING
    assert not intent.asking


@pytest.mark.parametrize("why", ["held by operator (priority 0)", "stop", "lease expired"])
def test_whoever_lost_the_robot_or_was_refused_it_must_say_neutral(why: str) -> None:
    intent = driving()
    intent.lost(why)
    assert not intent.held
    with pytest.raises(Refused, match="release the stick first") as caught:
        intent.motion(0.5)
    assert str(caught.value).startswith(why)
    assert intent.neutral(0.6) is Action.NOTHING
    assert intent.motion(0.7) is Action.ACQUIRE


def test_whoever_is_refused_while_asking_may_ask_again_after_neutral() -> None:
    intent = ready()
    intent.motion(0.0)
    intent.lost("held by operator (priority 0)")
    assert not intent.asking
    with pytest.raises(Refused):
        intent.motion(0.1)
    intent.neutral(0.2)
    assert intent.motion(0.3) is Action.ACQUIRE


def test_a_refused_motion_holds_back_and_leaves_the_lease() -> None:
    intent = driving()
    intent.refused("busy: map")
    assert intent.held
    assert not intent.may_steer
    with pytest.raises(Refused, match="busy: map: release the stick first"):
        intent.motion(0.5)
    assert intent.neutral(0.6) is Action.SEND
    assert intent.motion(0.7) is Action.SEND


def test_a_program_that_gave_the_robot_back_need_not_say_neutral_anew() -> None:
    intent = driving()
    intent.neutral(0.5)
    intent.released()
    assert intent.motion(5.0) is Action.ACQUIRE


# Deadman


def test_motion_that_is_not_repeated_within_the_deadman_has_ended() -> None:
    intent = driving()
    with pytest.raises(Refused, match="deadman: release the stick first"):
        intent.motion(DEADMAN_S)
    assert intent.neutral(DEADMAN_S + 0.1) is Action.SEND
    assert intent.motion(DEADMAN_S + 0.2) is Action.SEND


def test_motion_that_is_repeated_just_in_time_goes_on() -> None:
    intent, now = driving(), 0.0
    for _ in range(100):
        now += DEADMAN_S - 0.001
        assert intent.motion(now) is Action.SEND


def test_silence_after_neutral_is_no_deadman() -> None:
    intent = driving()
    intent.neutral(0.1)
    assert intent.motion(2.9) is Action.SEND


def test_the_deadman_needs_no_message_to_be_noticed() -> None:
    intent = driving()
    intent.expire(DEADMAN_S - 0.001)
    assert intent.may_steer
    intent.expire(DEADMAN_S)
    assert not intent.may_steer
    assert intent.held


def test_the_deadman_counts_from_the_motion_and_not_from_the_grant() -> None:
    intent = ready()
    intent.motion(0.0)
    intent.granted(3.0)
    intent.expire(DEADMAN_S)
    assert intent.held_back == "deadman"


def test_motion_refused_is_no_sign_of_life() -> None:
    intent = driving()
    intent.expire(1.4)
    for step in range(30):
        with pytest.raises(Refused):
            intent.motion(1.5 + step / 10)
    assert intent.wants_release(3.0)


# Control modes


def test_without_modes_motion_suffices() -> None:
    assert Intent(DEADMAN_S).mode == "manual"


def test_motion_before_a_control_mode_is_refused() -> None:
    intent = ready(modes=True)
    with pytest.raises(Refused, match="control mode is none"):
        intent.motion(0.5)
    assert not intent.asking


def test_after_motion_in_mode_none_neutral_must_come_although_the_mode_has() -> None:
    """A stick that was pushed while the mode was none moves nothing when the mode is chosen."""
    intent = ready(modes=True)
    with pytest.raises(Refused):
        intent.motion(0.5)
    assert intent.choose("manual", 0.61) is Action.NOTHING
    with pytest.raises(Refused, match="release the stick first"):
        intent.motion(0.7)
    intent.neutral(0.8)
    assert intent.motion(0.9) is Action.ACQUIRE


def test_a_mode_stands_through_release_loss_and_neutral() -> None:
    intent = ready(modes=True)
    assert intent.choose("manual", 0.1) is Action.NOTHING, "a mode alone moves nothing"
    assert intent.motion(0.2) is Action.ACQUIRE
    intent.granted(3.0)
    intent.lost("stop")
    intent.neutral(0.3)
    assert intent.motion(0.4) is Action.ACQUIRE
    intent.granted(3.0)
    intent.neutral(0.5)
    intent.released()
    assert intent.motion(0.6) is Action.ACQUIRE
    assert intent.mode == "manual"


def test_mode_none_gives_the_robot_back_and_ends_motion() -> None:
    intent = ready(modes=True)
    intent.choose("manual", 0.0)
    intent.motion(0.1)
    assert intent.choose("none", 0.2) is Action.RELEASE, "asked for, though not had yet"
    intent.released()
    intent.choose("manual", 0.3)
    intent.motion(0.4)
    intent.granted(3.0)
    assert intent.choose("none", 0.5) is Action.RELEASE
    intent.released()
    assert intent.choose("none", 0.6) is Action.NOTHING


def test_a_mode_while_the_robot_is_held_is_sent_and_while_it_is_asked_for_waits() -> None:
    intent = ready(modes=True)
    intent.choose("manual", 0.0)
    intent.motion(0.1)
    assert intent.choose("autonomous", 0.2) is Action.WAIT
    assert intent.choose("manual", 0.3) is Action.WAIT
    intent.granted(3.0)
    assert intent.choose("autonomous", 0.4) is Action.SEND
    assert intent.choose("manual", 0.5) is Action.SEND


def test_a_mode_that_motion_has_overtaken_is_no_mode_that_came_too_late() -> None:
    intent = connected(modes=True)
    intent.neutral(0.0)
    with pytest.raises(Refused, match="control mode is none"):
        intent.motion(1.0)
    intent.choose("manual", 1.05)
    assert intent.motion(1.5) is Action.ACQUIRE
    late = connected(modes=True)
    late.neutral(0.0)
    for now in (1.0, 1.5):
        with pytest.raises(Refused, match="control mode is none"):
            late.motion(now)
    late.choose("manual", 1.55)
    with pytest.raises(Refused, match="control mode is none: release the stick"):
        late.motion(2.0)


def test_mode_autonomous_is_motion() -> None:
    intent = connected(modes=True)
    with pytest.raises(Refused, match="connected: release the stick first"):
        intent.choose("autonomous", 0.0)
    assert (intent.mode, intent.asking) == ("autonomous", False), "it stands: programs say it once"
    intent.neutral(0.1)
    assert intent.choose("autonomous", 0.2) is Action.ACQUIRE


# Giving back


def test_neutral_for_the_time_of_the_lease_gives_the_robot_back() -> None:
    intent = driving(lease_s=2.0)
    intent.motion(1.0)
    for now in (1.1, 2.0, 2.6):
        intent.neutral(now)
        assert not intent.wants_release(now)
    assert intent.wants_release(3.0)


def test_silence_for_the_time_of_the_lease_gives_the_robot_back() -> None:
    intent = driving(lease_s=2.0)
    assert not intent.wants_release(2.0 - EARLY_S - 0.001)
    assert intent.wants_release(2.0 - EARLY_S + 0.001)


def test_motion_keeps_the_robot() -> None:
    intent = driving(lease_s=2.0)
    for step in range(100):
        intent.motion(step * 1.0)
        assert not intent.wants_release(step * 1.0)


def test_who_holds_nothing_has_nothing_to_give_back() -> None:
    intent = ready()
    assert not intent.wants_release(1e9)
    intent.motion(0.0)
    assert not intent.wants_release(1e9)


def test_a_robot_on_its_own_is_used_as_long_as_anything_is_heard() -> None:
    intent = on_its_own()
    for step in range(100):
        intent.heard(step * 2.0)
        assert not intent.wants_release(step * 2.0 + 1.9)
    assert not intent.wants_release(198.0 + LEASE_S - EARLY_S - 0.001)
    assert intent.wants_release(198.0 + LEASE_S - EARLY_S + 0.001)


def test_choosing_a_mode_does_not_put_the_deadman_of_the_stick_off() -> None:
    intent = driving()
    intent.choose("autonomous", 1.0)
    intent.choose("manual", 1.1)
    intent.expire(DEADMAN_S)
    assert intent.held_back == "deadman"


def test_a_robot_on_its_own_has_no_deadman() -> None:
    intent = on_its_own()
    intent.expire(1e6)
    assert intent.held_back is None


def test_a_robot_taken_back_from_driving_itself_is_not_given_away_at_once() -> None:
    intent = on_its_own()
    for step in range(20):
        intent.heard(step * 0.5)
    assert intent.choose("manual", 10.0) is Action.SEND
    assert not intent.wants_release(10.0 + LEASE_S - EARLY_S - 0.001)
    assert intent.wants_release(10.0 + LEASE_S - EARLY_S + 0.001)


def test_what_is_heard_does_not_keep_a_robot_that_is_driven_by_hand() -> None:
    intent = driving()
    intent.heard(2.9)
    assert intent.wants_release(LEASE_S)


def test_steering_needs_the_robot_and_neutral() -> None:
    intent = Intent(DEADMAN_S)
    assert not intent.may_steer
    intent.neutral(0.0)
    assert not intent.may_steer
    intent.motion(0.1)
    assert not intent.may_steer
    intent.granted(3.0)
    assert intent.may_steer
    intent.refused("busy")
    assert not intent.may_steer


def test_neutral_of_one_part_of_several_does_not_end_the_wait_for_neutral() -> None:
    intent = driving()
    intent.lost("stop")
    assert intent.neutral(0.1, whole=False) is Action.NOTHING
    with pytest.raises(Refused):
        intent.motion(0.2)
    assert intent.neutral(0.3) is Action.NOTHING
    assert intent.motion(0.4) is Action.ACQUIRE


def test_neutral_of_one_part_does_not_end_the_deadman_of_the_others() -> None:
    intent = driving()
    assert intent.neutral(0.1, whole=False) is Action.SEND
    intent.expire(DEADMAN_S)
    assert intent.held_back == "deadman"


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
