"""The bus: what gateways and clients use of Zenoh, its implementation, and a fake for tests.

Knows no robot and no protocol. ``interface`` is what others use; ``inbox`` carries input to the event loop, ``writer``
output from it. Only ``zenoh`` imports zenoh; it is imported when a bus is opened, so that programs without a bus start
without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from zbridge.bus.interface import Answer as Answer
from zbridge.bus.interface import Batch as Batch
from zbridge.bus.interface import Bus as Bus
from zbridge.bus.interface import BusSettings as BusSettings
from zbridge.bus.interface import Handle as Handle
from zbridge.bus.interface import IncomingQuery as IncomingQuery
from zbridge.bus.interface import Neighbour as Neighbour
from zbridge.bus.interface import PriorityClass as PriorityClass
from zbridge.bus.interface import Publisher as Publisher
from zbridge.bus.interface import ReadPayload as ReadPayload
from zbridge.bus.interface import Sample as Sample
from zbridge.bus.interface import Sort as Sort
from zbridge.bus.interface import Tls as Tls
from zbridge.errors import ConfigError
from zbridge.fleet.topics import SizeBounds
from zbridge.metrics import Metrics

OPEN_S = 1.0
"""Time limit of one attempt to open a client session, seconds."""


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
    """Open a Zenoh session; raise BusError if that is not possible (a client: no router within ``within_s``).

    The error names the cause if that can be found within three more seconds; it is BusRefused if retrying soon is
    useless. wait_for_peers: return only when the peers that scouting finds at once are connected. bounds: Zenoh drops
    larger input on these keys, uncounted. realm, robot: on a secure bus, those for which the router must know our name.
    timestamps: Zenoh stamps what is put here; kept frames need that. threads: each subscription has a thread, which
    relieves Zenoh's own at tens of thousands of samples a second; False saves each sample a change of threads.
    """
    from zbridge.bus.zenoh import open_zenoh, zenoh_config

    config = zenoh_config(
        settings, wait_for_peers=wait_for_peers, bounds=bounds, within_s=within_s, timestamps=timestamps
    )
    return await open_zenoh(config, settings, metrics, realm=realm, robot=robot, explain=explain, threads=threads)


async def open_router(
    values: Mapping[str, Any], metrics: Metrics, on_neighbour: Callable[[Neighbour, bool], None]
) -> Bus:
    """Open a Zenoh router; raise BusError if that is not possible.

    values: Zenoh's configuration, by paths (``listen/endpoints``). on_neighbour: called on the event loop with every
    process that connects (True) or leaves (False).
    """
    from zbridge.bus.zenoh import open_router as open_zenoh_router

    return await open_zenoh_router(values, metrics, on_neighbour)


def read_zenoh_log(handler: Callable[[str], None]) -> None:
    """Pass Zenoh's printed warnings to ``handler``, on a thread of its own. Call it once, before a bus is open."""
    from zbridge.bus.zenoh import read_log

    read_log(handler)


def read_key_expr(option: str, text: str) -> str:
    """Return a key expression in Zenoh's canonical form; raise ConfigError, which names the option and what is wrong.

    Call this before subscribing to an expression that a person wrote: Zenoh's own error is no ZbridgeError.
    """
    from zbridge.bus.zenoh import canonical

    try:
        return canonical(text)
    except ValueError as error:
        chunks = "/".join(filter(None, text.split("/")))
        hint = f"; keys neither begin nor end with '/': try {chunks!r}" if chunks and text.strip("/") != text else ""
        raise ConfigError(f"{option} = {text!r}: {error}{hint}") from error
