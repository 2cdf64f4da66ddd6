"""Control authority: every transition of the lease, what each tells the world, and what may not drive."""

import contextlib
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import msgpack
import msgspec
import pytest

from tests.proofs import numbered, proof, shown
from tests.tables import documented, executed
from zbridge.control.authority import Authority
from zbridge.control.events import Event, EventKind
from zbridge.control.proof import ENDED
from zbridge.control.refusal_counts import REFUSALS
from zbridge.control.wishes import LEAST_S
from zbridge.errors import Code, Held, LeaseLost, Malformed, NotReady, Refused
from zbridge.fleet.messages import Acquire, Authorization, Control, Lease, Refusal

NOW = 100.0
LEASE_S, DEADMAN_S = 3.0, 2.0
"""The most a holder may ask for."""
DRIVE = "fleet/r1/@cmd/drive"
RENEW, RELEASE = "fleet/r1/@rpc/control/renew", "fleet/r1/@rpc/control/release"
PAYLOAD = b"\x81\xa7forward\x01"


class Given(NamedTuple):
    """What was given with a lease."""

    lease: bytes
    token: bytes


ANN, BOB = Given(b"\x01" * 8, b"\x01" * 32), Given(b"\x02" * 8, b"\x02" * 32)
"""The first and the second lease of an authority. Ann has, or had, the first; Bob asks for it."""
FORGED = Given(b"\xff" * 8, b"\xff" * 32)
ALIVE = "ann.1"
SEQ = 7
"""The number of Ann's last command."""
WAIT_S = 0.5
"""Ann's deadman."""

Does = Callable[[Authority], object]


def new() -> Authority:
    return Authority(LEASE_S, DEADMAN_S, numbered())


def released() -> Authority:
    return after(held(), release(ANN))


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


def attach(given: Given, seq: int, key: str = DRIVE, payload: bytes = PAYLOAD) -> bytes:
    return shown(given.lease, given.token, key, seq, payload)


_questions = itertools.count(1)


def asking(given: Given, seq: int | None = None, key: str = RENEW) -> Authorization:
    """What is asked with by who was given this; with the next number where it says none."""
    seq = next(_questions) if seq is None else seq
    return Authorization(lease=given.lease, seq=seq, proof=proof(given.token, key, seq))


def acquire(priority: int = 0, now: float = NOW) -> Does:
    return lambda authority: authority.acquire(Acquire(who="bob", priority=priority), now)


def takeover(priority: int = 0, now: float = NOW) -> Does:
    return lambda authority: authority.takeover(Acquire(who="bob", priority=priority), now)


def renew(given: Given, now: float = NOW) -> Does:
    return lambda authority: authority.renew(asking(given), RENEW, now)


def release(given: Given, now: float = NOW) -> Does:
    return lambda authority: authority.release(asking(given, key=RELEASE), RELEASE, now)


def admit(attachment: bytes | None, now: float = NOW) -> Does:
    return lambda authority: authority.admit(attachment, DRIVE, PAYLOAD, now)


def held_lease(authority: Authority) -> bytes | None:
    """The lease that is held, as those who sort what comes in see it."""
    return authority.verifier.lease if authority.verifier is not None else None


def ended(reason: str, *, stops: bool, what: EventKind = EventKind.ENDED) -> Event:
    return Event(what, "ann", reason, stops=stops)


# The lease


@pytest.mark.parametrize("state", STATES)
def test_the_states_to_start_from_are_what_they_are_called(state: str) -> None:
    authority = STATES[state]()
    assert authority.state == STATE[state]
    assert authority.moving is (state in IN_MOTION)
    assert held_lease(authority) == (ANN.lease if state in HELD else None)
    assert authority.events() == []


