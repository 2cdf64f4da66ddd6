"""The Python client: see and drive robots on the bus from programs, notebooks and scripts.

    async with zbridge.connect(endpoints=["tcp/127.0.0.1:7447"]) as fleet:
        robot = fleet["r1"]
        async for scan in robot.scan:
            ...
        async with robot.control() as drive:
            await drive(forward=0.3)

Knows no protocol and no part of a gateway, only keys and fleet messages. :mod:`zbridge.client.blocking` is the same for
programs without an event loop.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

from zbridge.bus import Bus, BusSettings, Tls, open_bus
from zbridge.bus.tls.files import folder_settings, own_name
from zbridge.client.driver import Driver
from zbridge.client.feed import Feed, StateFeed
from zbridge.client.fleet import Fleet
from zbridge.client.robot import Robot
from zbridge.metrics import Metrics

__all__ = ["LOCAL_ROUTER", "Driver", "Feed", "Fleet", "Robot", "StateFeed", "bus_settings", "connect", "joined"]

LOCAL_ROUTER = "tcp/127.0.0.1:7447"
"""The default address of a router on this machine."""


def bus_settings(endpoints: Sequence[str] = (), tls: Tls | Path | str | None = None) -> BusSettings:
    """Return the bus settings of a program: the given endpoints, else multicast and the router on this machine.

    tls: the files of this program's certificate, or a folder made by ``zbridge certs bundle``, which names
    endpoints too. Raises ConfigError if they do not fit together.
    """
    if isinstance(tls, Path | str):
        return folder_settings(Path(tls), endpoints)
    if endpoints or tls is not None:
        return BusSettings(connect=tuple(endpoints), multicast=False, tls=tls)
    return BusSettings(mode="peer", connect=(LOCAL_ROUTER,))


@contextlib.asynccontextmanager
async def connect(
    endpoints: Sequence[str] | str = (),
    *,
    realm: str = "fleet",
    tls: Tls | Path | str | None = None,
    settings: BusSettings | None = None,
) -> AsyncIterator[Fleet]:
    """Join the bus for as long as the context lasts.

    endpoints: Zenoh endpoints, ``tcp/192.168.0.2:7447``; by default the local network and the router on this machine.
    tls: for a secure bus, a folder made by ``zbridge certs bundle``, whose endpoints are used if none are given; or the
    files. settings: all settings of the bus, instead of ``endpoints`` and ``tls``.
    Raises BusError if no given endpoint can be reached, or the router rejects this program, with the reason;
    ConfigError if the certificate cannot be read.
    """
    if isinstance(endpoints, str):
        endpoints = (endpoints,)
    settings = settings or bus_settings(endpoints, tls)
    name = own_name(settings.tls)
    async with joined(settings, realm) as bus:
        yield Fleet(bus, realm, name)


@contextlib.asynccontextmanager
async def joined(settings: BusSettings, realm: str | None) -> AsyncIterator[Bus]:
    """Open the bus while the context lasts; raise BusError. realm: in which a router must know us; None: any."""
    bus = await open_bus(settings, Metrics(), wait_for_peers=True, realm=realm)
    try:
        yield bus
    finally:
        await bus.close()
