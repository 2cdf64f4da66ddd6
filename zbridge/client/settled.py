"""Queries of a fleet whose members come and go: repeated until two results in a row are the same."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable
from typing import TypeVar

T = TypeVar("T")

QUERY_AFTER_S = (0.02, 0.1, 0.3, 0.5)
"""Seconds between two queries; the last one repeats."""
SETTLE_S = 3.0
"""Longest time for which is queried until two results are the same, seconds."""


async def settled(query: Callable[[], Awaitable[T]], compared: Callable[[T], object]) -> T:
    """Query until two results in a row are the same, for at most :data:`SETTLE_S` seconds; return the last.

    Results may be partial for a while, for example when many gateways join the bus at once. compared: returns the part
    of a result that must be the same, or None if the result is known to be partial.
    """
    loop = asyncio.get_running_loop()
    end, found = loop.time() + SETTLE_S, await query()
    for after_s in itertools.chain(QUERY_AFTER_S, itertools.repeat(QUERY_AFTER_S[-1])):
        if loop.time() + after_s > end:
            break
        await asyncio.sleep(after_s)
        before, found = compared(found), await query()
        if before is not None and compared(found) == before:
            break
    return found
