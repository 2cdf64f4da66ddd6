"""The bus: what gateways and clients use of Zenoh, its implementation, and a fake for tests.

Knows no robot and no protocol. ``interface`` is what others use; ``inbox`` carries what comes in to the event loop,
``writer`` what goes out from it; ``zenoh`` alone imports zenoh, and is imported when a bus is opened: whatever needs no
bus starts without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from zbridge.bus.interface import (
    Answer,
    Batch,
    Bus,
    BusSettings,
    Handle,
    IncomingQuery,
    Neighbour,
    PriorityClass,
    Publisher,
    ReadPayload,
    Sample,
    Sort,
    Tls,
)
from zbridge.errors import ConfigError
from zbridge.fleet.topics import SizeBounds
from zbridge.metrics import Metrics

OPEN_S = 1.0
"""Longest time one attempt to open a client session takes."""

__all__ = [
    "OPEN_S",
    "Answer",
    "Batch",
    "Bus",
    "BusSettings",
    "Handle",
    "IncomingQuery",
    "Neighbour",
    "PriorityClass",
    "Publisher",
    "ReadPayload",
    "Sample",
    "Sort",
    "Tls",
    "hear_zenoh",
    "open_bus",
    "open_router",
    "read_key_expr",
]


async def open_bus(
    settings: BusSettings,
    metrics: Metrics,
    *,
    wait_for_peers: bool = False,
    bounds: SizeBounds = (),
    within_s: float = OPEN_S,
    realm: str | None = None,
    robot: str | None = None,
    timestamps: bool = False,
    explain: bool = True,
    threads: bool = True,
) -> Bus:
    """Open a Zenoh session; raise BusError where that is not possible (a client: no router within ``within_s``).

    The error says which case it is, where that can be found within three more seconds; it is BusRefused where trying
    again soon helps nobody. wait_for_peers: return only when the peers that scouting finds at once are connected.
    bounds: Zenoh drops what comes in on these keys and is larger; nobody can count it. realm, robot: on a secure bus,
    those in which the router must know our name. timestamps: Zenoh stamps what is put here, as kept frames need.
    threads: each subscription has a thread, which spares Zenoh's where samples come by tens of thousands a second;
    False spares each sample a way between threads.
    """
    from zbridge.bus.zenoh import open_zenoh

    return await open_zenoh(
        settings,
        metrics,
        wait_for_peers=wait_for_peers,
        bounds=bounds,
        within_s=within_s,
        realm=realm,
        robot=robot,
        timestamps=timestamps,
        explain=explain,
        threads=threads,
    )


async def open_router(
    values: Mapping[str, Any], metrics: Metrics, on_neighbour: Callable[[Neighbour, bool], None]
) -> Bus:
    """Open a Zenoh router; raise BusError where that is not possible.

    values: Zenoh's configuration, by paths (``listen/endpoints``). on_neighbour: called on the event loop with every
    process that connects (True) or leaves (False).
    """
    from zbridge.bus.zenoh import open_router as open_zenoh_router

    return await open_zenoh_router(values, metrics, on_neighbour)


def hear_zenoh(handler: Callable[[str], None]) -> None:
    """Give ``handler`` the warnings that Zenoh prints, on a thread of its own. Call it once, before a bus is open."""
    from zbridge.bus.zenoh import hear_log

    hear_log(handler)


def read_key_expr(option: str, text: str) -> str:
    """Return a key expression in Zenoh's canonical form; raise ConfigError, which names the option and what is wrong.

    Ask this before subscribing to what a person wrote: Zenoh's own error is no ZbridgeError.
    """
    from zbridge.bus.zenoh import canonical

    try:
        return canonical(text)
    except ValueError as error:
        chunks = "/".join(filter(None, text.split("/")))
        hint = f"; keys neither begin nor end with '/': try {chunks!r}" if chunks and text.strip("/") != text else ""
        raise ConfigError(f"{option} = {text!r}: {error}{hint}") from error
