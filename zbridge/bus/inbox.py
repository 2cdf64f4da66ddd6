"""Carries input from Zenoh's threads to the event loop. Knows no zenoh.

Theory of operation. Every subscription and every queryable has a :class:`Source`, with one bounded queue for each
priority class it uses: a flood of one source fills no other's queue. Only COMMAND has one queue for all sources: the
holder's commands and queries keep their order, and a release must not overtake the neutral before it. A queue that has
items is listed in the line of its class. The event loop is woken once per batch. A batch serves the classes by
priority, one item of each listed queue in turn, and of each class no more than its share: a stop waits for one item at
most, and a class that never empties leaves the others their share. The rest is served after the loop has served sockets
and timers.

Several threads fill a queue and the loop's thread empties it, without a lock: every step is one operation of a deque,
and an item is added before its queue is listed. A queue that is listed twice is harmless.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from zbridge.bus.interface import PriorityClass
from zbridge.log import Log, current_robot
from zbridge.metrics import Count, Histogram, Metrics

log = Log("zbridge.bus")

QUEUE = 4096
"""Items of one source and one priority class that may wait; one more drops the oldest."""
QUEUE_BYTES = 4 * 2**20
"""Bytes of one source's items of one priority class that may wait; more drop the oldest."""
SHARES = {PriorityClass.STOP: 64, PriorityClass.LATCH: 64, PriorityClass.COMMAND: 128, PriorityClass.OTHER: 64}
"""Items of each priority class that one batch serves at most."""

_OTHER = PriorityClass.OTHER
"""Of all other classes is measured how long their items wait and are handled."""

Handler = Callable[[Any], None]
Read = Callable[[Any], Any]


class Inbox:
    """Serves the queues of all sources by priority, on the event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop, metrics: Metrics) -> None:
        self._loop = loop
        self._lines: dict[PriorityClass, deque[_Queue]] = {priority: deque() for priority in PriorityClass}
        self.commands = _Queue()
        self._awake = False
        self._dropped = metrics.count("bus_dropped", queue="bus_in")
        self._folded = metrics.count("bus_stops_folded")
        self._metrics = metrics
        self._robot = current_robot.get()
        """Of the gateway that made this, where several share a process: an inbox also serves those of the others."""
        self._handled: Histogram | None = None
        """From arrival until the handler has returned; made with the first command."""

    def source(self, handler: Handler, read: Read | None = None) -> Source:
        """Make the source of one subscription or queryable.

        read: converts each item for the handler, on the event loop's thread; None: the handler gets the item itself.
        """
        return Source(self, handler, read, self._dropped, self._folded)

    @property
    def length(self) -> int:
        """How many items wait, about."""
        return sum(len(queue.items) for line in self._lines.values() for queue in set(line))

    def attend(self) -> None:
        """Serve the stops and commands that wait, and nothing else."""
        self._serve({**SHARES, PriorityClass.OTHER: 0})

    def line_up(self, queue: _Queue, priority: PriorityClass) -> None:
        """List a queue in the line of its priority class and wake the loop; from any thread."""
        if not queue.listed:
            queue.listed = True
            self._lines[priority].append(queue)
        if not self._awake:
            self._awake = True
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._drain)

    def _drain(self) -> None:
        self._awake = False
        self._serve(dict(SHARES))
        if any(self._lines.values()) and not self._awake:
            self._awake = True
            self._loop.call_soon(self._drain)

    def _serve(self, shares: dict[PriorityClass, int]) -> None:
        """Serve one item after the other, always of the highest priority that has items and share left."""
        lines = tuple(self._lines.items())
        while True:
            for priority, line in lines:
                if line and shares[priority]:
                    shares[priority] -= 1
                    self._serve_one(line)
                    break
            else:
                return

    def _serve_one(self, line: deque[_Queue]) -> None:
        queue = line.popleft()
        queue.listed = False  # before the item is taken: a later item lists the queue again
        try:
            source, raw, size, at = queue.items.popleft()
        except IndexError:  # the queue was listed twice, or its items were dropped
            return
        queue.taken += size
        if queue.items and not queue.listed:
            queue.listed = True
            line.append(queue)
        serving = current_robot.set(self._robot) if self._robot else None
        try:
            source.handler(raw if source.read is None else source.read(raw))
        except Exception:
            log.exception("handler_failed", "a handler failed")
        finally:
            if serving is not None:
                current_robot.reset(serving)
        if at:
            if self._handled is None:
                self._handled = self._metrics.histogram("bus_to_socket_seconds")
            self._handled.observe(time.monotonic() - at)


class Source:
    """The input of one subscription or queryable."""

    def __init__(self, inbox: Inbox, handler: Handler, read: Read | None, dropped: Count, folded: Count) -> None:
        self.handler = handler
        self.read = read
        self._inbox = inbox
        self._dropped = dropped
        self._folded = folded
        self._queues = {
            priority: inbox.commands if priority is PriorityClass.COMMAND else _Queue() for priority in PriorityClass
        }

    def __repr__(self) -> str:
        waiting = ", ".join(
            f"{len(queue.items)} {priority.name}" for priority, queue in self._queues.items() if queue.items
        )
        return f"<Source {waiting or 'empty'}>"

    def put(self, raw: Any, priority: PriorityClass, size: int = 0) -> None:
        """Queue an item of ``size`` bytes for the loop, from any thread; drop and count the oldest if it is full."""
        queue = self._queues[priority]
        while queue.items and (len(queue.items) >= QUEUE or queue.bytes + size > QUEUE_BYTES):
            with contextlib.suppress(IndexError):  # the loop was quicker
                queue.forgotten += queue.items.popleft()[2]
            self._dropped.value += 1
        queue.added += size
        queue.items.append((self, raw, size, 0.0 if priority is _OTHER else time.monotonic()))
        self._inbox.line_up(queue, priority)

    def fold(self, raw: Any, priority: PriorityClass) -> None:
        """Queue an item unless one already waits: both are the same, and the new one is counted."""
        queue = self._queues[priority]
        if queue.items:
            self._folded.value += 1
        else:
            queue.items.append((self, raw, 0, 0.0 if priority is _OTHER else time.monotonic()))
        self._inbox.line_up(queue, priority)


class _Queue:
    """Items of one priority class, of one source or of all. Each side counts bytes of its own, without a lock."""

    def __init__(self) -> None:
        self.listed = False
        self.items: deque[tuple[Source, Any, int, float]] = deque()
        """Source, item, bytes, and when it arrived if that is measured."""
        self.added = 0
        """Bytes that were added, as of the threads that add; so is ``forgotten``."""
        self.forgotten = 0
        self.taken = 0
        """Bytes that were taken, as of the loop's thread."""

    @property
    def bytes(self) -> int:
        """Bytes that wait."""
        return self.added - self.forgotten - self.taken
