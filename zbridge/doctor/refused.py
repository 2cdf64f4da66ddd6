"""Finds out whether a router refuses a member because as many as it allows are connected.

Zenoh reports "Unable to connect" for that, too; only its log names the message with which the router closed. It is read
from a process of its own that tries to join once.
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress

import msgspec

from zbridge.bus import BusSettings
from zbridge.doctor.findings import Finding, Layer, error

_TRY_S = 6.0
_REFUSES = b"in response to an OpenSyn"
"""What Zenoh logs if the router ends the handshake at its last step: the limit of sessions is checked there."""


async def why_router_refuses(settings: BusSettings) -> Finding | None:
    """Try to join the bus once more, and return the finding that the router is full; None if it is not known to be."""
    if not settings.connect:
        return None
    command = (sys.executable, "-m", "zbridge.bus.zenoh.try_open", msgspec.json.encode(settings).decode())
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT, stdin=asyncio.subprocess.DEVNULL
    )
    output = b""
    try:
        with suppress(TimeoutError):
            async with asyncio.timeout(_TRY_S):
                output, _ = await process.communicate()
    finally:
        with suppress(ProcessLookupError):
            process.kill()
    if _REFUSES not in output:
        return None
    where = ", ".join(settings.connect)
    return error(
        Layer.BUS,
        "router_full",
        f"the router at {where} answers, and refuses further members: its limits.sessions are used",
        "raise limits.sessions of the router, or end programs that are not needed; its log counts the refused ones",
    )
