"""Control authority: what each input does in each state, what is told of it, and what may not drive."""

import contextlib
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import pytest

from tests.proofs import numbered, proof, shown
from tests.tables import documented, executed
from zbridge.control.authority import Authority
from zbridge.control.authority_machine import AuthorityMachine
from zbridge.control.events import StopCause
from zbridge.control.holders import ENDED
from zbridge.errors import Code, Held, LeaseLost, NeutralFirst, Refused
from zbridge.fleet.lease_messages import Acquire, Authorization, Lease
from zbridge.fleet.messages import Control, Refusal

NOW = 100.0
LEASE_S, DEADMAN_S = 3.0, 2.0
"""The most a holder may ask for."""
WAIT_S = 0.5
"""Ann's deadman."""
SEQ = 7
"""The number of Ann's last command."""
DRIVE = "fleet/r1/@cmd/drive"
QUESTION = "fleet/r1/@rpc/control/"
PAYLOAD = b"\x81\xa7forward\x01"
STOPS = ", and the robot is sent its stop"


class Given(NamedTuple):
    """What was given with a lease."""

    lease: bytes
    token: bytes


ANN, BOB = Given(b"\x01" * 8, b"\x01" * 32), Given(b"\x02" * 8, b"\x02" * 32)
"""The first and the second lease of an authority. Ann has, or had, the first; Bob asks for it."""
FORGED = Given(b"\xff" * 8, b"\xff" * 32)
GUESSED = Given(ANN.lease, FORGED.token)

Does = Callable[[Authority], object]
_numbers = itertools.count(1)


# What may be done with an authority; ``at`` is seconds after NOW


def ask(name: str, priority: int = 0, at: float = 0.0) -> Does:
    return lambda authority: getattr(authority, name)(Acquire(who="bob", priority=priority), NOW + at)


def asking(given: Given, name: str, seq: int) -> Authorization:
    return Authorization(lease=given.lease, seq=seq, proof=proof(given.token, QUESTION + name, seq))


def question(name: str, given: Given = ANN, at: float = 0.0) -> Does:
    """Renew or release, with a number that was never used."""
    return lambda authority: getattr(authority, name)(asking(given, name, next(_numbers)), QUESTION + name, NOW + at)


def attach(given: Given, seq: int, key: str = DRIVE, payload: bytes = PAYLOAD) -> bytes:
    return shown(given.lease, given.token, key, seq, payload)


def command(attachment: bytes | None, at: float = 0.0) -> Does:
    return lambda authority: authority.admit(attachment, DRIVE, PAYLOAD, NOW + at).who


def applied(*, moving: bool, at: float = 0.0, part: str = "drive") -> Does:
    return lambda authority: authority.applied(part, NOW + at, moving=moving)


def expire(at: float) -> Does:
    return lambda authority: authority.expire(NOW + at)


def stop(authority: Authority) -> None:
    authority.stop("stop")


def acquired(authority: Authority) -> None:
    authority.acquire(Acquire(who="ann", priority=5, deadman_s=WAIT_S, alive="ann.1"), NOW)
    authority.admit(attach(ANN, SEQ), DRIVE, PAYLOAD, NOW)


MOTION, NEUTRAL = applied(moving=True), applied(moving=False)
STATES: dict[str, tuple[str, list[Does]]] = {
    "new": ("free", []),
    "released": ("free", [acquired, question("release")]),
    "held": ("held", [acquired]),
    "moving": ("held", [acquired, MOTION]),
    "by itself": ("held", [acquired, lambda authority: authority.motion.mode_chosen(autonomous=True)]),
    "needs neutral": ("held", [acquired, MOTION, expire(WAIT_S)]),
    "stopped": ("stopped", [acquired, MOTION, stop]),
}
"""What ``control`` shows, and how it came to that."""
HELD = [name for name, (state, _) in STATES.items() if state == "held"]
NOT_HELD = [name for name in STATES if name not in HELD]
IN_MOTION = ("moving", "by itself")


def made(state: str) -> Authority:
    authority = Authority(LEASE_S, DEADMAN_S, numbered())
    for does in STATES[state][1]:
        does(authority)
    authority.events()
    assert authority.state == STATES[state][0]
    assert authority.motion.moving is (state in IN_MOTION)
    return authority


