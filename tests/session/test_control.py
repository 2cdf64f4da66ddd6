"""Control authority: refusals, the deadman, and what makes motion possible again."""

import math

import pytest

from zbridge.errors import Refused
from zbridge.fleet.messages import Refusal
from zbridge.session.control import REFUSALS, Authority


@pytest.fixture
def authority() -> Authority:
    return Authority(deadman_s=0.5)


def test_motion_is_admitted_at_first(authority: Authority) -> None:
    authority.admit(moving=True)
    assert authority.report().state == "free"
    assert not authority.moving


def test_nothing_is_overdue_while_the_robot_stands(authority: Authority) -> None:
    authority.applied(moving=False, now=0.0)
    assert authority.deadline() is None
    assert not authority.overdue(1e9)


def test_motion_is_overdue_after_the_deadman_time_and_not_before(authority: Authority) -> None:
    authority.applied(moving=True, now=10.0)
    assert authority.moving
    assert authority.deadline() == 10.5
    assert not authority.overdue(math.nextafter(10.5, 0))
    assert authority.overdue(10.5)


def test_every_fresh_command_puts_the_deadman_off(authority: Authority) -> None:
    authority.applied(moving=True, now=10.0)
    authority.applied(moving=True, now=10.4)
    assert authority.deadline() == 10.9
    assert not authority.overdue(10.6)


def test_neutral_ends_the_watch(authority: Authority) -> None:
    authority.applied(moving=True, now=10.0)
    authority.applied(moving=False, now=10.1)
    assert not authority.moving
    assert authority.deadline() is None
    assert not authority.overdue(11.0)


def test_a_stop_ends_the_watch_and_refuses_motion_with_its_reason(authority: Authority) -> None:
    authority.applied(moving=True, now=10.0)
    authority.stopped("deadman")
    assert not authority.moving
    assert authority.deadline() is None
    assert authority.report().state == "stopped"
    with pytest.raises(Refused, match=r"stopped \(deadman\).*neutral"):
        authority.admit(moving=True)


def test_after_a_stop_only_neutral_makes_motion_possible_again(authority: Authority) -> None:
    authority.stopped("stop")
    with pytest.raises(Refused):
        authority.admit(moving=True)
    with pytest.raises(Refused):
        authority.admit(moving=True)
    authority.admit(moving=False)
    authority.applied(moving=False, now=1.0)
    assert authority.report().state == "free"
    authority.admit(moving=True)


def test_a_neutral_that_was_only_admitted_changes_nothing(authority: Authority) -> None:
    authority.stopped("stop")
    authority.admit(moving=False)
    with pytest.raises(Refused):
        authority.admit(moving=True)


def test_motion_noted_after_a_stop_does_not_lift_it(authority: Authority) -> None:
    authority.stopped("stop")
    authority.applied(moving=True, now=1.0)
    with pytest.raises(Refused, match="stop"):
        authority.admit(moving=True)


def test_the_latest_reason_for_a_stop_is_the_one_shown(authority: Authority) -> None:
    authority.stopped("deadman")
    authority.stopped("robot lost")
    with pytest.raises(Refused, match="robot lost"):
        authority.admit(moving=True)


def test_equal_refusals_are_counted_together_and_the_newest_stands_last(authority: Authority) -> None:
    authority.refuse("drive", "offline")
    authority.refuse("lidar", "offline")
    authority.refuse("drive", "offline")
    assert authority.report().refusals == (
        Refusal(who=None, command="lidar", reason="offline", count=1),
        Refusal(who=None, command="drive", reason="offline", count=2),
    )


def test_refusals_of_different_senders_are_told_apart(authority: Authority) -> None:
    authority.refuse("drive", "offline", who="hq.1")
    authority.refuse("drive", "offline", who="hq.2")
    assert [(refusal.who, refusal.count) for refusal in authority.report().refusals] == [("hq.1", 1), ("hq.2", 1)]


def test_refusals_are_bounded_and_the_oldest_makes_room(authority: Authority) -> None:
    for number in range(REFUSALS + 3):
        authority.refuse("raw", f"reason {number}")
    shown = authority.report().refusals
    assert len(shown) == REFUSALS
    assert shown[0].reason == "reason 3"
    assert shown[-1].reason == f"reason {REFUSALS + 2}"


def test_an_authority_prints_its_state(authority: Authority) -> None:
    assert repr(authority) == "<Authority free>"
    authority.applied(moving=True, now=0.0)
    assert repr(authority) == "<Authority moving>"
    authority.stopped("bus lost")
    assert repr(authority) == "<Authority bus lost>"
