"""The bus: what gateways and clients use of Zenoh, its implementation, and a fake for tests.

Knows no robot and no protocol. ``interface`` is what others use; ``inbox`` carries what comes in to the event loop,
``writer`` what goes out from it; ``zenoh`` alone imports zenoh, and is imported when a bus is opened: whatever needs no
bus starts without it.
"""

from __future__ import annotations

from zbridge.bus.interface import (
    Answer,
    Batch,
    Bus,
    BusSettings,
    Handle,
    IncomingQuery,
    Lane,
    Look,
    Publisher,
    Sample,
    Sort,
    Tls,
)
from zbridge.fleet.topics import SizeBounds
from zbridge.metrics import Metrics

__all__ = [
    "Answer",
    "Batch",
    "Bus",
    "BusSettings",
    "Handle",
    "IncomingQuery",
    "Lane",
    "Look",
    "Publisher",
    "Sample",
    "Sort",
    "Tls",
    "open_bus",
]


async def open_bus(
    settings: BusSettings, metrics: Metrics, *, wait_for_peers: bool = False, bounds: SizeBounds = ()
) -> Bus:
    """Open a Zenoh session; raise BusError where that is not possible (a client: no router within a second).

    wait_for_peers: return only when the peers that scouting finds at once are connected. bounds: Zenoh drops what comes
    in on these keys and is larger; nobody can count it.
    """
    from zbridge.bus.zenoh import open_zenoh

    return await open_zenoh(settings, metrics, wait_for_peers=wait_for_peers, bounds=bounds)