def seen(authority: Authority) -> tuple[object, ...]:
    """What must not change where something is refused."""
    lease = authority.verifier.lease if authority.verifier is not None else None
    return authority.state, authority.motion.moving, authority.motion.driven, authority.deadline(), lease


def told(authority: Authority) -> list[str]:
    """Take the events."""
    return [f"{event}{STOPS if event.stops else ''}" for event in authority.events()]


def refused(authority: Authority, attachment: bytes | None, at: float = 0.0) -> Refused:
    """Tell how a command is refused."""
    with pytest.raises(Refused) as raised:
        command(attachment, at)(authority)
    return raised.value


def must_be_neutral(authority: Authority, why: str) -> None:
    with pytest.raises(NeutralFirst, match=f"^{why}: send a neutral drive first$"):
        authority.motion.check_motion()


def test_the_table_of_the_documentation_is_the_one_that_is_executed() -> None:
    assert documented("reference/state-tables.md", "input") == executed(AuthorityMachine.TABLE)


# The lease

GRANTED = [
    *((state, name, priority) for state in HELD for name, priority in (("acquire", 6), ("takeover", -100))),
    *((state, name, -1) for state in NOT_HELD for name in ("acquire", "takeover")),
]


@pytest.mark.parametrize(("state", "name", "priority"), GRANTED)
def test_a_free_robot_a_higher_priority_and_a_takeover_are_granted_and_need_no_neutral(state, name, priority) -> None:
    authority = made(state)
    lease = ask(name, priority)(authority)
    given = ANN if state == "new" else BOB
    assert lease == Lease(ok=True, lease=given.lease, token=given.token, expires_in_s=LEASE_S, holder="bob")
    assert authority.report(NOW).priority == priority
    ended = [f"ended ann (taken over by bob){STOPS if state in IN_MOTION else ''}"] if state in HELD else []
    assert told(authority) == [*ended, "taken over bob" if name == "takeover" else "acquired bob"]
    assert seen(authority) == ("held", False, False, NOW + LEASE_S, given.lease)
    authority.motion.check_motion()
    assert command(attach(given, 0))(authority) == "bob", "numbers begin anew, from anywhere"


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize("priority", [-1, 5])
def test_a_robot_that_is_held_is_not_given_for_the_same_or_a_lower_priority(state: str, priority: int) -> None:
    authority = made(state)
    before, why = seen(authority), "held by ann (priority 5)"
    denied = Lease(ok=False, expires_in_s=LEASE_S, holder="ann", reason=why, code="held")
    assert ask("acquire", priority)(authority) == denied
    assert told(authority) == [f"refused bob acquire ({why})"]
    shows = Refusal(who="bob", command="acquire", code="held", reason=why, count=1)
    assert authority.report(NOW).refusals == (shows,)
    assert seen(authority) == before


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize(
    ("wish", "why"),
    [
        ({"who": ""}, "who = '': expected a name that others are shown"),
        ({"lease_s": 0.0}, "lease_s = 0: expected at least 0.01"),
        ({"deadman_s": math.nan}, "deadman_s = nan: expected at least 0.01"),
    ],
)
def test_a_wish_that_cannot_be_granted_is_refused_and_leaves_everything_as_it_was(state, wish, why) -> None:
    authority = made(state)
    before = seen(authority)
    request = msgspec.structs.replace(Acquire(who="bob", priority=9), **wish)
    for name in ("acquire", "takeover"):
        lease = getattr(authority, name)(request, NOW)
        assert (lease.ok, lease.token, lease.reason) == (False, None, why)
        assert [(each.who, each.command) for each in authority.report(NOW).refusals][-1] == (request.who, name)
    assert seen(authority) == before


@pytest.mark.parametrize("wish_s", [1.5, 9.0])
def test_wishes_are_granted_up_to_the_most(wish_s: float) -> None:
    authority = made("new")
    lease = authority.acquire(Acquire(who="ann", lease_s=wish_s, deadman_s=wish_s), NOW)
    assert lease.expires_in_s == question("renew")(authority).expires_in_s == min(wish_s, LEASE_S)  # type: ignore[attr-defined]
    assert authority.deadline() == NOW + min(wish_s, LEASE_S)
    MOTION(authority)
    assert authority.deadline() == NOW + min(wish_s, DEADMAN_S)


