"""The thread that writes what may block, so that the event loop never does. Knows no zenoh."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

from zbridge.metrics import Metrics

log = logging.getLogger("zbridge.bus")

CALLS = 4096
"""Calls that may wait; one more is dropped and counted."""
BACKLOG = 20_000
"""Messages that may wait in batches before their source is asked to pause."""

Call = Callable[[], None]


class Writer:
    """Carries out calls in order. States wait by key and the newest wins; batches wait behind both.

    ``relieved`` is called, on the writing thread, when a source that was asked to pause may go on.
    """

    def __init__(self, name: str, metrics: Metrics, relieved: Call) -> None:
        self._relieved = relieved
        self._states: dict[str, Call] = {}
        self._calls: deque[Call] = deque()
        self._batches: deque[tuple[Call, int]] = deque()
        self._backlog = 0
        self._full = False
        self._stopping = False
        self._wake = threading.Condition()
        self._dropped = metrics.count("bus_out_dropped", writer=name)
        self._thread = threading.Thread(target=self._run, name=f"zbridge-{name}", daemon=True)
        self._thread.start()

    def state(self, key: str, put: Call) -> None:
        """Write a state; one of the same key that still waits is forgotten."""
        with self._wake:
            self._states[key] = put
            self._wake.notify()

    def call(self, call: Call) -> None:
        """Carry out a call; dropped and counted when too many wait."""
        with self._wake:
            if len(self._calls) >= CALLS:
                self._dropped.value += 1
                return
            self._calls.append(call)
            self._wake.notify()

    def batch(self, call: Call, size: int) -> bool:
        """Carry out a call that writes ``size`` messages; False asks to pause the source."""
        with self._wake:
            self._batches.append((call, size))
            self._backlog += size
            self._full = self._full or self._backlog > BACKLOG
            self._wake.notify()
            return not self._full

    def stop(self, timeout_s: float = 0.5) -> None:
        """Finish what waits, for at most ``timeout_s`` seconds."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._wake:
                while not (self._calls or self._states or self._batches or self._stopping):
                    self._wake.wait()
                if not (self._calls or self._states or self._batches):
                    return
                calls = [*self._calls, *self._states.values()]
                self._calls.clear()
                self._states.clear()
                batch = self._batches.popleft() if self._batches else None
            for call in calls:
                self._carry_out(call)
            if batch is not None:
                self._carry_out(batch[0])
                self._written(batch[1])

    def _carry_out(self, call: Call) -> None:
        try:
            call()
        except Exception as error:
            self._dropped.value += 1
            log.debug("not written to the bus: %s", error)

    def _written(self, size: int) -> None:
        with self._wake:
            self._backlog -= size
            relieved = self._full and self._backlog < BACKLOG // 2
            self._full = self._full and not relieved
        if relieved:
            self._relieved()
