"""Answers queries about the lease of one robot: acquire, takeover, renew, release, unlatch, what listeners refused.

Every kind of query has an admission filter on the bus's threads; the authority decides, the enforcer carries out.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from zbridge.bus import Handle, IncomingQuery
from zbridge.control.admission import NameFilter, QueryFilter
from zbridge.control.context import RobotContext
from zbridge.control.enforcer import Enforcer
from zbridge.errors import Code, Malformed, NotReady, PayloadError, RateLimited, Refused
from zbridge.errors import refusal as refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Acquire, Unlatch
from zbridge.fleet.messages import FleetMessage, Query, Refusals
from zbridge.lease.lease_events import NAMED
from zbridge.lease.proof import read
from zbridge.protocol.rate_limit import RateLimit

REPORTS_HZ = 20.0
"""Times a second that listeners, all together, may report what they refused."""
TAKEOVERS_HZ = 5.0
"""Takeovers a second, of all programs together."""
_LISTENER = "hq."
_COUNTED = 1_000_000
"""Most refusals of one kind that a report counts."""
_BY_NAME = "/*"
"""Queries whose key ends with the name of who asks. On a secure bus nobody can ask at another's key."""
_ANYBODY = "*"

Decide = Callable[[IncomingQuery], FleetMessage]


