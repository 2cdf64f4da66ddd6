"""The age of commands, sentence by sentence as the design's "Command age" has it.

Times are seconds on the gateway's clock. The sender's clock shows other numbers, and may run at another speed; what it
sends takes ``way`` seconds.
"""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET

from tests.proofs import numbered, proof, shown
from zbridge.control.authority import Authority
from zbridge.control.events import StopCause
from zbridge.control.holders import CommandAge
from zbridge.errors import Code, Malformed, NeutralFirst, Refused
from zbridge.fleet.lease_messages import Acquire, Authorization, Lease

KEYS = "fleet/r1/"
DRIVE, RENEW, RELEASE = KEYS + "@cmd/drive", KEYS + "@rpc/control/renew", KEYS + "@rpc/control/release"
ID, TOKEN = b"\x01" * 8, b"\x01" * 32
"""Of the first lease of an authority."""
PAYLOAD = b"\x81\xa7forward\x01"
LEASE_S, DEADMAN_S, MAX_AGE_S = 3.0, 2.0, 0.4
SENDER_MS = 5_000_000
"""What the sender's clock shows at 0 s of the gateway's."""
WAY_S = 0.01


class Ann:
    """A program that dates what it sends, and the authority that it sends to. speed: of its clock."""

    def __init__(
        self, *, max_age_s: float = MAX_AGE_S, deadman_s: float = DEADMAN_S, dates: bool = True, speed: float = 1.0
    ) -> None:
        self.authority = Authority(LEASE_S, DEADMAN_S, numbered(), max_age_s)
        self.deadman_s = deadman_s
        self.dates = dates
        self.speed = speed
        self.seq = 0

    def t(self, at: float) -> int:
        return round(SENDER_MS + at * self.speed * 1000)

    def acquire(self, at: float = 0.0, way_s: float = WAY_S) -> Lease:
        request = Acquire(who="ann", deadman_s=self.deadman_s, t=self.t(at) if self.dates else UNSET)
        lease = self.authority.acquire(request, at + way_s, (at + way_s) * 1000)
        assert lease.ok
        return lease

    def command(self, at: float, way_s: float = WAY_S, *, moving: bool = True) -> bool:
        """Send a drive; tell whether it was carried out, as a gateway does."""
        self.seq += 1
        t, now = self.t(at) if self.dates else None, at + way_s
        attachment = shown(ID, TOKEN, DRIVE, self.seq, PAYLOAD, t)
        sender = self.authority.admit(attachment, DRIVE, PAYLOAD, now, now * 1000)
        assert sender.who == "ann"
        if moving and sender.stale:
            return False
        if moving:
            self.authority.motion.check_motion()
        self.authority.applied("drive", sender.given_at, moving=moving, stale=sender.stale)
        return True

    def renew(self, at: float, way_s: float = WAY_S) -> Lease:
        self.seq += 1
        t, now = self.t(at), at + way_s
        asks = Authorization(lease=ID, seq=self.seq, proof=proof(TOKEN, RENEW, self.seq, t=t), t=t)
        return self.authority.renew(asks, RENEW, now, now * 1000)

    def ends_at(self, at: float) -> float:
        """When the lease expires, as seen at this time."""
        left_s = self.authority.report(at).expires_in_s
        assert left_s is not None
        return at + left_s


def near(expected: float) -> float:
    """Within what a clock in whole milliseconds shows."""
    return pytest.approx(expected, abs=0.0011)  # type: ignore[no-any-return]


# What is obeyed, and what is stale


@pytest.mark.parametrize(("late_s", "obeyed"), [(0.0, True), (0.39, True), (0.41, False), (1.8, False)])
def test_motion_that_is_later_than_the_greatest_age_is_not_obeyed(late_s: float, obeyed: bool) -> None:
    ann = Ann()
    ann.acquire()
    assert ann.command(1.0)
    assert ann.command(1.1, WAY_S + late_s) is obeyed


