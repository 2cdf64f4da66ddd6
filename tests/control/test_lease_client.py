"""The lease as a program holds it, without a bus and a clock: replies and times are arguments."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from tests.proofs import numbered
from tests.tables import documented, executed
from zbridge.bus import Answer
from zbridge.control.authority import Authority
from zbridge.control.lease_client import ASK_S, LEASE_S, RETRY_S, LeaseClient, Question
from zbridge.control.lease_events import LeaseEvent, LeaseEventKind
from zbridge.control.proof import read
from zbridge.errors import BusError, Code, Held, LeaseLost, NotReady, PayloadError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Acquire, Control, FleetMessage, Lease, Refusal
from zbridge.fleet.topics import KeySpace

KEYS = KeySpace("fleet", "r1")
WHO = "ann"
NOW = 100.0
WAIT_S = 5.0
GRANTED = Lease(ok=True, lease=b"L" * 8, token=b"T" * 32, expires_in_s=LEASE_S)
RENEWED = Lease(ok=True, expires_in_s=LEASE_S)
ENDED = Lease(ok=False, reason="the lease has ended (stop)", code=Code.LEASE_ENDED)


def client(*, wait_s: float | None = None, takeover: bool = False) -> LeaseClient:
    return LeaseClient(
        KEYS, Acquire(who=WHO), WHO, concerns=lambda refusal: refusal.who == WHO, takeover=takeover, wait_s=wait_s
    )


def reply(message: FleetMessage) -> list[Answer]:
    return [Answer("key", payloads.encode(message))]


def refused(error: Refused | BusError) -> list[Answer]:
    return [Answer("key", b"", error)]


def asked(lease: LeaseClient, name: str) -> Question:
    """Take the question that is to be asked now, which must be this one."""
    question = lease.question()
    assert question is not None
    assert KEYS.path(question.key) == f"@rpc/control/{name}"
    assert lease.question() is None, "each is asked once"
    return question


def holding(*, wait_s: float | None = None) -> LeaseClient:
    """A client that was granted the lease at NOW."""
    lease = client(wait_s=wait_s)
    lease.want(NOW)
    lease.answered(asked(lease, "acquire/ann"), reply(GRANTED), NOW)
    (event,) = lease.events()
    assert (event.kind, event.expires_in_s) == (LeaseEventKind.GRANTED, LEASE_S)
    return lease


def only(lease: LeaseClient) -> LeaseEvent:
    (event,) = lease.events()
    return event


def test_the_table_of_the_documentation_is_the_one_that_is_executed() -> None:
    assert documented("control.md", "said") == executed(LeaseClient.TABLE)


# Getting the lease


def test_a_lease_that_is_wanted_is_asked_for_once() -> None:
    lease = client()
    assert lease.free
    lease.want(NOW)
    lease.want(NOW)
    question = asked(lease, "acquire/ann")
    assert payloads.decode(Acquire, question.payload) == Acquire(who=WHO)
    assert question.timeout_s == ASK_S
    assert not lease.held


def test_a_takeover_is_asked_at_its_own_key() -> None:
    lease = client(takeover=True)
    lease.want(NOW)
    asked(lease, "takeover/ann")


def test_a_lease_that_was_granted_proves_commands_with_rising_numbers() -> None:
    lease = holding()
    assert lease.held
    shown = [read(lease.prove(KEYS.key("@cmd/drive"), b"x")) for _ in range(3)]
    assert [each.seq for each in shown] == [1, 2, 3]
    assert {each.lease for each in shown} == {GRANTED.lease}


@pytest.mark.parametrize(
    ("replied", "kind", "reason"),
    [
        (reply(Lease(ok=False, reason="held by bob", code=Code.HELD, holder="bob")), Held, "held by bob"),
        (reply(Lease(ok=False)), Refused, "no reason given"),
        (refused(NotReady("ends", Code.CLOSING)), NotReady, "ends"),
        (reply(Lease(ok=True)), PayloadError, "granted without an id"),
        ([Answer("key", b"\xc1")], PayloadError, "Lease"),
        (refused(BusError("a timeout")), BusError, "no gateway answers"),
        ([], BusError, "no gateway answers"),
        (BusError("the bus is closed"), BusError, "the bus is closed"),
    ],
)
def test_a_client_that_does_not_wait_is_denied_by_whatever_is_no_grant(replied, kind, reason) -> None:
    lease = client()
    lease.want(NOW)
    lease.answered(asked(lease, "acquire/ann"), replied, NOW)
    event = only(lease)
    assert event.kind is LeaseEventKind.DENIED
    assert isinstance(event.error, kind)
    assert reason in str(event.error)
    assert event.unanswered == (reason == "no gateway answers")
    assert lease.free


def test_a_client_that_waits_asks_again_until_its_time_is_over_and_tells_what_it_heard_last() -> None:
    lease = client(wait_s=WAIT_S)
    lease.want(NOW)
    lease.answered(asked(lease, "acquire/ann"), refused(NotReady("starting")), NOW)
    assert lease.deadline() == NOW + RETRY_S
    lease.expire(NOW + RETRY_S / 2)
    assert lease.question() is None
    lease.expire(NOW + RETRY_S)
    question = asked(lease, "acquire/ann")
    assert lease.events() == []
    lease.answered(question, [], NOW + WAIT_S)
    assert str(only(lease).error) == "starting"
    assert lease.free


def test_the_last_question_of_a_client_that_waits_is_short() -> None:
    lease = client(wait_s=0.3)
    lease.want(NOW)
    assert asked(lease, "acquire/ann").timeout_s == pytest.approx(0.3)


def test_a_refusal_that_decides_ends_the_wait() -> None:
    lease = client(wait_s=WAIT_S)
    lease.want(NOW)
    denied = Lease(ok=False, reason="held by bob", code=Code.HELD, holder="bob", expires_in_s=2.0)
    lease.answered(asked(lease, "acquire/ann"), reply(denied), NOW)
    event = only(lease)
    assert (event.holder, event.expires_in_s) == ("bob", 2.0)


# Giving it back


def test_a_lease_that_is_dropped_is_given_back_after_the_commands_before_it() -> None:
    lease = holding()
    lease.drop(NOW)
    question = asked(lease, "release")
    assert question.returns
    assert not lease.held
    assert not lease.free
    lease.answered(question, reply(Lease(ok=True)), NOW)
    assert lease.free
    assert lease.events() == []


def test_a_lease_that_is_granted_after_it_was_dropped_is_given_back() -> None:
    lease = client()
    lease.want(NOW)
    question = asked(lease, "acquire/ann")
    lease.drop(NOW)
    lease.answered(question, reply(GRANTED), NOW)
    assert not lease.held
    assert lease.events() == []
    asked(lease, "release")


def test_a_program_that_changes_its_mind_twice_keeps_what_was_granted_meanwhile() -> None:
    lease = client()
    lease.want(NOW)
    question = asked(lease, "acquire/ann")
    lease.drop(NOW)
    lease.want(NOW)
    assert lease.question() is None
    lease.answered(question, reply(GRANTED), NOW)
    assert lease.held


def test_a_program_that_changes_its_mind_twice_asks_again_where_the_first_question_was_denied() -> None:
    lease = client()
    lease.want(NOW)
    question = asked(lease, "acquire/ann")
    lease.drop(NOW)
    lease.want(NOW)
    lease.answered(question, [], NOW)
    asked(lease, "acquire/ann")
    assert lease.events() == []


def test_a_lease_that_is_wanted_again_while_it_is_given_back_is_asked_for_when_that_is_done() -> None:
    lease = holding()
    lease.drop(NOW)
    question = asked(lease, "release")
    lease.want(NOW)
    assert lease.question() is None
    lease.answered(question, BusError("the bus is closed"), NOW)
    asked(lease, "acquire/ann")


def test_a_pause_is_given_up_at_once() -> None:
    lease = client(wait_s=WAIT_S)
    lease.want(NOW)
    lease.answered(asked(lease, "acquire/ann"), [], NOW)
    lease.drop(NOW)
    assert lease.free
    assert lease.deadline() is None


# Keeping it


def test_a_client_that_waits_renews_its_lease_three_times_in_its_length() -> None:
    lease = holding(wait_s=WAIT_S)
    for number in range(1, 4):
        due = NOW + number * LEASE_S / 3
        assert lease.deadline() == pytest.approx(due)
        lease.expire(due)
        lease.answered(asked(lease, "renew"), reply(RENEWED), due)
    assert lease.events() == []


def test_a_client_that_does_not_renew_has_no_deadline_unless_told_to() -> None:
    lease = holding()
    assert lease.deadline() is None
    lease.renews = True
    assert lease.deadline() == NOW + LEASE_S / 3


def test_silence_is_borne_until_the_lease_must_have_expired() -> None:
    lease = holding(wait_s=WAIT_S)
    for now in (NOW + 1.0, NOW + 2.0):
        lease.expire(now)
        lease.answered(asked(lease, "renew"), [], now)
        assert lease.held
    lease.expire(NOW + LEASE_S)
    lease.answered(asked(lease, "renew"), [Answer("key", b"\xc1")], NOW + LEASE_S)
    event = only(lease)
    assert (event.kind, event.unanswered) == (LeaseEventKind.LOST, True)
    assert lease.free


@pytest.mark.parametrize("wait_s", [None, WAIT_S])
def test_the_gateways_word_ends_the_lease_at_once(wait_s: float | None) -> None:
    lease = holding(wait_s=wait_s)
    lease.look(Control(state="stopped"), NOW)
    lease.answered(asked(lease, "renew"), reply(ENDED), NOW)
    event = only(lease)
    assert event.kind is LeaseEventKind.LOST
    assert isinstance(event.error, LeaseLost)
    assert not lease.held


@pytest.mark.parametrize("replied", [[], refused(NotReady("ends")), BusError("closed"), [Answer("key", b"\xc1")]])
def test_a_client_that_does_not_wait_has_lost_a_lease_that_is_not_confirmed(replied: Any) -> None:
    lease = holding()
    lease.look(Control(state="free"), NOW)
    lease.answered(asked(lease, "renew"), replied, NOW)
    assert only(lease).kind is LeaseEventKind.LOST


@pytest.mark.parametrize("wait_s", [None, WAIT_S])
def test_a_renewal_that_somebody_repeated_and_was_first_with_loses_nothing(wait_s: float | None) -> None:
    lease = holding(wait_s=wait_s)
    lease.look(Control(state="free"), NOW)
    out_of_order = Lease(ok=False, reason="repeated or out of order", code=Code.OUT_OF_ORDER)
    lease.answered(asked(lease, "renew"), reply(out_of_order), NOW)
    assert lease.held
    assert lease.events() == []


def test_news_that_come_during_a_renewal_need_another_one() -> None:
    lease = holding()
    lease.look(Control(state="free"), NOW)
    question = asked(lease, "renew")
    lease.look(Control(state="free"), NOW)
    assert lease.question() is None
    lease.answered(question, reply(RENEWED), NOW)
    lease.answered(asked(lease, "renew"), reply(RENEWED), NOW)
    assert lease.held
    assert lease.question() is None


def test_a_late_reply_about_an_earlier_lease_changes_nothing() -> None:
    lease = holding()
    lease.look(Control(state="free"), NOW)
    late = asked(lease, "renew")
    lease.drop(NOW)
    lease.answered(asked(lease, "release"), [], NOW)
    lease.want(NOW)
    lease.answered(asked(lease, "acquire/ann"), reply(GRANTED), NOW)
    lease.events()
    lease.answered(late, reply(ENDED), NOW)
    assert lease.held
    assert lease.events() == []


def test_a_gateway_that_is_gone_takes_the_lease_along() -> None:
    lease = holding()
    lease.gateway_lost(NOW)
    assert str(only(lease).error) == "the robot's gateway is gone"
    assert lease.free


def test_what_is_granted_after_the_gateway_was_gone_is_given_back() -> None:
    lease = client()
    lease.want(NOW)
    question = asked(lease, "acquire/ann")
    lease.gateway_lost(NOW)
    assert only(lease).kind is LeaseEventKind.LOST
    lease.answered(question, reply(GRANTED), NOW)
    asked(lease, "release")


# Refusals


def shown(code: Code, count: int, who: str | None = WHO, by: str | None = None) -> Control:
    refusal = Refusal(who=who, command="drive", code=code, reason="why", count=count, by=by)
    return Control(state="held", lease=GRANTED.lease, refusals=(refusal,))


def test_a_refusal_is_news_each_time_it_is_counted() -> None:
    lease = holding()
    assert [refusal.count for refusal in lease.look(shown(Code.BUSY, 1), NOW)] == [1]
    assert lease.look(shown(Code.BUSY, 1), NOW) == []
    assert [refusal.count for refusal in lease.look(shown(Code.BUSY, 2), NOW)] == [2]


@pytest.mark.parametrize(("who", "by"), [("bob", None), (None, None), (WHO, "hq.toy")])
def test_refusals_of_others_are_no_news(who: str | None, by: str | None) -> None:
    assert holding().look(shown(Code.BUSY, 1, who, by), NOW) == []


def test_a_refusal_because_the_lease_has_ended_is_looked_into_and_not_told() -> None:
    lease = holding()
    assert lease.look(shown(Code.LEASE_ENDED, 1), NOW) == []
    asked(lease, "renew")


# Any course of events, against a gateway's own authority


class Holding(RuleBasedStateMachine):
    """Questions and replies are lost or late; the gateway stops, and others take over."""

    def __init__(self) -> None:
        super().__init__()
        self.now = NOW
        self.authority = Authority(LEASE_S, 2.0, numbered())
        self.lease = client()
        self.wanted = False
        self.under_way: list[Question] = []

    @rule()
    def want(self) -> None:
        if not self.wanted:
            self.wanted = True
            self.lease.want(self.now)

    @rule()
    def drop(self) -> None:
        self.wanted = False
        self.lease.drop(self.now)

    @rule(number=st.integers(0, 9), reaches=st.booleans(), returns=st.booleans())
    def reply(self, number: int, reaches: bool, returns: bool) -> None:
        if not self.under_way:
            return
        question = self.under_way.pop(number % len(self.under_way))
        answer = reply(self.decide(question)) if reaches else []
        self.lease.answered(question, answer if returns else [], self.now)

    @rule()
    def show(self) -> None:
        self.lease.look(self.authority.report(self.now), self.now)

    @rule()
    def stop(self) -> None:
        self.authority.stop("stop")

    @rule()
    def lose_gateway(self) -> None:
        self.authority = Authority(LEASE_S, 2.0, numbered())
        self.lease.gateway_lost(self.now)

    @rule(s=st.floats(0, 2))
    def wait(self, s: float) -> None:
        self.now += s
        self.lease.expire(self.now)

    def decide(self, question: Question) -> Lease:
        name = KEYS.path(question.key).removeprefix("@rpc/control/")
        if name.startswith("acquire"):
            return self.authority.acquire(payloads.decode(Acquire, question.payload), self.now)
        decide = self.authority.renew if name == "renew" else self.authority.release
        return decide(read(question.payload), question.key, self.now)

    @invariant()
    def it_is_held_only_while_it_is_wanted(self) -> None:
        if (question := self.lease.question()) is not None:
            self.under_way.append(question)
        for event in self.lease.events():
            if event.kind is not LeaseEventKind.GRANTED:
                self.wanted = False
        assert not self.lease.held or self.wanted
        assert self.lease.free or self.wanted or self.under_way, "what is not wanted any more is being given back"


def test_over_any_course_of_events_a_lease_is_held_only_while_it_is_wanted() -> None:
    run_state_machine_as_test(
        Holding, settings=settings(max_examples=2 * settings().max_examples, stateful_step_count=40)
    )
