"""What gateways and commands use of the bus: keys, payloads and delivery. Knows neither zenoh nor robots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Annotated, Literal, Protocol

import msgspec

from zbridge.errors import BusError, ConfigError, Refused
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics

Connection = Annotated[str, msgspec.Meta(pattern=r"^(tcp|udp|tls|quic|ws|unixsock-stream|serial|vsock)/[^ ]+$")]
"""Where Zenoh listens or connects: ``tcp/127.0.0.1:7447``."""

SECURE = ("tls", "quic")
"""The kinds of endpoints that use certificates."""
_FULL = "transport/link/tx/queue/congestion_control"
FULL_QUEUES = {f"{_FULL}/drop/wait_before_drop": 20_000, f"{_FULL}/block/wait_before_close": 1_000_000}
"""How long Zenoh waits for room in a full transmission queue, by the paths of its configuration, microseconds.

Streams are dropped when the bus stalls, not when one of its threads is a millisecond late. Everything else closes the
connection, which is then reopened. While threads wait for room, Zenoh 1.10 may lock up: with its default, 5 s, one of
six sessions never reconnected after 4 of 33 cuts of the network (eclipse-zenoh/zenoh#1876); with 1 s, after 1 of 183.
"""


class Tls(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Files for mutual TLS.

    ca: the authority's certificate. certificate: this program's. key: the private key of that certificate.
    """

    ca: str
    certificate: str | None = None
    key: str | None = None


class BusSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ``[bus]`` table of a configuration.

    With ``tls`` a session is a client of the routers in ``connect``: peers with certificates find each other by gossip,
    and would bypass the router's rules in plain TCP. Anything else raises ConfigError.
    """

    mode: Literal["peer", "client", "router"] | None = None
    connect: tuple[Connection, ...] = ()
    listen: tuple[Connection, ...] = ()
    multicast: bool = True
    stream: Literal["drop", "block"] = "drop"
    tls: Tls | None = None

    def __post_init__(self) -> None:
        if self.tls is None:
            return
        why = "with tls every program is a client of a router"
        if self.mode not in (None, "client"):
            raise ConfigError(f"bus.mode = {self.mode!r}: expected 'client', or none: {why}")
        if self.listen:
            raise ConfigError(f"bus.listen = {list(self.listen)}: expected none: {why}")
        if not self.connect:
            raise ConfigError(f"bus.connect: missing, expected tls/host:port: {why}")
        for endpoint in self.connect:
            if endpoint.partition("/")[0] not in SECURE:
                raise ConfigError(
                    f"bus.connect = {endpoint!r}: expected tls/host:port: with tls nothing goes in the open"
                )

    @property
    def effective_mode(self) -> str:
        """The mode that is used: client with tls, and when only ``connect`` is given, else peer."""
        alone = self.tls is not None or (self.connect and not self.listen)
        return self.mode or ("client" if alone else "peer")

    @property
    def alone_is_normal(self) -> bool:
        """Whether a session may be healthy without any connection: it only waits for others to connect."""
        return self.effective_mode != "client" and not self.connect


class Neighbour(msgspec.Struct, frozen=True):
    """A process that is connected to a router. name: the common name of its certificate, None without one."""

    name: str | None
    address: str
    zid: str


class Sample(msgspec.Struct, frozen=True):
    """One message that came in on a key."""

    key: str
    payload: bytes
    attachment: bytes | None = None


class IncomingQuery(Protocol):
    """A query that waits for its answer. Call :meth:`answer` or :meth:`refuse` once.

    key: the key that is answered. asked: the key expression of the query, perhaps with wildcards.
    """

    key: str
    asked: str
    payload: bytes
    attachment: bytes | None

    def answer(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Reply with a payload."""

    def refuse(self, refusal: Refused) -> None:
        """Reply with an error: its code, and its text."""


class Answer(msgspec.Struct, frozen=True):
    """One reply to a query of ours.

    error: None, or why there is no payload: Refused as the replier sent it, BusError for any other error reply.
    replier: the id of the session that replied, as the bus reports it; None if unknown.
    """

    key: str
    payload: bytes
    error: Refused | BusError | None = None
    replier: str | None = None


class Publisher(Protocol):
    """Publishes on one key."""

    key: str

    @property
    def last(self) -> bytes | None:
        """The last value, if the key keeps it."""

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        """Publish with the key's delivery, without blocking; False asks to pause the source."""

    def close(self) -> None:
        """Undeclare the key; idempotent."""


class Handle(Protocol):
    """A declaration on the bus."""

    def close(self) -> None:
        """Undeclare; idempotent."""


Batch = Sequence[tuple[Publisher, list[bytes]]]
"""Stream messages of one read: for each key its payloads in order."""


class PriorityClass(IntEnum):
    """The order in which the event loop serves input; each class has a bound and a share of its own.

    STOP: identical stops; of each source only one waits. LATCH: stops that have an id; each is served.
    """

    STOP = 0
    LATCH = 1
    COMMAND = 2
    OTHER = 3


ReadPayload = Callable[[], bytes]
"""Returns the payload that an authorization proves: of a query, whose payload is the authorization, b""."""
Sort = Callable[[str, bytes | None, int, ReadPayload], PriorityClass | None]
"""Chooses the priority class of a sample or query; None: the sort has counted it, and it is dropped.

Runs on Zenoh's threads: must not block and must not raise. Arguments: the key (of a query the asked key expression),
the attachment of a sample or the payload of a query, the bytes of payload and attachment together, and a function
that returns the payload.
"""


class Bus(Protocol):
    """What gateways and commands use of Zenoh. Handlers are called on the event loop's thread, if not ``direct``."""

    @property
    def zid(self) -> str:
        """The id of this session on the bus."""

    def routers(self) -> list[str]:
        """Return the ids of the routers that this session is connected to."""

    def share(self, metrics: Metrics) -> Bus:
        """Return a bus on the same session for one robot, with queues, bounds and declarations of its own.

        Its ``close`` undeclares what was declared on it, and leaves the session to the others.
        """

    def publisher(self, key: str, topic: Topic, last: bytes | None = None) -> Publisher:
        """Declare a publisher of ``key``. last: what another process published last, for keys that keep it."""

    def put_all(self, batch: Batch) -> bool:
        """Publish stream messages in order; False asks to pause the source until the relief handler is called.

        The bus owns the lists from then on: the caller must not use them again.
        """

    def on_relief(self, handler: Callable[[], None]) -> None:
        """Call ``handler`` when a paused source may resume."""

    def subscribe(
        self,
        key_expr: str,
        handler: Callable[[Sample], None],
        *,
        priority: PriorityClass | Sort = PriorityClass.OTHER,
        history: bool = False,
        kept: bool = False,
        direct: bool = False,
    ) -> Handle:
        """Subscribe to ``key_expr``.

        priority: of all samples, or a Sort that chooses it for each. history: query last values too.
        kept: also receive the frames that publishers keep, including publishers that appear later.
        direct: the handler is called on one of Zenoh's threads, for streams without priority and history: it must be
        quick, and may put frames on another bus.

        Of the samples that a Sort gives priority STOP only one waits at a time, because they are all the same stop.
        """

    def answer(
        self,
        key: str,
        handler: Callable[[IncomingQuery], None],
        *,
        priority: PriorityClass | Sort = PriorityClass.OTHER,
        complete: bool = False,
    ) -> Handle:
        """Answer queries that ask for ``key``, with or without wildcards; the last chunk of ``key`` may be one.

        complete: this session answers for the whole key, so that queries to complete answerers alone find it.
        """

    def gather(self, key_expr: str) -> Handle:
        """Declare one queryable, ``key_expr`` (``.../**``), for all keys below it that are answered from now on.

        A session that access rules permit to answer for some of the keys only must not gather.
        """

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        """Query ``key_expr`` and collect the replies of ``timeout_s`` seconds, bounded in number."""

    def attend(self) -> None:
        """Serve the stops and the holder's commands that wait. Call it in the middle of long work."""

    def announce(self, key: str) -> Handle:
        """Declare a liveliness token."""

    async def alive(self, key_expr: str, *, timeout_s: float = 0.5) -> list[str]:
        """List the liveliness tokens that exist."""

    def watch_alive(self, key_expr: str, handler: Callable[[str, bool], None]) -> Handle:
        """Call ``handler`` with every liveliness token that exists or appears (True) or disappears (False)."""

    async def flush(self) -> None:
        """Wait until all queued states and answers are handed to Zenoh (streams excluded); raise BusError after 2 s."""

    async def drain(self, key_expr: str) -> None:
        """Wait until all that was published has left this process, streams too; ``key_expr``: a query for its answer.

        The query has the lowest priority, so that everything else is sent before it. Waits for a second at most; raises
        BusError.
        """

    def frames(
        self, key: str, listened: Callable[[bool], None], *, best_effort: bool = False, kept: int = 0
    ) -> Publisher:
        """Declare a key for raw frames; call ``listened`` when the first listener appears and the last one leaves.

        best_effort: links may lose frames. kept: last frames that late advanced subscribers of Zenoh get; needs a bus
        with timestamps.
        """

    def watch_listeners(self, key: str, handler: Callable[[bool], None]) -> Handle:
        """Call ``handler`` when the first listener of ``key`` appears (True) and when the last one leaves (False)."""

    def watch_connected(self, handler: Callable[[bool], None]) -> Handle:
        """Call ``handler`` when the first connection to the bus is made (True) and the last one is lost (False)."""

    async def close(self) -> bool:
        """Leave the bus; False if that hangs: its threads then end with the process."""
