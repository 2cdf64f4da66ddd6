"""What of the bus reaches the event loop, decided on the bus's threads: proofs, floods, stops, names."""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Iterable

import pytest

from tests.bounds import most_kept
from tests.proofs import Holder, lease, numbered, packed, shown
from zbridge.bus import PriorityClass
from zbridge.control import admission
from zbridge.control.admission import OPEN_HZ, SHOWN_HZ, CommandFilter, NameFilter, QueryFilter, RefusalLimit
from zbridge.control.authority import Authority
from zbridge.errors import Code, Refused
from zbridge.fleet.lease_messages import Acquire
from zbridge.fleet.topics import KeySpace

DRIVE, MODE, STOP = (f"fleet/r1/@cmd/{name}" for name in ("drive", "mode", "stop"))
RENEW, ACQUIRE = "fleet/r1/@rpc/control/renew", "fleet/r1/@rpc/control/acquire/"
FORWARD = packed({"forward": 0.5})
FLOOD = 1000


def dropped(limit: RefusalLimit) -> dict[Code, int]:
    return {refusal.code: count for refusal, count in limit.dropped()}


class Rig:
    """A robot's authority, which gave its lease, and its filters, at a time that stands still."""

    def __init__(self, *, held: bool = True) -> None:
        self.now = 100.0
        self.authority = Authority(3.0, 2.0, numbered())
        self.filter = CommandFilter(self.authority, KeySpace("fleet", "r1"), lambda: self.now)
        self._leases = itertools.count(1)
        self.held = self.grant() if held else lease(1)

    def grant(self) -> Holder:
        assert self.authority.takeover(Acquire(who="me"), self.now).ok
        return lease(next(self._leases))

    def command(self, attachment: bytes | None, payload: bytes = FORWARD, key: str = DRIVE) -> PriorityClass | None:
        return self.filter(key, attachment, len(payload) + len(attachment or b""), lambda: payload)

    def drive(self) -> PriorityClass | None:
        return self.command(self.held.attachment("drive", FORWARD))

    def flood(self, attachments: Iterable[bytes | None], key: str = DRIVE) -> Counter[PriorityClass | None]:
        return Counter(self.command(attachment, key=key) for attachment in attachments)

    def forged(self, seq: int) -> bytes:
        return packed({"lease": self.held.lease, "seq": seq, "proof": os.urandom(16)})


FEW = {PriorityClass.OTHER: int(SHOWN_HZ), None: FLOOD - int(SHOWN_HZ)}
"""A few a second are shown, with their senders; the others are counted."""


@pytest.mark.parametrize("key", [DRIVE, MODE, "fleet/r1/@cmd/motor/left", "fleet/r1/@cmd/raw/tcpudp"])
@pytest.mark.parametrize("attachment", [None, b"no proof", bytes(100), shown(b"12345678", bytes(32), DRIVE, 1)])
def test_of_what_cannot_be_a_proof_a_few_a_second_are_shown_and_the_others_counted(attachment, key) -> None:
    rig = Rig()
    assert rig.flood([attachment] * FLOOD, key) == FEW
    assert dropped(rig.filter.refusals) == {Code.NO_LEASE: FEW[None]}
    assert dropped(rig.filter.refusals) == {}
    rig.now += 1.0
    assert rig.flood([attachment] * FLOOD, key) == FEW
    assert rig.drive() is PriorityClass.COMMAND, "the holder's commands keep their own priority"


def test_neither_a_lease_that_was_not_granted_nor_the_lease_before_gets_the_holders_priority() -> None:
    rig = Rig(held=False)
    assert rig.flood(rig.held.attachment("drive", FORWARD) for _ in range(FLOOD)) == FEW
    assert dropped(rig.filter.refusals) == {Code.NO_LEASE: FEW[None]}
    rig = Rig()
    former, rig.held.seq = rig.held, 10**6
    assert rig.drive() is PriorityClass.COMMAND
    rig.held = rig.grant()
    assert rig.drive() is PriorityClass.COMMAND, "a new lease counts from anywhere"
    assert rig.command(former.attachment("drive", FORWARD)) is PriorityClass.OTHER


def test_who_knows_the_leases_id_or_overheard_a_command_neither_fills_the_holders_queue_nor_locks_it_out() -> None:
    rig = Rig()
    overheard = rig.held.attachment("drive", FORWARD)
    assert rig.command(overheard) is PriorityClass.COMMAND
    assert rig.flood(rig.forged(2**63 + number) for number in range(FLOOD)) == FEW
    assert rig.flood([overheard] * FLOOD) == {None: FLOOD}
    assert dropped(rig.filter.refusals) == {Code.MALFORMED: FEW[None], Code.OUT_OF_ORDER: FLOOD}
    assert rig.drive() is PriorityClass.COMMAND


