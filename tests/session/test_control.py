"""Control authority: every transition of the lease, what each tells the world, and what may not drive."""

import contextlib
import itertools
import math
from collections.abc import Callable

import msgpack
import msgspec
import pytest

from zbridge.errors import Code, NotReady, Refused
from zbridge.fleet.messages import Acquire, Control, Lease, Refusal
from zbridge.session.control import ENDED, LEAST_S, REFUSALS, TOKEN_BYTES, Authority, Event, What

NOW = 100.0
LEASE_S, DEADMAN_S = 3.0, 2.0
"""The most a holder may ask for."""
ANN, BOB = b"\x01" * TOKEN_BYTES, b"\x02" * TOKEN_BYTES
"""The first and the second token of an authority. Ann has, or had, the lease; Bob asks for it."""
FORGED = b"\xff" * TOKEN_BYTES
ALIVE = "ann.1"
SEQ = 7
"""The number of Ann's last command."""
WAIT_S = 0.5
"""Ann's deadman."""

Does = Callable[[Authority], object]


def new() -> Authority:
    tokens = itertools.count(1)
    return Authority(LEASE_S, DEADMAN_S, lambda: bytes([next(tokens)]) * TOKEN_BYTES)


def released() -> Authority:
    return after(held(), lambda authority: authority.release(ANN, NOW))


def held() -> Authority:
    request = Acquire(who="ann", priority=5, deadman_s=WAIT_S, alive=ALIVE)
    return after(new(), lambda authority: authority.acquire(request, NOW), admit(attach(ANN, SEQ)))


def moving() -> Authority:
    return after(held(), lambda authority: authority.applied("drive", NOW, moving=True))


def by_itself() -> Authority:
    authority = held()
    authority.on_its_own = True
    return authority


def held_back() -> Authority:
    return after(moving(), lambda authority: authority.hold_back("deadman"))


def stopped() -> Authority:
    return after(moving(), lambda authority: authority.stop("stop"))


STATES = {make.__name__: make for make in (new, released, held, moving, by_itself, held_back, stopped)}
STATE = {
    "new": "free",
    "released": "free",
    "held": "held",
    "moving": "held",
    "by_itself": "held",
    "held_back": "held",
    "stopped": "stopped",
}
IN_MOTION = ("moving", "by_itself")
HELD = ("held", "moving", "by_itself", "held_back")
NOT_HELD = ("new", "released", "stopped")


def after(authority: Authority, *done: Does) -> Authority:
    """Give the authority after all this was done and its events were taken."""
    for does in done:
        does(authority)
    authority.events()
    return authority


def attach(token: bytes, seq: int) -> bytes:
    attachment: bytes = msgpack.packb({"token": token, "seq": seq})
    return attachment


def acquire(priority: int = 0, now: float = NOW) -> Does:
    return lambda authority: authority.acquire(Acquire(who="bob", priority=priority), now)


def takeover(priority: int = 0, now: float = NOW) -> Does:
    return lambda authority: authority.takeover(Acquire(who="bob", priority=priority), now)


def renew(token: bytes, now: float = NOW) -> Does:
    return lambda authority: authority.renew(token, now)


def release(token: bytes, now: float = NOW) -> Does:
    return lambda authority: authority.release(token, now)


def admit(attachment: bytes | None, now: float = NOW) -> Does:
    return lambda authority: authority.admit(attachment, now)


def ended(reason: str, *, stops: bool, what: What = What.ENDED) -> Event:
    return Event(what, "ann", reason, stops=stops)


# The lease


@pytest.mark.parametrize("state", STATES)
def test_the_states_to_start_from_are_what_they_are_called(state: str) -> None:
    authority = STATES[state]()
    assert authority.state == STATE[state]
    assert authority.moving is (state in IN_MOTION)
    assert authority.token == (ANN if state in HELD else None)
    assert authority.events() == []


