"""Carries what the bus's own threads bring to the event loop. Knows no zenoh."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import Callable
from typing import Any

from zbridge.bus.interface import Lane
from zbridge.metrics import Metrics

log = logging.getLogger("zbridge.bus")

LANE = 4096
"""Items that may wait for the event loop in each lane; the oldest makes room."""
_DRAIN = 256

Handler = Callable[[Any], None]
Read = Callable[[Any], Any]


class Inbox:
    """A bounded queue per lane, emptied in the order of the lanes; the loop is woken once per batch."""

    def __init__(self, loop: asyncio.AbstractEventLoop, metrics: Metrics) -> None:
        self._loop = loop
        self._lanes: list[deque[tuple[Handler, Any, Read]]] = [deque() for _ in Lane]
        self._awake = False
        self._dropped = metrics.count("bus_in_dropped")

    def put(self, handler: Handler, raw: Any, read: Read, lane: Lane) -> None:
        """Store an item for the loop, from any thread."""
        waiting = self._lanes[lane]
        if len(waiting) >= LANE:
            with contextlib.suppress(IndexError):
                waiting.popleft()
            self._dropped.value += 1
        waiting.append((handler, raw, read))
        if not self._awake:
            self._awake = True
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._drain)

    def attend(self) -> None:
        """Serve the stops and commands that wait, and nothing else."""
        stops, commands, _others = self._lanes
        for _ in range(_DRAIN):
            waiting = stops or commands
            if not waiting:
                return
            self._serve(waiting)

    def _serve(self, waiting: deque[tuple[Handler, Any, Read]]) -> None:
        handler, raw, read = waiting.popleft()
        try:
            handler(read(raw))
        except Exception:
            log.exception("a handler failed")

    def _drain(self) -> None:
        self._awake = False
        stops, commands, others = self._lanes
        for _ in range(_DRAIN):
            waiting = stops or commands or others
            if not waiting:
                return
            self._serve(waiting)
        if not self._awake:
            self._awake = True
            self._loop.call_soon(self._drain)
