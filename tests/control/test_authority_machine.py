"""Control authority against a model of its own, over any course of events: a robot moves only for its one driver.

The model is told the same things and knows only the rules of the design ("Who may drive"). The robot it drives
does what it is told, forever: what makes it stand is a neutral, or a stop that the authority gave in time.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import msgpack
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from tests.proofs import proof, shown
from zbridge.control.authority import Authority
from zbridge.control.events import EventKind
from zbridge.errors import Refused
from zbridge.fleet.messages import Acquire, Authorization, Lease

LEASE_S, DEADMAN_S = 3.0, 2.0
REMEMBERED = 8
"""Old leases that are tried again and again."""
KEY, OTHER_KEY = "fleet/r1/@cmd/drive", "fleet/r1/@cmd/mode"
RENEW, RELEASE = "fleet/r1/@rpc/control/renew", "fleet/r1/@rpc/control/release"
PAYLOAD = b"\x80"

clients = st.sampled_from(["ann", "bob", "hq.1"])
priorities = st.integers(-1, 2)
wishes_s = st.none() | st.sampled_from([0.01, 0.5, 1.0, 10.0]) | st.floats(0.01, 5)
waits_s = st.sampled_from([0.0, 0.01, 0.5, 1.0, 2.0, 3.0]) | st.floats(0, 5)
late_s = st.sampled_from([0.0] * 9 + [0.01, 0.5, 1.0, 2.0, 3.0]) | st.floats(0, 1)
"""Time that went by without the timer, as where the event loop is late; mostly none."""
parts = st.sampled_from(["drive", "left motor"])
mostly = st.sampled_from([True, True, True, False])
which = st.integers(0, REMEMBERED)


class Given(NamedTuple):
    """What was given with a lease."""

    lease: bytes
    token: bytes


NEVER = Given(bytes(8), bytes(32))
"""A lease that never was."""


@dataclass
class Driver:
    """Who drives, as the model sees it."""

    who: str
    priority: int
    given: Given
    alive: str | None
    lease_s: float
    deadman_s: float
    expires_at: float
    seq: int = -1
    obeyed_at: float = 0.0
    """When a command of its was last carried out."""


@dataclass
class Robot:
    """Moves as it was told until it is told to stop; nothing else stops it."""

    parts: set[str] = field(default_factory=set)
    on_its_own: bool = False

    @property
    def moving(self) -> bool:
        return bool(self.parts) or self.on_its_own

    def stop(self) -> None:
        self.parts.clear()
        self.on_its_own = False


class Driving(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        numbers, self.questions = itertools.count(1), itertools.count(1)
        self.authority = Authority(
            LEASE_S, DEADMAN_S, lambda size: b"\xa5" * (size - 4) + next(numbers).to_bytes(4, "big")
        )
        self.now = 1000.0
        self.robot = Robot()
        self.driver: Driver | None = None
        self.stopped = False
        self.must_neutral = False
        self.leases: list[Given] = []
        self.attachments: list[bytes] = []

    # The lease

    @rule(who=clients, priority=priorities, lease_s=wishes_s, deadman_s=wishes_s, alive=st.booleans(), late=late_s)
    def acquire(
        self, who: str, priority: int, lease_s: float | None, deadman_s: float | None, alive: bool, late: float
    ) -> None:
        self.pass_unwatched(late)
        request = Acquire(
            who=who, priority=priority, lease_s=lease_s, deadman_s=deadman_s, alive=f"{who}.1" if alive else None
        )
        granted = self.driver is None or priority > self.driver.priority
        self.take_grant(request, self.authority.acquire(request, self.now), granted)

    @rule(who=clients, priority=priorities, lease_s=wishes_s, deadman_s=wishes_s, alive=st.booleans(), late=late_s)
    def take_over(
        self, who: str, priority: int, lease_s: float | None, deadman_s: float | None, alive: bool, late: float
    ) -> None:
        self.pass_unwatched(late)
        request = Acquire(
            who=who, priority=priority, lease_s=lease_s, deadman_s=deadman_s, alive=f"{who}.1" if alive else None
        )
        self.take_grant(request, self.authority.takeover(request, self.now), granted=True)

    @rule(who=clients, wish_s=st.sampled_from([0.0, -1.0, float("nan"), float("-inf")]), late=late_s)
    def wish_for_no_time(self, who: str, wish_s: float, late: float) -> None:
        self.pass_unwatched(late)
        request = Acquire(who=who, priority=9, deadman_s=wish_s)
        self.take_grant(request, self.authority.takeover(request, self.now), granted=False)

    @rule(number=which, late=late_s)
    def renew(self, number: int, late: float) -> None:
        self.pass_unwatched(late)
        given = self.any_lease(number)
        lease = self.renewed(given)
        self.take_events()
        assert lease.ok == self.is_drivers(given)
        if self.driver is not None and lease.ok:
            self.driver.expires_at = self.now + self.driver.lease_s

    @rule(number=which, late=late_s)
    def release(self, number: int, late: float) -> None:
        self.pass_unwatched(late)
        given = self.any_lease(number)
        lease = self.released(given)
        assert lease.ok == self.is_drivers(given)
        if lease.ok:
            self.driver = None
        self.take_events()

    # Commands

    @precondition(lambda self: self.driver is not None)
    @rule(part=parts, moving=mostly, skipped=st.integers(0, 3), late=late_s)
    def drive(self, part: str, moving: bool, skipped: int, late: float) -> None:
        assert self.driver is not None
        attachment = attach(self.driver.given, self.driver.seq + 1 + skipped)
        self.pass_unwatched(late)
        self.command(attachment, self.driver is not None, lambda: self.obey(part, moving))

    @rule(who=clients, priority=priorities, deadman_s=wishes_s, part=parts)
    def set_off(self, who: str, priority: int, deadman_s: float | None, part: str) -> None:
        """Have a driver and motion, so that there is something to end."""
        if self.driver is None:
            self.acquire(who, priority, None, deadman_s, True, 0.0)
        if self.must_neutral:
            self.drive(part, False, 0, 0.0)
        self.drive(part, True, 0, 0.0)

    @rule(number=which, offset=st.integers(-3, 3), part=parts, moving=st.booleans(), late=late_s)
    def drive_somehow(self, number: int, offset: int, part: str, moving: bool, late: float) -> None:
        """Come with any lease that ever was, and any number."""
        self.pass_unwatched(late)
        given, last = self.any_lease(number), self.driver.seq if self.driver is not None else 0
        seq = max(0, last + offset)
        expected = self.is_drivers(given) and seq > last
        self.command(attach(given, seq), expected, lambda: self.obey(part, moving))

    @precondition(lambda self: self.attachments)
    @rule(number=st.integers(0, 100), late=late_s)
    def replay(self, number: int, late: float) -> None:
        """Send again what was sent once, admitted or not."""
        self.pass_unwatched(late)
        self.command(self.attachments[number % len(self.attachments)], False, lambda: self.obey("drive", True))

    @rule(
        lease=st.binary(min_size=8, max_size=8),
        token=st.binary(min_size=32, max_size=32),
        bit=st.integers(0, 8 * 16 - 1),
        late=late_s,
    )
    def forge(self, lease: bytes, token: bytes, bit: int, late: float) -> None:
        """Make a lease or a token up, change one bit of the right proof, or use it for another command."""
        self.pass_unwatched(late)
        tries = [attach(Given(lease, token), 2**40)]
        if self.driver is not None:
            given, seq = self.driver.given, self.driver.seq + 1
            near = (int.from_bytes(proof(given.token, KEY, seq, PAYLOAD), "big") ^ 1 << bit).to_bytes(16, "big")
            tries += [
                attach(Given(given.lease, token), seq),
                msgpack.packb({"lease": given.lease, "seq": seq, "proof": near}),
                shown(given.lease, given.token, OTHER_KEY, seq, PAYLOAD),
                shown(given.lease, given.token, KEY, seq, PAYLOAD + b"\x00"),
            ]
        for attachment in tries:
            self.command(attachment, False, lambda: self.obey("drive", True))

    @rule(attachment=st.none() | st.binary(max_size=40), late=late_s)
    def send_rubbish(self, attachment: bytes | None, late: float) -> None:
        self.pass_unwatched(late)
        self.command(attachment, False, lambda: self.obey("drive", True))

    @precondition(lambda self: self.driver is not None)
    @rule(late=late_s)
    def send_what_the_robot_refuses(self, late: float) -> None:
        """Come with a command that is admitted and then not carried out."""
        assert self.driver is not None
        attachment = attach(self.driver.given, self.driver.seq + 1)
        self.pass_unwatched(late)
        self.command(attachment, self.driver is not None, lambda: None)

    @precondition(lambda self: self.driver is not None)
    @rule(late=late_s)
    def send_it_off_by_itself(self, late: float) -> None:
        assert self.driver is not None
        attachment = attach(self.driver.given, self.driver.seq + 1)
        self.pass_unwatched(late)
        self.command(attachment, self.driver is not None, self.obey_by_itself)

    # What happens

    @rule(s=waits_s)
    def wait(self, s: float) -> None:
        """Let time go by with a timer that rings exactly when the authority said, and never else."""
        end = self.now + s
        while (deadline := self.authority.deadline()) is not None and deadline <= end:
            self.now = max(self.now, deadline)
            self.expire_model()
            self.authority.expire(self.now)
            self.take_events()
            after = self.authority.deadline()
            assert after is None or after > deadline, "a deadline that has passed must have been met"
        self.now = end

    @rule(who=clients)
    def stop(self, who: str) -> None:
        self.authority.stop(f"stop by {who}")
        self.driver, self.stopped = None, True
        self.take_events(must_stop=True)

    @rule(who=clients)
    def vanish(self, who: str) -> None:
        self.authority.vanished(f"{who}.1")
        if self.driver is not None and self.driver.alive == f"{who}.1":
            self.driver, self.stopped = None, True
        self.take_events()

    @rule()
    def lose_bus(self) -> None:
        self.authority.bus_lost()
        if self.driver is not None:
            self.driver, self.stopped = None, True
        self.take_events()

    @rule()
    def become_busy(self) -> None:
        self.authority.hold_back("busy")
        self.must_neutral = True
        self.take_events(must_stop=True)

    @rule()
    def lose_robot(self) -> None:
        """Know that the robot stands: nobody can stop it, and nobody need."""
        self.authority.hold_back("robot lost", stops=False)
        self.must_neutral = True
        self.robot.stop()
        self.take_events()

    # What must always hold

    @invariant()
    def it_moves_only_for_its_driver_and_only_in_time(self) -> None:
        assert self.authority.moving == self.robot.moving
        if not self.robot.moving:
            return
        driver, deadline = self.driver, self.authority.deadline()
        assert driver is not None, "moves, and nobody drives"
        assert deadline is not None
        assert self.now < deadline <= driver.expires_at
        if self.robot.parts:
            assert deadline <= driver.obeyed_at + driver.deadman_s

    @invariant()
    def there_is_one_holder_or_none(self) -> None:
        control, driver = self.authority.report(self.now), self.driver
        assert control.state == self.authority.state == ("held" if driver else "stopped" if self.stopped else "free")
        assert control.holder == (driver.who if driver else None)
        assert control.priority == (driver.priority if driver else None)
        assert control.expires_in_s == (driver.expires_at - self.now if driver else None)
        assert control.lease == (driver.given.lease if driver else None)
        verifier = self.authority.verifier
        assert (verifier.lease if verifier else None) == control.lease

    @invariant()
    def no_other_lease_is_good_for_anything(self) -> None:
        for given in self.leases:
            if not self.is_drivers(given):
                assert not self.renewed(given).ok
                assert not self.released(given).ok
                with pytest.raises(Refused):
                    self.authority.admit(attach(given, 2**63), KEY, PAYLOAD, self.now)
        assert {event.what for event in self.authority.events()} <= {EventKind.REFUSED}

    @invariant()
    def it_is_held_back_until_neutral_or_a_new_lease(self) -> None:
        if self.driver is not None:
            assert self.is_held_back() == self.must_neutral

    @invariant()
    def what_is_remembered_is_bounded(self) -> None:
        assert len(self.authority.report(self.now).refusals) <= 16

    # The model

    def pass_unwatched(self, s: float) -> None:
        """Let time go by without a timer: the next call must find out by itself."""
        self.now += s
        self.expire_model()

    def expire_model(self) -> None:
        if self.driver is not None and self.now >= self.driver.expires_at:
            self.driver, self.stopped = None, True

    def is_drivers(self, given: Given) -> bool:
        return self.driver is not None and given == self.driver.given

    def any_lease(self, number: int) -> Given:
        """Give one of the last leases, the newest for 0; one that never was where there is none."""
        return self.leases[-1 - number % len(self.leases)] if self.leases else NEVER

    def renewed(self, given: Given) -> Lease:
        return self.authority.renew(self.asking(given, RENEW), RENEW, self.now)

    def released(self, given: Given) -> Lease:
        return self.authority.release(self.asking(given, RELEASE), RELEASE, self.now)

    def asking(self, given: Given, key: str) -> Authorization:
        seq = next(self.questions)
        return Authorization(lease=given.lease, seq=seq, proof=proof(given.token, key, seq))

    def is_held_back(self) -> bool:
        try:
            self.authority.require_motion()
        except Refused:
            return True
        return False

    def take_grant(self, request: Acquire, lease: Lease, granted: bool) -> None:
        assert lease.ok == granted
        if not granted:
            assert (lease.lease, lease.token) == (None, None)
            self.take_events()
            return
        assert lease.lease is not None
        assert lease.token is not None
        given = Given(lease.lease, lease.token)
        assert given.lease not in (old.lease for old in self.leases)
        assert given.token not in (old.token for old in self.leases)
        lease_s, deadman_s = (
            most_s if wish_s is None else min(wish_s, most_s)
            for wish_s, most_s in ((request.lease_s, LEASE_S), (request.deadman_s, DEADMAN_S))
        )
        assert lease.expires_in_s == lease_s
        self.take_events()
        self.driver = Driver(
            request.who, request.priority, given, request.alive, lease_s, deadman_s, self.now + lease_s
        )
        self.leases = [*self.leases[1 - REMEMBERED :], given]
        self.stopped = self.must_neutral = False
        assert not self.robot.moving, "the new driver finds a robot that stands"

    def command(self, attachment: bytes | None, admitted: bool, carry_out: Callable[[], None]) -> None:
        """Bring a command as the gateway does: admission, what follows from it, then the robot."""
        try:
            who = self.authority.admit(attachment, KEY, PAYLOAD, self.now)
        except Refused:
            self.take_events()
            assert not admitted
            return
        finally:
            if attachment is not None:
                self.attachments.append(attachment)
        assert admitted
        assert self.driver is not None
        assert who == self.driver.who
        self.take_events()
        self.driver.seq = msgpack.unpackb(attachment)["seq"]
        self.driver.expires_at = self.now + self.driver.lease_s
        carry_out()

    def obey(self, part: str, moving: bool) -> None:
        assert self.driver is not None
        if moving and self.is_held_back():
            return
        self.authority.applied(part, self.now, moving=moving)
        self.driver.obeyed_at = self.now
        if moving:
            assert not self.must_neutral
            self.robot.parts.add(part)
        else:
            self.must_neutral = False
            self.robot.parts.discard(part)

    def obey_by_itself(self) -> None:
        if not self.is_held_back():
            assert not self.must_neutral
            self.authority.on_its_own = self.robot.on_its_own = True

    def take_events(self, *, must_stop: bool = False) -> None:
        """Send the robot the stops that were given; whatever ended or was stopped must have come with one."""
        events = self.authority.events()
        for event in events:
            if event.reason == "deadman":
                self.must_neutral = True
                assert self.robot.parts, "the deadman watches motion"
                if self.driver is not None:
                    assert self.now >= self.driver.obeyed_at + self.driver.deadman_s, "and is not hasty"
            if event.what in (EventKind.ENDED, EventKind.RELEASED) and not event.stops:
                assert not self.robot.moving, f"{event}: and the robot moves on"
            if event.stops:
                assert event.what is not EventKind.ACQUIRED
                assert not self.authority.moving
                self.robot.stop()
        assert not must_stop or any(event.stops for event in events)
        if self.driver is None:
            assert not self.robot.moving, "the driver is gone, and the robot moves on"


def attach(given: Given, seq: int) -> bytes:
    return shown(given.lease, given.token, KEY, seq, PAYLOAD)


def test_over_any_course_of_events_the_robot_moves_only_for_its_one_driver() -> None:
    run_state_machine_as_test(
        Driving,
        settings=settings(
            max_examples=4 * settings().max_examples, stateful_step_count=50, deadline=None, print_blob=False
        ),
    )
