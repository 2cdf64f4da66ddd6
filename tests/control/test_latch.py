"""Latched stops: ids in force until they are released, whatever is lost, repeated or comes in another order."""

from __future__ import annotations

import itertools

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from tests.proofs import numbered, packed
from zbridge.control.authority import Authority
from zbridge.control.events import EventKind
from zbridge.control.latch import LATCHES, RELEASED, STOPS, Latches, LatchRecord, read_stop
from zbridge.errors import Code, Malformed, ProtocolError, Unsupported
from zbridge.fleet.lease_messages import Acquire, FleetLatches
from zbridge.fleet.messages import Latch, Stop

UNSET = msgspec.UNSET


def stop_id(number: int) -> bytes:
    return number.to_bytes(16, "big")


def latch(number: int, *, fleet: bool = False) -> Latch:
    return Latch(stop_id(number), "ann", "wet floor", fleet)


def numbers(latches: Latches) -> list[int]:
    return [int.from_bytes(each.id, "big") for each in latches.in_force]


ID = stop_id(7)
READ = {
    "nothing": (b"", Stop()),
    "an empty map": (b"\x80", Stop()),
    "no MessagePack": (b"\xc1", Stop()),
    "a text": (packed("stop"), Stop()),  # type: ignore[arg-type]
    "a latch without an id": (packed({"latch": True}), Stop()),
    "a short id": (packed({"latch": True, "id": ID[1:]}), Stop()),
    "an id as text": (packed({"latch": True, "id": "0123456789abcdef"}), Stop()),
    "an id alone": (packed({"id": ID}), Stop(id=ID)),
    "a latch": (packed({"latch": True, "id": ID}), Stop(latch=True, id=ID)),
    "a latch with its reasons": (
        packed({"latch": True, "id": ID, "who": "ann", "reason": "fire", "more": 1}),
        Stop(latch=True, id=ID, who="ann", reason="fire"),
    ),
    "no latch": (packed({"latch": False, "id": ID}), Stop(latch=False, id=ID)),
    "a number as latch": (packed({"latch": 1, "id": ID}), Stop()),
}


@pytest.mark.parametrize(("payload", "stop"), READ.values(), ids=READ)
def test_a_stop_that_cannot_be_read_is_a_plain_stop(payload: bytes, stop: Stop) -> None:
    assert read_stop(payload) == stop


def test_names_and_reasons_are_shortened() -> None:
    kept = Latches().take(Stop(latch=True, id=ID, who="w" * 500, reason="r" * 500), fleet=True)
    assert kept is not None
    assert (len(kept.who or ""), len(kept.reason or ""), kept.fleet) == (64, 128, True)


def test_an_id_is_in_force_until_it_is_released_and_never_again() -> None:
    latches = Latches()
    assert latches.add(latch(1))
    assert not latches.add(latch(1)), "a repetition"
    assert latches.add(latch(2))
    assert latches.release(stop_id(1), fleet=False)
    assert not latches.release(stop_id(1), fleet=False), "once more: it was released"
    assert not latches.add(latch(1)), "a repetition that was late"
    assert numbers(latches) == [2]


def test_a_release_is_of_the_robot_or_of_the_fleet_and_of_a_known_id() -> None:
    latches = Latches()
    latches.add(latch(1))
    latches.add(latch(2, fleet=True))
    with pytest.raises(Unsupported, match="belongs to the whole fleet: release it with zbridge unlatch --all"):
        latches.release(stop_id(2), fleet=False)
    with pytest.raises(Unsupported, match=r"belongs to this robot alone: release it with zbridge unlatch ROBOT$"):
        latches.release(stop_id(1), fleet=True)
    with pytest.raises(Malformed):
        latches.release(stop_id(3), fleet=False)
    assert numbers(latches) == [1, 2]


def test_a_release_of_the_fleet_that_comes_before_its_latch_is_remembered() -> None:
    latches = Latches()
    assert not latches.release(stop_id(1), fleet=True)
    assert not latches.add(latch(1, fleet=True))
    assert latches.adopt([FleetLatches(latches=(latch(1, fleet=True),))]) == ()


def test_of_more_than_sixteen_the_last_is_replaced_and_the_robot_stays_latched() -> None:
    latches = Latches()
    for number in range(LATCHES + 5):
        latches.add(latch(number))
    assert numbers(latches) == [*range(LATCHES - 1), LATCHES + 4]


def test_the_same_stop_sent_to_one_robot_and_to_all_is_one_of_the_fleet() -> None:
    latches = Latches()
    latches.add(latch(1))
    assert latches.add(latch(1, fleet=True))
    assert not latches.add(latch(1))
    assert [each.fleet for each in latches.in_force] == [True]