ASKED = Acquire(who="ann", priority=5, alive="ann.1", t=1000)


def test_a_program_whose_grant_was_lost_asks_again_and_gets_another_lease_in_place_of_the_first() -> None:
    authority = Authority(LEASE_S, DEADMAN_S, numbered())
    first = authority.acquire(ASKED, NOW, 500.0)
    authority.require_neutral("robot lost", StopCause.ROBOT_LOST, stops=False)
    authority.events()
    again = authority.acquire(msgspec.structs.replace(ASKED, t=2000), NOW + 1.0, 1500.0)
    assert (first.ok, again.ok, again.code) == (True, True, None)
    assert again.lease != first.lease
    assert authority.report(NOW + 1.0).lease == again.lease
    assert told(authority) == ["ended ann (taken over by ann)", "acquired ann"], "the robot was at rest"
    authority.motion.check_motion()
    with pytest.raises(LeaseLost):
        authority.admit(attach(ANN, SEQ), DRIVE, PAYLOAD, NOW + 1.0)


@pytest.mark.parametrize(
    "change",
    [{"t": 1000}, {"t": 999}, {"t": msgspec.UNSET}, {"alive": "ann.2"}, {"alive": None}, {"who": "ann.x"}],
    ids=[
        "the same question, delivered twice",
        "an earlier one, held up",
        "undated",
        "another",
        "no token",
        "a namesake",
    ],
)
def test_any_other_question_in_the_holders_name_is_denied(change: dict[str, object]) -> None:
    authority = Authority(LEASE_S, DEADMAN_S, numbered())
    authority.acquire(ASKED, NOW, 500.0)
    before = seen(authority)
    denied = authority.acquire(msgspec.structs.replace(ASKED, **{"t": 2000, **change}), NOW + 1.0, 1500.0)
    assert (denied.ok, denied.code) == (False, Code.HELD)
    assert seen(authority) == before


@pytest.mark.parametrize("used", ["a command", "a question"])
def test_who_has_used_a_lease_has_got_it_and_is_denied_another(used: str) -> None:
    authority = Authority(LEASE_S, DEADMAN_S, numbered())
    authority.acquire(ASKED, NOW, 500.0)
    with contextlib.suppress(Refused):
        if used == "a command":
            authority.admit(attach(ANN, SEQ), DRIVE, PAYLOAD, NOW)
        else:
            question("renew")(authority)
    assert not authority.acquire(msgspec.structs.replace(ASKED, t=2000), NOW + 1.0, 1500.0).ok


def test_a_lease_that_was_granted_to_an_undated_question_is_not_granted_again() -> None:
    authority = Authority(LEASE_S, DEADMAN_S, numbered())
    authority.acquire(msgspec.structs.replace(ASKED, t=msgspec.UNSET), NOW)
    assert not authority.acquire(ASKED, NOW + 1.0).ok


ENDS: dict[str, tuple[Does, str]] = {
    "released": (question("release"), "free"),
    "holder lost": (lambda authority: authority.vanished("ann.1"), "stopped"),
    "bus lost": (Authority.bus_lost, "stopped"),
    "lease expired": (expire(LEASE_S), "stopped"),
    "stop": (stop, "stopped"),
}


@pytest.mark.parametrize("state", HELD)
@pytest.mark.parametrize("why", ENDS)
def test_whenever_a_lease_ends_what_moves_is_stopped_and_its_holder_drives_no_more(state: str, why: str) -> None:
    authority, (happens, after) = made(state), ENDS[why]
    happens(authority)
    what = {"released": "released", "stop": "stopped"}.get(why, "ended")
    assert told(authority) == [f"{what} ann ({why}){STOPS if state in IN_MOTION or why == 'stop' else ''}"]
    assert seen(authority) == (after, False, False, None, None)
    assert str(refused(authority, attach(ANN, SEQ + 1))) == f"the lease has ended ({why})"
    for name in ("renew", "release"):
        assert question(name)(authority).code == Code.LEASE_ENDED  # type: ignore[attr-defined]
    ask("acquire")(authority)
    assert str(refused(authority, attach(ANN, SEQ + 2))) == f"the lease has ended ({why})"
    assert command(attach(BOB, 0))(authority) == "bob"
    authority.motion.check_motion()


