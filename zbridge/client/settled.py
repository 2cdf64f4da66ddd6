"""Questions whose answer may be partial for a while, as when many gateways come to the bus at once."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable
from typing import TypeVar

T = TypeVar("T")

LOOK_AFTER_S = (0.02, 0.1, 0.3, 0.5)
"""Seconds between two looks for robots; the last one stays."""
SETTLE_S = 3.0
"""Longest time for which robots are looked for until two looks find the same, seconds."""


async def settled(look: Callable[[], Awaitable[T]], compared: Callable[[T], object]) -> T:
    """Look until two looks in a row find the same, for at most :data:`SETTLE_S` seconds; return the last.

    compared: what of a look must be the same; None where the look is known to be partial.
    """
    loop = asyncio.get_running_loop()
    end, found = loop.time() + SETTLE_S, await look()
    for after_s in itertools.chain(LOOK_AFTER_S, itertools.repeat(LOOK_AFTER_S[-1])):
        if loop.time() + after_s > end:
            break
        await asyncio.sleep(after_s)
        before, found = compared(found), await look()
        if before is not None and compared(found) == before:
            break
    return found
