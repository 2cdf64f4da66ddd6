"""Control authority against a model of its own, over any course of events: a robot moves only for its one driver.

The model is told the same things and knows only the rules of the design ("Who may drive"). The robot it drives
does what it is told, forever: what makes it stand is a neutral, or a stop that the authority gave in time.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import msgpack
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from tests.proofs import proof, shown
from zbridge.control.authority import Authority
from zbridge.control.events import EventKind, StopCause
from zbridge.errors import Refused
from zbridge.fleet.lease_messages import Acquire, Authorization, Lease

LEASE_S, DEADMAN_S = 3.0, 2.0
REMEMBERED = 8
"""Old leases that are tried again and again."""
KEY = "fleet/r1/@cmd/drive"
PAYLOAD = b"\x80"

wishes_s = st.none() | st.sampled_from([0.01, 0.5, 1.0, 10.0]) | st.floats(0.01, 5)
tokens = st.sampled_from(["operator.1", "operator.2"])
requests = st.builds(
    Acquire,
    who=st.sampled_from(["ann", "bob", "hq.1"]),
    priority=st.integers(-1, 2),
    lease_s=wishes_s,
    deadman_s=wishes_s,
    alive=tokens | st.none(),
)
waits_s = st.sampled_from([0.0, 0.01, 0.5, 1.0, 2.0, 3.0]) | st.floats(0, 5)
parts = st.sampled_from(["drive", "left motor"])
which = st.integers(0, REMEMBERED)


class Given(NamedTuple):
    """What was given with a lease."""

    lease: bytes
    token: bytes


NEVER = Given(bytes(8), bytes(32))
"""A lease that never was."""


@dataclass(eq=False)
class Driver:
    """Who drives, as the model sees it."""

    request: Acquire
    given: Given
    lease_s: float
    deadman_s: float
    expires_at: float
    seq: int = -1
    obeyed_at: float = 0.0
    """When a command of its was last carried out."""


class Driving(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        numbers, self.questions = itertools.count(1), itertools.count(1)
        self.authority = Authority(
            LEASE_S, DEADMAN_S, lambda size: b"\xa5" * (size - 4) + next(numbers).to_bytes(4, "big")
        )
        self.now = 1000.0
        self.late_s = 0.0
        self.driver: Driver | None = None
        self.stopped = False
        self.must_neutral = False
        self.not_rested: set[str] = set()
        """The parts that moved when neutral was required, and that had no neutral since."""
        self.moving_parts: set[str] = set()
        self.on_its_own = False
        self.leases: list[Given] = []

    # The lease

    @rule(request=requests, takes_over=st.booleans())
    def ask(self, request: Acquire, takes_over: bool) -> None:
        self.wake()
        granted = takes_over or self.driver is None or request.priority > self.driver.request.priority
        lease = (self.authority.takeover if takes_over else self.authority.acquire)(request, self.now)
        assert lease.ok == granted
        self.take_events()
        if not granted:
            assert (lease.lease, lease.token) == (None, None)
            return
        assert lease.lease is not None
        assert lease.token is not None
        given = Given(lease.lease, lease.token)
        assert not {*given} & {each for old in self.leases for each in old}
        lease_s, deadman_s = min(request.lease_s or LEASE_S, LEASE_S), min(request.deadman_s or DEADMAN_S, DEADMAN_S)
        assert lease.expires_in_s == lease_s
        assert not self.robot_moves, "the new driver finds a robot that stands"
        self.driver = Driver(request, given, lease_s, deadman_s, self.now + lease_s)
        self.leases = [*self.leases[1 - REMEMBERED :], given]
        self.stopped = self.must_neutral = False
        self.not_rested.clear()

    @rule(number=which, name=st.sampled_from(["renew", "release"]))
    def question(self, number: int, name: str) -> None:
        self.wake()
        given, driver = self.any_lease(number), self.driver
        assert self.asked(name, given).ok == self.is_drivers(given)
        if driver is not None and self.is_drivers(given):
            driver.expires_at = self.now + driver.lease_s
            self.driver = driver if name == "renew" else None
        self.take_events()

    # Commands

    @rule(
        part=parts,
        moving=st.sampled_from([True, True, True, False]),
        number=st.just(0) | which,
        offset=st.sampled_from([1, 1, 2, 4]) | st.integers(-3, 0),
    )
    def drive(self, part: str, moving: bool, number: int = 0, offset: int = 1) -> None:
        """Come with the newest lease and the next number, or with any lease that ever was and any number."""
        given, last = self.any_lease(number), self.driver.seq if self.driver is not None else 0
        seq = max(0, last + offset)
        allowed = self.driver if self.is_drivers(given) and seq > last else None
        self.command(attach(given, seq), allowed, lambda: self.obey(part, moving))

    @rule(request=requests, part=parts)
    def set_off(self, request: Acquire, part: str) -> None:
        """Have a driver and motion, so that there is something to end."""
        self.wake()
        if self.driver is None:
            self.ask(request, False)
        if self.must_neutral:
            self.drive(part, False)
        self.drive(part, True)

    @precondition(lambda self: self.driver is not None)
    @rule(by_itself=st.booleans())
    def send_what_is_no_drive(self, by_itself: bool) -> None:
        """Send it off by itself, or come with a command that is admitted and then not carried out."""
        assert self.driver is not None
        attachment = attach(self.driver.given, self.driver.seq + 1)
        self.command(attachment, self.driver, self.obey_by_itself if by_itself else lambda: None)

    @rule(rubbish=st.none() | st.binary(max_size=40))
    def forge(self, rubbish: bytes | None) -> None:
        """Send nothing, rubbish, a lease that never was, or a guess at the token."""
        lease, seq = (self.driver.given.lease, self.driver.seq + 1) if self.driver is not None else (b"never is", 0)
        for attachment in (rubbish, attach(NEVER, seq), attach(Given(lease, NEVER.token), seq)):
            self.command(attachment, None)

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

    @rule(s=st.sampled_from([0.01, 0.5, 1.0, 2.0, 3.0]) | st.floats(0, 1))
    def oversleep(self, s: float) -> None:
        """Let the next call come late, without a timer before it, as where the event loop hangs."""
        self.late_s = s

    @rule(token=tokens, how=st.sampled_from(["stop", "vanished", "bus lost"]))
    def end(self, token: str, how: str) -> None:
        if how == "stop":
            self.authority.stop("stop")
        elif how == "vanished":
            self.authority.vanished(token)
        else:
            self.authority.bus_lost()
        lost = self.driver is not None and (how == "bus lost" or self.driver.request.alive == token)
        if how == "stop" or lost:
            self.driver, self.stopped = None, True
        self.take_events(must_stop=how == "stop")

    @rule(stands=st.booleans())
    def require_neutral(self, stands: bool) -> None:
        """Become busy; or know that the robot stands, so that nobody need stop it."""
        self.authority.require_neutral("robot lost" if stands else "busy", StopCause.ROBOT_LOST, stops=not stands)
        self.must_neutral = True
        self.not_rested |= self.moving_parts
        if stands:
            self.stand()
        self.take_events(must_stop=not stands)

    # What must always hold

    @invariant()
    def it_moves_only_for_its_driver_and_only_in_time(self) -> None:
        assert self.authority.motion.moving == self.robot_moves
        if not self.robot_moves:
            return
        driver, deadline = self.driver, self.authority.deadline()
        assert driver is not None, "moves, and nobody drives"
        assert deadline is not None
        assert self.now < deadline <= driver.expires_at
        if self.moving_parts:
            assert deadline <= driver.obeyed_at + driver.deadman_s

    @invariant()
    def there_is_one_holder_or_none(self) -> None:
        control, driver = self.authority.report(self.now), self.driver
        assert control.state == self.authority.state == ("held" if driver else "stopped" if self.stopped else "free")
        assert control.holder == (driver.request.who if driver else None)
        assert control.priority == (driver.request.priority if driver else None)
        assert control.expires_in_s == (driver.expires_at - self.now if driver else None)
        assert control.lease == (driver.given.lease if driver else None)
        verifier = self.authority.verifier
        assert (verifier.lease if verifier else None) == control.lease
        assert len(control.refusals) <= 16

    @invariant()
    def no_other_lease_is_good_for_anything(self) -> None:
        for given in self.leases:
            if not self.is_drivers(given):
                assert not self.asked("renew", given).ok
                assert not self.asked("release", given).ok
                with pytest.raises(Refused):
                    self.authority.admit(attach(given, 2**63), KEY, PAYLOAD, self.now)
        assert {event.what for event in self.authority.events()} <= {EventKind.REFUSED}

    @invariant()
    def it_needs_neutral_until_neutral_or_a_new_lease(self) -> None:
        if self.driver is not None:
            assert self.needs_neutral() == self.must_neutral

    # The model

    @property
    def robot_moves(self) -> bool:
        return bool(self.moving_parts) or self.on_its_own

    def stand(self) -> None:
        self.moving_parts.clear()
        self.on_its_own = False

    def wake(self) -> None:
        """Come back late, perhaps: the next call must find out by itself what was due."""
        self.now += self.late_s
        self.late_s = 0.0
        self.expire_model()

    def expire_model(self) -> None:
        if self.driver is not None and self.now >= self.driver.expires_at:
            self.driver, self.stopped = None, True

    def is_drivers(self, given: Given) -> bool:
        return self.driver is not None and given == self.driver.given

    def any_lease(self, number: int) -> Given:
        """Give one of the last leases, the newest for 0; one that never was where there is none."""
        return self.leases[-1 - number % len(self.leases)] if self.leases else NEVER

    def asked(self, name: str, given: Given) -> Lease:
        key, seq = f"fleet/r1/@rpc/control/{name}", next(self.questions)
        shows = Authorization(lease=given.lease, seq=seq, proof=proof(given.token, key, seq))
        lease: Lease = getattr(self.authority, name)(shows, key, self.now)
        return lease

    def needs_neutral(self) -> bool:
        try:
            self.authority.motion.check_motion()
        except Refused:
            return True
        return False

    def command(self, attachment: bytes | None, sender: Driver | None, obey: Callable[[], None] | None = None) -> None:
        """Bring a command as the gateway does: admission, what follows from it, then the robot.

        sender: who may drive with it, unless its lease has expired meanwhile.
        """
        self.wake()
        admitted = sender is not None and sender is self.driver
        try:
            who = self.authority.admit(attachment, KEY, PAYLOAD, self.now).who
        except Refused:
            self.take_events()
            assert not admitted
            return
        assert admitted
        assert obey is not None
        assert self.driver is not None
        assert who == self.driver.request.who
        self.take_events()
        self.driver.seq = msgpack.unpackb(attachment)["seq"]
        self.driver.expires_at = self.now + self.driver.lease_s
        obey()

    def obey(self, part: str, moving: bool) -> None:
        assert self.driver is not None
        if moving and self.needs_neutral():
            return
        self.authority.applied(part, self.now, moving=moving)
        self.driver.obeyed_at = self.now
        if moving:
            assert not self.must_neutral
            self.moving_parts.add(part)
        else:
            self.not_rested.discard(part)
            self.must_neutral = self.must_neutral and bool(self.not_rested)
            self.moving_parts.discard(part)

    def obey_by_itself(self) -> None:
        if not self.needs_neutral():
            self.authority.motion.sent_opaque()
            self.on_its_own = True

    def take_events(self, *, must_stop: bool = False) -> None:
        """Send the robot the stops that were given; whatever ended or was stopped must have come with one."""
        events = self.authority.events()
        for event in events:
            if event.reason == "deadman":
                self.must_neutral = True
                self.not_rested |= self.moving_parts
                assert self.moving_parts, "the deadman watches motion"
                if self.driver is not None:
                    assert self.now >= self.driver.obeyed_at + self.driver.deadman_s, "and is not hasty"
            if event.what in (EventKind.ENDED, EventKind.RELEASED) and not event.stops:
                assert not self.robot_moves, f"{event}: and the robot moves on"
            if event.stops:
                assert event.what is not EventKind.ACQUIRED
                assert not self.authority.motion.moving
                self.stand()
        assert not must_stop or any(event.stops for event in events)
        if self.driver is None:
            assert not self.robot_moves, "the driver is gone, and the robot moves on"


def attach(given: Given, seq: int) -> bytes:
    return shown(given.lease, given.token, KEY, seq, PAYLOAD)


def test_over_any_course_of_events_the_robot_moves_only_for_its_one_driver() -> None:
    run_state_machine_as_test(
        Driving,
        settings=settings(
            max_examples=settings().max_examples, stateful_step_count=50, deadline=None, print_blob=False
        ),
    )