@pytest.mark.parametrize("state", NOT_HELD)
def test_whoever_asks_first_is_given_a_robot_that_nobody_holds(state: str) -> None:
    authority = STATES[state]()
    lease = authority.acquire(Acquire(who="bob", priority=-1), NOW)
    given = ANN if state == "new" else BOB
    assert lease == Lease(ok=True, lease=given.lease, token=given.token, expires_in_s=LEASE_S, holder="bob")
    assert held_lease(authority) == given.lease
    assert authority.events() == [Event(EventKind.ACQUIRED, "bob", priority=-1)]
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
    assert lease == Lease(ok=False, expires_in_s=LEASE_S, holder="ann", reason=reason, code="held")
    assert authority.events() == [Event(EventKind.REFUSED, "bob", reason, command="acquire", code=Code.HELD)]
    assert authority.report(NOW).refusals == (
        Refusal(who="bob", command="acquire", code="held", reason=reason, count=1),
    )
    assert (repr(authority), authority.moving, authority.deadline()) == before
    assert admit(attach(ANN, SEQ + 1))(authority) == "ann"


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize(
    ("asks", "what", "priority"), [(acquire(6), EventKind.ACQUIRED, 6), (takeover(), EventKind.TAKEN_OVER, 0)]
)
def test_a_higher_priority_or_a_takeover_stops_what_moves_before_it_gives_the_lease(
    state: str, asks: Does, what: EventKind, priority: int
) -> None:
    authority = STATES[state]()
    assert asks(authority) == Lease(ok=True, lease=BOB.lease, token=BOB.token, expires_in_s=LEASE_S, holder="bob")
    assert authority.events() == [
        ended("taken over by bob", stops=state in IN_MOTION),
        Event(what, "bob", priority=priority),
    ]
    assert not authority.moving
    authority.require_motion()
    assert refusal(authority, attach(ANN, SEQ + 1)) == "the lease has ended (taken over by bob)"
    assert admit(attach(BOB, 0))(authority) == "bob"


@pytest.mark.parametrize("state", NOT_HELD)
def test_a_takeover_of_a_robot_that_nobody_holds_is_granted(state: str) -> None:
    authority = STATES[state]()
    lease = authority.takeover(Acquire(who="bob", priority=2), NOW)
    given = ANN if state == "new" else BOB
    assert lease == Lease(ok=True, lease=given.lease, token=given.token, expires_in_s=LEASE_S, holder="bob")
    assert authority.events() == [Event(EventKind.TAKEN_OVER, "bob", priority=2)]


@pytest.mark.parametrize("state", HELD)
def test_a_takeover_is_granted_whatever_its_priority(state: str) -> None:
    authority = STATES[state]()
    assert authority.takeover(Acquire(who="bob", priority=-100), NOW).ok
    assert authority.report(NOW).priority == -100


@pytest.mark.parametrize("state", HELD)
def test_the_holder_renews_and_its_lease_begins_anew(state: str) -> None:
    authority = STATES[state]()
    authority.applied("drive", NOW, moving=False)
    assert authority.renew(asking(ANN), RENEW, NOW + 0.25) == Lease(ok=True, expires_in_s=LEASE_S, holder="ann")
    assert authority.events() == []
    assert authority.deadline() == NOW + 0.25 + LEASE_S


def test_renewing_does_not_feed_the_deadman() -> None:
    authority = moving()
    authority.renew(asking(ANN), RENEW, NOW + 0.25)
    assert authority.deadline() == NOW + WAIT_S


@pytest.mark.parametrize(
    ("state", "event"),
    [(state, ended("released", stops=state in IN_MOTION, what=EventKind.RELEASED)) for state in HELD],
)
def test_the_holder_releases_and_what_moves_is_stopped(state: str, event: Event) -> None:
    authority = STATES[state]()
    assert authority.release(asking(ANN, key=RELEASE), RELEASE, NOW) == Lease(ok=True)
    assert authority.events() == [event]
    assert authority.state == "free"
    assert not authority.moving
    assert authority.deadline() is None
    assert refusal(authority, attach(ANN, SEQ + 1)) == "the lease has ended (released)"