@pytest.mark.parametrize("state", NOT_HELD)
def test_where_nobody_holds_the_robot_nothing_is_lost_and_a_stop_stops_all_the_same(state: str) -> None:
    authority = made(state)
    authority.vanished("ann.1")
    authority.bus_lost()
    authority.expire(1e12)
    assert told(authority) == []
    assert seen(authority) == (STATES[state][0], False, False, None, None)
    stop(authority)
    assert told(authority) == [f"stopped (stop){STOPS}"]
    assert authority.state == "stopped"


@pytest.mark.parametrize("alive", ["ann.1", None])
def test_a_peer_whose_last_neighbour_leaves_keeps_the_lease_of_a_holder_with_a_token(alive: str | None) -> None:
    authority = Authority(LEASE_S, DEADMAN_S, numbered(), alone_is_normal=True)
    authority.acquire(Acquire(who="ann", alive=alive), NOW)
    authority.bus_lost()
    assert authority.state == ("held" if alive else "stopped")
    authority.vanished("ann.1")
    assert authority.state == "stopped"


def test_only_the_liveliness_token_that_the_holder_named_ends_its_lease() -> None:
    authority = made("moving")
    before = seen(authority)
    for alive in ("", "ann", "ann.10", "bob.1"):
        authority.vanished(alive)
    assert seen(authority) == before
    authority.takeover(Acquire(who="bob"), NOW)
    for alive in ("ann.1", "", "bob"):
        authority.vanished(alive)
    assert authority.report(NOW).holder == "bob", "that of the holder before is nothing, and bob named none"


# Who asks, and who commands

WHY_NOT = [
    ("new", ANN, "no lease: acquire first", "no_lease"),
    ("released", ANN, "the lease has ended (released)", "lease_ended"),
    ("stopped", ANN, "the lease has ended (stop)", "lease_ended"),
    *((state, FORGED, "no lease: acquire first", "no_lease") for state in NOT_HELD),
    *((state, FORGED, "held by ann (priority 5)", "held") for state in HELD),
    *((state, GUESSED, "wrong proof", "malformed") for state in STATES if state != "new"),
]


@pytest.mark.parametrize(("state", "given", "why", "code"), WHY_NOT)
def test_nobody_but_the_holder_renews_releases_commands_or_feeds_the_deadman(state, given, why, code) -> None:
    authority = made(state)
    before = seen(authority)
    holder, left_s = ("ann", LEASE_S - 0.25) if state in HELD else (None, None)
    who = "ann" if code == "lease_ended" else None
    for name in ("renew", "release"):
        denied = Lease(ok=False, expires_in_s=left_s, holder=holder, reason=why, code=code)
        assert question(name, given, 0.25)(authority) == denied
        assert [(event.who, event.command, event.code) for event in authority.events()] == [(who, name, code)]
    how = refused(authority, attach(given, SEQ + 1), 0.25)
    assert (str(how), how.code, how.who) == (why, code, who)
    assert how.holder == ("ann" if code == "held" else None)
    assert str(refused(authority, None, 0.25)) == "no lease: acquire first"
    assert refused(authority, b"rubbish", 0.25).code == "malformed"
    assert seen(authority) == before


@pytest.mark.parametrize("state", HELD)
def test_the_holder_commands_with_rising_numbers_and_each_is_taken_once(state: str) -> None:
    authority = made(state)
    for seq in (SEQ + 1, SEQ + 1000, 2**64 - 1):
        assert command(attach(ANN, seq))(authority) == "ann"
        for late in (0, SEQ, seq):
            assert refused(authority, attach(ANN, late), 0.25).code == "out_of_order"
    assert seen(authority) == seen(made(state)), "neither the lease nor the deadman was fed by what was late"
    assert told(authority) == []


