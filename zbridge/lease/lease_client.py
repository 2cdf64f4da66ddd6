"""The lease as a program holds it: asks for it, renews it, proves commands, notices its loss. Sans-IO.

Theory of operation. The machine is :attr:`LeaseClient.TABLE`, ``{state: {input: (action, next state)}}``;
``state-tables.md`` shows the same table, and a test compares both. A pair that the table lacks changes nothing.

States. FREE: no lease and no question. ASKING: an ``acquire`` awaits its answer. PAUSED: the gateway could not answer;
the question is repeated soon. DROPPED: an ``acquire`` awaits its answer, but the program no longer wants the lease.
RECALLED: as DROPPED, but the program wants the lease again. HELD: the lease is held. CHECKING: the lease is held and a
``renew`` awaits its answer. DOUBTED: as CHECKING, and news since then demand another ``renew``. RETURNING: a
``release`` awaits its answer. WANTED: as RETURNING, and the program wants the lease again. Commands may be sent in
HELD, CHECKING and DOUBTED.

Who calls what. The caller (:class:`zbridge.lease.lease_holder.LeaseHolder` on a bus) calls :meth:`want` and
:meth:`drop` for the program, :meth:`read_control` for news from ``control``, :meth:`gateway_lost`, and :meth:`expire`
at :meth:`deadline`. After each call it must ask :meth:`question` and handle :meth:`events`, and must pass the replies
to :meth:`answered`.

Guarantees. At most one question is awaited. A reply to an earlier question changes nothing. A lease that is granted
after :meth:`drop` is released. A lease that ends without :meth:`drop` causes exactly one LOST event.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import ClassVar, TypeAlias

import msgspec

from zbridge.bus import Answer
from zbridge.errors import BusError, Code, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Acquire, Lease
from zbridge.fleet.messages import Control, Refusal
from zbridge.fleet.topics import KeySpace
from zbridge.lease.lease_events import (
    LeaseEvent,
    LeaseEventKind,
    LeaseInput,
    LeaseState,
    RefusalNews,
    Reply,
    code_of,
    passes,
    read,
)
from zbridge.lease.proof import Signer
from zbridge.machine import step

ASK_S = 1.0
"""The longest time that one question waits for its answer, seconds."""
RETRY_S = 0.1
"""Seconds between two questions to a gateway that does not answer, or cannot say."""
LEASE_S = 3.0
"""The length of a lease that does not tell its own, seconds."""


class Question(msgspec.Struct, frozen=True):
    """A query to send. returns: whether it releases the lease; then all earlier commands must be flushed first."""

    key: str
    payload: bytes
    timeout_s: float
    asked_at: float
    returns: bool = False


class _Cause(msgspec.Struct, frozen=True):
    """What comes with an input of the table.

    signer, lease_s: of a grant. expires_at: when a confirmed lease ends. event: what the program is notified of.
    """

    now: float
    signer: Signer | None = None
    lease_s: float | None = None
    expires_at: float = math.inf
    event: LeaseEvent | None = None


Row: TypeAlias = dict[LeaseInput, tuple[Callable[["LeaseClient", _Cause], None], LeaseState]]


def _wait(client: LeaseClient, cause: _Cause) -> None:
    """Do nothing before the answer comes."""


class LeaseClient:
    """The lease of one robot for one program.

    name: the name in the key of the question; ``request.who`` begins with it. concerns: whether a refusal is this
    program's. clock_ms: the raw clock, which dates questions and commands. wait_s: seconds for which a gateway that
    does not answer is asked again; a held lease then ends only if the gateway says so, or at its expiry. None: a
    missing answer denies the lease, or ends it.
    """

    def __init__(
        self,
        keys: KeySpace,
        request: Acquire,
        name: str,
        *,
        concerns: Callable[[Refusal], bool],
        clock_ms: Callable[[], float],
        takeover: bool = False,
        wait_s: float | None = None,
    ) -> None:
        self.keys = keys
        self.request = request
        self.renews = wait_s is not None
        """Whether the lease is renewed three times in its length; else commands must do so."""
        self.news = RefusalNews(concerns)
        self.clock_ms = clock_ms
        self._acquire_key = keys.key((topics.RPC_TAKEOVER if takeover else topics.RPC_ACQUIRE)(name).path)
        self._wait_s = wait_s
        self.state = LeaseState.FREE
        self._signer: Signer | None = None
        self._lease_s = LEASE_S
        self._expires_at = self._due_at = math.inf
        self._wait_until = -math.inf
        self._waiting: Question | None = None
        self._unasked: Question | None = None
        self._later: Reply = None
        """The gateway's last reply that could not decide."""
        self._events: list[LeaseEvent] = []

    def __repr__(self) -> str:
        return f"<LeaseClient of {self.keys.robot} {self.state}>"

    @property
    def held(self) -> bool:
        """Whether commands can be proven."""
        return self._signer is not None

    def prove(self, key: str, payload: bytes, given_ms: float | None = None) -> bytes:
        """Return the attachment of the next command on this key; only while :attr:`held`.

        given_ms: the raw clock when the command was given; None: now.
        """
        assert self._signer is not None, "a command without a lease"
        return self._signer.command(key, payload, int(self.clock_ms() if given_ms is None else given_ms))

    # What the program wants

    def want(self, now: float) -> None:
        """Get the lease."""
        self._later = None
        if self._wait_s is not None:
            self._wait_until = now + self._wait_s
        self._handle(LeaseInput.WANT, _Cause(now))

    def drop(self, now: float) -> None:
        """Release the lease, or stop asking for it."""
        self._handle(LeaseInput.DROP, _Cause(now))

    # News

    def read_control(self, control: Control, now: float) -> list[Refusal]:
        """Take news from ``control``, and return what was refused to this program since the last call."""
        if self._signer is not None and control.lease != self._signer.lease:
            self._handle(LeaseInput.DOUBT, _Cause(now))
        news = []
        for refused in self.news.take(control):
            if refused.code != Code.LEASE_ENDED:
                news.append(refused)
            elif refused.who is not None:  # of an earlier lease, or of this one: the gateway knows
                self._handle(LeaseInput.DOUBT, _Cause(now))
        return news

    def gateway_lost(self, now: float) -> None:
        """Record that the robot's gateway is gone, and every lease with it."""
        event = LeaseEvent.of(LeaseEventKind.LOST, BusError("the robot's gateway is gone"))
        self._handle(LeaseInput.GATEWAY_LOST, _Cause(now, event=event))

    def answered(self, question: Question, replied: Sequence[Answer] | BusError, now: float) -> None:
        """Take the replies to a question, or why it could not be asked."""
        if question is not self._waiting:
            return
        self._waiting = None
        reply = read(replied)
        if question.returns:
            self._handle(LeaseInput.RETURNED, _Cause(now))
        elif question.key == self._acquire_key:
            self._on_acquire_reply(reply, now)
        else:
            self._on_renew_reply(question, reply, now)

    # Time, questions and events

    def deadline(self) -> float | None:
        """Return when :meth:`expire` is next due; None: never."""
        due = self.state is LeaseState.PAUSED or (self.state is LeaseState.HELD and self.renews)
        return self._due_at if due else None

    def expire(self, now: float) -> None:
        """Do what is due: renew, or ask again."""
        deadline = self.deadline()
        if deadline is not None and now >= deadline:
            self._handle(LeaseInput.DUE, _Cause(now))

    def question(self) -> Question | None:
        """Return the question that must be asked now, once."""
        question, self._unasked = self._unasked, None
        return question

    def events(self) -> list[LeaseEvent]:
        """Return what happened since the last call, in order."""
        events, self._events = self._events, []
        return events

    # Replies

    def _on_acquire_reply(self, reply: Reply, now: float) -> None:
        if isinstance(reply, Lease) and reply.ok:
            try:
                signer = Signer(reply)
            except PayloadError as error:
                reply = error
            else:
                self._handle(LeaseInput.GRANTED, _Cause(now, signer, reply.expires_in_s))
                return
        if passes(reply):
            self._later = reply = reply or self._later
            if now < self._wait_until:
                self._handle(LeaseInput.LATER, _Cause(now))
                return
        self._handle(LeaseInput.DENIED, _Cause(now, event=LeaseEvent.of(LeaseEventKind.DENIED, reply)))

    def _on_renew_reply(self, question: Question, reply: Reply, now: float) -> None:
        confirmed = isinstance(reply, Lease) and reply.ok
        if confirmed or code_of(reply) == Code.OUT_OF_ORDER:  # somebody repeated the question, and was first with it
            expires_in_s = reply.expires_in_s if isinstance(reply, Lease) else None
            expires_at = question.asked_at + (expires_in_s or self._lease_s)
            self._handle(LeaseInput.CONFIRMED, _Cause(now, expires_at=expires_at))
            return
        decided = self._wait_s is None or (isinstance(reply, Lease) and not passes(reply))
        expired = now >= self._expires_at
        if decided or expired:
            event = LeaseEvent.of(LeaseEventKind.LOST, reply if decided else None, expired=expired)
            self._handle(LeaseInput.ENDED, _Cause(now, event=event))
        else:
            self._handle(LeaseInput.UNANSWERED, _Cause(now))

    # The machine

    def _handle(self, given: LeaseInput, cause: _Cause) -> None:
        self.state, _ = step(self.TABLE, self.state, given, self, cause)

    def _ask(self, cause: _Cause) -> None:
        """Ask for the lease."""
        left_s = max(RETRY_S, self._wait_until - cause.now) if self._wait_s is not None else ASK_S
        request = msgspec.structs.replace(self.request, t=int(self.clock_ms()))
        question = Question(self._acquire_key, payloads.encode(request), min(ASK_S, left_s), cause.now)
        self._waiting = self._unasked = question

    def _pause(self, cause: _Cause) -> None:
        """Ask again soon."""
        self._due_at = min(cause.now + RETRY_S, self._wait_until)

    def _begin(self, cause: _Cause) -> None:
        """Hold the lease."""
        self._signer, self._lease_s = cause.signer, cause.lease_s or LEASE_S
        self._extend(_Cause(cause.now, expires_at=cause.now + self._lease_s))
        self._events.append(LeaseEvent(LeaseEventKind.GRANTED, expires_in_s=cause.lease_s))

    def _notify(self, cause: _Cause) -> None:
        """Notify the program why there is no lease."""
        assert cause.event is not None
        self._signer = None
        self._events.append(cause.event)

    def _check(self, cause: _Cause) -> None:
        """Renew the lease, or learn that it has ended."""
        assert self._signer is not None
        key = self.keys.key(topics.RPC_RENEW.path)
        timeout_s = ASK_S if self._wait_s is None else min(ASK_S, self._lease_s / 3)
        question = Question(key, self._signer.renewal(key, int(self.clock_ms())), timeout_s, cause.now)
        self._waiting = self._unasked = question

    def _extend(self, cause: _Cause) -> None:
        """Note how long the lease lasts at least."""
        self._expires_at = cause.expires_at
        self._renew_later(cause)

    def _recheck(self, cause: _Cause) -> None:
        """Note how long the lease lasts at least, and renew it again."""
        self._extend(cause)
        self._check(cause)

    def _renew_later(self, cause: _Cause) -> None:
        """Renew in a third of the lease's length."""
        self._due_at = cause.now + self._lease_s / 3

    def _give_back(self, cause: _Cause) -> None:
        """Release the lease."""
        signer, self._signer = cause.signer or self._signer, None
        assert signer is not None
        key = self.keys.key(topics.RPC_RELEASE.path)
        self._waiting = self._unasked = Question(key, signer.release(key), ASK_S, cause.now, returns=True)

    _HELD: ClassVar[Row] = {
        LeaseInput.DROP: (_give_back, LeaseState.RETURNING),
        LeaseInput.GATEWAY_LOST: (_notify, LeaseState.FREE),
        LeaseInput.ENDED: (_notify, LeaseState.FREE),
    }
    TABLE: ClassVar[dict[LeaseState, Row]] = {
        LeaseState.FREE: {
            LeaseInput.WANT: (_ask, LeaseState.ASKING),
        },
        LeaseState.ASKING: {
            LeaseInput.GRANTED: (_begin, LeaseState.HELD),
            LeaseInput.DENIED: (_notify, LeaseState.FREE),
            LeaseInput.LATER: (_pause, LeaseState.PAUSED),
            LeaseInput.DROP: (_wait, LeaseState.DROPPED),
            LeaseInput.GATEWAY_LOST: (_notify, LeaseState.DROPPED),
        },
        LeaseState.DROPPED: {
            LeaseInput.WANT: (_wait, LeaseState.RECALLED),
            LeaseInput.GRANTED: (_give_back, LeaseState.RETURNING),
            LeaseInput.DENIED: (_wait, LeaseState.FREE),
            LeaseInput.LATER: (_wait, LeaseState.FREE),
        },
        LeaseState.RECALLED: {
            LeaseInput.GRANTED: (_begin, LeaseState.HELD),
            LeaseInput.DENIED: (_ask, LeaseState.ASKING),
            LeaseInput.LATER: (_ask, LeaseState.ASKING),
            LeaseInput.DROP: (_wait, LeaseState.DROPPED),
            LeaseInput.GATEWAY_LOST: (_notify, LeaseState.DROPPED),
        },
        LeaseState.PAUSED: {
            LeaseInput.DUE: (_ask, LeaseState.ASKING),
            LeaseInput.DROP: (_wait, LeaseState.FREE),
            LeaseInput.GATEWAY_LOST: (_notify, LeaseState.FREE),
        },
        LeaseState.HELD: _HELD
        | {LeaseInput.DOUBT: (_check, LeaseState.CHECKING), LeaseInput.DUE: (_check, LeaseState.CHECKING)},
        LeaseState.CHECKING: _HELD
        | {
            LeaseInput.DOUBT: (_wait, LeaseState.DOUBTED),
            LeaseInput.CONFIRMED: (_extend, LeaseState.HELD),
            LeaseInput.UNANSWERED: (_renew_later, LeaseState.HELD),
        },
        LeaseState.DOUBTED: _HELD
        | {
            LeaseInput.CONFIRMED: (_recheck, LeaseState.CHECKING),
            LeaseInput.UNANSWERED: (_check, LeaseState.CHECKING),
        },
        LeaseState.RETURNING: {
            LeaseInput.WANT: (_wait, LeaseState.WANTED),
            LeaseInput.RETURNED: (_wait, LeaseState.FREE),
        },
        LeaseState.WANTED: {
            LeaseInput.RETURNED: (_ask, LeaseState.ASKING),
            LeaseInput.DROP: (_wait, LeaseState.RETURNING),
            LeaseInput.GATEWAY_LOST: (_notify, LeaseState.RETURNING),
        },
    }