@pytest.mark.parametrize(("late_s", "obeyed"), [(0.19, True), (0.21, False)])
def test_the_greatest_age_is_the_deadman_where_that_is_less(late_s: float, obeyed: bool) -> None:
    ann = Ann(deadman_s=0.2)
    assert ann.acquire().max_age_s == 0.2
    assert ann.command(1.0, WAY_S + late_s) is obeyed


def test_the_deadman_counts_from_when_motion_was_given() -> None:
    ann = Ann()
    ann.acquire()
    assert ann.command(1.0, WAY_S + 0.3)  # the first: it may be as late as it is
    assert ann.command(1.1)
    assert ann.command(1.2, WAY_S + 0.3)
    assert ann.authority.deadline() == near(1.2 + WAY_S + DEADMAN_S)


def test_what_is_stale_extends_neither_motion_nor_the_lease() -> None:
    ann = Ann()
    ann.acquire()
    assert ann.command(1.0)
    deadline, ends_at = ann.authority.deadline(), ann.ends_at(1.01)
    assert not ann.command(1.1, 0.9)
    assert ann.command(1.1, 0.9, moving=False)
    assert ann.ends_at(2.0) == near(ends_at)
    assert deadline == near(1.0 + WAY_S + DEADMAN_S)


def test_a_stale_renewal_is_answered_with_what_is_left() -> None:
    ann = Ann()
    ann.acquire()
    assert ann.renew(1.0).expires_in_s == LEASE_S
    late = ann.renew(1.1, 1.9)
    assert late.ok
    assert late.expires_in_s == near(1.0 + WAY_S + LEASE_S - 3.0)
    assert ann.renew(3.1).expires_in_s == LEASE_S


def test_a_stale_neutral_ends_motion_and_leaves_the_robot_needs_neutral() -> None:
    ann = Ann()
    ann.acquire()
    ann.command(1.0)
    ann.authority.require_neutral("the robot's link stalled", StopCause.LINK_STALLED)
    assert ann.command(1.1, 0.9, moving=False)
    with pytest.raises(NeutralFirst):
        ann.authority.motion.check_motion()
    assert ann.command(2.1, moving=False)
    assert ann.command(2.2)


def test_a_stale_neutral_that_finds_the_robot_moving_stops_it_and_the_next_fresh_motion_is_obeyed() -> None:
    ann = Ann()
    ann.acquire()
    ann.command(1.0)
    assert ann.command(1.1, 0.9, moving=False)
    assert not ann.authority.motion.moving
    assert ann.authority.deadline() == near(1.0 + WAY_S + LEASE_S), "no deadman runs"
    assert ann.command(2.1)


def test_a_stale_neutral_of_one_part_leaves_the_deadman_of_another_alone() -> None:
    ann = Ann()
    ann.acquire()
    ann.command(1.0)
    ann.authority.applied("motor/lift", 1.0, moving=True)
    before = ann.authority.deadline()
    ann.command(1.1, 0.9, moving=False)
    assert ann.authority.motion.moving
    assert ann.authority.deadline() == before


def test_after_a_cut_neutral_and_push_that_waited_move_nothing() -> None:
    """The issue that asked for all this: a cut of 2.3 s, and 20 commands a second that TCP kept."""
    ann = Ann()
    ann.acquire()
    for tick in range(20):
        ann.command(tick * 0.05)
    ann.authority.expire(0.95 + WAY_S + DEADMAN_S)
    with pytest.raises(NeutralFirst):
        ann.authority.motion.check_motion()
    healed = 3.3
    for tick in range(20, 66):
        given_at = tick * 0.05
        if tick in (24, 25):
            assert ann.command(given_at, healed - given_at, moving=False)
        elif healed - given_at > MAX_AGE_S + WAY_S:
            assert not ann.command(given_at, healed - given_at)
        else:
            with pytest.raises(NeutralFirst):
                ann.command(given_at, healed - given_at)
    assert not ann.authority.motion.moving


# The baseline


def test_a_baseline_that_was_set_during_a_cut_is_lowered_by_the_first_command_in_time() -> None:
    ann = Ann()
    ann.acquire(0.0, 3.0)
    assert ann.command(3.1)
    assert not ann.command(3.2, WAY_S + 0.5)


