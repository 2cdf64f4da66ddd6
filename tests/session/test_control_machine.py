"""Control authority against a model of its own, over any course of events: a robot moves only for its one driver.

The model is told the same things and knows only the rules of the design ("Who may drive"). The robot it drives
does what it is told, forever: what makes it stand is a neutral, or a stop that the authority gave in time.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

import msgpack
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from zbridge.errors import Refused
from zbridge.fleet.messages import Acquire, Lease
from zbridge.session.control import TOKEN_BYTES, Authority, What

LEASE_S, DEADMAN_S = 3.0, 2.0
REMEMBERED = 8
"""Old tokens that are tried again and again."""

clients = st.sampled_from(["ann", "bob", "hq.1"])
priorities = st.integers(-1, 2)
wishes_s = st.none() | st.sampled_from([0.01, 0.5, 1.0, 10.0]) | st.floats(0.01, 5)
waits_s = st.sampled_from([0.0, 0.01, 0.5, 1.0, 2.0, 3.0]) | st.floats(0, 5)
late_s = st.sampled_from([0.0] * 9 + [0.01, 0.5, 1.0, 2.0, 3.0]) | st.floats(0, 1)
"""Time that went by without the timer, as where the event loop is late; mostly none."""
parts = st.sampled_from(["drive", "left motor"])
mostly = st.sampled_from([True, True, True, False])
which = st.integers(0, REMEMBERED)


@dataclass
class Driver:
    """Who drives, as the model sees it."""

    who: str
    priority: int
    token: bytes
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
        numbers = itertools.count(1)
        self.authority = Authority(LEASE_S, DEADMAN_S, lambda: next(numbers).to_bytes(TOKEN_BYTES, "big"))
        self.now = 1000.0
        self.robot = Robot()
        self.driver: Driver | None = None
        self.stopped = False
        self.must_neutral = False
        self.tokens: list[bytes] = []
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
        token = self.any_token(number)
        lease = self.authority.renew(token, self.now)
        self.take_events()
        assert lease.ok == self.is_drivers(token)
        if self.driver is not None and lease.ok:
            self.driver.expires_at = self.now + self.driver.lease_s

    @rule(number=which, late=late_s)
    def release(self, number: int, late: float) -> None:
        self.pass_unwatched(late)
        token = self.any_token(number)
        lease = self.authority.release(token, self.now)
        assert lease.ok == self.is_drivers(token)
        if lease.ok:
            self.driver = None
        self.take_events()

    # Commands

    @precondition(lambda self: self.driver is not None)
    @rule(part=parts, moving=mostly, skipped=st.integers(0, 3), late=late_s)
    def drive(self, part: str, moving: bool, skipped: int, late: float) -> None:
        assert self.driver is not None
        attachment = attach(self.driver.token, self.driver.seq + 1 + skipped)
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
        """Come with any token that ever was, and any number."""
        self.pass_unwatched(late)
        token, last = self.any_token(number), self.driver.seq if self.driver is not None else 0
        seq = max(0, last + offset)
        expected = self.is_drivers(token) and seq > last
        self.command(attach(token, seq), expected, lambda: self.obey(part, moving))

    @precondition(lambda self: self.attachments)
    @rule(number=st.integers(0, 100), late=late_s)
    def replay(self, number: int, late: float) -> None:
        """Send again what was sent once, admitted or not."""
        self.pass_unwatched(late)
        self.command(self.attachments[number % len(self.attachments)], False, lambda: self.obey("drive", True))

    @rule(token=st.binary(max_size=TOKEN_BYTES + 1), bit=st.integers(0, 8 * TOKEN_BYTES - 1), late=late_s)
    def forge(self, token: bytes, bit: int, late: float) -> None:
        """Make a token up, or change one bit of the right one."""
        self.pass_unwatched(late)
        if self.driver is not None:
            near = (int.from_bytes(self.driver.token, "big") ^ 1 << bit).to_bytes(TOKEN_BYTES, "big")
            self.command(attach(near, self.driver.seq + 1), False, lambda: self.obey("drive", True))
        if not self.is_drivers(token):
            self.command(attach(token, 2**40), False, lambda: self.obey("drive", True))

    @rule(attachment=st.none() | st.binary(max_size=40), late=late_s)
    def send_rubbish(self, attachment: bytes | None, late: float) -> None:
        self.pass_unwatched(late)
        self.command(attachment, False, lambda: self.obey("drive", True))

    @precondition(lambda self: self.driver is not None)
    @rule(late=late_s)
    def send_what_the_robot_refuses(self, late: float) -> None:
        """Come with a command that is admitted and then not carried out."""
        assert self.driver is not None
        attachment = attach(self.driver.token, self.driver.seq + 1)
        self.pass_unwatched(late)
        self.command(attachment, self.driver is not None, lambda: None)

    @precondition(lambda self: self.driver is not None)
    @rule(late=late_s)
    def send_it_off_by_itself(self, late: float) -> None:
        assert self.driver is not None
        attachment = attach(self.driver.token, self.driver.seq + 1)
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
        assert self.authority.token == (driver.token if driver else None)

    @invariant()
    def no_other_token_is_good_for_anything(self) -> None:
        for token in self.tokens:
            if not self.is_drivers(token):
                assert not self.authority.renew(token, self.now).ok
                assert not self.authority.release(token, self.now).ok
                with pytest.raises(Refused):
                    self.authority.admit(attach(token, 2**63), self.now)
        assert self.authority.events() == []

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

    def is_drivers(self, token: bytes) -> bool:
        return self.driver is not None and token == self.driver.token

    def any_token(self, number: int) -> bytes:
        """Give one of the last tokens, the newest for 0; one that never was where there is none."""
        return self.tokens[-1 - number % len(self.tokens)] if self.tokens else bytes(TOKEN_BYTES)

    def is_held_back(self) -> bool:
        try:
            self.authority.require_motion()
        except Refused:
            return True
        return False

    def take_grant(self, request: Acquire, lease: Lease, granted: bool) -> None:
        assert lease.ok == granted
        if not granted:
            assert lease.token is None
            self.take_events()
            return
        assert lease.token is not None
        assert lease.token not in self.tokens
        lease_s, deadman_s = (
            most_s if wish_s is None else min(wish_s, most_s)
            for wish_s, most_s in ((request.lease_s, LEASE_S), (request.deadman_s, DEADMAN_S))
        )
        assert lease.expires_in_s == lease_s
        self.take_events()
        self.driver = Driver(
            request.who, request.priority, lease.token, request.alive, lease_s, deadman_s, self.now + lease_s
        )
        self.tokens = [*self.tokens[1 - REMEMBERED :], lease.token]
        self.stopped = self.must_neutral = False
        assert not self.robot.moving, "the new driver finds a robot that stands"

    def command(self, attachment: bytes | None, admitted: bool, carry_out: Callable[[], None]) -> None:
        """Bring a command as the gateway does: admission, what follows from it, then the robot."""
        try:
            who = self.authority.admit(attachment, self.now)
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
            if event.what in (What.ENDED, What.RELEASED) and not event.stops:
                assert not self.robot.moving, f"{event}: and the robot moves on"
            if event.stops:
                assert event.what is not What.ACQUIRED
                assert not self.authority.moving
                self.robot.stop()
        assert not must_stop or any(event.stops for event in events)
        if self.driver is None:
            assert not self.robot.moving, "the driver is gone, and the robot moves on"


def attach(token: bytes, seq: int) -> bytes:
    attachment: bytes = msgpack.packb({"token": token, "seq": seq})
    return attachment


def test_over_any_course_of_events_the_robot_moves_only_for_its_one_driver() -> None:
    run_state_machine_as_test(
        Driving, settings=settings(max_examples=400, stateful_step_count=50, deadline=None, print_blob=False)
    )
