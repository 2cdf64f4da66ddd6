"""A thread that makes the calls that may block, so that the event loop never does. Knows no zenoh.

Theory of operation. :meth:`Writer.put` queues a call, in order and bounded by :data:`BACKLOG`; :meth:`Writer.replace`
keeps one call for each key, the newest. The thread makes all calls by key, then one queued call, and starts over. If
calls are queued faster than the thread makes them, a lossy writer drops the oldest and counts it; a ``lossless`` writer
keeps all, and asks its callers to pause until half of the backlog is free. For a single message, waking a thread costs
more than the call itself: :meth:`Writer.put_at_once` makes a small call on the caller's thread while the bus accepts
everything.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from queue import SimpleQueue

from zbridge.log import Log
from zbridge.metrics import Metrics

log = Log("zbridge.bus")

BACKLOG = 4096
"""Most messages that wait: a message counts one, a state one more for every 256 bytes."""

AT_ONCE = 4
"""Most messages of a call that is made on the caller's thread."""
SLOW_S = 0.002
"""A call that takes longer than this met a full bus, seconds."""
WARY_S = 1.0
"""Seconds after a slow call during which none is made on the caller's thread."""

Call = Callable[[], object]


class Writer:
    """Makes calls in order, within :data:`BACKLOG`.

    lossless: ask to pause the source instead of dropping the oldest call. relieved: called on the writer's thread when
    a paused source may resume. name: the label of the counters.
    """

    def __init__(self, name: str, metrics: Metrics, *, lossless: bool, relieved: Call) -> None:
        self._lossless = lossless
        self._relieved = relieved
        self._latest: dict[str, Call] = {}
        self._jobs: deque[tuple[Call, int]] = deque()
        self._backlog = 0
        self._full = False
        self._stopping = False
        self._ended = False
        self._wary_until = 0.0
        self._lock = threading.Lock()
        self._bell: SimpleQueue[None] = SimpleQueue()
        self._rung = False
        self._dropped = metrics.count("bus_dropped", queue=f"bus_out_{name}")
        self._replaced = metrics.count("bus_replaced", queue=f"bus_out_{name}")
        self._thread = threading.Thread(target=self._run, name=f"zbridge-{name}", daemon=True)
        self._thread.start()

    @property
    def length(self) -> int:
        """How many messages wait."""
        return self._backlog + len(self._latest)

    def put(self, call: Call, size: int = 1) -> bool:
        """Queue a call of ``size`` messages; False asks to pause the source."""
        with self._lock:
            if self._ended:
                self._dropped.value += size
                return True
            self._jobs.append((call, size))
            self._backlog += size
            if self._lossless:
                self._full = self._full or self._backlog > BACKLOG
            else:
                self._forget_oldest()
            self._ring()
            return not self._full

    def put_at_once(self, call: Call, size: int) -> bool:
        """Make a lossy call now if it is small, nothing waits and the bus is not full; else queue it as :meth:`put`.

        The calls of one key must come from one thread, or their order is lost. A call blocks at most as long as Zenoh
        waits for room, and then not again for :data:`WARY_S`.
        """
        if self._lossless or self._backlog or size > AT_ONCE or self._stopping or time.monotonic() < self._wary_until:
            return self.put(call, size)
        begun = time.monotonic()
        self._carry_out(call, size)
        ended = time.monotonic()
        if ended - begun > SLOW_S:
            self._wary_until = ended + WARY_S
        return True

    def replace(self, key: str, call: Call, size: int = 1) -> bool:
        """Queue a call in place of an older one of the same key; a lossless writer makes every call."""
        return self.put(call, size) if self._lossless else self.newest(key, call)

    def newest(self, key: str, call: Call) -> bool:
        """Queue a call in place of an older one of the same key, of a lossless writer too."""
        with self._lock:
            if self._ended:
                self._dropped.value += 1
                return True
            if key in self._latest:
                self._replaced.value += 1
            self._latest[key] = call
            self._ring()
            return True

    def stop(self, timeout_s: float = 0.5) -> None:
        """Make the calls that wait, for at most ``timeout_s`` seconds, and end the thread."""
        with self._lock:
            self._stopping = True
            self._ring()
        self._thread.join(timeout_s)

    def _forget_oldest(self) -> None:
        while self._backlog > BACKLOG and len(self._jobs) > 1:
            _, size = self._jobs.popleft()
            self._backlog -= size
            self._dropped.value += size

    def _ring(self) -> None:
        """Wake the thread, once. A queue does it several times faster than a condition variable."""
        if not self._rung:
            self._rung = True
            self._bell.put(None)

    def _run(self) -> None:
        while True:
            self._bell.get()
            self._rung = False
            while self._work():
                pass
            with self._lock:
                if self._stopping and not (self._jobs or self._latest):
                    self._ended = True
                    return

    def _work(self) -> bool:
        """Make all calls by key and the oldest queued call; False if there was none."""
        with self._lock:
            latest = list(self._latest.values())
            self._latest.clear()
            job = self._jobs.popleft() if self._jobs else None
        for call in latest:
            self._carry_out(call, 1)
        if job is not None:
            self._carry_out(*job)
            self._written(job[1])
        return job is not None or bool(latest)

    def _carry_out(self, call: Call, size: int) -> None:
        try:
            call()
        except Exception as error:
            self._dropped.value += size
            log.debug("bus_write_failed", "not written to the bus: {error}", error=error)

    def _written(self, size: int) -> None:
        with self._lock:
            self._backlog -= size
            relieved = self._full and self._backlog < BACKLOG // 2
            self._full = self._full and not relieved
        if relieved:
            self._relieved()