@pytest.mark.parametrize("speed", [0.9995, 0.9999, 1.0, 1.0001, 1.0005])
def test_clocks_that_run_at_different_speeds_make_nothing_stale_in_a_day(speed: float) -> None:
    """NTP slews a clock by 500 millionths at most; raw clocks differ by less than 200."""
    age, ann = CommandAge(MAX_AGE_S), Ann(speed=speed)
    for minute in range(24 * 60):
        at = minute * 60.0
        assert age.late_s(ann.t(at), (at + WAY_S) * 1000) < 0.02
        assert age.late_s(ann.t(at + 1), (at + 1 + WAY_S + 0.5) * 1000) == pytest.approx(0.5, abs=0.02)


def test_a_network_that_became_slower_for_good_is_forgiven_by_a_millisecond_a_second() -> None:
    age = CommandAge(0.4)
    age.late_s(0, 10.0)
    assert age.late_s(1_000, 1_510.0) == pytest.approx(0.5 - 0.0015)
    assert age.late_s(301_000, 301_510.0) == pytest.approx(0.2 - 0.0015)
    assert age.late_s(601_000, 601_510.0) == pytest.approx(0.0)


@given(st.lists(st.tuples(st.floats(0, 5), st.floats(0, 10)), min_size=1, max_size=50))
def test_nothing_is_ever_late_by_less_than_nothing_nor_by_more_than_its_way(events: list[tuple[float, float]]) -> None:
    age, at_ms, newest_ms = CommandAge(0.4), 0.0, 0.0
    for after_s, way_s in events:
        at_ms += after_s * 1000
        newest_ms = max(newest_ms, at_ms + way_s * 1000)
        assert 0.0 <= age.late_s(round(at_ms), newest_ms) <= (newest_ms - at_ms) / 1000 + 0.001


# Who dates, and who does not


def test_programs_that_never_date_anything_are_served_as_before() -> None:
    ann = Ann(dates=False)
    assert ann.acquire().max_age_s is UNSET
    for way_s in (WAY_S, 1.5):
        assert ann.command(1.0, way_s)
    assert ann.authority.deadline() == 1.0 + 1.5 + DEADMAN_S


@pytest.mark.parametrize("after", ["acquire", "command"])
def test_after_a_date_was_seen_a_command_or_renewal_without_one_is_malformed_and_renews_nothing(after: str) -> None:
    ann = Ann(dates=after == "acquire")
    ann.acquire()
    if after == "command":
        ann.dates = True
        ann.command(0.5)
    ends_at, ann.dates = ann.ends_at(1.0), False
    with pytest.raises(Malformed, match="t is missing") as refused:
        ann.command(1.0)
    assert refused.value.who == "ann", "its proof shows it"
    ann.seq += 1
    asks = Authorization(lease=ID, seq=ann.seq, proof=proof(TOKEN, RENEW, ann.seq))
    assert ann.authority.renew(asks, RENEW, 1.0, 1000.0).code == Code.MALFORMED
    assert ann.ends_at(1.0) == near(ends_at)
    asks = Authorization(lease=ID, seq=ann.seq + 1, proof=proof(TOKEN, RELEASE, ann.seq + 1))
    assert ann.authority.release(asks, RELEASE, 1.0).ok, "a release is never too late, and needs none"


def test_with_a_greatest_age_of_zero_nothing_is_stale_and_nothing_must_be_dated() -> None:
    ann = Ann(max_age_s=0.0)
    assert ann.acquire().max_age_s is UNSET
    for way_s in (WAY_S, 1.5):
        assert ann.command(1.0, way_s)
    ann.dates = False
    assert ann.command(1.0, 1.6)
    assert CommandAge(math.inf).late_s(0, 1e9) == 0.0


def test_a_new_lease_begins_with_a_baseline_of_its_own() -> None:
    ann = Ann()
    ann.acquire()
    ann.command(0.1)
    ann.authority.stop("stop")
    request = Acquire(who="bob", t=1)
    bob = ann.authority.acquire(request, 50.0, 50_000.0)
    assert bob.max_age_s == MAX_AGE_S
    with pytest.raises(Refused):
        ann.command(50.1)
