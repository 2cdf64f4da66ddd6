"""Marks: events that people write into all running recordings of a realm (``fleet/@mark``)."""

from __future__ import annotations

import contextlib
import time

from zbridge.bus import Bus
from zbridge.errors import ConfigError
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Text
from zbridge.fleet.topics import LARGE_BYTES, Delivery, Topic

MARK = Topic("@mark", Text, Delivery.COMMAND, LARGE_BYTES)
"""Delivered as a command is: a mark that waits for room is not dropped."""
TEXT_BYTES = 4096


async def put(bus: Bus, realm: str, text: str, who: str) -> None:
    """Put a mark; raise ConfigError where the text is empty or too long, BusError where the bus takes nothing."""
    if not text.strip() or len(text.encode()) > TEXT_BYTES:
        raise ConfigError(f"TEXT: expected 1 to {TEXT_BYTES} bytes")
    mark = Text(text=text, kind="chat", sender=who, stamp_ns=time.time_ns())
    with contextlib.closing(bus.publisher(f"{realm}/{MARK.path}", MARK)) as publisher:
        publisher.put(payloads.encode(mark))
        await bus.flush()