WHY_NOT = [
    ("new", ANN, "no lease: acquire first", "no_lease"),
    ("released", ANN, "the lease has ended (released)", "lease_ended"),
    ("stopped", ANN, "the lease has ended (stop)", "lease_ended"),
    *((state, FORGED, "no lease: acquire first", "no_lease") for state in NOT_HELD),
    *((state, FORGED, "held by ann (priority 5)", "held") for state in HELD),
    *((state, Given(ANN.lease, FORGED.token), "wrong proof", "malformed") for state in (*HELD, "released", "stopped")),
]


@pytest.mark.parametrize(("state", "given", "reason", "code"), WHY_NOT)
@pytest.mark.parametrize("asks", [renew, release])
def test_nobody_else_renews_or_releases(state, given, reason, code, asks) -> None:
    authority = STATES[state]()
    before = repr(authority), authority.moving, authority.deadline()
    holder, left_s = ("ann", LEASE_S) if state in HELD else (None, None)
    assert asks(given)(authority) == Lease(ok=False, expires_in_s=left_s, holder=holder, reason=reason, code=code)
    who = "ann" if code == "lease_ended" else None
    assert authority.events() == [Event(EventKind.REFUSED, who, reason, command=asks.__name__, code=Code(code))]
    assert (repr(authority), authority.moving, authority.deadline()) == before


@pytest.mark.parametrize("name", ["renew", "release"])
def test_a_question_is_taken_once_and_only_for_the_key_it_was_asked_at(name: str) -> None:
    authority = held()
    asks = getattr(authority, name)
    key = f"fleet/r1/@rpc/control/{name}"
    other = f"fleet/r2/@rpc/control/{name}"
    for wrong in (
        asking(ANN, 900, other),
        asking(ANN, 900, DRIVE),
        asking(ANN, 900, RENEW + "/"),
        asking(BOB, 900, key),
    ):
        assert asks(wrong, key, NOW).code in ("malformed", "held")
    renewed = authority.renew(asking(ANN, 800), RENEW, NOW)
    assert renewed.ok, "what was refused used no number up"
    repeated = authority.renew(asking(ANN, 800), RENEW, NOW)
    assert (repeated.ok, repeated.code, repeated.reason) == (False, "out_of_order", "repeated or out of order")
    assert not authority.release(asking(ANN, 799, RELEASE), RELEASE, NOW).ok, "they share their numbers"
    assert authority.state == "held"
    assert [(refused.who, refused.code) for refused in authority.report(NOW).refusals][-1] == (None, "out_of_order")
    assert authority.release(asking(ANN, 801, RELEASE), RELEASE, NOW).ok


def test_questions_and_commands_are_numbered_apart() -> None:
    authority = held()
    assert authority.renew(asking(ANN, 2**63), RENEW, NOW).ok
    assert admit(attach(ANN, SEQ + 1))(authority) == "ann"
    assert not authority.renew(asking(ANN, SEQ + 2), RENEW, NOW).ok


def test_a_command_is_no_question_and_a_question_no_command() -> None:
    authority = held()
    as_question = proof(ANN.token, DRIVE, 900)
    assert authority.renew(Authorization(lease=ANN.lease, seq=900, proof=as_question), RENEW, NOW).code == "malformed"
    assert refusal(authority, attach(ANN, 900, RENEW, b"")) == "wrong proof"


def test_no_answer_but_the_grant_shows_a_token() -> None:
    authority = new()
    granted = authority.acquire(Acquire(who="ann"), NOW)
    assert (granted.lease, granted.token) == ANN
    answers = [asks(authority) for asks in (acquire(), renew(ANN), renew(FORGED), release(FORGED), release(ANN))]
    assert [answer.token for answer in answers if isinstance(answer, Lease)] == [None] * 5


def test_every_lease_has_an_id_and_a_token_of_its_own() -> None:
    authority = new()
    leases = [authority.takeover(Acquire(who="ann"), NOW) for _ in range(5)]
    assert len({lease.token for lease in leases}) == len({lease.lease for lease in leases}) == 5