def test_a_question_is_taken_once_and_only_for_the_key_it_was_asked_at() -> None:
    authority = made("held")
    for name, key in (("renew", QUESTION + "renew"), ("release", QUESTION + "release")):
        for wrong in ("fleet/r2/@rpc/control/" + name, DRIVE, key + "/"):
            said = Authorization(lease=ANN.lease, seq=900, proof=proof(ANN.token, wrong, 900))
            assert getattr(authority, name)(said, key, NOW).code == "malformed", "and uses no number up"
    again = asking(ANN, "renew", 800)
    assert authority.renew(again, QUESTION + "renew", NOW).ok
    repeated = authority.renew(again, QUESTION + "renew", NOW)
    assert (repeated.ok, repeated.code, repeated.reason) == (False, "out_of_order", "repeated or out of order")
    assert authority.report(NOW).refusals[-1].who is None, "anybody may have sent it"
    assert not authority.release(asking(ANN, "release", 799), QUESTION + "release", NOW).ok, "they share their numbers"
    assert refused(authority, attach(ANN, 900, QUESTION + "renew", b"")).code == "malformed", "it is no command"
    assert command(attach(ANN, SEQ + 1))(authority) == "ann", "commands are numbered apart"
    assert authority.release(asking(ANN, "release", 801), QUESTION + "release", NOW).ok


OVERHEARD = attach(ANN, SEQ + 1)
"""Ann's next command, as whoever listens sees it."""
HIGHER = attach(ANN, SEQ + 1).replace(b"\xa3seq" + bytes([SEQ + 1]), b"\xa3seq\x7f")
ALTERED = {
    "another payload": (OVERHEARD, DRIVE, PAYLOAD[:-1] + b"\x00"),
    "a longer payload": (OVERHEARD, DRIVE, PAYLOAD + b"\x00"),
    "no payload": (OVERHEARD, DRIVE, b""),
    "another command": (OVERHEARD, "fleet/r1/@cmd/mode", PAYLOAD),
    "another robot": (OVERHEARD, "fleet/r2/@cmd/drive", PAYLOAD),
    "a higher number": (HIGHER, DRIVE, PAYLOAD),
    "a byte moved from key to payload": (OVERHEARD, DRIVE[:-1], DRIVE[-1:].encode() + PAYLOAD),
    "a guess at the token": (attach(GUESSED, 2**64 - 1), DRIVE, PAYLOAD),
}


@pytest.mark.parametrize(("attachment", "key", "payload"), ALTERED.values(), ids=ALTERED)
def test_what_was_overheard_and_altered_is_refused_and_uses_no_number_up(attachment, key, payload) -> None:
    authority = made("held")
    with pytest.raises(Refused, match=r"^wrong proof$") as how:
        authority.admit(attachment, key, payload, NOW)
    assert (how.value.code, how.value.who) == (Code.MALFORMED, None)
    assert command(OVERHEARD)(authority) == "ann"


def test_what_was_overheard_and_repeated_is_nobodys_during_the_lease_and_after_it() -> None:
    authority = made("held")
    command(OVERHEARD)(authority)
    assert refused(authority, OVERHEARD).who is None, "or a stranger would make a client think it was its own"
    ask("takeover")(authority)
    for attachment, who in ((OVERHEARD, None), (attach(ANN, SEQ + 2), "ann"), (attach(ANN, SEQ + 2), None)):
        how = refused(authority, attachment)
        assert isinstance(how, LeaseLost)
        assert how.who == who, "a new number is Ann's own; the others anybody's"


def test_every_lease_has_an_id_and_a_secret_of_its_own_which_only_the_grant_shows() -> None:
    asked: list[int] = []

    def random(size: int) -> bytes:
        asked.append(size)
        return b"\xff" * size

    authority = Authority(LEASE_S, DEADMAN_S, random)
    ids = [authority.takeover(Acquire(who="ann"), NOW).lease for _ in range(ENDED + 1)]
    assert sorted(asked[:2]) == [8, 32]
    assert ids[:3] == [b"\xff" * 8, b"\x00" * 8, b"\x00" * 7 + b"\x01"]
    assert len(set(ids)) == ENDED + 1, "whatever chance says"
    authority = made("held")
    for does in (ask("acquire"), question("renew"), question("renew", FORGED), question("release")):
        assert does(authority).token is None  # type: ignore[attr-defined]