class LeaseServer:
    """Serves the lease of one robot on the bus."""

    def __init__(self, context: RobotContext, enforcer: Enforcer) -> None:
        authority, clock = enforcer.authority, context.clock
        self._context = context
        self._enforcer = enforcer
        self._authority = authority
        self._clock = clock
        self._queries: dict[str, tuple[Decide, QueryFilter | NameFilter]] = {
            "acquire/*": (self._acquire, NameFilter(clock)),
            "takeover/*": (self._take_over, NameFilter(clock)),
            "renew": (self._renew, QueryFilter(authority, clock)),
            "release": (self._release, QueryFilter(authority, clock)),
            "unlatch/*": (partial(self._unlatch, fleet=False), NameFilter(clock)),
            "unlatch_fleet/*": (partial(self._unlatch, fleet=True), NameFilter(clock)),
            "refused/*": (self._take_reported, NameFilter(clock)),
        }
        """Queries about the lease. A key that ends with ``*`` has the name of who asks there."""
        for name, (_, admission) in self._queries.items():
            enforcer.refusal_limits[name.removesuffix(_BY_NAME)] = admission.refusals
        self._closing: str | None = None
        self._waits: str | None = None
        """Why no lease is granted yet."""
        self._takeovers = RateLimit(TAKEOVERS_HZ)
        self._reports = RateLimit(REPORTS_HZ)

    def __repr__(self) -> str:
        return f"<LeaseServer {self._context.keys.robot} {self._authority!r}>"

    def serve(self) -> list[Handle]:
        """Answer queries about the lease, and watch whether its holder lives."""
        return [
            *(self._answer(name, *query) for name, query in self._queries.items()),
            self._context.bus.answer(self._context.keys.key(topics.RPC_LATCH.path), self._report_latches),
            self._context.bus.watch_alive(self._context.keys.alive(_ANYBODY), self._on_alive),
        ]

    def refuse_all(self, reason: str | None) -> None:
        """Give no lease from now on; None: give leases again."""
        self._closing = reason

    def wait(self, reason: str | None) -> None:
        """Grant no lease until the fleet's latched stops are known; None: they are."""
        self._waits = reason

    def _answer(self, name: str, decide: Decide, admission: QueryFilter | NameFilter) -> Handle:
        """Answer one kind of query, or refuse it and show the refusal on ``control``."""
        command = name.removesuffix(_BY_NAME)

        def answer(query: IncomingQuery) -> None:
            self._enforcer.keep_time()
            if self._closing is not None:
                query.refuse(NotReady(self._closing, Code.CLOSING))
                return
            try:
                if not topics.is_concrete(query.asked):
                    raise Malformed("its key has wildcards")
                query.answer(payloads.encode(decide(query)))
            except (PayloadError, Refused) as error:
                refusal = error if isinstance(error, Refused) else Malformed(str(error))
                self._authority.refuse(command, refusal, _bound_name(query) if command != name else None)
                query.refuse(refusal)
            self._enforcer.settle()

        key = self._context.keys.key(f"@rpc/control/{name}")
        return self._context.bus.answer(key, answer, priority=admission)

    def _on_alive(self, key: str, alive: bool) -> None:
        if not alive:
            self._authority.vanished(key.removeprefix(self._context.keys.alive("")))
            self._enforcer.settle()

    def _acquire(self, query: IncomingQuery) -> FleetMessage:
        self._require_latches()
        return self._authority.acquire(_request(query), self._clock(), self._context.raw_ms())

    def _take_over(self, query: IncomingQuery) -> FleetMessage:
        self._require_latches()
        request = _request(query)
        if not self._takeovers.take(self._clock()):
            raise RateLimited(f"more than {TAKEOVERS_HZ:g} takeovers a second")
        return self._authority.takeover(request, self._clock(), self._context.raw_ms())

    def _renew(self, query: IncomingQuery) -> FleetMessage:
        return self._authority.renew(read(query.payload), query.asked, self._clock(), self._context.raw_ms())

    def _release(self, query: IncomingQuery) -> FleetMessage:
        return self._authority.release(read(query.payload), query.asked, self._clock())

    def _require_latches(self) -> None:
        if self._waits is not None:
            raise NotReady(self._waits)

    def _unlatch(self, query: IncomingQuery, *, fleet: bool) -> FleetMessage:
        stop_id = payloads.decode(Unlatch, query.payload).id
        name = topics.unescape(query.asked.rpartition("/")[2])
        self._authority.unlatch(stop_id, name[:NAMED], fleet=fleet)
        return Query()

    def _report_latches(self, query: IncomingQuery) -> None:
        query.answer(payloads.encode(self._authority.latches.fleet))

    def _take_reported(self, query: IncomingQuery) -> FleetMessage:
        """Show what a listener refused its HQ programs.

        The names of listeners begin with ``hq.``: no refusal can be reported in the name of any other program.
        """
        name = query.asked.rpartition("/")[2]
        if not name.startswith(_LISTENER):
            raise Malformed(f"its name does not begin with {_LISTENER!r}: only listeners tell what they refused")
        reported = payloads.decode(Refusals, query.payload).refusals
        for each in reported:
            _require_own_name(query, each.who or "")
        if not self._reports.take(self._clock()):
            raise RateLimited(f"more than {REPORTS_HZ:g} reports a second")
        for each in reported:
            count = min(max(each.count, 1), _COUNTED)
            self._authority.refuse(each.command, refused(each.code, each.reason), each.who, by=name, count=count)
        return Query()


def _bound_name(query: IncomingQuery) -> str | None:
    """Return the name in the key of a query, which its payload cannot change; None where the key has wildcards."""
    return topics.unescape(query.asked.rpartition("/")[2]) if topics.is_concrete(query.asked) else None


def _request(query: IncomingQuery) -> Acquire:
    """Read who asks for the lease; raise Malformed if it asks, or is to live, in another name than its key's."""
    request = payloads.decode(Acquire, query.payload)
    _require_own_name(query, request.who)
    name = query.asked.rpartition("/")[2]
    if request.alive is not None and not topics.may_name_token(request.alive, name):
        own = f"{'' if name.startswith(_LISTENER) else 'operator.'}{name}.<id>"
        raise Malformed(f"alive = {request.alive[:NAMED]!r}: expected a token of its own name, {own[:NAMED]!r}")
    return request


def _require_own_name(query: IncomingQuery, who: str) -> None:
    """Raise Malformed if somebody asks in another name than its key's."""
    name = query.asked.rpartition("/")[2]
    if not topics.speaks_for(who, name):
        raise Malformed(f"who = {who[:NAMED]!r}: expected {topics.unescape(name)[:NAMED]!r}, or that and '.suffix'")