def test_what_the_gate_proved_is_admitted_once_and_only_as_it_was() -> None:
    rig = Rig()
    attachment = rig.held.attachment("drive", FORWARD)
    assert rig.command(attachment) is PriorityClass.COMMAND
    for key, payload in ((DRIVE, packed({"forward": 1.0})), (MODE, FORWARD)):
        with pytest.raises(Refused, match="wrong proof"):
            rig.authority.admit(attachment, key, payload, rig.now)
    assert rig.authority.admit(attachment, DRIVE, FORWARD, rig.now).who == "me"
    with pytest.raises(Refused, match="repeated"):
        rig.authority.admit(attachment, DRIVE, FORWARD, rig.now)


def test_a_command_that_is_larger_than_its_key_allows_is_refused_whoever_proves_it() -> None:
    rig = Rig()
    large = bytes(300)
    assert rig.command(rig.held.attachment("drive", large), large) is PriorityClass.OTHER
    assert rig.drive() is PriorityClass.COMMAND
    assert rig.command(None, bytes(70_000), "fleet/r1/@cmd/scan") is PriorityClass.OTHER
    assert {rig.command(None, large) for _ in range(FLOOD)} == {PriorityClass.OTHER, None}
    assert set(dropped(rig.filter.refusals)) == {Code.MALFORMED}


@pytest.mark.parametrize("name", ["light", "fly", "*", "sensor/front"])
def test_commands_that_need_no_lease_have_a_rate_and_cost_the_holder_none_of_its(name: str) -> None:
    rig = Rig()
    priorities = rig.flood([None] * FLOOD, f"fleet/r1/@cmd/{name}")
    assert priorities == {PriorityClass.OTHER: OPEN_HZ, None: FLOOD - OPEN_HZ}
    assert dropped(rig.filter.refusals) == {Code.RATE: FLOOD - OPEN_HZ}
    assert rig.drive() is PriorityClass.COMMAND


# Stops


@pytest.mark.parametrize("key", [STOP, "fleet/*/@cmd/stop", "fleet/**/@cmd/stop", "*/*/@cmd/stop"])
def test_every_stop_is_let_through_until_one_was_carried_out_just_now(key: str) -> None:
    rig = Rig()
    assert {rig.command(None, bytes(10_000), key) for _ in range(FLOOD)} == {PriorityClass.STOP}
    rig.authority.stop("stop")
    rig.filter.stopped()
    assert rig.flood([None] * FLOOD, key) == {None: FLOOD}
    assert rig.filter.same_stops == FLOOD
    assert dropped(rig.filter.refusals) == {}, "nobody was refused anything"
    rig.now += 2 * admission.SAME_STOP_S
    assert rig.command(None, key=key) is PriorityClass.STOP


@pytest.mark.parametrize(
    "happens", [Rig.grant, lambda rig: rig.authority.motion.sent_opaque()], ids=["acquired", "moves"]
)
def test_a_stop_right_after_a_stop_is_let_through_where_the_robot_is_held_or_may_move_again(happens) -> None:
    rig = Rig()
    rig.authority.stop("stop")
    rig.filter.stopped()
    assert rig.command(None, key=STOP) is None
    happens(rig)
    assert rig.command(None, key=STOP) is PriorityClass.STOP


# Queries


def test_the_holders_questions_are_told_from_everybody_elses() -> None:
    rig = Rig()
    filter_ = QueryFilter(rig.authority, lambda: rig.now)
    priorities = Counter(filter_(RENEW, question, 0, bytes) for question in [None, b"", rig.forged(2**60)] * FLOOD)
    assert priorities == {PriorityClass.OTHER: SHOWN_HZ, None: 3 * FLOOD - SHOWN_HZ}
    question = rig.held.question("renew")
    assert filter_(RENEW, question, 0, bytes) is PriorityClass.COMMAND
    assert filter_(RENEW, question, 0, bytes) is None
    assert sum(dropped(filter_.refusals).values()) == 3 * FLOOD - SHOWN_HZ + 1


def test_who_asks_too_often_for_a_lease_costs_only_its_own_name_and_many_names_have_a_rate_together() -> None:
    now = 100.0
    filter_ = NameFilter(lambda: now)
    priorities = Counter(filter_(ACQUIRE + "noise", None, 0, bytes) for _ in range(FLOOD))
    assert priorities == {PriorityClass.OTHER: admission.NAME_HZ, None: FLOOD - admission.NAME_HZ}
    assert filter_(ACQUIRE + "ann", None, 0, bytes) is PriorityClass.OTHER
    assert dropped(filter_.refusals) == {Code.RATE: FLOOD - admission.NAME_HZ}
    now += 2.0
    assert filter_(ACQUIRE + "noise", None, 0, bytes) is PriorityClass.OTHER
    priorities = Counter(filter_(f"{ACQUIRE}n{number}", None, 0, bytes) for number in range(FLOOD))
    assert priorities[PriorityClass.OTHER] == admission.ALL_NAMES_HZ - 1
    assert most_kept(filter_) == admission.NAMES, "the others are forgotten"
