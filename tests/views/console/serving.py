"""A console on a real socket of loopback."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from tests.ports import HOST
from zbridge.bus import Bus
from zbridge.client import Fleet
from zbridge.protocol.address import Address
from zbridge.views.console import server
from zbridge.views.console.http_server import listener
from zbridge.views.console.roster import Roster


@contextlib.asynccontextmanager
async def served(
    fleet: Fleet, bus: Bus, roster: Path | Roster, *, port: int = 0, **settings: Any
) -> AsyncIterator[str]:
    """Serve a console; give its address for browsers."""
    ready: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    with contextlib.closing(listener(Address(HOST, port))) as listening:
        known = roster if isinstance(roster, Roster) else Roster(roster)
        made = server.ConsoleSettings(Address(HOST, 0), **settings)
        serving = asyncio.create_task(server.serve(fleet, bus, made, listening, known, ready.set_result))
        try:
            await asyncio.wait((serving, ready), return_when=asyncio.FIRST_COMPLETED)
            if serving.done():
                serving.result()
            yield ready.result()
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