def test_ids_of_the_fleet_are_adopted_unless_any_answer_releases_them() -> None:
    latches = Latches()
    answers = [
        FleetLatches(latches=(latch(1, fleet=True), latch(2, fleet=True))),
        FleetLatches(latches=(latch(1, fleet=True), latch(3, fleet=True)), released=(stop_id(2),)),
        FleetLatches(released=(stop_id(9),)),
    ]
    assert [each.id for each in latches.adopt(answers)] == [stop_id(1), stop_id(3)]
    assert latches.adopt(answers) == (), "once"
    assert numbers(latches) == [1, 3]


def test_an_id_that_was_written_down_ends_by_a_release_here_only() -> None:
    latches = Latches(LatchRecord((latch(1, fleet=True),)))
    latches.adopt([FleetLatches(released=(stop_id(1),))])
    assert numbers(latches) == [1]
    assert latches.release(stop_id(1), fleet=True)


def test_the_answer_to_others_has_the_ids_of_the_fleet_and_its_last_releases() -> None:
    latches = Latches()
    latches.add(latch(1))
    latches.add(latch(2, fleet=True))
    for number in range(100, 100 + RELEASED + 3):
        latches.release(stop_id(number), fleet=True)
    told = latches.fleet
    assert [each.id for each in told.latches] == [stop_id(2)]
    assert told.released == tuple(stop_id(number) for number in range(103, 100 + RELEASED + 3))


def test_what_another_gateway_of_the_robot_released_is_released_here_and_stays_so() -> None:
    away, meanwhile = Latches(), Latches()
    for latches in (away, meanwhile):
        latches.add(latch(1))
        latches.add(latch(2, fleet=True))
        latches.add(latch(3))
    meanwhile.release(stop_id(1), fleet=False)
    meanwhile.release(stop_id(2), fleet=True)
    assert away.merge(meanwhile.record) == ()
    assert away.in_force == (latch(3),)
    assert not away.add(latch(1)), "released for good"
    assert not away.add(latch(2, fleet=True))


def test_everything_is_handed_to_another_process() -> None:
    one, other = Latches(), Latches()
    one.add(latch(1))
    one.add(latch(2, fleet=True))
    one.add(latch(3))
    one.release(stop_id(3), fleet=False)
    other.add(latch(3))  # as the file had it a moment ago
    other.restore(msgspec.msgpack.decode(msgspec.msgpack.encode(one.export())))
    assert numbers(other) == [1, 2]
    assert not other.add(latch(3))
    with pytest.raises(ProtocolError, match="latches"):
        other.restore({"latches": [{"id": b"short"}]})


# The authority


def latched(authority: Authority, number: int = 1, *, fleet: bool = False) -> None:
    authority.take_stop(Stop(latch=True, id=stop_id(number), who="ann", reason="wet floor"), fleet=fleet)


def test_a_latched_robot_is_stopped_and_nobody_gets_its_lease_until_the_last_id_is_released() -> None:
    authority = Authority(3.0, 2.0, numbered())
    authority.acquire(Acquire(who="bob"), 0.0)
    authority.applied("drive", 0.0, moving=True)
    authority.events()
    latched(authority)
    latched(authority, 2)
    assert [(event.what, event.who, event.stops) for event in authority.events()] == [
        (EventKind.LATCHED, "ann", True),
        (EventKind.LATCHED, "ann", True),
    ]
    assert (authority.state, authority.motion.moving, authority.verifier) == ("latched", False, None)
    for ask in (authority.acquire, authority.takeover):
        refused = ask(Acquire(who="bob", priority=9), 1.0)
        assert (refused.ok, refused.code, refused.reason) == (
            False,
            Code.LATCHED,
            "latched by ann (wet floor) and 1 more",
        )
    authority.stop("stop")
    assert authority.state == "latched"
    authority.unlatch(stop_id(1), "op1", fleet=False)
    assert not authority.acquire(Acquire(who="bob"), 2.0).ok
    authority.unlatch(stop_id(2), "op1", fleet=False)
    assert authority.state == "stopped"
    assert authority.acquire(Acquire(who="bob"), 3.0).ok


def test_what_another_gateway_released_frees_the_robot_with_the_last_id() -> None:
    authority = Authority(3.0, 2.0, numbered())
    latched(authority)
    latched(authority, 2)
    authority.merge(LatchRecord(released=(stop_id(1),)))
    assert authority.state == "latched"
    authority.merge(LatchRecord(released=(stop_id(1), stop_id(2))))
    assert authority.state == "stopped"
    assert [event.what for event in authority.events()][-2:] == [EventKind.UNLATCHED, EventKind.UNLATCHED]
    assert authority.acquire(Acquire(who="bob"), 3.0).ok


