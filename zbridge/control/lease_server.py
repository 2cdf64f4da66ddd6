"""One robot's control authority on the bus: leases by query, ``control``, stops and timers in time, the audit log."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from zbridge.bus import Bus, Handle, Question
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.events import EventKind
from zbridge.control.gate import CommandGate, NameGate, QuestionGate
from zbridge.control.motion_limits import MotionLimits
from zbridge.control.proof import read
from zbridge.control.standstill import Standstill
from zbridge.errors import Code, Malformed, NotReady, PayloadError, Refused, TooFast
from zbridge.errors import refusal as refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Acquire, FleetMessage, Query, Refusals
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import Robot
from zbridge.protocol.rate_limit import RateLimit
from zbridge.protocol.session import State

TELLINGS_HZ = 20.0
"""Times a second that listeners, all together, may tell what they refused."""
_LISTENER = "hq."
_COUNTED = 1_000_000
_NAMED = 64
"""Characters of a name that are repeated to whoever uses it wrongly."""
_CONTROL_S = 0.05
"""Least time between two publications of ``control`` while refusals come in."""
TAKEOVERS_HZ = 5.0
"""Takeovers a second, of whoever asks."""
_ANYBODY = "*"

Decide = Callable[[Question], FleetMessage]


class LeaseServer:
    """Carries out what the authority decides. ``publish`` shows a message on the bus.

    ``clock``: seconds on the event loop's time line.
    """

    def __init__(
        self,
        robot: Robot,
        authority: Authority,
        keys: KeySpace,
        metrics: Metrics,
        audit: Audit,
        limits: MotionLimits,
        standstill: Standstill,
        *,
        publish: Callable[[Topic, FleetMessage], object],
        clock: Callable[[], float],
    ) -> None:
        self.authority = authority
        self.limits = limits
        self.standstill = standstill
        self.gate = CommandGate(authority, keys, clock)
        """Sorts commands."""
        self._gates: dict[str, CommandGate | QuestionGate | NameGate] = {
            "commands": self.gate,
            "acquire": NameGate(clock),
            "takeover": NameGate(clock),
            "renew": QuestionGate(authority, clock),
            "release": QuestionGate(authority, clock),
            "refused": NameGate(clock),
        }
        self._takeovers = RateLimit(TAKEOVERS_HZ)
        self._robot = robot
        self._keys = keys
        self._metrics = metrics
        self._audit = audit
        self._publish = publish
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = math.inf
        self._control_due: asyncio.TimerHandle | None = None
        self._closing: str | None = None
        self._tellings = RateLimit(TELLINGS_HZ)
        self._refused = metrics.count("refused")
        self._same_stops = metrics.count("stops_folded")

    def __repr__(self) -> str:
        return f"<LeaseServer {self._keys.robot} {self.authority!r}>"

    def serve(self, bus: Bus) -> list[Handle]:
        """Answer questions about the lease, and watch whether its holder lives."""
        return [
            self._answer(bus, "acquire/*", self._acquire),
            self._answer(bus, "takeover/*", self._take_over),
            self._answer(bus, "renew", self._renew),
            self._answer(bus, "release", self._release),
            self._answer(bus, "refused/*", self._take_told),
            bus.watch_alive(self._keys.alive(_ANYBODY), self._on_alive),
        ]

    def stop(self, reason: str) -> None:
        """Stop the robot at once and for a second, and end the lease."""
        self.authority.stop(reason)
        self.settle()

    def hold_back(self, reason: str, *, stops: bool) -> None:
        """Allow no motion before a neutral drive; with ``stops`` the robot is sent its stop."""
        self.authority.hold_back(reason, stops=stops)
        self.settle()

    def bus_lost(self) -> None:
        """End the lease: its holder cannot be heard any more."""
        self.authority.bus_lost()
        self.settle()

    def refuse_all(self, reason: str) -> None:
        """Give no lease from now on."""
        self._closing = reason

    def settle(self) -> None:
        """Carry out what the authority decided, and be there when it is next due."""
        if not self.authority.eventful:
            self._watch_time()
            return
        changed = False
        while events := self.authority.events():
            for event in events:
                if event.what is EventKind.REFUSED:
                    self._refused.value += 1
                else:
                    changed = True
                    if event.what is not EventKind.ACQUIRED:
                        self.limits.stands()
                    self._metrics.count("control", what=event.what.value).value += 1
                if event.stops:
                    self._send_stop()
                self._audit.write(event)
            if self._control_due is None:
                self._control_due = self._loop.call_later(_CONTROL_S, self.report)
        if changed:
            self.report()
        self._watch_time()

    def beat(self) -> None:
        """Publish ``control``, and have written down what repeated itself; to be called once a second."""
        self._count_kept_back()
        self.report()
        self._audit.flush()

    def _count_kept_back(self) -> None:
        """Show what the gates refused by themselves since the last time: an entry for each code, with its count."""
        for command, gate in self._gates.items():
            for refusal, count in gate.sieve.kept_back():
                self.authority.refuse(command, refusal, count=count)
                self._refused.value += count - 1  # settling counts one
        self._same_stops.value = self.gate.same_stops
        self.settle()

    def report(self) -> None:
        """Publish ``control`` now."""
        if self._control_due is not None:
            self._control_due.cancel()
            self._control_due = None
        self._publish(topics.CONTROL, self.authority.report(self._clock()))

    def close(self) -> None:
        """Let no timer fire any more."""
        for timer in (self._timer, self._control_due):
            if timer is not None:
                timer.cancel()

    def _send_stop(self) -> None:
        session = self._robot.driving
        if session is None or session.state is not State.ESTABLISHED:
            return
        try:
            self.standstill.stop()
        except Refused as refusal:
            self.authority.refuse("stop", refusal)

    def look_at_time(self) -> None:
        """Do what is due, before anything else is done: the loop may come back late, from a process that was frozen."""
        self.authority.expire(self._clock())
        if self.authority.eventful:
            self.settle()

    def _watch_time(self) -> None:
        """Have a timer at the deadline or before it: commands put the deadline off far more often than it comes."""
        deadline = self.authority.deadline()
        if deadline is None or self._timer_at <= deadline:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer_at = deadline
        self._timer = self._loop.call_at(deadline, self._on_time)

    def _on_time(self) -> None:
        self._timer, self._timer_at = None, math.inf
        self.authority.expire(self._clock())
        self.settle()

    def _on_alive(self, key: str, alive: bool) -> None:
        if not alive:
            self.authority.vanished(key.removeprefix(self._keys.alive("")))
            self.settle()

    # Questions

    def _answer(self, bus: Bus, name: str, decide: Decide) -> Handle:
        """Answer one kind of question, or refuse it where everybody sees."""
        command = name.removesuffix("/*")

        def answer(question: Question) -> None:
            if self._closing is not None:
                question.refuse(NotReady(self._closing, Code.CLOSING))
                return
            try:
                if not topics.is_concrete(question.asked):
                    raise Malformed("its key has wildcards")
                question.answer(payloads.encode(decide(question)))
            except (PayloadError, Refused) as error:
                refusal = error if isinstance(error, Refused) else Malformed(str(error))
                self.authority.refuse(command, refusal)
                question.refuse(refusal)
            self.settle()

        return bus.answer(self._keys.key(f"@rpc/control/{name}"), answer, lane=self._gates[command])

    def _acquire(self, question: Question) -> FleetMessage:
        return self.authority.acquire(_request(question), self._clock())

    def _take_over(self, question: Question) -> FleetMessage:
        request = _request(question)
        if not self._takeovers.take(self._clock()):
            raise TooFast(f"more than {TAKEOVERS_HZ:g} takeovers a second")
        return self.authority.takeover(request, self._clock())

    def _renew(self, question: Question) -> FleetMessage:
        return self.authority.renew(read(question.payload), question.asked, self._clock())

    def _release(self, question: Question) -> FleetMessage:
        return self.authority.release(read(question.payload), question.asked, self._clock())

    def _take_told(self, question: Question) -> FleetMessage:
        """Show what a listener refused its HQ programs.

        Their names begin with ``hq.``, so that nobody can be told of a refusal in the name of any other program.
        """
        name = question.asked.rpartition("/")[2]
        if not name.startswith(_LISTENER):
            raise Malformed(f"its name does not begin with {_LISTENER!r}: only listeners tell what they refused")
        told = payloads.decode(Refusals, question.payload).refusals
        for each in told:
            _require_own_name(question, each.who or "")
        if not self._tellings.take(self._clock()):
            raise TooFast(f"more than {TELLINGS_HZ:g} tellings a second")
        for each in told:
            count = min(max(each.count, 1), _COUNTED)
            self.authority.refuse(each.command, refused(each.code, each.reason), each.who, by=name, count=count)
        return Query()


def _request(question: Question) -> Acquire:
    """Read who asks for the lease; raise Malformed where it asks in another name than its key's."""
    request = payloads.decode(Acquire, question.payload)
    _require_own_name(question, request.who)
    return request


def _require_own_name(question: Question, who: str) -> None:
    """Raise Malformed where somebody asks in another name than its key's."""
    name = question.asked.rpartition("/")[2]
    if not topics.speaks_for(who, name):
        raise Malformed(f"who = {who[:_NAMED]!r}: expected {topics.unescape(name)[:_NAMED]!r}, or that and '.suffix'")
