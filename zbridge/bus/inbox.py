"""Carries what the bus's own threads bring to the event loop. Knows no zenoh."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import Callable
from typing import Any

from zbridge.metrics import Metrics

log = logging.getLogger("zbridge.bus")

LANE = 4096
"""Items that may wait for the event loop in each lane; the oldest makes room."""
_DRAIN = 256

Handler = Callable[[Any], None]
Read = Callable[[Any], Any]


class Inbox:
    """Carries what Zenoh's threads bring to the event loop: two bounded lanes, one wake-up per batch."""

    def __init__(self, loop: asyncio.AbstractEventLoop, metrics: Metrics) -> None:
        self._loop = loop
        self._first: deque[tuple[Handler, Any, Read]] = deque()
        self._other: deque[tuple[Handler, Any, Read]] = deque()
        self._awake = False
        self._dropped = metrics.count("bus_in_dropped")

    def put(self, handler: Handler, raw: Any, read: Read, *, first: bool) -> None:
        lane = self._first if first else self._other
        if len(lane) >= LANE:
            with contextlib.suppress(IndexError):
                lane.popleft()
            self._dropped.value += 1
        lane.append((handler, raw, read))
        if not self._awake:
            self._awake = True
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._drain)

    def _drain(self) -> None:
        self._awake = False
        for _ in range(_DRAIN):
            lane = self._first or self._other
            if not lane:
                return
            handler, raw, read = lane.popleft()
            try:
                handler(read(raw))
            except Exception:
                log.exception("a handler failed")
        if not self._awake:
            self._awake = True
            self._loop.call_soon(self._drain)