def test_an_id_is_not_given_again_while_its_lease_is_remembered_whatever_chance_says() -> None:
    authority = Authority(LEASE_S, DEADMAN_S, lambda size: b"\xff" * size)
    ids = [authority.takeover(Acquire(who="ann"), NOW).lease for _ in range(ENDED + 1)]
    assert ids[:3] == [b"\xff" * 8, b"\x00" * 8, b"\x00" * 7 + b"\x01"]
    assert len(set(ids)) == ENDED + 1


def test_the_token_has_32_bytes_and_the_id_8() -> None:
    sizes: list[int] = []

    def random(size: int) -> bytes:
        sizes.append(size)
        return bytes(size)

    Authority(LEASE_S, DEADMAN_S, random).acquire(Acquire(who="ann"), NOW)
    assert sorted(sizes) == [8, 32]


def test_a_holder_that_takes_over_from_itself_has_lost_its_old_token() -> None:
    authority = moving()
    assert authority.takeover(Acquire(who="ann", priority=5), NOW).token == BOB.token
    assert [(event.what, event.stops) for event in authority.events()] == [
        (EventKind.ENDED, True),
        (EventKind.TAKEN_OVER, False),
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
    assert authority.renew(asking(ANN), RENEW, NOW).expires_in_s == given_s


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
    admit(attach(ANN, 0))(authority)
    authority.applied("drive", NOW, moving=True)
    assert authority.deadline() == NOW + given_s


NO_TIME = [0.0, -0.0, -1.0, -math.inf, math.nan, math.nextafter(LEAST_S, 0)]


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("field", ["lease_s", "deadman_s"])
@pytest.mark.parametrize("wish_s", NO_TIME)
def test_what_is_no_time_is_refused_and_leaves_everything_as_it_was(state: str, field: str, wish_s: float) -> None:
    authority = STATES[state]()
    before = repr(authority), authority.moving, authority.deadline(), held_lease(authority)
    request = msgspec.structs.replace(Acquire(who="bob", priority=9), **{field: wish_s})
    lease = authority.takeover(request, NOW)
    assert not lease.ok
    assert lease.token is None
    assert lease.reason == f"{field} = {wish_s:g}: expected at least {LEAST_S:g}"
    assert [event.what for event in authority.events()] == [EventKind.REFUSED]
    assert (repr(authority), authority.moving, authority.deadline(), held_lease(authority)) == before


@pytest.mark.parametrize("state", STATES)
def test_nobody_without_a_name_is_given_a_robot(state: str) -> None:
    authority = STATES[state]()
    before = repr(authority), authority.moving, authority.deadline(), held_lease(authority)
    lease = authority.acquire(Acquire(who="", priority=9), NOW)
    assert (lease.ok, lease.token) == (False, None)
    assert lease.reason == "who = '': expected a name that others are shown"
    assert (repr(authority), authority.moving, authority.deadline(), held_lease(authority)) == before


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


def refused(authority: Authority, attachment: bytes | None, now: float = NOW) -> Refused:
    """Give how a command is refused."""
    with pytest.raises(Refused) as raised:
        authority.admit(attachment, DRIVE, PAYLOAD, now)
    return raised.value


def refusal(authority: Authority, attachment: bytes | None, now: float = NOW) -> str:
    """Give the reason for which a command is refused."""
    return str(refused(authority, attachment, now))


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize("seq", [SEQ + 1, SEQ + 1000, 2**64 - 1])
def test_the_holders_next_command_is_admitted_once(state: str, seq: int) -> None:
    authority = STATES[state]()
    assert admit(attach(ANN, seq))(authority) == "ann"
    assert refusal(authority, attach(ANN, seq)) == "repeated or out of order"
    assert authority.events() == []


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize("seq", [0, SEQ - 1, SEQ])
def test_a_repeated_or_late_command_is_refused(state: str, seq: int) -> None:
    assert refusal(STATES[state](), attach(ANN, seq)) == "repeated or out of order"


def test_the_first_number_may_be_zero() -> None:
    authority = new()
    authority.acquire(Acquire(who="ann"), NOW)
    assert admit(attach(ANN, 0))(authority) == "ann"


def test_numbers_begin_anew_with_each_lease() -> None:
    authority = moving()
    authority.takeover(Acquire(who="bob"), NOW)
    assert admit(attach(BOB, 0))(authority) == "bob"


@pytest.mark.parametrize("state", STATES)
def test_a_command_without_an_attachment_is_refused(state: str) -> None:
    assert refusal(STATES[state](), None) == "no lease: acquire first"


WHOLE = {"lease": ANN.lease, "seq": 9, "proof": proof(ANN.token, DRIVE, 9, PAYLOAD)}


def wrong(**fields: object) -> bytes:
    """The attachment that would be right but for these fields."""
    attachment: bytes = msgpack.packb({**WHOLE, **fields})
    return attachment


MALFORMED = {
    "empty": b"",
    "no map": msgpack.packb([*WHOLE.values()]),
    "nil": msgpack.packb(None),
    "the bare token": ANN.token,
    "as it was before": msgpack.packb({"token": ANN.token, "seq": 9}),
    **{f"no {name}": msgpack.packb({**WHOLE, "x": 0, name: None}) for name in WHOLE},
    **{f"{name} is not there": msgpack.packb({key: WHOLE[key] for key in WHOLE if key != name}) for name in WHOLE},
    "a lease as text": wrong(lease=ANN.lease.decode()),
    "a short lease": wrong(lease=ANN.lease[1:]),
    "a long lease": wrong(lease=ANN.lease + b"\x01"),
    "a short proof": wrong(proof=proof(ANN.token, DRIVE, 9, PAYLOAD)[:15]),
    "no proof at all": wrong(proof=b""),
    "a longer proof": wrong(proof=proof(ANN.token, DRIVE, 9, PAYLOAD) + b"\x00"),
    "a proof as text": wrong(proof="0123456789abcdef"),
    "a negative number": wrong(seq=-1),
    "a fraction": wrong(seq=9.5),
    "a truth": wrong(seq=True),
    "cut": attach(ANN, 9)[:-1],
    "more behind it": attach(ANN, 9) + b"\x00",
    "much beside it": wrong(x=bytes(200)),
    "deeply nested": b"\x91" * 100_000 + b"\xc0",
    "deeply nested but short": attach(ANN, 9).replace(b"\x83", b"\x84", 1) + b"\xa1x" + b"\x91" * 60,
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("attachment", MALFORMED.values(), ids=MALFORMED)
def test_a_malformed_attachment_is_refused(state: str, attachment: bytes) -> None:
    how = refused(STATES[state](), attachment)
    assert isinstance(how, Malformed)
    assert (how.code, str(how), how.who) == (
        Code.MALFORMED,
        "malformed authorization: expected {lease, seq, proof}",
        None,
    )


@pytest.mark.parametrize("size", range(len(attach(ANN, 9))))
def test_an_attachment_cut_anywhere_is_refused(size: int) -> None:
    assert refused(held(), attach(ANN, 9)[:size]).code == "malformed"


def test_whatever_order_its_fields_have_and_however_long_they_are_written_an_attachment_is_read() -> None:
    backwards: bytes = msgpack.packb(dict(reversed(WHOLE.items())))
    assert admit(backwards)(held()) == "ann"
    (lease, proven) = (bytes([0xC6, 0, 0, 0, len(value)]) + value for value in (ANN.lease, WHOLE["proof"]))  # type: ignore[arg-type]
    number = b"\xcf" + bytes(7) + b"\x09"
    long = b"\xdf\0\0\0\x03" + b"\xda\0\5lease" + lease + b"\xda\0\3seq" + number + b"\xda\0\5proof" + proven
    assert admit(long)(held()) == "ann"
    assert admit(wrong(more="to come"))(held()) == "ann", "readers bear what they do not know"


@pytest.mark.parametrize(("state", "given", "reason", "code"), WHY_NOT)
def test_a_command_with_another_lease_is_refused_with_the_reason(state, given, reason, code) -> None:
    how = refused(STATES[state](), attach(given, SEQ + 1))
    assert (str(how), how.code) == (reason, code)
    assert how.holder == ("ann" if how.code == "held" else None)


@pytest.mark.parametrize("bit", range(8 * 16))
def test_a_proof_with_one_bit_changed_drives_nothing(bit: int) -> None:
    near = (int.from_bytes(proof(ANN.token, DRIVE, 9, PAYLOAD), "big") ^ 1 << bit).to_bytes(16, "big")
    assert refused(held(), wrong(proof=near)).code == "malformed"


@pytest.mark.parametrize("bit", range(8 * 32))
def test_a_token_with_one_bit_changed_drives_nothing(bit: int) -> None:
    token = (int.from_bytes(ANN.token, "big") ^ 1 << bit).to_bytes(32, "big")
    assert refusal(held(), attach(Given(ANN.lease, token), SEQ + 1)) == "wrong proof"


OVERHEARD = attach(ANN, SEQ + 1)
"""Ann's next command, as whoever listens sees it."""
ALTERED = {
    "another payload": (OVERHEARD, DRIVE, PAYLOAD[:-1] + b"\x00"),
    "a longer payload": (OVERHEARD, DRIVE, PAYLOAD + b"\x00"),
    "no payload": (OVERHEARD, DRIVE, b""),
    "another command": (OVERHEARD, "fleet/r1/@cmd/mode", PAYLOAD),
    "another robot": (OVERHEARD, "fleet/r2/@cmd/drive", PAYLOAD),
    "another realm": (OVERHEARD, "flee/r1/@cmd/drive", PAYLOAD),
    "a higher number": (wrong(seq=SEQ + 2, proof=proof(ANN.token, DRIVE, SEQ + 1, PAYLOAD)), DRIVE, PAYLOAD),
    "the highest number": (wrong(seq=2**64 - 1, proof=proof(ANN.token, DRIVE, SEQ + 1, PAYLOAD)), DRIVE, PAYLOAD),
    "a byte moved from key to payload": (OVERHEARD, DRIVE[:-1], DRIVE[-1:].encode() + PAYLOAD),
}


@pytest.mark.parametrize(("attachment", "key", "payload"), ALTERED.values(), ids=ALTERED)
def test_what_was_overheard_and_altered_is_refused_and_costs_the_holder_nothing(attachment, key, payload) -> None:
    authority = held()
    with pytest.raises(Malformed, match=r"^wrong proof$") as how:
        authority.admit(attachment, key, payload, NOW)
    assert (how.value.code, how.value.who) == (Code.MALFORMED, None)
    assert admit(OVERHEARD)(authority) == "ann", "it used no number up"


def test_what_was_overheard_and_repeated_is_refused_and_is_nobodys() -> None:
    authority = held()
    assert admit(OVERHEARD)(authority) == "ann"
    how = refused(authority, OVERHEARD)
    assert isinstance(how, Malformed)
    assert (how.code, how.who) == (Code.OUT_OF_ORDER, None), "or a stranger would make a client think it was its own"


def test_what_was_overheard_of_a_lease_that_has_ended_is_refused() -> None:
    authority = held()
    admit(OVERHEARD)(authority)
    authority.takeover(Acquire(who="bob"), NOW)
    for attachment, who in ((OVERHEARD, None), (attach(ANN, SEQ + 2), "ann"), (attach(ANN, SEQ + 2), None)):
        how = refused(authority, attachment)
        assert isinstance(how, LeaseLost)
        assert (how.code, how.who) == (Code.LEASE_ENDED, who), "a new number is Ann's own; the others anybody's"
    assert refused(authority, attach(Given(ANN.lease, BOB.token), 99)).code == "malformed"
    assert admit(attach(BOB, 0))(authority) == "bob"


def test_whoever_knows_only_the_public_id_can_neither_use_numbers_up_nor_learn_of_them() -> None:
    authority = held()
    answers = {refusal(authority, attach(Given(ANN.lease, FORGED.token), seq)) for seq in (0, SEQ, SEQ + 1, 2**64 - 1)}
    assert answers == {"wrong proof"}
    assert admit(attach(ANN, SEQ + 1))(authority) == "ann"


def test_who_comes_with_no_lease_of_ours_is_told_who_holds_the_robot() -> None:
    how = refused(held(), attach(FORGED, 9))
    assert isinstance(how, Held)
    assert how.holder == "ann"


REFUSED = {
    "no attachment": None,
    "malformed": b"",
    "forged": attach(FORGED, SEQ + 1),
    "a guess at the token": attach(Given(ANN.lease, FORGED.token), SEQ + 1),
    "repeated": attach(ANN, SEQ),
    "late": attach(ANN, 0),
}


@pytest.mark.parametrize("attachment", REFUSED.values(), ids=REFUSED)
def test_a_refused_command_neither_renews_the_lease_nor_feeds_the_deadman(attachment: bytes | None) -> None:
    authority = moving()
    refusal(authority, attachment, NOW + 0.25)
    assert authority.deadline() == NOW + WAIT_S
    assert authority.report(NOW + 0.25).expires_in_s == LEASE_S - 0.25
    assert admit(attach(ANN, SEQ + 1), NOW + 0.25)(authority) == "ann", "and uses up no number"


def test_a_command_renews_the_lease() -> None:
    authority = held()
    admit(attach(ANN, SEQ + 1), NOW + 1.0)(authority)
    assert authority.report(NOW + 1.0).expires_in_s == LEASE_S
    assert authority.deadline() == NOW + 1.0 + LEASE_S


def test_a_command_that_was_only_admitted_does_not_feed_the_deadman() -> None:
    authority = moving()
    for step in range(1, 5):
        admit(attach(ANN, SEQ + step), NOW + 0.1 * step)(authority)
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
        admit(attach(ANN, seq))(authority)
        with pytest.raises(Refused, match=r"^deadman: send a neutral drive first$"):
            authority.require_motion()
    authority.applied("drive", NOW, moving=False)
    authority.require_motion()
    assert authority.state == "held"


def test_a_neutral_that_was_only_admitted_allows_no_motion() -> None:
    authority = held_back()
    admit(attach(ANN, SEQ + 1))(authority)
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
    assert (authority.deadline(), held_lease(authority)) == (None, None)
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
    assert authority.events() == [Event(EventKind.STOPPED, "ann" if state in HELD else None, "stop", stops=True)]
    assert authority.state == "stopped"
    assert not authority.moving
    assert (authority.deadline(), held_lease(authority)) == (None, None)
    assert "acquire first" in refusal(authority, attach(FORGED, 0))


def test_nobody_drives_after_a_stop_before_acquiring_anew() -> None:
    authority = stopped()
    assert refusal(authority, attach(ANN, SEQ + 1)) == "the lease has ended (stop)"
    assert not authority.renew(asking(ANN), RENEW, NOW).ok
    assert not authority.release(asking(ANN, key=RELEASE), RELEASE, NOW).ok
    assert authority.state == "stopped"
    authority.acquire(Acquire(who="ann"), NOW)
    assert refusal(authority, attach(ANN, SEQ + 1)) == "the lease has ended (stop)"
    assert admit(attach(BOB, 0))(authority) == "ann"
    authority.require_motion()


@pytest.mark.parametrize("state", STATES)
def test_holding_back_stops_keeps_the_lease_and_demands_neutral(state: str) -> None:
    authority = STATES[state]()
    authority.hold_back("busy")
    assert authority.events() == [Event(EventKind.STOPPED, "ann" if state in HELD else None, "busy", stops=True)]
    assert authority.state == STATE[state]
    assert not authority.moving
    with pytest.raises(Refused, match=r"^busy: send a neutral drive first$"):
        authority.require_motion()


@pytest.mark.parametrize("state", STATES)
def test_a_robot_that_stands_anyway_is_held_back_without_a_stop_and_told_once(state: str) -> None:
    authority = STATES[state]()
    for _ in range(3):
        authority.hold_back("robot lost", stops=False)
    assert authority.events() == [Event(EventKind.STOPPED, "ann" if state in HELD else None, "robot lost", stops=False)]
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
    assert authority.events() == [Event(EventKind.STOPPED, "ann", "deadman", stops=True)]
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
    assert authority.events()[0] == Event(EventKind.STOPPED, "ann", "deadman", stops=True)
    assert not authority.moving
    with pytest.raises(Refused):
        authority.require_motion()


@pytest.mark.parametrize("does", [renew(ANN, NOW + LEASE_S), release(ANN, NOW + LEASE_S), acquire(now=NOW + LEASE_S)])
def test_an_expired_lease_is_found_by_whoever_comes_first(does: Does) -> None:
    authority = moving()
    with contextlib.suppress(Refused):
        does(authority)
    assert authority.events()[0] == ended("lease expired", stops=True)
    assert held_lease(authority) != ANN.lease


def test_a_takeover_too_comes_after_a_stop_that_is_due() -> None:
    authority = moving()
    authority.takeover(Acquire(who="bob"), NOW + WAIT_S)
    assert [(event.what, event.reason, event.stops) for event in authority.events()] == [
        (EventKind.STOPPED, "deadman", True),
        (EventKind.ENDED, "taken over by bob", False),
        (EventKind.TAKEN_OVER, None, False),
    ]


def test_a_lease_that_expired_is_free_for_the_lowest_priority() -> None:
    authority = moving()
    assert authority.acquire(Acquire(who="bob", priority=-9), NOW + LEASE_S).ok
    assert [event.what for event in authority.events()] == [EventKind.ENDED, EventKind.ACQUIRED]


def test_every_motion_puts_the_deadman_off() -> None:
    authority = moving()
    for step in range(1, 20):
        now = NOW + 0.4 * step
        admit(attach(ANN, SEQ + step), now)(authority)
        authority.applied("drive", now, moving=True)
        assert authority.deadline() == now + WAIT_S
    assert authority.events() == []


def test_neutral_ends_the_watch_and_keeps_the_lease() -> None:
    authority = moving()
    admit(attach(ANN, SEQ + 1))(authority)
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
    assert authority.events() == [Event(EventKind.STOPPED, None, "deadman", stops=True)]
    assert not authority.moving


# What is shown


def test_control_says_who_drives_and_for_how_long() -> None:
    assert moving().report(NOW + 1.0) == Control(
        state="held", holder="ann", lease=ANN.lease, priority=5, expires_in_s=LEASE_S - 1.0
    )
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
        Event(EventKind.REFUSED, reason="offline", command=command, code=Code.NOT_READY)
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
    authority = new()
    for number in range(1, ENDED + 3):
        authority.takeover(Acquire(who=f"client {number}"), NOW)
    forgotten, *remembered, current = (Given(bytes([n]) * 8, bytes([n]) * 32) for n in range(1, ENDED + 3))
    how = refused(authority, attach(forgotten, 9))
    assert (how.who, str(how)) == (None, f"held by client {ENDED + 2} (priority 0)"), "refused all the same"
    for number, given in enumerate(remembered, 2):
        how = refused(authority, attach(given, 9))
        assert (how.who, str(how)) == (f"client {number}", f"the lease has ended (taken over by client {number + 1})")
    assert admit(attach(current, 0))(authority) == f"client {ENDED + 2}"


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


# The table


def test_the_table_of_the_documentation_is_the_one_that_is_executed() -> None:
    assert documented("control.md", "input") == executed(Authority.TABLE)
