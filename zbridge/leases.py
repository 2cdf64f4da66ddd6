"""One robot's control authority on the bus: leases by query, ``control``, stops and timers in time, the audit log."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from zbridge.audit import Audit
from zbridge.bus import Bus, Handle, Lane, Question
from zbridge.errors import Code, NotReady, PayloadError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Acquire, FleetMessage, Lease, LeaseToken
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.metrics import Metrics
from zbridge.protocol import Robot
from zbridge.session.control import Authority, What
from zbridge.session.motion import MotionLimits
from zbridge.session.session import State

STOP_REPEAT_S = 1.0
"""Seconds for which a stop is repeated."""
_CONTROL_S = 0.05
"""Least time between two publications of ``control`` while refusals come in."""
_ANYBODY = "*"


class Leases:
    """Carries out what the authority decides. ``publish`` shows a message on the bus, ``pump`` writes to the robot.

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
        *,
        publish: Callable[[Topic, FleetMessage], object],
        pump: Callable[[], None],
        clock: Callable[[], float],
    ) -> None:
        self.authority = authority
        self.limits = limits
        self._robot = robot
        self._keys = keys
        self._metrics = metrics
        self._audit = audit
        self._publish = publish
        self._pump = pump
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = math.inf
        self._control_due: asyncio.TimerHandle | None = None
        self._closing: str | None = None
        self._stands_at = -math.inf
        self._refused = metrics.count("refused")

    def __repr__(self) -> str:
        return f"<Leases {self._keys.robot} {self.authority!r}>"

    def serve(self, bus: Bus) -> list[Handle]:
        """Answer questions about the lease, and watch whether its holder lives."""
        asked = (topics.RPC_ACQUIRE, topics.RPC_TAKEOVER, topics.RPC_RENEW, topics.RPC_RELEASE)
        return [
            *(bus.answer(self._keys.key(topic.path), self._on_question, lane=self.lane) for topic in asked),
            bus.watch_alive(self._keys.alive(_ANYBODY), self._on_alive),
        ]

    @property
    def stopping_s(self) -> float:
        """Seconds for which a stop or a neutral is still being repeated."""
        return max(0.0, self._stands_at - self._clock())

    def lane(self, shown: bytes | None) -> Lane:
        """Let what shows the holder's token wait for nobody else's; called on the bus's threads."""
        token = self.authority.token
        return Lane.COMMAND if token and shown and token in shown else Lane.OTHER

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

    def stand_still(self) -> None:
        """Send the robot its stop, for a second; raise Refused where it cannot be sent."""
        now = self._clock()
        self._robot.stop(now, now + STOP_REPEAT_S)
        self.stands(now)
        self._pump()

    def stands(self, now: float) -> None:
        """Take note that neutral or a stop is being repeated from now on."""
        self._stands_at = now + STOP_REPEAT_S

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
                if event.what is What.REFUSED:
                    self._refused.value += 1
                else:
                    changed = True
                    if event.what is not What.ACQUIRED:
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
        self.report()
        self._audit.flush()

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
            self.stand_still()
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

    def _on_question(self, question: Question) -> None:
        try:
            question.answer(payloads.encode(self._decide(self._keys.path(question.key), question.payload)))
        except (PayloadError, Refused) as error:
            question.refuse(str(error))
        self.settle()

    def _decide(self, path: str, payload: bytes) -> Lease:
        if self._closing is not None:
            raise NotReady(self._closing, Code.CLOSING)
        authority, now = self.authority, self._clock()
        if path == topics.RPC_RENEW.path:
            return authority.renew(payloads.decode(LeaseToken, payload).token, now)
        if path == topics.RPC_RELEASE.path:
            return authority.release(payloads.decode(LeaseToken, payload).token, now)
        request = payloads.decode(Acquire, payload)
        return authority.takeover(request, now) if path == topics.RPC_TAKEOVER.path else authority.acquire(request, now)
