"""The bus: what gateways and commands use of Zenoh, its implementation, and a fake for tests.

Nothing here knows a robot. Only :mod:`zbridge.bus.zenoh` imports zenoh; it is imported where a bus is
opened, so that whatever needs no bus starts without it.
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

    ``wait_for_peers`` returns only when the peers that scouting finds at once are connected. bounds: what comes in on
    these keys and is larger is dropped by Zenoh, before anybody can count it.
    """
    from zbridge.bus.zenoh import open_zenoh

    return await open_zenoh(settings, metrics, wait_for_peers=wait_for_peers, bounds=bounds)
