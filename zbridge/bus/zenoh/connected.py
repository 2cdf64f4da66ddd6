"""Whether a session is connected to the bus.

Zenoh tells that a connection is gone before its own list shows it: who read the list at that moment would take a lost
bus for a connected one, for good. So what was just told is trusted, and the list is looked at once more a little later.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import zenoh

from zbridge.bus.zenoh.declared import Declared, threadless

LOOK_AGAIN_S = 0.1
"""Seconds after the end of a connection: the list is right by then."""


def watch_connected(info: Any, loop: asyncio.AbstractEventLoop, handler: Callable[[bool], None]) -> Declared:
    """Call ``handler`` when the first connection is made (True) and when the last one is lost (False).

    info: of the session (``zenoh.SessionInfo``).
    """
    told = False

    def tell(here: bool) -> None:
        nonlocal told
        if here is not told:
            told = here
            handler(here)

    def look() -> None:
        with contextlib.suppress(zenoh.ZError):  # the session has ended
            tell(bool(info.transports()))

    def lost(others: bool) -> None:
        tell(others)
        loop.call_later(LOOK_AGAIN_S, look)

    def changed(event: zenoh.TransportEvent) -> None:
        call: Callable[[bool], None]
        if event.kind == zenoh.SampleKind.PUT:
            call, here = tell, True
        else:
            gone = str(event.transport.zid)
            call, here = lost, any(str(transport.zid) != gone for transport in info.transports())
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(call, here)

    return Declared(info.declare_transport_events_listener(threadless(changed), history=True))