@pytest.mark.parametrize("state", NOT_HELD)
def test_whoever_asks_first_is_given_a_robot_that_nobody_holds(state: str) -> None:
    authority = STATES[state]()
    lease = authority.acquire(Acquire(who="bob", priority=-1), NOW)
    assert lease == Lease(ok=True, token=authority.token, expires_in_s=LEASE_S, holder="bob")
    assert lease.token == (ANN if state == "new" else BOB)
    assert authority.events() == [Event(What.ACQUIRED, "bob", priority=-1)]
    assert authority.state == "held"
    assert not authority.moving
    authority.require_motion()


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize("priority", [-1, 0, 4, 5])
def test_a_robot_that_is_held_is_not_given_for_the_same_or_a_lower_priority(state: str, priority: int) -> None:
    authority = STATES[state]()
    before = repr(authority), authority.moving, authority.deadline()
    reason = "held by ann (priority 5)"
    lease = authority.acquire(Acquire(who="bob", priority=priority), NOW)
    assert lease == Lease(ok=False, expires_in_s=LEASE_S, holder="ann", reason=reason)
    assert authority.events() == [Event(What.REFUSED, "bob", reason, command="acquire", code=Code.HELD)]
    assert authority.report(NOW).refusals == (
        Refusal(who="bob", command="acquire", code="held", reason=reason, count=1),
    )
    assert (repr(authority), authority.moving, authority.deadline()) == before
    assert authority.admit(attach(ANN, SEQ + 1), NOW) == "ann"


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize(
    ("asks", "what", "priority"), [(acquire(6), What.ACQUIRED, 6), (takeover(), What.TAKEN_OVER, 0)]
)
def test_a_higher_priority_or_a_takeover_stops_what_moves_before_it_gives_the_lease(
    state: str, asks: Does, what: What, priority: int
) -> None:
    authority = STATES[state]()
    assert asks(authority) == Lease(ok=True, token=BOB, expires_in_s=LEASE_S, holder="bob")
    assert authority.events() == [
        ended("taken over by bob", stops=state in IN_MOTION),
        Event(what, "bob", priority=priority),
    ]
    assert not authority.moving
    authority.require_motion()
    assert refusal(authority, attach(ANN, SEQ + 1)) == "the lease has ended (taken over by bob)"
    assert authority.admit(attach(BOB, 0), NOW) == "bob"


@pytest.mark.parametrize("state", NOT_HELD)
def test_a_takeover_of_a_robot_that_nobody_holds_is_granted(state: str) -> None:
    authority = STATES[state]()
    lease = authority.takeover(Acquire(who="bob", priority=2), NOW)
    assert lease == Lease(ok=True, token=authority.token, expires_in_s=LEASE_S, holder="bob")
    assert authority.events() == [Event(What.TAKEN_OVER, "bob", priority=2)]


@pytest.mark.parametrize("state", HELD)
def test_a_takeover_is_granted_whatever_its_priority(state: str) -> None:
    authority = STATES[state]()
    assert authority.takeover(Acquire(who="bob", priority=-100), NOW).ok
    assert authority.report(NOW).priority == -100


@pytest.mark.parametrize("state", HELD)
def test_the_holder_renews_and_its_lease_begins_anew(state: str) -> None:
    authority = STATES[state]()
    authority.applied("drive", NOW, moving=False)
    assert authority.renew(ANN, NOW + 0.25) == Lease(ok=True, expires_in_s=LEASE_S, holder="ann")
    assert authority.events() == []
    assert authority.deadline() == NOW + 0.25 + LEASE_S


def test_renewing_does_not_feed_the_deadman() -> None:
    authority = moving()
    authority.renew(ANN, NOW + 0.25)
    assert authority.deadline() == NOW + WAIT_S


@pytest.mark.parametrize(
    ("state", "event"),
    [(state, ended("released", stops=state in IN_MOTION, what=What.RELEASED)) for state in HELD],
)
def test_the_holder_releases_and_what_moves_is_stopped(state: str, event: Event) -> None:
    authority = STATES[state]()
    assert authority.release(ANN, NOW) == Lease(ok=True)
    assert authority.events() == [event]
    assert authority.state == "free"
    assert not authority.moving
    assert authority.deadline() is None
    assert refusal(authority, attach(ANN, SEQ + 1)) == "the lease has ended (released)"


WHY_NOT = [
    ("new", ANN, "no lease: acquire first"),
    ("released", ANN, "the lease has ended (released)"),
    ("stopped", ANN, "the lease has ended (stop)"),
    *((state, FORGED, "no lease: acquire first") for state in NOT_HELD),
    *((state, token, "held by ann (priority 5)") for state in HELD for token in (FORGED, b"", ANN[1:], ANN + ANN)),
]


