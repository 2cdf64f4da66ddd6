"""Request and answer: one request on the wire, the matching answer, a time limit, polls. Sans-IO.

Theory of operation
-------------------
An :class:`Exchange` is an outbox that waits. A session writes what ``take`` returns, as with any outbox.

    FREE     no answer is awaited. ``take`` returns the next request, in the order below. A request that
             ``expects`` an answer leads to WAITING, another one stays in FREE.
    WAITING  a request is on the wire. ``take`` returns None. ``answered`` (the matching answer came) and
             ``expire`` (its time limit passed) lead to FREE.
    OPEN     the session is closing. ``take`` returns what is left and awaits nothing.

Order of requests: urgent ones (the stop), then slots and queue alternately. The rules of :class:`Outbox` hold:
``set`` keeps the newest motion of a slot; an urgent group replaces the motion of its slot and is never
dropped; ``put`` refuses a request when too many wait. So a stop waits for one answer at most: ``answer_s`` seconds.

A poll is a slot that repeats: ``poll`` sends a request every ``period_s``. A poll that is late is sent once, and the
next one is due a period after it; missed polls are not made up.

Silence: each request without an answer within ``answer_s`` counts as failed. :class:`ExchangeSession` notifies the
session (``unanswered``). After ``busy_after`` failures in a row the robot accepts no commands: the gateway stops it,
and neutral is needed. After ``lost_after`` in a row the session ends. One answer ends the silence.

An answer that matches no request on the wire is malformed: it is counted and dropped. A robot that also sends
unsolicited messages overrides ``unasked``.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

from zbridge.errors import ProtocolError
from zbridge.protocol.kept import FRAME
from zbridge.protocol.outbox import LIMIT, Outbox
from zbridge.protocol.session import Limits, Session
from zbridge.wire.frames import FrameBuffer

M = TypeVar("M")

SILENT = "the robot does not answer"


class Exchange(Outbox):
    """Requests on their way out, one at a time.

    answer_s: seconds that an answer may take. expects: whether a request is answered at all.
    """

    kept: ClassVar[dict[str, Any]] = {
        "awaited": FRAME,
        "failed": int,
        "failed_in_a_row": int,
        "_answer_at": float,
        "_open": bool,
    }

    def __init__(
        self,
        answer_s: float,
        *,
        gap_s: float = 0.0,
        limit: int = LIMIT,
        expects: Callable[[bytes], bool] = lambda request: True,
    ) -> None:
        super().__init__(gap_s, limit)
        self.answer_s = answer_s
        self.awaited: bytes | None = None
        """The request on the wire, None while no answer is awaited."""
        self.failed = 0
        """Requests without an answer."""
        self.failed_in_a_row = 0
        self._expects = expects
        self._answer_at = math.inf
        self._open = False

    def __repr__(self) -> str:
        return f"<Exchange awaits {self.awaited!r}, {self.failed_in_a_row} failed in a row, {super().__repr__()}>"

    def take(self, now: float) -> bytes | None:
        """Take the request to write now; None while an answer is awaited, or when there is none."""
        if self.awaited is not None:
            return None
        request = super().take(now)
        if request is not None and not self._open and self._expects(request):
            self.awaited, self._answer_at = request, now + self.answer_s
        return request

    def written(self, now: float) -> None:
        """Start the gap and the time limit now: the last request was written only now."""
        super().written(now)
        if self.awaited is not None:
            self._answer_at = now + self.answer_s

    def deadline(self) -> float | None:
        """Return when ``take`` will have something; None while an answer is awaited, or nothing waits."""
        return None if self.awaited is not None else super().deadline()

    def answered(self) -> None:
        """Complete the request on the wire."""
        self.awaited, self._answer_at, self.failed_in_a_row = None, math.inf, 0

    @property
    def answer_at(self) -> float:
        """When the request on the wire fails; ``inf`` while no answer is awaited."""
        return self._answer_at

    def expire(self, now: float) -> bytes | None:
        """Fail the request on the wire if its time is up, and return it."""
        if now < self._answer_at:
            return None
        request, self.awaited, self._answer_at = self.awaited, None, math.inf
        self.failed += 1
        self.failed_in_a_row += 1
        return request

    def open(self) -> None:
        """Await nothing from now on: the last requests go out one after the other."""
        self._open, self.awaited, self._answer_at = True, None, math.inf


class ExchangeSession(Session[M]):
    """A session of a request-and-answer protocol, in the role of the asking side.

    A protocol implements ``encode``, ``read``, ``answers`` and ``accept``, sets ``frame_end`` and, in ``opened``, asks
    for what begins the conversation. Raise ProtocolError in ``read`` for a frame that is no message.
    """

    answer_s = 0.2
    """Seconds that an answer may take."""
    busy_after = 2
    """Failures in a row after which the robot accepts no commands."""
    lost_after = 10
    """Failures in a row after which the session ends."""

    def __init__(self, limits: Limits, *, name: str = "", peer: str = "") -> None:
        super().__init__(limits, name=name, peer=peer)
        self.exchange = Exchange(self.answer_s, gap_s=limits.gap_s, expects=self.expects)
        self.outbox = self.exchange

    # What a protocol contributes

    @abstractmethod
    def read(self, frame: bytes) -> M:
        """Read one frame; raise ProtocolError if it is no message. ``exchange.awaited`` is the request."""

    @abstractmethod
    def answers(self, request: bytes, message: M) -> bool:
        """Return whether a message is the answer to the request on the wire."""

    def expects(self, request: bytes) -> bool:
        """Return whether a request is answered at all."""
        return True

    def unasked(self, message: M) -> bool:
        """Return whether the robot may send a message without a request."""
        return False

    def unanswered(self, request: bytes, now: float) -> None:
        """Handle a failed request; it is not sent again unless this method does so."""

    # What a protocol's own code calls

    def poll(self, slot: str, request: M, now: float, period_s: float) -> None:
        """Send a request now, and again every ``period_s`` seconds; a newer one of the same slot replaces it."""
        self.outbox.set(slot, (self.encode(request),), now, period_s=period_s, lasting=True)

    def unpoll(self, slot: str) -> None:
        """End a poll."""
        self.outbox.clear(slot)

    # How a session does it

    def decode(self, frame: bytes) -> M:
        """Read one frame and complete the request that it answers; raise ProtocolError if it answers none."""
        message = self.read(frame)
        awaited = self.exchange.awaited
        if awaited is not None and self.answers(awaited, message):
            self.exchange.answered()
            self.busy = None if self.busy == SILENT else self.busy
        elif not self.unasked(message):
            raise ProtocolError(f"{frame[:_QUOTED]!r} answers no request" + (f", not {awaited!r}" if awaited else ""))
        return message

    def timers(self) -> float:
        """Return when the request on the wire fails. A protocol with timers of its own takes the earlier."""
        return self.exchange.answer_at

    def on_timer(self, now: float) -> None:
        """Fail the request on the wire if its time is up."""
        request = self.exchange.expire(now)
        if request is None:
            return
        self.traffic.unanswered += 1
        self._frames = FrameBuffer(self.frame_end, self.limits.frame_bytes)  # half an answer must not join the next
        in_a_row = self.exchange.failed_in_a_row
        if in_a_row >= self.lost_after:
            self.fail(f"no answer to {in_a_row} requests in a row")
            return
        if in_a_row >= self.busy_after and self.busy is None:
            self.busy = SILENT
        self.unanswered(request, now)

    def close(self, reason: str, now: float) -> None:
        """End the conversation once the requests that wait are written; their answers are not awaited."""
        self.exchange.open()
        super().close(reason, now)


_QUOTED = 40
