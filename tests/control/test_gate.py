"""What of the bus reaches the event loop, decided on the bus's threads: proofs, floods, stops, names."""

from __future__ import annotations

import itertools
import os

import pytest

from tests.proofs import Holder, lease, numbered, packed, shown
from zbridge.bus import Lane
from zbridge.control.authority import Authority
from zbridge.control.gate import (
    ALL_NAMES_HZ,
    NAME_HZ,
    NAMES,
    OPEN_HZ,
    SAME_STOP_S,
    SHOWN_HZ,
    CommandGate,
    NameGate,
    QueryGate,
    Sieve,
)
from zbridge.errors import Code, Refused
from zbridge.fleet.messages import Acquire
from zbridge.fleet.topics import KeySpace

DRIVE, MODE, STOP = (f"fleet/r1/@cmd/{name}" for name in ("drive", "mode", "stop"))
FORWARD = packed({"forward": 0.5})
FLOOD = 1000


class Rig:
    """A robot's authority and its gates, at a time that stands still until it is told to go on."""

    def __init__(self, *, held: bool = True) -> None:
        self.now = 100.0
        self.authority = Authority(3.0, 2.0, numbered())
        self.gate = CommandGate(self.authority, KeySpace("fleet", "r1"), lambda: self.now)
        self._leases = itertools.count(1)
        self.held = self.grant() if held else lease(1)

    def grant(self) -> Holder:
        assert self.authority.takeover(Acquire(who="me"), self.now).ok
        return lease(next(self._leases))

    def command(self, attachment: bytes | None, payload: bytes = FORWARD, key: str = DRIVE) -> Lane | None:
        return self.gate(key, attachment, len(payload) + len(attachment or b""), lambda: payload)

    def drive(self) -> Lane | None:
        return self.command(self.held.attachment("drive", FORWARD))

    def flood(self, attachment: bytes | None, key: str = DRIVE) -> list[Lane | None]:
        return [self.command(attachment, key=key) for _ in range(FLOOD)]

    def forged(self, seq: int) -> bytes:
        return packed({"lease": self.held.lease, "seq": seq, "proof": os.urandom(16)})

    def kept_back(self) -> dict[Code, int]:
        return {refusal.code: count for refusal, count in self.gate.sieve.kept_back()}


def strange() -> bytes:
    return shown(b"12345678", bytes(32), DRIVE, 1, FORWARD)


@pytest.mark.parametrize("key", [DRIVE, MODE, "fleet/r1/@cmd/motor/left", "fleet/r1/@cmd/raw/tcpudp"])
@pytest.mark.parametrize("attachment", [None, b"", b"no proof", bytes(100), bytes(200), strange()])
def test_of_what_cannot_be_a_proof_a_few_a_second_are_shown_and_the_others_counted(attachment, key) -> None:
    rig = Rig()
    lanes = rig.flood(attachment, key)
    assert lanes.count(Lane.OTHER) == SHOWN_HZ
    assert lanes.count(None) == FLOOD - SHOWN_HZ
    assert rig.kept_back() == {Code.NO_LEASE: FLOOD - SHOWN_HZ}
    assert rig.kept_back() == {}
    rig.now += 1.0
    assert rig.flood(attachment, key).count(Lane.OTHER) == SHOWN_HZ
    assert rig.drive() is Lane.COMMAND, "the holder's goes by its own lane all the same"


def test_without_a_lease_nothing_that_needs_one_goes_by_the_holders_lane() -> None:
    rig = Rig(held=False)
    lanes = [rig.drive() for _ in range(FLOOD)]
    assert set(lanes) == {Lane.OTHER, None}
    assert rig.kept_back() == {Code.NO_LEASE: FLOOD - SHOWN_HZ}


def test_who_knows_the_leases_id_neither_fills_the_holders_lane_nor_locks_it_out() -> None:
    rig = Rig()
    assert rig.drive() is Lane.COMMAND
    lanes = [rig.command(rig.forged(2**63 + number)) for number in range(FLOOD)]
    assert Lane.COMMAND not in lanes
    assert rig.kept_back() == {Code.MALFORMED: FLOOD - SHOWN_HZ}
    assert rig.drive() is Lane.COMMAND


def test_what_the_gate_proved_is_admitted_once_and_only_as_it_was() -> None:
    rig = Rig()
    attachment = rig.held.attachment("drive", FORWARD)
    assert rig.command(attachment) is Lane.COMMAND
    for key, payload in ((DRIVE, packed({"forward": 1.0})), (MODE, FORWARD)):
        with pytest.raises(Refused, match="wrong proof"):
            rig.authority.admit(attachment, key, payload, rig.now)
    assert rig.authority.admit(attachment, DRIVE, FORWARD, rig.now) == "me"
    with pytest.raises(Refused, match="repeated"):
        rig.authority.admit(attachment, DRIVE, FORWARD, rig.now)


def test_what_was_overheard_goes_by_the_holders_lane_once() -> None:
    rig = Rig()
    attachment = rig.held.attachment("drive", FORWARD)
    assert rig.command(attachment) is Lane.COMMAND
    assert Lane.COMMAND not in rig.flood(attachment)
    assert rig.kept_back() == {Code.OUT_OF_ORDER: FLOOD - SHOWN_HZ}


