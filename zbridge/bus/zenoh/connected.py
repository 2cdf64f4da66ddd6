"""Whether a session is connected to the bus.

Zenoh tells that a connection is gone before its own list shows it: who read the list at that moment would take a lost
bus for a connected one, for good. So what was just told is trusted, and the list is looked at a few times more.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import zenoh

from zbridge.bus.zenoh.declared import Declared, threadless

LOOK_AGAIN_S = (0.1, 0.5, 2.0, 10.0)
"""Seconds after the end of a connection: the list is right by then, the later the busier the machine."""


class ConnectedWatch:
    """Calls ``handler`` when the first connection is made (True) and when the last one is lost (False).

    info: of the session (``zenoh.SessionInfo``).
    """

    def __init__(self, info: Any, loop: asyncio.AbstractEventLoop, handler: Callable[[bool], None]) -> None:
        self._info = info
        self._loop = loop
        self._handler = handler
        self._told = False
        self._looks: list[asyncio.TimerHandle] = []
        self._declared = Declared(info.declare_transport_events_listener(threadless(self._changed), history=True))

    def __repr__(self) -> str:
        return f"<ConnectedWatch {'connected' if self._told else 'not connected'}>"

    @property
    def closed(self) -> bool:
        """Whether it was closed."""
        return self._declared.closed

    def close(self) -> None:
        """Call the handler no more; idempotent."""
        self._declared.close()
        self._forget_looks()

    def _changed(self, event: zenoh.TransportEvent) -> None:
        """Take an event, on one of Zenoh's threads."""
        gone = str(event.transport.zid) if event.kind == zenoh.SampleKind.DELETE else None
        here = gone is None or any(str(transport.zid) != gone for transport in self._info.transports())
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._take, here, gone is not None)

    def _take(self, here: bool, lost: bool) -> None:
        self._forget_looks()
        self._tell(here)
        if lost and not self.closed:
            self._looks = [self._loop.call_later(after_s, self._look) for after_s in LOOK_AGAIN_S]

    def _look(self) -> None:
        with contextlib.suppress(zenoh.ZError):  # the session has ended
            self._tell(bool(self._info.transports()))

    def _tell(self, here: bool) -> None:
        if here is not self._told and not self.closed:
            self._told = here
            self._handler(here)

    def _forget_looks(self) -> None:
        looks, self._looks = self._looks, []
        for look in looks:
            look.cancel()
