"""What the robots publish that pages look at: of each key the newest message, and the last texts.

Theory of operation. A :class:`RobotWatch` exists while at least one page looks at its robot; only then does the console
subscribe to the robot's streams, because a subscription switches on its camera. Messages are not decoded: pages get the
payloads as they are on the bus. Each message gets a number; a page asks for what is newer than the last number it got
(:meth:`RobotWatch.news`), as often as its socket allows. So nothing waits for a slow page, and a page that was away
gets the newest of each key only.

Guarantees. At most :data:`KEYS` keys, :data:`TEXTS` texts and :data:`TEXT_BYTES` of texts are kept of a robot.
Ages are right however long a message was on its way to the page: each has the time at which the console received it.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from statistics import median

import msgspec

from zbridge.bus import Bus, Handle, Sample
from zbridge.errors import BusError
from zbridge.fleet import topics
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics
from zbridge.tasks import Tasks

KEYS = 512
"""Most keys of a robot whose newest message is kept; further ones are counted."""
TEXTS = 100
"""Most texts that are kept."""
TEXT_BYTES = 262_144
"""Most bytes of the texts that are kept."""
SESSIONS_EVERY_S = 3.0
"""Seconds between two queries for the sessions of the robot's processes."""
SESSIONS_PATH, HISTORY_PATH = "@sessions", "@history"
"""Paths of what no key of the robot has: its processes' answers by name, and the history of its control."""
_PERIODS = 8
"""Periods whose median is the period of a key."""
_ANSWERS = 64
"""Most processes whose sessions are shown."""
_encode = msgspec.msgpack.Encoder().encode


class _Newest(msgspec.Struct):
    """The newest message of a key. came_s: when the last ones came."""

    number: int
    payload: bytes
    came_s: deque[float]

    @property
    def period_s(self) -> float:
        """The median of the last periods: one pause is not the period from now on. 0 if there was none yet."""
        periods = [later - earlier for earlier, later in pairwise(self.came_s)]
        return median(periods) if periods else 0.0


class _KeptText(msgspec.Struct, frozen=True):
    number: int
    payload: bytes
    came_s: float


class RobotWatch:
    """One robot, while pages look at it. history: returns its control history as a payload. clock: seconds."""

    def __init__(
        self,
        bus: Bus,
        keys: KeySpace,
        history: Callable[[], bytes],
        metrics: Metrics,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.robot = keys.robot
        self.pages = 0
        """How many pages look at it."""
        self._bus = bus
        self._keys = keys
        self._history = history
        self._left_out = metrics.count("console_keys_left_out")
        self._clock = clock
        self._number = 0
        self._newest: dict[str, _Newest] = {}
        """By path, that which changed last at the end."""
        self._texts: deque[_KeptText] = deque()
        self._text_bytes = 0
        self._handles: list[Handle] = []
        self._work = Tasks()

    def __repr__(self) -> str:
        return f"<RobotWatch {self._keys.robot}, {len(self._newest)} keys, {self.pages} pages>"

    def open(self) -> None:
        """Subscribe to all that the robot publishes, and query its last states and its sessions."""
        for path in ("*", "sensor/*", topics.STATS.path):
            self._handles.append(self._bus.subscribe(self._keys.key(path), self._take, history=True))
        self.note_history()
        self._work.start(self._follow_sessions())

    def close(self) -> None:
        """Unsubscribe; idempotent."""
        self._work.cancel()
        while self._handles:
            self._handles.pop().close()

    def news(self, since: int) -> tuple[int, bytes | None]:
        """Return the number of the newest message, and what is newer than ``since`` as a payload; None: nothing is.

        The payload is a map: ``robot``; ``now``, seconds of the console's clock; ``news``: path, when it came, its
        period (0: unknown), both in seconds, and payload of each message.
        """
        if since >= self._number:
            return since, None
        news: list[tuple[str, float, float, bytes]] = []
        for path, newest in reversed(self._newest.items()):
            if newest.number <= since:
                break
            news.append((path, newest.came_s[-1], newest.period_s, newest.payload))
        news += [(topics.TEXT.path, text.came_s, 0.0, text.payload) for text in self._texts if text.number > since]
        return self._number, _encode({"robot": self._keys.robot, "now": self._clock(), "news": news})

    def note_history(self) -> None:
        """Pass on the control history, which has changed."""
        self._keep(HISTORY_PATH, self._history())

    def _take(self, sample: Sample) -> None:
        path = self._keys.path(sample.key)
        if path == topics.TEXT.path:
            self._keep_text(sample.payload)
        else:
            self._keep(path, sample.payload)

    def _keep(self, path: str, payload: bytes) -> None:
        newest = self._newest.pop(path, None)
        if newest is None:
            if len(self._newest) >= KEYS:
                self._left_out.value += 1
                return
            newest = _Newest(0, b"", deque(maxlen=_PERIODS + 1))
        self._number += 1
        newest.number, newest.payload = self._number, payload
        newest.came_s.append(self._clock())
        self._newest[path] = newest

    def _keep_text(self, payload: bytes) -> None:
        self._number += 1
        self._texts.append(_KeptText(self._number, payload, self._clock()))
        self._text_bytes += len(payload)
        while len(self._texts) > TEXTS or (self._text_bytes > TEXT_BYTES and len(self._texts) > 1):
            self._text_bytes -= len(self._texts.popleft().payload)

    async def _follow_sessions(self) -> None:
        while True:
            tables: dict[str, bytes] = {}
            with contextlib.suppress(BusError):
                for answer in (await self._bus.ask(self._keys.key("@rpc/sessions/*")))[:_ANSWERS]:
                    if answer.error is None:
                        tables[answer.key.rpartition("/")[2]] = answer.payload
            self._keep(SESSIONS_PATH, _encode(tables))
            await asyncio.sleep(SESSIONS_EVERY_S)


class RobotWatches:
    """The robots that pages look at. history: returns the control history of a robot as a payload."""

    def __init__(self, bus: Bus, realm: str, history: Callable[[str], bytes], metrics: Metrics) -> None:
        self.watched: dict[str, RobotWatch] = {}
        self._bus = bus
        self._realm = realm
        self._history = history
        self._metrics = metrics

    def __repr__(self) -> str:
        return f"<RobotWatches {sorted(self.watched)}>"

    def join(self, robot: str) -> RobotWatch:
        """Return the watch of a robot for one more page, which must call :meth:`leave`."""
        watch = self.watched.get(robot)
        if watch is None:
            keys = KeySpace(self._realm, robot)
            watch = RobotWatch(self._bus, keys, lambda: self._history(robot), self._metrics)
            self.watched[robot] = watch
            watch.open()
        watch.pages += 1
        return watch

    def leave(self, robot: str) -> None:
        """Drop the watch of a robot for one page; the last one ends it."""
        watch = self.watched[robot]
        watch.pages -= 1
        if not watch.pages:
            del self.watched[robot]
            watch.close()

    def history_changed(self, robot: str) -> None:
        """Show the pages that look at a robot what has happened to its control."""
        if (watch := self.watched.get(robot)) is not None:
            watch.note_history()