@pytest.mark.parametrize(("state", "token", "reason"), WHY_NOT)
@pytest.mark.parametrize("asks", [renew, release])
def test_nobody_else_renews_or_releases(state: str, token: bytes, reason: str, asks: Callable[[bytes], Does]) -> None:
    authority = STATES[state]()
    before = repr(authority), authority.moving, authority.deadline()
    who, left_s = ("ann", LEASE_S) if state in HELD else (None, None)
    assert asks(token)(authority) == Lease(ok=False, expires_in_s=left_s, holder=who, reason=reason)
    assert authority.events() == []
    assert (repr(authority), authority.moving, authority.deadline()) == before


def test_no_answer_but_the_grant_shows_a_token() -> None:
    authority = new()
    given = authority.acquire(Acquire(who="ann"), NOW)
    assert given.token is not None
    answers = [asks(authority) for asks in (acquire(), renew(ANN), renew(FORGED), release(FORGED), release(ANN))]
    assert [answer.token for answer in answers if isinstance(answer, Lease)] == [None] * 5


def test_every_lease_has_a_token_of_its_own() -> None:
    authority = new()
    tokens = [authority.takeover(Acquire(who="ann"), NOW).token for _ in range(5)]
    assert len(set(tokens)) == 5


def test_a_holder_that_takes_over_from_itself_has_lost_its_old_token() -> None:
    authority = moving()
    assert authority.takeover(Acquire(who="ann", priority=5), NOW).token == BOB
    assert [(event.what, event.stops) for event in authority.events()] == [
        (What.ENDED, True),
        (What.TAKEN_OVER, False),
    ]
    assert refusal(authority, attach(ANN, SEQ + 1)) == "the lease has ended (taken over by ann)"


# Wishes


@pytest.mark.parametrize(
    ("wish_s", "given_s"),
    [
        (None, LEASE_S),
        (LEAST_S, LEAST_S),
        (1.5, 1.5),
        (LEASE_S, LEASE_S),
        (math.nextafter(LEASE_S, 9), LEASE_S),
        (1e9, LEASE_S),
        (math.inf, LEASE_S),
    ],
)
def test_a_wish_for_the_lease_is_capped(wish_s: float | None, given_s: float) -> None:
    authority = new()
    assert authority.acquire(Acquire(who="ann", lease_s=wish_s), NOW).expires_in_s == given_s
    assert authority.deadline() == NOW + given_s
    assert authority.renew(ANN, NOW).expires_in_s == given_s


@pytest.mark.parametrize(
    ("wish_s", "given_s"),
    [
        (None, DEADMAN_S),
        (LEAST_S, LEAST_S),
        (0.3, 0.3),
        (DEADMAN_S, DEADMAN_S),
        (2.5, DEADMAN_S),
        (math.inf, DEADMAN_S),
    ],
)
def test_a_wish_for_the_deadman_is_capped(wish_s: float | None, given_s: float) -> None:
    authority = new()
    authority.acquire(Acquire(who="ann", deadman_s=wish_s), NOW)
    authority.admit(attach(ANN, 0), NOW)
    authority.applied("drive", NOW, moving=True)
    assert authority.deadline() == NOW + given_s


NO_TIME = [0.0, -0.0, -1.0, -math.inf, math.nan, math.nextafter(LEAST_S, 0)]


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("field", ["lease_s", "deadman_s"])
@pytest.mark.parametrize("wish_s", NO_TIME)
def test_what_is_no_time_is_refused_and_leaves_everything_as_it_was(state: str, field: str, wish_s: float) -> None:
    authority = STATES[state]()
    before = repr(authority), authority.moving, authority.deadline(), authority.token
    request = msgspec.structs.replace(Acquire(who="bob", priority=9), **{field: wish_s})
    lease = authority.takeover(request, NOW)
    assert not lease.ok
    assert lease.token is None
    assert lease.reason == f"{field} = {wish_s:g}: expected at least {LEAST_S:g}"
    assert [event.what for event in authority.events()] == [What.REFUSED]
    assert (repr(authority), authority.moving, authority.deadline(), authority.token) == before


@pytest.mark.parametrize("state", STATES)
def test_nobody_without_a_name_is_given_a_robot(state: str) -> None:
    authority = STATES[state]()
    before = repr(authority), authority.moving, authority.deadline(), authority.token
    lease = authority.acquire(Acquire(who="", priority=9), NOW)
    assert (lease.ok, lease.token) == (False, None)
    assert lease.reason == "who = '': expected a name that others are shown"
    assert (repr(authority), authority.moving, authority.deadline(), authority.token) == before


