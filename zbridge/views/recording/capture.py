"""Subscribes to robots as any viewer does, and gives a recorder all that is published; publishes marks.

Theory of operation. Each key expression has one subscription, whose samples the bus's own thread puts into the intake:
they never wait for the event loop. When a robot's gateway appears its states are queried, since those that it
published before are not repeated; an answer older than what came live meanwhile is left out. Session tables are queried
every :data:`SESSIONS_S`. Tokens that come and go are recorded as ``Alive``.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable

import msgspec

from zbridge.bus import Bus, PriorityClass, ReadPayload, Sample
from zbridge.errors import BusError, ConfigError
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Text
from zbridge.fleet.topics import LARGE_BYTES, Delivery, Topic, split_key
from zbridge.views.recording.contents import Alive
from zbridge.views.recording.intake import Intake

SESSIONS_S = 10.0
"""Seconds between two queries for the session tables."""
QUERY_AFTER_S = (0.0, 0.1, 0.4, 1.5)
"""Seconds before each query for the states of a robot that does not answer."""
QUERIED_AT_ONCE = 256
"""Robots that are queried at the same time."""
LIVE_KEYS = 4096
"""Keys that are noted as live while robots are queried."""


class RecordPlan(msgspec.Struct, frozen=True):
    """What is recorded. robots: their names; empty: all. keys: a key expression instead. wire: raw frames too."""

    realm: str = "fleet"
    robots: tuple[str, ...] = ()
    keys: str | None = None
    wire: bool = False

    @property
    def key_exprs(self) -> tuple[str, ...]:
        """The key expressions that are subscribed to; no key matches two of them."""
        if self.keys is not None:
            return (self.keys,)
        parts = ("**", "@cmd/**", *(("@wire/**",) if self.wire else ()))
        below = [f"{self.realm}/{robot}/{part}" for robot in self.robots or ("*",) for part in parts]
        if not self.robots:
            below[0] = f"{self.realm}/**"  # as access rules allow it
        return (*below, f"{self.realm}/@mark")

    @property
    def names(self) -> tuple[str, ...]:
        """The robots' names, or a wildcard; none where a key expression is recorded."""
        return () if self.keys is not None else self.robots or ("*",)


class BusCapture:
    """Gives an intake what the bus carries, from :meth:`open` to :meth:`close`."""

    def __init__(self, bus: Bus, plan: RecordPlan, intake: Intake) -> None:
        self._bus = bus
        self._plan = plan
        self._intake = intake
        self._querying: dict[str, asyncio.Task[None]] = {}
        self._live: set[str] = set()
        self._sessions: asyncio.Task[None] | None = None

    def __repr__(self) -> str:
        return f"<BusCapture {self._plan.key_exprs}>"

    def open(self) -> None:
        """Subscribe."""
        bus, plan = self._bus, self._plan
        for key_expr in plan.key_exprs:
            bus.subscribe(key_expr, self._store, priority=self._receive)
        for name in plan.names:
            bus.watch_alive(f"{plan.realm}/{name}/@alive/*", self._on_token)
        if plan.names:
            self._sessions = asyncio.get_running_loop().create_task(self._query_sessions())

    def close(self) -> None:
        """Take nothing more; idempotent. The bus unsubscribes at its end, within bounds: here a session could hang."""
        self._intake.close()
        for task in (*self._querying.values(), *((self._sessions,) if self._sessions else ())):
            task.cancel()
        self._querying.clear()

    def _receive(
        self, key: str, attachment: bytes | None, size: int, read_payload: ReadPayload
    ) -> PriorityClass | None:
        """Store a sample; on Zenoh's threads. The intake counts what it drops."""
        self._intake.put_sized(key, size, read_payload, attachment)
        if self._querying and len(self._live) < LIVE_KEYS:
            self._live.add(key)
        return None

    def _store(self, sample: Sample) -> None:
        """Store a sample of a bus that has no priorities."""
        self._receive(sample.key, sample.attachment, len(sample.payload), lambda: sample.payload)

    def _on_token(self, key: str, alive: bool) -> None:
        self._intake.put(key, payloads.encode(Alive(alive=alive)))
        split = split_key(key)
        if split is None or split[2] != "@alive/gateway":
            return
        querying = self._querying.pop(split[1], None)
        if querying is not None:
            querying.cancel()
        if alive and len(self._querying) < QUERIED_AT_ONCE:
            self._querying[split[1]] = asyncio.get_running_loop().create_task(self._query_states(split[1]))

    async def _query_states(self, robot: str) -> None:
        for after_s in QUERY_AFTER_S:
            await asyncio.sleep(after_s)
            if await self._query(f"{self._plan.realm}/{robot}/*", lambda key: key not in self._live):
                break
        self._querying.pop(robot, None)
        if not self._querying:
            self._live.clear()

    async def _query_sessions(self) -> None:
        while True:
            for name in self._plan.names:
                await self._query(f"{self._plan.realm}/{name}/@rpc/sessions/*", lambda key: True)
            await asyncio.sleep(SESSIONS_S)

    async def _query(self, key_expr: str, wanted: Callable[[str], bool]) -> bool:
        """Record the answers of a query; False if nobody answered."""
        answers = []
        with contextlib.suppress(BusError):
            answers = [answer for answer in await self._bus.ask(key_expr) if answer.error is None]
        for answer in answers:
            if wanted(answer.key):
                self._intake.put(answer.key, answer.payload)
        return bool(answers)


MARK = Topic("@mark", Text, Delivery.COMMAND, LARGE_BYTES)
"""Delivered as a command is: a mark that waits for room is not dropped."""
TEXT_BYTES = 4096


async def publish_mark(bus: Bus, realm: str, text: str, who: str) -> None:
    """Put a mark; raise ConfigError if the text is empty or too long, BusError if the bus is stalled."""
    if not text.strip() or len(text.encode()) > TEXT_BYTES:
        raise ConfigError(f"TEXT: expected 1 to {TEXT_BYTES} bytes")
    mark = Text(text=text, kind="chat", sender=who, stamp_ns=time.time_ns())
    with contextlib.closing(bus.publisher(f"{realm}/{MARK.path}", MARK)) as publisher:
        publisher.put(payloads.encode(mark))
        await bus.flush()
