"""Whether a session is connected to the bus.

Zenoh reports the end of a connection before its own list shows it: a reader of the list at that moment would mistake a
lost bus for a connected one, forever. So the report is trusted, and the list is polled a few times more.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import zenoh

from zbridge.bus.zenoh.declared import Declared, threadless

POLL_S = (0.1, 0.5, 2.0, 10.0)
"""Seconds after the end of a connection at which the list is polled: on a busy machine it is right only later."""


class ConnectedWatch:
    """Calls ``handler`` when the first connection is made (True) and when the last one is lost (False).

    info: of the session (``zenoh.SessionInfo``).
    """

    def __init__(self, info: Any, loop: asyncio.AbstractEventLoop, handler: Callable[[bool], None]) -> None:
        self._info = info
        self._loop = loop
        self._handler = handler
        self._reported = False
        self._polls: list[asyncio.TimerHandle] = []
        self._declared = Declared(info.declare_transport_events_listener(threadless(self._changed), history=True))

    def __repr__(self) -> str:
        return f"<ConnectedWatch {'connected' if self._reported else 'not connected'}>"

    @property
    def closed(self) -> bool:
        """Whether it was closed."""
        return self._declared.closed

    def close(self) -> None:
        """Call the handler no more; idempotent."""
        self._declared.close()
        self._cancel_polls()

    def _changed(self, event: zenoh.TransportEvent) -> None:
        """Handle an event, on one of Zenoh's threads."""
        gone = str(event.transport.zid) if event.kind == zenoh.SampleKind.DELETE else None
        connected = gone is None or any(str(transport.zid) != gone for transport in self._info.transports())
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._on_change, connected, gone is not None)

    def _on_change(self, connected: bool, lost: bool) -> None:
        self._cancel_polls()
        self._report(connected)
        if lost and not self.closed:
            self._polls = [self._loop.call_later(after_s, self._poll) for after_s in POLL_S]

    def _poll(self) -> None:
        with contextlib.suppress(zenoh.ZError):  # the session has ended
            self._report(bool(self._info.transports()))

    def _report(self, connected: bool) -> None:
        if connected is not self._reported and not self.closed:
            self._reported = connected
            self._handler(connected)

    def _cancel_polls(self) -> None:
        polls, self._polls = self._polls, []
        for poll in polls:
            poll.cancel()