def test_a_bounded_number_of_ended_leases_is_remembered() -> None:
    authority = made("new")
    for number in range(1, ENDED + 3):
        authority.takeover(Acquire(who=f"client {number}"), NOW)
    forgotten, *remembered, current = (Given(bytes([n]) * 8, bytes([n]) * 32) for n in range(1, ENDED + 3))
    assert isinstance(refused(authority, attach(forgotten, 9)), Held)
    for number, given in enumerate(remembered, 2):
        how = refused(authority, attach(given, 9))
        assert (how.who, str(how)) == (f"client {number}", f"the lease has ended (taken over by client {number + 1})")
    assert command(attach(current, 0))(authority) == f"client {ENDED + 2}"


# Neutral first


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize(("why", "stops"), [("busy", True), ("robot lost", False)])
def test_holding_back_keeps_the_lease_and_demands_neutral(state: str, why: str, stops: bool) -> None:
    authority = made(state)
    for _ in range(3):
        authority.require_neutral(why, StopCause.ROBOT_BUSY, stops=stops)
    who = " ann" if state in HELD else ""
    assert told(authority) == (3 if stops else 1) * [f"stopped{who} ({why}){STOPS if stops else ''}"], "always stops"
    assert authority.state == STATES[state][0]
    assert not authority.motion.moving
    must_be_neutral(authority, why)
    ask("takeover")(authority)
    authority.motion.check_motion()


def test_only_a_neutral_that_was_carried_out_allows_motion_again() -> None:
    authority = made("needs neutral")
    for does in (command(attach(ANN, SEQ + 1)), question("renew"), MOTION):
        does(authority)
        must_be_neutral(authority, "deadman")
    NEUTRAL(authority)
    authority.motion.check_motion()
    assert authority.state == "held"
    for state in ("held", "moving", "by itself"):
        made(state).motion.check_motion()


def test_a_robot_that_moves_for_nobody_is_stopped_before_somebody_gets_it() -> None:
    authority = made("stopped")
    MOTION(authority)
    assert authority.acquire(Acquire(who="bob"), NOW).ok
    assert told(authority) == [f"stopped (moving without a driver when bob acquired){STOPS}", "acquired bob"]
    assert not authority.motion.moving
    assert authority.deadline() == NOW + LEASE_S


@pytest.mark.parametrize("stops", [True, False])
def test_the_neutral_of_a_part_that_did_not_move_allows_no_motion(stops: bool) -> None:
    authority = made("moving")
    authority.require_neutral("busy", StopCause.ROBOT_BUSY, stops=stops)
    applied(moving=False, part="left motor")(authority)  # a program that drives may say this all the time
    must_be_neutral(authority, "busy")
    NEUTRAL(authority)
    authority.motion.check_motion()


def test_each_part_that_moved_is_neutral_before_motion_or_all_at_once() -> None:
    for whole in (False, True):
        authority = made("moving")
        applied(moving=True, part="left motor")(authority)
        authority.require_neutral("busy", StopCause.ROBOT_BUSY)
        authority.applied("drive", NOW, moving=False, whole=whole)
        if not whole:
            must_be_neutral(authority, "busy")
            applied(moving=False, part="left motor")(authority)
        authority.motion.check_motion()


# Time

DEADMAN = f"stopped ann (deadman){STOPS}"
EXPIRED = f"ended ann (lease expired){STOPS}"
LEFT = applied(moving=True, part="left motor")
LEFT_NEUTRAL = applied(moving=False, part="left motor")
NEXT = attach(ANN, SEQ + 1)