def test_control_shows_the_latches_and_the_last_four_stops() -> None:
    authority = Authority(3.0, 2.0, numbered())
    for number in range(1, 7):
        authority.take_stop(Stop(id=stop_id(number)), fleet=False)
    latched(authority, 8, fleet=True)
    shown = authority.report(0.0)
    assert shown.state == "latched"
    assert shown.latches == (latch(8, fleet=True),)
    assert shown.stops == tuple(stop_id(number) for number in (4, 5, 6)), "it is not written down yet"
    authority.latches.saved()
    shown = authority.report(0.0)
    assert shown.stops == tuple(stop_id(number) for number in (4, 5, 6, 8))
    assert len(shown.stops) == STOPS


def test_a_released_stop_that_is_repeated_late_stops_and_does_not_latch() -> None:
    authority = Authority(3.0, 2.0, numbered())
    latched(authority)
    authority.unlatch(stop_id(1), "op1", fleet=False)
    authority.acquire(Acquire(who="bob"), 1.0)
    authority.events()
    latched(authority)
    assert [event.stops for event in authority.events()] == [True]
    assert authority.state == "stopped"


def test_a_latch_of_before_is_in_force_from_the_start() -> None:
    authority = Authority(3.0, 2.0, numbered(), latches=Latches(LatchRecord((latch(1),))))
    assert authority.state == "latched"
    assert authority.acquire(Acquire(who="bob"), 0.0).code == Code.LATCHED
    other = Authority(3.0, 2.0, numbered())
    other.restore_latches(authority.latches.export())
    assert other.state == "latched"


# A fleet that is cut in two again and again


class Partitions(RuleBasedStateMachine):
    """Gateways hear of latches and releases or not, restart, and ask those that they can reach."""

    COUNT = 4

    def __init__(self) -> None:
        super().__init__()
        self.ids = itertools.count(1)
        self.known: dict[int, set[int]] = {}
        """For each id that was sent: the gateways that heard of it, and may not forget it."""
        self.released: set[int] = set()
        self.gateways = [Latches() for _ in range(self.COUNT)]

    @rule(heard=st.sets(st.integers(0, COUNT - 1), min_size=1))
    def stop_all(self, heard: set[int]) -> None:
        number = next(self.ids)
        self.known[number] = set(heard)
        for gateway in heard:
            self.gateways[gateway].add(latch(number, fleet=True))

    @rule(which=st.integers(0, 5), heard=st.sets(st.integers(0, COUNT - 1), min_size=1))
    def release(self, which: int, heard: set[int]) -> None:
        if not self.known:
            return
        number = sorted(self.known)[which % len(self.known)]
        self.released.add(number)
        for gateway in heard:
            self.gateways[gateway].release(stop_id(number), fleet=True)
            self.known[number].discard(gateway)

    @rule(gateway=st.integers(0, COUNT - 1), reaches=st.sets(st.integers(0, COUNT - 1)), restarts=st.booleans())
    def comes_back(self, gateway: int, reaches: set[int], restarts: bool) -> None:
        if restarts:
            self.gateways[gateway] = Latches(self.gateways[gateway].record)
        self.gateways[gateway].adopt(self.gateways[other].fleet for other in reaches)

    @invariant()
    def no_gateway_loses_a_latch_that_was_not_released_there(self) -> None:
        for number, heard in self.known.items():
            for gateway in heard:
                assert stop_id(number) in self.gateways[gateway]

    @invariant()
    def what_was_never_released_is_adopted_by_who_reaches_one_that_knows_it(self) -> None:
        for number, heard in self.known.items():
            if number not in self.released and heard:
                newcomer = Latches()
                newcomer.adopt(latches.fleet for latches in self.gateways)
                assert stop_id(number) in newcomer


def test_no_partition_loses_a_latched_stop() -> None:
    run_state_machine_as_test(
        Partitions, settings=settings(max_examples=3 * settings().max_examples, stateful_step_count=15)
    )


@given(st.lists(st.tuples(st.sampled_from(["add", "release"]), st.integers(0, 3)), max_size=12), st.randoms())
def test_the_order_in_which_latches_and_releases_come_does_not_matter(acts, random) -> None:
    def played(order: list[tuple[str, int]]) -> list[int]:
        latches = Latches()
        for act, number in order:
            if act == "add":
                latches.add(latch(number, fleet=True))
            else:
                latches.release(stop_id(number), fleet=True)
        return sorted(numbers(latches))

    shuffled = list(acts)
    random.shuffle(shuffled)
    assert played(acts) == played(shuffled)
