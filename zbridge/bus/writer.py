"""A thread that writes what may block, so that the event loop never does. Knows no zenoh."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

from zbridge.metrics import Metrics

log = logging.getLogger("zbridge.bus")

BACKLOG = 4096
"""How much may wait: each message counts one, and one more for every 256 bytes of a state."""

Call = Callable[[], None]


class Writer:
    """Carries out calls in order, within :data:`BACKLOG`.

    Where that is not enough, a ``lossless`` writer asks to pause the source, and calls ``relieved`` (on its own
    thread) when it may go on; any other forgets the oldest call and counts it: the newest wins.
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
        self._wake = threading.Condition()
        self._dropped = metrics.count("bus_out_dropped", writer=name)
        self._replaced = metrics.count("bus_out_replaced", writer=name)
        self._thread = threading.Thread(target=self._run, name=f"zbridge-{name}", daemon=True)
        self._thread.start()

    def put(self, call: Call, size: int = 1) -> bool:
        """Carry out a call of ``size`` messages; False asks to pause the source."""
        with self._wake:
            if self._ended:
                self._dropped.value += size
                return True
            self._jobs.append((call, size))
            self._backlog += size
            if self._lossless:
                self._full = self._full or self._backlog > BACKLOG
            else:
                self._forget_oldest()
            self._wake.notify()
            return not self._full

    def replace(self, key: str, call: Call, size: int = 1) -> bool:
        """Carry out a call unless a newer one of the same key comes first; a lossless writer does every one."""
        if self._lossless:
            return self.put(call, size)
        with self._wake:
            if self._ended:
                self._dropped.value += 1
                return True
            if key in self._latest:
                self._replaced.value += 1
            self._latest[key] = call
            self._wake.notify()
            return True

    def stop(self, timeout_s: float = 0.5) -> None:
        """Finish what waits, for at most ``timeout_s`` seconds."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join(timeout_s)

    def _forget_oldest(self) -> None:
        while self._backlog > BACKLOG and len(self._jobs) > 1:
            _, size = self._jobs.popleft()
            self._backlog -= size
            self._dropped.value += size

    def _run(self) -> None:
        while True:
            with self._wake:
                while not (self._jobs or self._latest or self._stopping):
                    self._wake.wait()
                if not (self._jobs or self._latest):
                    self._ended = True
                    return
                latest = list(self._latest.values())
                self._latest.clear()
                job = self._jobs.popleft() if self._jobs else None
            for call in latest:
                self._carry_out(call, 1)
            if job is not None:
                self._carry_out(*job)
                self._written(job[1])

    def _carry_out(self, call: Call, size: int) -> None:
        try:
            call()
        except Exception as error:
            self._dropped.value += size
            log.debug("not written to the bus: %s", error)

    def _written(self, size: int) -> None:
        with self._wake:
            self._backlog -= size
            relieved = self._full and self._backlog < BACKLOG // 2
            self._full = self._full and not relieved
        if relieved:
            self._relieved()
