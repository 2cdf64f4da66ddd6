"""The robots of a realm as operators see them: one model for ``ls``, ``top``, ``doctor``, viewers and the console.

It reads what gateways publish of themselves once a second: ``status``, ``control``, ``@gateway/stats``, and their
liveliness tokens. It subscribes to no stream: a subscriber of all keys would switch on every camera.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing
from typing import Any

import msgspec

from zbridge.bus import Answer, Bus, Handle, Sample
from zbridge.client.settled import settled
from zbridge.errors import PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Status
from zbridge.fleet.processes import Stats
from zbridge.fleet.topics import Topic, is_name, split_key
from zbridge.metrics import Count

ROBOTS = 10_000
"""Most robots of a model; further ones are counted."""
SILENT_S = 3.0
"""Seconds after which a gateway that has published nothing is silent: it does so once a second."""
_READ: tuple[Topic, ...] = (topics.STATUS, topics.CONTROL, topics.STATS)
_FIELDS = {topic.path: topic.path.rpartition("/")[2] for topic in _READ}


class RobotEntry(msgspec.Struct):
    """One robot as it was last seen. Times are seconds of the model's clock.

    alive: whether its gateway has a liveliness token. published_at: when the gateway last published something; None if
    only its last values are known, which the bus keeps while the gateway hangs.
    """

    name: str
    alive: bool = False
    status: Status | None = None
    control: Control | None = None
    stats: Stats | None = None
    published_at: float | None = None

    @property
    def driver(self) -> str:
        """Who drives the robot; "" if nobody does."""
        return (self.control.holder or "") if self.control is not None else ""

    @property
    def stopped_by(self) -> str:
        """The latched stops in force, for people; "" if there is none."""
        return "; ".join(latch.described for latch in self.control.latches) if self.control is not None else ""

    @property
    def refused(self) -> int:
        """How many commands were refused lately, as ``control`` shows them."""
        return sum(each.count for each in self.control.refusals) if self.control is not None else 0

    @property
    def missing(self) -> str:
        """Why the robot cannot be used now, for people; "" if it can, or nothing is known yet."""
        if self.status is None or (self.status.state == "established" and self.status.stalled is not True):
            return ""
        if self.status.state == "established":
            return "the robot's link is stalled"
        return f"{self.status.state}: {self.status.reason}" if self.status.reason else self.status.state

    def silent(self, now: float) -> bool:
        """Return whether its gateway has published nothing for :data:`SILENT_S`."""
        return self.published_at is None or now - self.published_at >= SILENT_S


class FleetModel:
    """The robots of a realm, from :meth:`open` to :meth:`close`.

    changed: called with a robot's name after each message of its gateway. clock: seconds. malformed: counts payloads
    that cannot be decoded. lazy: nothing is decoded, and ``changed`` not called, before :meth:`take`: of each key only
    the newest message is read, which a program that draws once a second needs.
    """

    def __init__(
        self,
        bus: Bus,
        realm: str,
        changed: Callable[[str], None] = lambda name: None,
        clock: Callable[[], float] = time.monotonic,
        malformed: Count | None = None,
        lazy: bool = False,
    ) -> None:
        self.robots: dict[str, RobotEntry] = {}
        self.left_out: set[str] = set()
        """Names beyond :data:`ROBOTS`, as many at most."""
        self.malformed = malformed or Count()
        self.clock = clock
        self.opened_at = clock()
        self._bus = bus
        self._realm = realm
        self._changed = changed
        self._lazy = lazy
        self._waiting: dict[str, tuple[Sample, float]] = {}
        """The newest message of each key, and when it came; written by Zenoh's threads."""
        self._handles: list[Handle] = []

    def __repr__(self) -> str:
        return f"<FleetModel {self._realm}, {len(self.robots)} robots>"

    def open(self) -> None:
        """Follow what gateways publish from now on."""
        self.opened_at = self.clock()
        self._handles = [
            self._bus.watch_alive(f"{self._realm}/*/@alive/gateway", self._on_token),
            *(self._subscribe(f"{self._realm}/*/{topic.path}") for topic in _READ),
        ]

    def _subscribe(self, key_expr: str) -> Handle:
        if self._lazy:
            return self._bus.subscribe(key_expr, self._store, direct=True)
        return self._bus.subscribe(key_expr, self._on_sample)

    def _store(self, sample: Sample) -> None:
        if sample.key in self._waiting or len(self._waiting) < len(_READ) * ROBOTS:
            self._waiting[sample.key] = (sample, self.clock())

    def take(self) -> None:
        """Read the messages that came since the call before, of a lazy model."""
        waiting, self._waiting = self._waiting, {}
        for sample, at in list(waiting.values()):  # a thread may still write to it
            self._read(sample, at)

    def close(self) -> None:
        """Follow nothing any more; idempotent."""
        handles, self._handles = self._handles, []
        for handle in handles:
            handle.close()

    async def query(self) -> None:
        """Query the last values, and again while results differ because gateways are joining the bus."""
        await settled(self._query, lambda known: known)

    def silent(self, robot: RobotEntry) -> bool:
        """Return whether a robot's gateway is silent, now that this model has listened for long enough."""
        now = self.clock()
        return robot.silent(now) and now - self.opened_at >= SILENT_S

    async def _query(self) -> frozenset[str] | None:
        """Return the names of all robots; None if one of them has no status yet."""
        tokens = await self._bus.alive(f"{self._realm}/*/@alive/gateway")
        asked = [self._bus.ask(f"{self._realm}/*/{topic.path}") for topic in _READ]
        named = {entry.name for key in tokens if (entry := self._entry(key)) is not None}
        for answers in await asyncio.gather(*asked):
            named |= {name for answer in answers if (name := self._on_answer(answer)) is not None}
        complete = all(self.robots[name].status is not None for name in named)
        return frozenset(named) if complete else None

    def _entry(self, key: str) -> RobotEntry | None:
        """Return the robot of a key; None for an invalid name, or one too many."""
        split = split_key(key)
        if split is None or not is_name(split[1]):
            return None
        entry = self.robots.get(split[1])
        if entry is None and len(self.robots) < ROBOTS:
            entry = self.robots[split[1]] = RobotEntry(split[1])
        elif entry is None and len(self.left_out) < ROBOTS:
            self.left_out.add(split[1])
        return entry

    def _on_token(self, key: str, alive: bool) -> None:
        entry = self._entry(key)
        if entry is not None:
            entry.alive = alive
            self._changed(entry.name)

    def _on_sample(self, sample: Sample) -> None:
        self._read(sample, self.clock())

    def _read(self, sample: Sample, at: float) -> None:
        entry = self._note(sample.key, sample.payload, newer=True)
        if entry is not None:
            entry.published_at = at
            self._changed(entry.name)

    def _on_answer(self, answer: Answer) -> str | None:
        entry = self._note(answer.key, answer.payload, newer=False) if answer.error is None else None
        return entry.name if entry is not None else None

    def _note(self, key: str, payload: bytes, *, newer: bool) -> RobotEntry | None:
        """Keep a message. newer: than what is known; a last value that was queried is not."""
        entry = self._entry(key)
        if entry is None:
            return None
        path = key.partition("/")[2].partition("/")[2]
        field, topic = _FIELDS[path], topics.find(path)
        assert topic is not None
        if newer or getattr(entry, field) is None:
            try:
                message: Any = payloads.decode(topic.message, payload)
            except PayloadError:
                self.malformed.value += 1
                return None
            setattr(entry, field, message)
        return entry


@asynccontextmanager
async def watch(
    bus: Bus,
    realm: str,
    changed: Callable[[str], None] = lambda name: None,
    clock: Callable[[], float] = time.monotonic,
    *,
    lazy: bool = False,
) -> AsyncIterator[FleetModel]:
    """Follow the robots of a realm while the context lasts, with the arguments of :class:`FleetModel`."""
    model = FleetModel(bus, realm, changed, clock, lazy=lazy)
    with closing(model):
        model.open()
        await model.query()
        yield model
