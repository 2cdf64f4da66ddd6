"""The thread of a process that writes black boxes: all of them, once a second, so that no event loop waits for a disk.

A disk that hangs holds up all black boxes of the process, and nothing else.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

PERIOD_S = 1.0
"""Seconds between two rounds."""
Job = Callable[[], None]


class DiskThread:
    """Does jobs in rounds, and calls once, while there are any; the thread exists only then."""

    def __init__(self, period_s: float = PERIOD_S) -> None:
        self._period_s = period_s
        self._jobs: list[Job] = []
        self._calls: deque[Job] = deque()
        self._idle = threading.Event()
        self._idle.set()
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._thread: threading.Thread | None = None

    def __repr__(self) -> str:
        return f"<DiskThread of {len(self._jobs)} jobs>"

    def add(self, job: Job) -> None:
        """Do a job in each round from now on; it must not raise."""
        with self._lock:
            self._jobs.append(job)
            self._start()

    def remove(self, job: Job) -> None:
        """Do it no more; idempotent."""
        with self._lock:
            if job in self._jobs:
                self._jobs.remove(job)

    def call(self, work: Job) -> None:
        """Do something once, soon; it must not raise."""
        with self._lock:
            self._calls.append(work)
            self._start()
        self._wake.set()

    def settle(self, within_s: float) -> bool:
        """Wait so long until there are no jobs; return whether that is so."""
        return self._idle.wait(within_s)

    def wake(self) -> None:
        """Begin a round now."""
        self._wake.set()

    def _start(self) -> None:
        self._idle.clear()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="zbridge-blackbox", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        while True:
            self._wake.wait(self._period_s)
            self._wake.clear()
            for job in tuple(self._jobs):
                job()
            while self._calls:
                self._calls.popleft()()
            with self._lock:
                if not self._jobs and not self._calls:
                    self._thread = None
                    self._idle.set()
                    return


DISK = DiskThread()
"""The thread of this process."""
