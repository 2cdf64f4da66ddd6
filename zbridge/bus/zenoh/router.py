"""Opens a Zenoh router in this process; watches its neighbours and Zenoh's own log."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any

import zenoh

from zbridge.bus.interface import Neighbour
from zbridge.bus.tls.membership import router_id
from zbridge.bus.zenoh.declared import Declared, threadless
from zbridge.bus.zenoh.opening import open_session, write_config
from zbridge.bus.zenoh.session import ZenohBus
from zbridge.metrics import Metrics

LOG_LEVEL = "warn,zenoh_transport::unicast::manager=trace"
"""The part of Zenoh's log that is read, unless the environment variable ``RUST_LOG`` says otherwise.

The manager of sessions tells only there that it refuses one because as many as it allows are open; otherwise it has a
line for each connection that opens.
"""
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


async def open_router(
    values: Mapping[str, Any], metrics: Metrics, on_neighbour: Callable[[Neighbour, bool], None]
) -> ZenohBus:
    """Open a router; raise BusError if that is not possible."""
    values = {**values, "id": router_id()}
    router = ZenohRouter(await open_session(write_config(values)), asyncio.get_running_loop(), metrics)
    router.watch_neighbours(on_neighbour)
    return router


class ZenohRouter(ZenohBus):
    """The bus as the router's own process uses it. Access rules do not apply to its own declarations."""

    def watch_neighbours(self, handler: Callable[[Neighbour, bool], None]) -> None:
        """Call ``handler`` with every process that connects (True) or leaves (False)."""
        loop = self._loop

        def changed(event: zenoh.LinkEvent) -> None:
            link = event.link
            neighbour = Neighbour(link.auth_identifier, str(link.dst), str(link.zid))
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(handler, neighbour, event.kind == zenoh.SampleKind.PUT)

        self._keep(Declared(self._session.info.declare_link_events_listener(threadless(changed), history=True)))


def read_log(handler: Callable[[str], None]) -> None:
    """Start Zenoh's log and pass its lines to ``handler``, without colours, on a thread of its own.

    Zenoh writes to standard output: that becomes a pipe, and what Python prints is still written where it was before.
    """
    read, write = os.pipe()
    sys.stdout.flush()
    own = os.dup(1)
    os.dup2(write, 1)
    os.close(write)
    sys.stdout = open(own, "w", encoding="utf-8", errors="replace", buffering=1)  # noqa: SIM115 - for the whole process

    def read_lines() -> None:
        with open(read, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                handler(_COLOUR.sub("", line).rstrip("\n"))

    threading.Thread(target=read_lines, name="zbridge-zenoh-log", daemon=True).start()
    zenoh.init_log_from_env_or(LOG_LEVEL)