COURSES: dict[str, tuple[str, list[Does], list[str], bool, float | None]] = {
    "the deadman is not hasty": ("moving", [expire(WAIT_S - 1e-9)], [], True, WAIT_S),
    "the deadman stops, once, and keeps the lease": ("moving", 3 * [expire(WAIT_S)], [DEADMAN], False, LEASE_S),
    "the lease expires, once": ("moving", 3 * [expire(LEASE_S)], [EXPIRED], False, None),
    "a late call finds it expired": ("moving", [expire(1000.0)], [EXPIRED], False, None),
    "motion puts the deadman off": ("moving", [applied(moving=True, at=0.4), expire(0.8)], [], True, 0.4 + WAIT_S),
    "neutral of another part does not": (
        *("moving", [LEFT, applied(moving=False, at=0.4, part="left motor"), expire(0.45)], [], True, WAIT_S),
    ),
    "a command alone feeds no deadman": ("moving", [command(NEXT, 0.1)], [], True, WAIT_S),
    "nor does renewing": ("moving", [question("renew", at=0.25)], [], True, WAIT_S),
    "a command renews the lease": ("held", [command(NEXT, 1.0)], [], False, 1.0 + LEASE_S),
    "renewing renews the lease": ("held", [question("renew", at=0.25)], [], False, 0.25 + LEASE_S),
    "neutral ends the watch": ("moving", [NEUTRAL, expire(WAIT_S)], [], False, LEASE_S),
    "one part's neutral does not": ("moving", [LEFT, NEUTRAL], [], True, WAIT_S),
    "that of both parts does": ("moving", [LEFT, NEUTRAL, LEFT_NEUTRAL], [], False, LEASE_S),
    "by itself there is no deadman": ("by itself", [expire(DEADMAN_S)], [], True, LEASE_S),
    "but the lease expires": ("by itself", [expire(LEASE_S)], [EXPIRED], False, None),
    "by itself only a stop makes sure": ("by itself", [NEUTRAL], [], True, LEASE_S),
    "a raw message may move it": (
        "held",
        [lambda authority: authority.motion.sent_opaque(), expire(LEASE_S)],
        [EXPIRED],
        False,
        None,
    ),
    "motion for nobody is watched": ("stopped", [MOTION, expire(WAIT_S)], [], True, DEADMAN_S),
    "and stopped": ("stopped", [MOTION, expire(DEADMAN_S)], [f"stopped (deadman){STOPS}"], False, None),
}
"""State, what is done, what is told of it, whether the robot moves then, and the next deadline after NOW."""


@pytest.mark.parametrize(("state", "course", "events", "moves", "due"), COURSES.values(), ids=COURSES)
def test_what_is_due_is_done_in_time_and_before_anything_else(state, course, events, moves, due) -> None:
    authority = made(state)
    for does in course:
        with contextlib.suppress(Refused):
            does(authority)
    assert told(authority) == events
    assert authority.motion.moving is moves
    assert authority.deadline() == (None if due is None else NOW + due)
    if events == [DEADMAN]:
        must_be_neutral(authority, "deadman")


LATE: dict[str, Callable[[float], Does]] = {
    "renew": lambda at: question("renew", at=at),
    "release": lambda at: question("release", at=at),
    "command": lambda at: command(NEXT, at),
    "acquire": lambda at: ask("acquire", -9, at),
    "takeover": lambda at: ask("takeover", -9, at),
}


@pytest.mark.parametrize("what", LATE)
def test_whatever_comes_late_finds_what_was_due_done_first(what: str) -> None:
    for at, due in ((WAIT_S, DEADMAN), (LEASE_S, EXPIRED)):
        authority = made("moving")
        with contextlib.suppress(Refused):
            LATE[what](at)(authority)
        assert told(authority)[0] == due
        assert not authority.motion.moving
    lease = authority.verifier.lease if authority.verifier is not None else None
    assert lease == (BOB.lease if what in ("acquire", "takeover") else None), "free for the lowest priority"


# What is shown


def test_control_says_who_drives_and_for_how_long() -> None:
    shows = Control(state="held", holder="ann", lease=ANN.lease, priority=5, expires_in_s=LEASE_S - 1.0)
    assert made("moving").report(NOW + 1.0) == shows
    assert made("moving").report(NOW + 9.0).expires_in_s == 0.0
    assert made("new").report(NOW) == Control(state="free")
    assert made("stopped").report(NOW) == Control(state="stopped")