@pytest.mark.parametrize("who", ["two\nlines", "\x1b[2J", "\x00", "\u2028", "\u202e", "a" * 100 + "\n"])
def test_a_name_that_would_not_print_is_refused_and_told_without_printing_it(who: str) -> None:
    authority = held()
    lease = authority.takeover(Acquire(who=who, priority=9), NOW)
    assert not lease.ok
    assert lease.reason is not None
    assert lease.reason.isprintable()
    assert len(lease.reason) < 400
    assert authority.report(NOW).holder == "ann"


@pytest.mark.parametrize("ask", ["acquire", "takeover"])
def test_a_refused_wish_is_shown_as_the_command_it_was(ask: str) -> None:
    authority = new()
    getattr(authority, ask)(Acquire(who="ann", lease_s=0.0), NOW)
    assert [(refused.who, refused.command) for refused in authority.report(NOW).refusals] == [("ann", ask)]


# Commands


def refusal(authority: Authority, attachment: bytes | None, now: float = NOW) -> str:
    """Give the reason for which a command is refused."""
    with pytest.raises(Refused) as refused:
        authority.admit(attachment, now)
    return str(refused.value)


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize("seq", [SEQ + 1, SEQ + 1000, 2**64 - 1])
def test_the_holders_next_command_is_admitted_once(state: str, seq: int) -> None:
    authority = STATES[state]()
    assert authority.admit(attach(ANN, seq), NOW) == "ann"
    assert refusal(authority, attach(ANN, seq)) == "repeated or out of order"
    assert authority.events() == []


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize("seq", [0, SEQ - 1, SEQ])
def test_a_repeated_or_late_command_is_refused(state: str, seq: int) -> None:
    assert refusal(STATES[state](), attach(ANN, seq)) == "repeated or out of order"


def test_the_first_number_may_be_zero() -> None:
    authority = new()
    authority.acquire(Acquire(who="ann"), NOW)
    assert authority.admit(attach(ANN, 0), NOW) == "ann"


def test_numbers_begin_anew_with_each_lease() -> None:
    authority = moving()
    authority.takeover(Acquire(who="bob"), NOW)
    assert authority.admit(attach(BOB, 0), NOW) == "bob"


@pytest.mark.parametrize("state", STATES)
def test_a_command_without_an_attachment_is_refused(state: str) -> None:
    assert refusal(STATES[state](), None) == "no lease: acquire first"


