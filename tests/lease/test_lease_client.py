"""The lease client: the table that it executes, what is done with every reply, and any course of events."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from tests.lease import decide
from tests.proofs import numbered
from tests.tables import documented, executed
from zbridge.bus import Answer
from zbridge.control.authority import Authority
from zbridge.errors import BusError, Code, NotReady
from zbridge.fleet import payload as payloads
from zbridge.fleet.lease_messages import Acquire, Lease
from zbridge.fleet.messages import Control, Refusal
from zbridge.fleet.topics import KeySpace
from zbridge.lease.lease_client import ASK_S, LEASE_S, LeaseClient, Question
from zbridge.lease.lease_events import LeaseEvent, LeaseEventKind, LeaseState

KEYS = KeySpace("fleet", "r1")
NOW = 100.0
WAIT_S = 5.0
CLOCK_MS = 7777.9
"""The raw clock, which stands still here."""
GRANTED = Lease(ok=True, lease=b"L" * 8, token=b"T" * 32, expires_in_s=LEASE_S)


def client(*, wait_s: float | None = None, takeover: bool = False) -> LeaseClient:
    request = Acquire(who="ann")
    return LeaseClient(
        KEYS,
        request,
        "ann",
        concerns=lambda refusal: refusal.who == "ann",
        clock_ms=lambda: CLOCK_MS,
        takeover=takeover,
        wait_s=wait_s,
    )


def reply(lease: Lease) -> list[Answer]:
    return [Answer("key", payloads.encode(lease))]


def name_of(question: Question) -> str:
    return KEYS.path(question.key).removeprefix("@rpc/control/")


REPLIES: dict[str, Sequence[Answer] | BusError] = {
    "granted": reply(GRANTED),
    "granted shortly": reply(Lease(ok=True, lease=b"L" * 8, token=b"T" * 32, expires_in_s=1.5)),
    "granted nothing": reply(Lease(ok=True)),
    "held by bob": reply(Lease(ok=False, reason="held by bob", code=Code.HELD, holder="bob", expires_in_s=2.0)),
    "no reason": reply(Lease(ok=False)),
    "returned": reply(Lease(ok=True)),
    "renewed": reply(Lease(ok=True, expires_in_s=LEASE_S)),
    "ended": reply(Lease(ok=False, reason="the lease has ended (stop)", code=Code.LEASE_ENDED)),
    "out of order": reply(Lease(ok=False, reason="repeated or out of order", code=Code.OUT_OF_ORDER)),
    "starting": [Answer("key", b"", NotReady("starting"))],
    "closing": [Answer("key", b"", NotReady("ends", Code.CLOSING))],
    "rubbish": [Answer("key", b"\xc1")],
    "timeout": [Answer("key", b"", BusError("a timeout"))],
    "silence": [],
    "closed": BusError("the bus is closed"),
}
CONTROLS = {
    "shown": Control(state="held", lease=GRANTED.lease),
    "stopped": Control(state="stopped"),
    "refused": Control(
        state="held",
        lease=GRANTED.lease,
        refusals=(Refusal(who="ann", command="drive", code=Code.LEASE_ENDED, reason="ended", count=1),),
    ),
}


class Program:
    """A program with a lease client, told step by step what happens."""

    def __init__(self, wait_s: float | None) -> None:
        self.now = NOW
        self.lease = client(wait_s=wait_s)
        self.asked: list[Question] = []

    def take(self, step: str) -> str:
        """Let something happen; tell what is asked then, and what the program is told."""
        if step.endswith(" s"):
            self.now += float(step.removesuffix(" s"))
            self.lease.expire(self.now)
        elif step in CONTROLS:
            assert self.lease.read_control(CONTROLS[step], self.now) == []
        elif step == "renews":
            self.lease.renews = True
        elif step in ("want", "drop", "gateway lost"):
            getattr(self.lease, step.replace(" ", "_"))(self.now)
        else:
            question = self.asked.pop(0 if step.startswith("late ") else -1)
            self.lease.answered(question, REPLIES[step.removeprefix("late ")], self.now)
        question = self.lease.question()
        self.asked += [question] if question else []
        assert self.lease.question() is None, "each is asked once"
        return ", ".join([*([name_of(question)] if question else []), *map(self._told, self.lease.events())])

    def _told(self, event: LeaseEvent) -> str:
        error = f": {type(event.error).__name__}: {event.error}" if event.error else ""
        by = f" by {event.holder} for {event.expires_in_s:g} s" if event.holder else ""
        expired = " expired" if event.expired else ""
        return f"{event.kind}{error}{by}{' unanswered' if event.unanswered else ''}{expired}"


ASK = "want -> acquire/ann; "
HOLD = ASK + "granted -> granted; "
CHECK = HOLD + "stopped -> renew; "
GONE = "gateway lost -> lost: BusError: the robot's gateway is gone"

COURSES = [
    # the course of a program that does not wait, and whether it holds the lease at its end
    ("a lease that is wanted is asked for once", HOLD + "want; shown", "held"),
    ("somebody has it", ASK + "held by bob -> denied: Held: held by bob by bob for 2 s", "free"),
    ("no reason is given", ASK + "no reason -> denied: Unsupported: no reason given", "free"),
    ("the gateway ends", ASK + "closing -> denied: NotReady: ends", "free"),
    ("it grants nothing", ASK + "granted nothing -> denied: PayloadError: Lease: granted without an id*", "free"),
    ("it talks rubbish", ASK + "rubbish -> denied: PayloadError: Lease*", "free"),
    ("it is late", ASK + "timeout -> denied: BusError: no gateway answers unanswered", "free"),
    ("nobody answers", ASK + "silence -> denied: BusError: no gateway answers unanswered", "free"),
    ("nobody can be asked", ASK + "closed -> denied: BusError: the bus is closed", "free"),
    ("what is dropped is given back", HOLD + "drop -> release; returned", "free"),
    ("what is granted after it was dropped is given back", ASK + "drop; granted -> release; returned", "free"),
    ("who changes its mind twice keeps what was granted meanwhile", ASK + "drop; want; granted -> granted", "held"),
    ("or asks again", ASK + "drop; want; silence -> acquire/ann; granted -> granted", "held"),
    ("who wants it again asks after it was given back", HOLD + "drop -> release; want; closed -> acquire/ann", "asks"),
    ("it does not renew unless it is told to", HOLD + "9 s; renews; 0 s -> renew; renewed; 1 s -> renew", "held"),
    ("the gateway's word ends a lease", CHECK + "ended -> lost: LeaseLost: the lease has ended (stop)", "free"),
    ("silence ends it", CHECK + "silence -> lost: BusError: no gateway answers unanswered", "free"),
    ("so does a gateway that cannot say", CHECK + "starting -> lost: NotReady: starting", "free"),
    ("so does a bus that is closed", CHECK + "closed -> lost: BusError: the bus is closed", "free"),
    ("so does rubbish", CHECK + "rubbish -> lost: PayloadError: Lease*", "free"),
    ("whose question was repeated and came second still holds it", CHECK + "out of order", "held"),
    ("news during a renewal need another one", CHECK + "stopped; renewed -> renew; renewed", "held"),
    ("a refusal because the lease has ended is looked into", HOLD + "refused -> renew; renewed", "held"),
    (
        "a late reply about an earlier lease changes nothing",
        CHECK + "drop -> release; silence; want -> acquire/ann; granted -> granted; late ended",
        "held",
    ),
    ("a gateway that is gone takes the lease along", HOLD + GONE, "free"),
    ("what is granted after it was gone is given back", ASK + GONE + "; granted -> release", "asks"),
]
WAITING = [
    # the same for a program that waits
    (
        "who waits asks again until its time is over and tells what it heard last",
        ASK + "starting; 0.05 s; 0.06 s -> acquire/ann; 4.9 s; silence -> denied: NotReady: starting",
        "free",
    ),
    ("a refusal that decides ends the wait", ASK + "held by bob -> denied: Held: *", "free"),
    ("a pause is given up at once", ASK + "silence; drop; 1 s", "free"),
    ("who waits renews three times", HOLD + "0.9 s; 0.1 s -> renew; renewed; 0.9 s; 0.1 s -> renew; renewed", "held"),
    (
        "silence is borne until the lease must have expired",
        HOLD + "1 s -> renew; silence; 1 s -> renew; starting; 1 s -> renew; rubbish -> lost: BusError: no gateway*",
        "free",
    ),
    ("the gateway's word ends it at once", CHECK + "ended -> lost: LeaseLost: the lease has ended (stop)", "free"),
    (
        "a program that was paused for longer than the lease is told that it expired",
        HOLD + "4 s -> renew; ended -> lost: LeaseLost: the lease has ended (stop) expired",
        "free",
    ),
    ("a repeated renewal loses nothing", CHECK + "out of order", "held"),
]


def test_the_table_of_the_documentation_is_the_one_that_is_executed() -> None:
    assert documented("reference/state-tables.md", "event") == executed(LeaseClient.TABLE)


@pytest.mark.parametrize(
    ("wait_s", "course", "state"),
    [*((None, *row[1:]) for row in COURSES), *((WAIT_S, *row[1:]) for row in WAITING)],
    ids=[row[0] for row in COURSES + WAITING],
)
def test_what_happens_is_answered_as_the_table_says(wait_s: float | None, course: str, state: str) -> None:
    program = Program(wait_s)
    for each in course.split("; "):
        step, _, follows = each.partition(" -> ")
        told = program.take(step)
        assert fnmatchcase(told, follows), step
    lease = program.lease
    assert state == ("held" if lease.held else "free" if lease.state is LeaseState.FREE else "asks")
    assert lease.state is not LeaseState.FREE or lease.deadline() is None


def test_a_question_has_a_key_a_payload_and_a_time_of_its_own() -> None:
    for wait_s, takeover, name, timeout_s in ((None, True, "takeover/ann", ASK_S), (0.3, False, "acquire/ann", 0.3)):
        lease = client(wait_s=wait_s, takeover=takeover)
        lease.want(NOW)
        question = lease.question()
        assert question is not None
        assert name_of(question) == name
        assert question.timeout_s == pytest.approx(timeout_s)
        assert payloads.decode(Acquire, question.payload) == Acquire(who="ann", t=7777)
    program = Program(WAIT_S)
    for step in ("want", "granted shortly", "0.5 s"):
        program.take(step)
    assert (program.asked[-1].timeout_s, program.asked[-1].returns) == (0.5, False), "there is time for another try"
    program.take("drop")
    assert program.asked[-1].returns, "the commands before it go before it"


def test_a_refusal_of_its_own_is_news_each_time_it_is_counted_and_those_of_others_are_none() -> None:
    lease = client()
    rows = [("ann", None, 1, 1), ("ann", None, 1, 0), ("ann", None, 2, 1)]
    for who, by, count, news in (*rows, ("bob", None, 1, 0), (None, None, 1, 0), ("ann", "hq.toy", 1, 0)):
        refusal = Refusal(who=who, command="drive", code=Code.BUSY, reason="why", count=count, by=by)
        assert lease.read_control(Control(state="held", refusals=(refusal,)), NOW) == [refusal] * news


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
        answer = reply(decide(self.authority, question.key, question.payload, self.now)) if reaches else []
        self.lease.answered(question, answer if returns else [], self.now)

    @rule()
    def show(self) -> None:
        self.lease.read_control(self.authority.report(self.now), self.now)

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

    @invariant()
    def it_is_held_only_while_it_is_wanted(self) -> None:
        if (question := self.lease.question()) is not None:
            self.under_way.append(question)
        for event in self.lease.events():
            if event.kind is not LeaseEventKind.GRANTED:
                self.wanted = False
        assert not self.lease.held or self.wanted
        free = self.lease.state is LeaseState.FREE
        assert free or self.wanted or self.under_way, "what is not wanted any more is being given back"


def test_over_any_course_of_events_a_lease_is_held_only_while_it_is_wanted() -> None:
    run_state_machine_as_test(
        Holding, settings=settings(max_examples=2 * settings().max_examples, stateful_step_count=40)
    )