def test_a_new_lease_counts_from_anywhere_and_the_former_goes_by_the_holders_lane_no_more() -> None:
    rig = Rig()
    former, rig.held.seq = rig.held, 10**6
    assert rig.drive() is Lane.COMMAND
    rig.held = rig.grant()
    assert rig.drive() is Lane.COMMAND
    assert rig.command(former.attachment("drive", FORWARD)) is Lane.OTHER


def test_a_command_that_is_larger_than_its_key_allows_is_refused_whoever_proves_it() -> None:
    rig = Rig()
    large = bytes(300)
    assert rig.command(rig.held.attachment("drive", large), large) is Lane.OTHER
    assert rig.drive() is Lane.COMMAND
    assert rig.command(None, bytes(70_000), "fleet/r1/@cmd/scan") is Lane.OTHER
    assert {rig.command(None, large) for _ in range(FLOOD)} == {Lane.OTHER, None}
    assert set(rig.kept_back()) == {Code.MALFORMED}


@pytest.mark.parametrize("name", ["light", "text", "scan", "fly", "*", "sensor/front"])
def test_commands_that_need_no_lease_have_a_rate_and_cost_the_holder_none_of_its(name: str) -> None:
    rig = Rig()
    lanes = [rig.command(None, key=f"fleet/r1/@cmd/{name}") for _ in range(FLOOD)]
    assert lanes.count(Lane.OTHER) == OPEN_HZ
    assert rig.kept_back() == {Code.RATE: FLOOD - OPEN_HZ}
    assert rig.drive() is Lane.COMMAND


@pytest.mark.parametrize("key", [STOP, "fleet/*/@cmd/stop", "fleet/**/@cmd/stop", "*/*/@cmd/stop"])
def test_every_stop_is_let_through_until_one_was_carried_out(key: str) -> None:
    rig = Rig()
    assert {rig.command(None, bytes(10_000), key) for _ in range(FLOOD)} == {Lane.STOP}
    rig.authority.stop("stop")
    rig.gate.stopped()
    assert {rig.command(None, b"", key) for _ in range(FLOOD)} == {None}
    assert rig.gate.same_stops == FLOOD
    assert rig.kept_back() == {}, "nobody was refused anything"
    rig.now += 2 * SAME_STOP_S
    assert rig.command(None, b"", key) is Lane.STOP


def test_a_stop_right_after_a_stop_is_let_through_where_somebody_acquired_between_them() -> None:
    rig = Rig()
    rig.authority.stop("stop")
    rig.gate.stopped()
    assert rig.command(None, b"", STOP) is None
    rig.grant()
    assert rig.command(None, b"", STOP) is Lane.STOP


def test_a_robot_that_may_move_is_stopped_by_every_stop() -> None:
    rig = Rig()
    rig.authority.stop("stop")
    rig.gate.stopped()
    rig.authority.sent_opaque()
    assert rig.command(None, b"", STOP) is Lane.STOP


def test_the_holders_questions_are_told_from_everybody_elses() -> None:
    rig = Rig()
    key = "fleet/r1/@rpc/control/renew"
    gate = QueryGate(rig.authority, lambda: rig.now)
    lanes = [gate(key, question, 0, bytes) for question in [None, b"", rig.forged(2**60)] * FLOOD]
    assert lanes.count(Lane.OTHER) == SHOWN_HZ
    assert Lane.COMMAND not in lanes
    question = rig.held.question("renew")
    assert gate(key, question, 0, bytes) is Lane.COMMAND
    assert gate(key, question, 0, bytes) is None
    assert sum(count for _, count in gate.sieve.kept_back()) == 3 * FLOOD - SHOWN_HZ + 1


def test_who_asks_too_often_for_a_lease_costs_only_its_own_name() -> None:
    now = 100.0
    gate = NameGate(lambda: now)
    lanes = [gate("fleet/r1/@rpc/control/acquire/noise", None, 0, bytes) for _ in range(FLOOD)]
    assert lanes.count(Lane.OTHER) == NAME_HZ
    assert gate("fleet/r1/@rpc/control/acquire/ann", None, 0, bytes) is Lane.OTHER
    assert [(refusal.code, count) for refusal, count in gate.sieve.kept_back()] == [(Code.RATE, FLOOD - NAME_HZ)]
    now += 0.5
    assert gate("fleet/r1/@rpc/control/acquire/noise", None, 0, bytes) is Lane.OTHER


def test_many_names_have_a_rate_together_and_are_forgotten() -> None:
    now = 100.0
    gate = NameGate(lambda: now)
    lanes = [gate(f"fleet/r1/@rpc/control/acquire/n{number}", None, 0, bytes) for number in range(FLOOD)]
    assert lanes.count(Lane.OTHER) == ALL_NAMES_HZ
    assert repr(gate) == f"<NameGate {NAMES} names, <Sieve {FLOOD - int(ALL_NAMES_HZ)} kept back>>"


def test_counts_are_told_once_whoever_counts_meanwhile() -> None:
    sieve = Sieve(0.0, lambda: 1.0)
    sieve.count(Code.RATE)
    assert sieve.lane(Code.NO_LEASE) is None
    assert {refusal.code: count for refusal, count in sieve.kept_back()} == {Code.NO_LEASE: 1, Code.RATE: 1}
    sieve.count(Code.RATE)
    assert [(refusal.code, count) for refusal, count in sieve.kept_back()] == [(Code.RATE, 1)]