MALFORMED = {
    "empty": b"",
    "no map": msgpack.packb([ANN, 9]),
    "nil": msgpack.packb(None),
    "the bare token": ANN,
    "no token": msgpack.packb({"seq": 9}),
    "no number": msgpack.packb({"token": ANN}),
    "a token as text": msgpack.packb({"token": ANN.decode(), "seq": 9}),
    "a negative number": msgpack.packb({"token": ANN, "seq": -1}),
    "a fraction": msgpack.packb({"token": ANN, "seq": 9.5}),
    "a truth": msgpack.packb({"token": ANN, "seq": True}),
    "cut": attach(ANN, 9)[:-1],
    "more behind it": attach(ANN, 9) + b"\x00",
    "deeply nested": b"\x91" * 100_000 + b"\xc0",
    "deeply nested aside": attach(ANN, 9).replace(b"\x82", b"\x83", 1) + b"\xa1x" + b"\x91" * 100_000 + b"\xc0",
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("attachment", MALFORMED.values(), ids=MALFORMED)
def test_a_malformed_attachment_is_refused(state: str, attachment: bytes) -> None:
    authority = STATES[state]()
    assert refusal(authority, attachment) == "malformed attachment: expected {token, seq}"
    assert authority.owner(attachment) is None


@pytest.mark.parametrize("size", range(len(attach(ANN, 9))))
def test_an_attachment_cut_anywhere_is_refused(size: int) -> None:
    assert refusal(held(), attach(ANN, 9)[:size]) == "malformed attachment: expected {token, seq}"


@pytest.mark.parametrize(("state", "token", "reason"), WHY_NOT)
def test_a_command_with_another_token_is_refused_with_the_reason(state: str, token: bytes, reason: str) -> None:
    assert refusal(STATES[state](), attach(token, SEQ + 1)) == reason


@pytest.mark.parametrize("bit", range(8 * TOKEN_BYTES))
def test_a_token_with_one_bit_changed_drives_nothing(bit: int) -> None:
    token = (int.from_bytes(ANN, "big") ^ 1 << bit).to_bytes(TOKEN_BYTES, "big")
    assert refusal(held(), attach(token, SEQ + 1)) == "held by ann (priority 5)"


REFUSED = {
    "no attachment": None,
    "malformed": b"",
    "forged": attach(FORGED, SEQ + 1),
    "repeated": attach(ANN, SEQ),
    "late": attach(ANN, 0),
}


@pytest.mark.parametrize("attachment", REFUSED.values(), ids=REFUSED)
def test_a_refused_command_neither_renews_the_lease_nor_feeds_the_deadman(attachment: bytes | None) -> None:
    authority = moving()
    refusal(authority, attachment, NOW + 0.25)
    assert authority.deadline() == NOW + WAIT_S
    assert authority.report(NOW + 0.25).expires_in_s == LEASE_S - 0.25
    assert authority.admit(attach(ANN, SEQ + 1), NOW + 0.25) == "ann", "and uses up no number"


def test_a_command_renews_the_lease() -> None:
    authority = held()
    authority.admit(attach(ANN, SEQ + 1), NOW + 1.0)
    assert authority.report(NOW + 1.0).expires_in_s == LEASE_S
    assert authority.deadline() == NOW + 1.0 + LEASE_S


def test_a_command_that_was_only_admitted_does_not_feed_the_deadman() -> None:
    authority = moving()
    for step in range(1, 5):
        authority.admit(attach(ANN, SEQ + step), NOW + 0.1 * step)
    assert authority.deadline() == NOW + WAIT_S, "the robot may have refused it, and then moves on as before"


def test_a_command_does_not_renew_a_lease_that_has_just_ended() -> None:
    authority = held()
    assert refusal(authority, attach(ANN, SEQ + 1), NOW + LEASE_S) == "the lease has ended (lease expired)"
    assert authority.state == "stopped"


@pytest.mark.parametrize("state", ["held", "moving", "by_itself"])
def test_motion_is_allowed_to_a_holder_that_was_not_held_back(state: str) -> None:
    STATES[state]().require_motion()


def test_a_holder_that_was_held_back_moves_nothing_before_neutral() -> None:
    authority = held_back()
    for seq in (SEQ + 1, SEQ + 2):
        authority.admit(attach(ANN, seq), NOW)
        with pytest.raises(Refused, match=r"^deadman: send a neutral drive first$"):
            authority.require_motion()
    authority.applied("drive", NOW, moving=False)
    authority.require_motion()
    assert authority.state == "held"


def test_a_neutral_that_was_only_admitted_allows_no_motion() -> None:
    authority = held_back()
    authority.admit(attach(ANN, SEQ + 1), NOW)
    with pytest.raises(Refused):
        authority.require_motion()


def test_motion_noted_while_held_back_does_not_replace_neutral() -> None:
    authority = held_back()
    authority.applied("drive", NOW, moving=True)
    with pytest.raises(Refused):
        authority.require_motion()


@pytest.mark.parametrize("state", STATES)
def test_a_new_lease_needs_no_neutral(state: str) -> None:
    authority = STATES[state]()
    authority.hold_back("busy")
    authority.takeover(Acquire(who="bob"), NOW)
    authority.require_motion()


def test_whose_a_refused_command_was_is_told_by_its_token() -> None:
    authority = held()
    assert authority.owner(attach(ANN, 0)) == "ann"
    assert authority.owner(attach(FORGED, 0)) is None
    assert authority.owner(None) is None
    authority.takeover(Acquire(who="bob"), NOW)
    assert authority.owner(attach(ANN, 0)) == "ann"
    assert authority.owner(attach(BOB, 0)) == "bob"


# Losing the lease


def vanish(alive: str) -> Does:
    return lambda authority: authority.vanished(alive)


def lose_bus(authority: Authority) -> None:
    authority.bus_lost()


def stop(authority: Authority) -> None:
    authority.stop("stop")


def expire(now: float) -> Does:
    return lambda authority: authority.expire(now)


LOSSES = {
    "vanished": (vanish(ALIVE), "holder lost"),
    "bus lost": (lose_bus, "bus lost"),
    "expired": (expire(NOW + LEASE_S), "lease expired"),
}


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize(("happens", "reason"), LOSSES.values(), ids=LOSSES)
def test_a_lost_holder_is_written_down_and_what_moves_is_stopped(state: str, happens: Does, reason: str) -> None:
    authority = STATES[state]()
    happens(authority)
    assert authority.events() == [ended(reason, stops=state in IN_MOTION)]
    assert authority.state == "stopped"
    assert not authority.moving
    assert (authority.deadline(), authority.token) == (None, None)
    assert refusal(authority, attach(ANN, SEQ + 1)) == f"the lease has ended ({reason})"


@pytest.mark.parametrize("state", NOT_HELD)
@pytest.mark.parametrize(("happens", "reason"), LOSSES.values(), ids=LOSSES)
def test_a_loss_of_nobody_is_nothing(state: str, happens: Does, reason: str) -> None:
    authority = STATES[state]()
    happens(authority)
    assert authority.events() == []
    assert authority.state == STATE[state]


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize("alive", ["", "ann", "ann.10", "bob.1"])
def test_another_liveliness_token_than_the_holders_is_nothing(state: str, alive: str) -> None:
    authority = STATES[state]()
    authority.vanished(alive)
    assert authority.events() == []
    assert authority.state == "held"
    assert authority.moving is (state in IN_MOTION)


def test_the_liveliness_token_of_the_holder_before_is_nothing() -> None:
    authority = moving()
    authority.takeover(Acquire(who="bob", alive="bob.1"), NOW)
    authority.vanished(ALIVE)
    assert authority.report(NOW).holder == "bob"


def test_a_holder_that_named_no_liveliness_token_has_none_to_lose() -> None:
    authority = after(new(), lambda authority: authority.acquire(Acquire(who="ann"), NOW))
    authority.vanished("")
    authority.vanished("ann")
    assert authority.state == "held"


@pytest.mark.parametrize("state", STATES)
def test_a_stop_always_stops_and_ends_the_lease(state: str) -> None:
    authority = STATES[state]()
    authority.stop("stop")
    assert authority.events() == [Event(What.STOPPED, "ann" if state in HELD else None, "stop", stops=True)]
    assert authority.state == "stopped"
    assert not authority.moving
    assert (authority.deadline(), authority.token) == (None, None)
    assert "acquire first" in refusal(authority, attach(FORGED, 0))


def test_nobody_drives_after_a_stop_before_acquiring_anew() -> None:
    authority = stopped()
    assert refusal(authority, attach(ANN, SEQ + 1)) == "the lease has ended (stop)"
    assert not authority.renew(ANN, NOW).ok
    assert not authority.release(ANN, NOW).ok
    assert authority.state == "stopped"
    authority.acquire(Acquire(who="ann"), NOW)
    assert refusal(authority, attach(ANN, SEQ + 1)) == "the lease has ended (stop)"
    assert authority.admit(attach(BOB, 0), NOW) == "ann"
    authority.require_motion()


@pytest.mark.parametrize("state", STATES)
def test_holding_back_stops_keeps_the_lease_and_demands_neutral(state: str) -> None:
    authority = STATES[state]()
    authority.hold_back("busy")
    assert authority.events() == [Event(What.STOPPED, "ann" if state in HELD else None, "busy", stops=True)]
    assert authority.state == STATE[state]
    assert not authority.moving
    with pytest.raises(Refused, match=r"^busy: send a neutral drive first$"):
        authority.require_motion()


@pytest.mark.parametrize("state", STATES)
def test_a_robot_that_stands_anyway_is_held_back_without_a_stop_and_told_once(state: str) -> None:
    authority = STATES[state]()
    for _ in range(3):
        authority.hold_back("robot lost", stops=False)
    assert authority.events() == [Event(What.STOPPED, "ann" if state in HELD else None, "robot lost", stops=False)]
    assert not authority.moving
    with pytest.raises(Refused, match=r"^robot lost: send a neutral drive first$"):
        authority.require_motion()


# Time


def test_nothing_is_due_while_nobody_holds_the_robot() -> None:
    for state in NOT_HELD:
        authority = STATES[state]()
        assert authority.deadline() is None
        authority.expire(1e12)
        assert authority.events() == []


def test_the_deadman_stops_at_its_time_and_not_before() -> None:
    authority = moving()
    assert authority.deadline() == NOW + WAIT_S
    authority.expire(math.nextafter(NOW + WAIT_S, 0))
    assert authority.events() == []
    assert authority.moving
    authority.expire(NOW + WAIT_S)
    assert authority.events() == [Event(What.STOPPED, "ann", "deadman", stops=True)]
    assert not authority.moving
    assert authority.state == "held"
    assert authority.deadline() == NOW + LEASE_S, "the lease stays until it expires"
    with pytest.raises(Refused, match=r"^deadman: send a neutral drive first$"):
        authority.require_motion()


def test_what_is_due_is_done_once() -> None:
    authority = moving()
    for _ in range(3):
        authority.expire(NOW + WAIT_S)
    assert len(authority.events()) == 1
    for _ in range(3):
        authority.expire(NOW + LEASE_S)
    assert authority.events() == [ended("lease expired", stops=False)]


def test_a_late_call_finds_the_lease_expired_and_stops() -> None:
    authority = moving()
    authority.expire(NOW + 1000.0)
    assert authority.events() == [ended("lease expired", stops=True)]
    assert not authority.moving


@pytest.mark.parametrize(
    "does",
    [
        acquire(now=NOW + WAIT_S),
        renew(ANN, NOW + WAIT_S),
        renew(FORGED, NOW + WAIT_S),
        release(FORGED, NOW + WAIT_S),
        admit(attach(ANN, SEQ + 1), NOW + WAIT_S),
    ],
)
def test_nothing_comes_before_a_stop_that_is_due(does: Does) -> None:
    authority = moving()
    does(authority)
    assert authority.events()[0] == Event(What.STOPPED, "ann", "deadman", stops=True)
    assert not authority.moving
    with pytest.raises(Refused):
        authority.require_motion()


@pytest.mark.parametrize("does", [renew(ANN, NOW + LEASE_S), release(ANN, NOW + LEASE_S), acquire(now=NOW + LEASE_S)])
def test_an_expired_lease_is_found_by_whoever_comes_first(does: Does) -> None:
    authority = moving()
    with contextlib.suppress(Refused):
        does(authority)
    assert authority.events()[0] == ended("lease expired", stops=True)
    assert authority.token != ANN


def test_a_takeover_too_comes_after_a_stop_that_is_due() -> None:
    authority = moving()
    authority.takeover(Acquire(who="bob"), NOW + WAIT_S)
    assert [(event.what, event.reason, event.stops) for event in authority.events()] == [
        (What.STOPPED, "deadman", True),
        (What.ENDED, "taken over by bob", False),
        (What.TAKEN_OVER, None, False),
    ]


def test_a_lease_that_expired_is_free_for_the_lowest_priority() -> None:
    authority = moving()
    assert authority.acquire(Acquire(who="bob", priority=-9), NOW + LEASE_S).ok
    assert [event.what for event in authority.events()] == [What.ENDED, What.ACQUIRED]


def test_every_motion_puts_the_deadman_off() -> None:
    authority = moving()
    for step in range(1, 20):
        now = NOW + 0.4 * step
        authority.admit(attach(ANN, SEQ + step), now)
        authority.applied("drive", now, moving=True)
        assert authority.deadline() == now + WAIT_S
    assert authority.events() == []


def test_neutral_ends_the_watch_and_keeps_the_lease() -> None:
    authority = moving()
    authority.admit(attach(ANN, SEQ + 1), NOW)
    authority.applied("drive", NOW, moving=False)
    assert not authority.moving
    assert authority.state == "held"
    assert authority.deadline() == NOW + LEASE_S
    authority.expire(NOW + WAIT_S)
    assert authority.events() == []


def test_the_neutral_of_one_part_does_not_end_the_watch_over_another() -> None:
    authority = moving()
    authority.applied("left motor", NOW, moving=True)
    authority.applied("drive", NOW, moving=False)
    assert authority.moving
    assert authority.deadline() == NOW + WAIT_S
    authority.applied("left motor", NOW, moving=False)
    assert not authority.moving


def test_a_robot_that_moves_by_itself_is_not_stopped_by_the_deadman() -> None:
    authority = by_itself()
    assert authority.deadline() == NOW + LEASE_S
    authority.expire(NOW + DEADMAN_S)
    assert authority.events() == []
    assert authority.moving
    authority.expire(NOW + LEASE_S)
    assert authority.events() == [ended("lease expired", stops=True)]
    assert not authority.on_its_own


def test_a_robot_that_moves_by_itself_still_moves_after_a_neutral() -> None:
    authority = by_itself()
    authority.applied("drive", NOW, moving=False)
    assert authority.moving, "only a stop makes sure of it"


def test_motion_is_watched_even_where_nobody_holds_the_robot() -> None:
    authority = stopped()
    authority.applied("drive", NOW, moving=True)
    assert authority.deadline() == NOW + DEADMAN_S
    authority.expire(NOW + DEADMAN_S)
    assert authority.events() == [Event(What.STOPPED, None, "deadman", stops=True)]
    assert not authority.moving


# What is shown


def test_control_says_who_drives_and_for_how_long() -> None:
    assert moving().report(NOW + 1.0) == Control(state="held", holder="ann", priority=5, expires_in_s=LEASE_S - 1.0)
    assert moving().report(NOW + 9.0).expires_in_s == 0.0
    assert new().report(NOW) == Control(state="free")
    assert stopped().report(NOW) == Control(state="stopped")


def test_equal_refusals_are_counted_together_and_the_newest_stands_last() -> None:
    authority = new()
    for command in ("drive", "lidar", "drive"):
        authority.refuse(command, NotReady("offline"))
    assert authority.report(NOW).refusals == (
        Refusal(who=None, command="lidar", code="not_ready", reason="offline", count=1),
        Refusal(who=None, command="drive", code="not_ready", reason="offline", count=2),
    )
    assert authority.events() == [
        Event(What.REFUSED, reason="offline", command=command, code=Code.NOT_READY)
        for command in ("drive", "lidar", "drive")
    ]


def test_refusals_of_different_senders_are_told_apart() -> None:
    authority = new()
    authority.refuse("drive", NotReady("offline"), who="hq.1")
    authority.refuse("drive", NotReady("offline"), who="hq.2")
    assert [(refused.who, refused.count) for refused in authority.report(NOW).refusals] == [("hq.1", 1), ("hq.2", 1)]


def test_refusals_are_bounded_and_the_oldest_makes_room() -> None:
    authority = new()
    for number in range(REFUSALS + 3):
        authority.refuse("raw", NotReady(f"reason {number}"))
    shown = authority.report(NOW).refusals
    assert [refused.reason for refused in shown] == [f"reason {number}" for number in range(3, REFUSALS + 3)]


def test_a_refusal_repeated_all_the_time_makes_room_for_no_other() -> None:
    authority = new()
    for number in range(REFUSALS * 2):
        authority.refuse("drive", NotReady("always"))
        authority.refuse("raw", NotReady(f"reason {number}"))
    shown = {refused.reason: refused.count for refused in authority.report(NOW).refusals}
    assert len(shown) == REFUSALS
    assert shown["always"] == REFUSALS * 2


def test_long_names_and_reasons_are_cut() -> None:
    authority = new()
    authority.acquire(Acquire(who="a" * 1000, priority=1), NOW)
    authority.refuse("c" * 1000, NotReady("r" * 1000), "w" * 1000)
    authority.acquire(Acquire(who="b" * 1000), NOW)
    control = authority.report(NOW)
    assert control.holder == "a" * 64
    for refused in control.refusals:
        assert refused.who is not None
        assert len(refused.who) == 64
        assert len(refused.command) <= 64
        assert len(refused.reason) <= 200
    assert all(len(str(event)) < 400 for event in authority.events())


def test_a_bounded_number_of_ended_leases_is_remembered() -> None:
    authority = Authority(LEASE_S, DEADMAN_S, iter(map(str.encode, map(str, itertools.count()))).__next__)
    tokens = [authority.takeover(Acquire(who=f"client {number}"), NOW).token for number in range(ENDED + 2)]
    *old, held_now = [token for token in tokens if token is not None]
    forgotten, remembered = old[: len(old) - ENDED], old[len(old) - ENDED :]
    assert len(forgotten) == 1
    for token in forgotten:
        assert authority.owner(attach(token, 9)) is None
        assert refusal(authority, attach(token, 9)) == f"held by client {ENDED + 1} (priority 0)", (
            "refused all the same"
        )
    for number, token in enumerate(remembered, 1):
        assert authority.owner(attach(token, 9)) == f"client {number}"
        assert refusal(authority, attach(token, 9)) == f"the lease has ended (taken over by client {number + 1})"
    assert authority.admit(attach(held_now, 0), NOW) == f"client {ENDED + 1}"


def test_events_are_given_once_and_in_order() -> None:
    authority = moving()
    authority.refuse("raw", NotReady("offline"), "bob")
    authority.takeover(Acquire(who="bob", priority=1), NOW)
    authority.stop("stop")
    assert [str(event) for event in authority.events()] == [
        "refused bob raw (offline)",
        "ended ann (taken over by bob)",
        "taken over bob",
        "stopped bob (stop)",
    ]
    assert authority.events() == []


def test_an_authority_prints_its_state_and_no_token() -> None:
    printed = {state: repr(make()) for state, make in STATES.items()}
    assert printed["new"] == "<Authority free>"
    assert printed["moving"] == "<Authority held by ann>"
    assert printed["stopped"] == "<Authority stopped>"
