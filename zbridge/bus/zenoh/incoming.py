"""What comes in from Zenoh: samples, queries, changes of liveliness, and replies to our own queries.

The functions that ``*_callback`` return run on Zenoh's threads. They choose a priority, copy what the event loop needs
and put it into the inbox, or call a handler that asked for that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import zenoh

from zbridge.bus.inbox import Inbox, Source
from zbridge.bus.interface import Answer, PriorityClass, ReadPayload, Sample, Sort
from zbridge.bus.writer import Writer
from zbridge.bus.zenoh.publishers import reply_and_drop
from zbridge.errors import BusError, PayloadError, Refused, refusal
from zbridge.fleet import payload as payloads
from zbridge.fleet.lease_messages import Denied
from zbridge.fleet.topics import is_concrete
from zbridge.log import Log
from zbridge.metrics import Count
from zbridge.protocol.rate_limit import RateLimit

log = Log("zbridge.bus")

QUERIES_HZ = 500.0
"""Queries a second that one queryable answers."""
REPLIES = 10_000
"""Most replies to one query."""
_REPLIES_OF_EACH = 16
"""Most replies of one session to a query for one key."""
_DENIED = zenoh.Encoding(payloads.ENCODING).with_schema(payloads.schema(Denied))


def priority_callback(priority: PriorityClass, source: Source) -> Callable[[Any], None]:
    """Make the callback of input that has one fixed priority."""

    def store(raw: Any) -> None:
        source.put(raw, priority)

    return store


def loop_callback(
    inbox: Inbox, handler: Callable[[Sample], None], priority: PriorityClass | Sort
) -> Callable[[zenoh.Sample], None]:
    """Make the callback of samples whose handler is called on the event loop's thread."""
    if isinstance(priority, PriorityClass):
        return priority_callback(priority, inbox.source(handler, read_sample))
    return sorted_callback(priority, inbox.source(handler))


def direct_callback(key_expr: str, handler: Callable[[Sample], None]) -> Callable[[zenoh.Sample], None]:
    """Make the callback of samples whose handler is called at once, on Zenoh's thread."""
    own_key = key_expr if is_concrete(key_expr) else None

    def call(raw: zenoh.Sample) -> None:
        attachment = raw.attachment
        shown = attachment.to_bytes() if attachment is not None else None
        try:
            handler(Sample(own_key or str(raw.key_expr), raw.payload.to_bytes(), shown))
        except Exception:
            log.exception("handler_failed", "a handler failed")

    return call


def sorted_callback(sort: Sort, source: Source) -> Callable[[zenoh.Sample], None]:
    """Make the callback of samples that are sorted before they reach the event loop."""

    def store(sample: zenoh.Sample) -> None:
        attachment, payload = sample.attachment, sample.payload
        shown = attachment.to_bytes() if attachment is not None else None
        size = len(payload) + (len(shown) if shown is not None else 0)
        key = str(sample.key_expr)
        priority = sort(key, shown, size, payload.to_bytes)
        if priority is PriorityClass.STOP:
            source.fold(Sample(key, b"", shown), priority)  # all stops of this priority are the same
        elif priority is not None:
            source.put(Sample(key, payload.to_bytes(), shown), priority, size)

    return store


def query_callback(sort: Sort, source: Source, unanswered: Count) -> Callable[[zenoh.Query], None]:
    """Make the callback of queries that are sorted before they reach the event loop."""

    def store(query: zenoh.Query) -> None:
        payload = query.payload
        shown = payload.to_bytes() if payload is not None else None
        size = len(shown) if shown is not None else 0
        priority = sort(str(query.key_expr), shown, size, bytes)
        if priority is None:
            unanswered.value += 1
            query.drop()  # type: ignore[no-untyped-call]
        else:
            source.put(query, priority, size)

    return store


def rate_limiting(priority: PriorityClass, clock: Callable[[], float]) -> Sort:
    """Give so many queries a second this priority; those above get no answer."""
    limit = RateLimit(QUERIES_HZ)

    def sort(key: str, shown: bytes | None, size: int, read_payload: ReadPayload) -> PriorityClass | None:
        return priority if limit.take(clock()) else None

    return sort


def read_sample(raw: zenoh.Sample) -> Sample:
    """Copy a sample."""
    attachment = raw.attachment
    return Sample(str(raw.key_expr), raw.payload.to_bytes(), attachment.to_bytes() if attachment is not None else None)


def read_change(raw: zenoh.Sample) -> tuple[str, bool]:
    """Read the key of a liveliness token, and whether the token came (True) or went."""
    return str(raw.key_expr), raw.kind == zenoh.SampleKind.PUT


class ZenohQuery:
    """A query to this session (:class:`zbridge.bus.IncomingQuery`); a writer thread answers it."""

    def __init__(self, query: zenoh.Query, key: str, writer: Writer) -> None:
        self.asked = str(query.key_expr)
        self.key = key if is_concrete(key) else self.asked
        self.payload = query.payload.to_bytes() if query.payload is not None else b""
        self.attachment = query.attachment.to_bytes() if query.attachment is not None else None
        self._query = query
        self._writer = writer

    def __repr__(self) -> str:
        return f"<ZenohQuery {self.asked}>"

    def answer(self, payload: bytes, attachment: bytes | None = None) -> None:
        self._writer.put(lambda: reply_and_drop(self._query, self.key, payload, attachment))

    def refuse(self, refusal: Refused) -> None:
        denied = payloads.encode(Denied(code=refusal.code, reason=str(refusal)))
        self._writer.put(lambda: self._refuse(denied))

    def _refuse(self, denied: bytes) -> None:
        try:
            self._query.reply_err(denied, encoding=_DENIED)
        finally:
            self._query.drop()  # type: ignore[no-untyped-call]


class Replies(list[Answer]):
    """The replies to one query of ours, within bounds; read on Zenoh's threads as they come.

    A reply of Zenoh's keeps the buffer of 64 kB that it came in: those of a fleet of 200 robots took 250 MB.
    A flood of one session's replies must not hide another's. A session that answers for one key sends few replies;
    one that answers for many may answer for a whole fleet.
    """

    def __init__(self, key_expr: str, dropped: Count) -> None:
        super().__init__()
        self._dropped = dropped
        self._of_each = REPLIES if "*" in key_expr else _REPLIES_OF_EACH
        self._counts: Counter[str | None] = Counter()

    def take(self, reply: zenoh.Reply) -> None:
        """Keep a reply while there is room; count it as dropped otherwise."""
        replier = _replier(reply)
        if len(self) < REPLIES and self._counts[replier] < self._of_each:
            self._counts[replier] += 1
            self.append(read_reply(reply))
        else:
            self._dropped.value += 1


def read_reply(reply: zenoh.Reply) -> Answer:
    """Read a reply: what was answered, or why it was refused."""
    if reply.ok is not None:
        return Answer(str(reply.ok.key_expr), reply.ok.payload.to_bytes(), replier=_replier(reply))
    error = read_error(reply.err.payload.to_bytes() if reply.err is not None else b"no answer")
    return Answer("", b"", error, _replier(reply))


def read_error(payload: bytes) -> Refused | BusError:
    """Read an error reply: a refusal has a code, anything else is a text of Zenoh's."""
    try:
        denied = payloads.decode(Denied, payload)
    except PayloadError:
        return BusError(payload.decode("utf-8", "replace"))
    return refusal(denied.code, denied.reason)


def _replier(reply: zenoh.Reply) -> str | None:
    return str(reply.replier_id.zid) if reply.replier_id is not None else None
