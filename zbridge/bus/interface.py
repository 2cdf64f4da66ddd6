"""What gateways and commands use of the bus: keys, payloads and delivery. Knows neither zenoh nor robots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Annotated, Literal, Protocol

import msgspec

from zbridge.errors import BusError, Refused
from zbridge.fleet.topics import Topic

Connection = Annotated[str, msgspec.Meta(pattern=r"^(tcp|udp|tls|quic|ws|unixsock-stream|serial|vsock)/[^ ]+$")]
"""Where Zenoh listens or connects: ``tcp/127.0.0.1:7447``."""


class Tls(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Files for mutual TLS."""

    ca: str
    certificate: str | None = None
    key: str | None = None


class BusSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ``[bus]`` table of a configuration."""

    mode: Literal["peer", "client", "router"] | None = None
    connect: tuple[Connection, ...] = ()
    listen: tuple[Connection, ...] = ()
    multicast: bool = True
    stream: Literal["drop", "block"] = "drop"
    tls: Tls | None = None

    @property
    def effective_mode(self) -> str:
        """The mode that is used: client when only ``connect`` is given, else peer."""
        return self.mode or ("client" if self.connect and not self.listen else "peer")


class Sample(msgspec.Struct, frozen=True):
    """What came in on a key."""

    key: str
    payload: bytes
    attachment: bytes | None = None


class IncomingQuery(Protocol):
    """A query that waits for its answer; answer or refuse it once.

    key: the one that is answered. asked: what was asked for, perhaps with wildcards.
    """

    key: str
    asked: str
    payload: bytes
    attachment: bytes | None

    def answer(self, payload: bytes) -> None:
        """Reply with a payload."""

    def refuse(self, refusal: Refused) -> None:
        """Reply with an error: its code, and its text."""


class Answer(msgspec.Struct, frozen=True):
    """One reply to a query; ``error`` instead of a payload.

    It is Refused as whoever was asked refused it, or BusError with what else came instead of an answer.
    replier: the id of the session that replied, as the bus says; None where it does not say.
    """

    key: str
    payload: bytes
    error: Refused | BusError | None = None
    replier: str | None = None


class Publisher(Protocol):
    """Writes one key."""

    key: str

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        """Publish as the key's class of delivery says, without blocking; False asks to pause the source."""

    def close(self) -> None:
        """Give the key up; idempotent."""


class Handle(Protocol):
    """Something declared on the bus."""

    def close(self) -> None:
        """Take it back; idempotent."""


Batch = Sequence[tuple[Publisher, list[bytes]]]
"""What was published together: for each key its payloads in order."""


class Lane(IntEnum):
    """What waits for the event loop, in the order it is served; each lane has its own bound and its own share."""

    STOP = 0
    COMMAND = 1
    OTHER = 2


Look = Callable[[], bytes]
"""Gives the payload that an authorization proves; of a question, whose payload the authorization is, none."""
Sort = Callable[[str, bytes | None, int, Look], Lane | None]
"""Chooses a lane, or drops what came (None) and counts it; called on the bus's own threads: quick and sure.

Arguments: the key (of a question what was asked, perhaps with wildcards), the attachment of a sample or the payload of
a question, the bytes of payload and attachment together, and a look at the payload.
"""


class Bus(Protocol):
    """What gateways and commands use of Zenoh. Handlers are called on the event loop's thread."""

    @property
    def zid(self) -> str:
        """The id of this session on the bus."""

    def publisher(self, key: str, topic: Topic) -> Publisher:
        """Declare that ``key`` will be written."""

    def put_all(self, batch: Batch) -> bool:
        """Publish stream messages in order; False asks to pause the source until the relief handler is called."""

    def on_relief(self, handler: Callable[[], None]) -> None:
        """Call ``handler`` when a source that was asked to pause may go on."""

    def subscribe(
        self,
        key_expr: str,
        handler: Callable[[Sample], None],
        *,
        lane: Lane | Sort = Lane.OTHER,
        history: bool = False,
    ) -> Handle:
        """Take samples by way of a lane; ``history`` asks for last values too.

        Of those that a Sort sends by the lane STOP only one waits: what comes meanwhile is the same stop.
        """

    def answer(self, key: str, handler: Callable[[IncomingQuery], None], *, lane: Lane | Sort = Lane.OTHER) -> Handle:
        """Answer queries that ask for ``key``, with or without wildcards; the last chunk of ``key`` may be one."""

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        """Query ``key_expr`` and collect the replies that come within ``timeout_s``, as far as they are no flood."""

    def attend(self) -> None:
        """Hand over the stops and the holder's commands that wait: to be called in the midst of long work."""

    def announce(self, key: str) -> Handle:
        """Declare a liveliness token."""

    async def alive(self, key_expr: str, *, timeout_s: float = 0.5) -> list[str]:
        """List the liveliness tokens that exist."""

    def watch_alive(self, key_expr: str, handler: Callable[[str, bool], None]) -> Handle:
        """Be told the key of every liveliness token there is or comes (True), and of each that goes (False)."""

    async def flush(self) -> None:
        """Wait until what may block, streams apart, is with the bus; raise BusError where that takes too long."""

    def frames(self, key: str, listened: Callable[[bool], None]) -> Publisher:
        """Declare a key for raw frames; ``listened`` is told when the first listener comes and the last one goes."""

    def watch_listeners(self, key: str, handler: Callable[[bool], None]) -> Handle:
        """Be told when the first listener of ``key`` comes and when the last one goes."""

    def watch_connected(self, handler: Callable[[bool], None]) -> Handle:
        """Be told when the first connection to the bus is made and when the last one is gone."""

    async def close(self) -> bool:
        """Leave the bus; False where that hangs, and its threads must be left to the end of the process."""
