"""Opens a Zenoh session: converts settings to Zenoh's configuration, and explains failures."""

from __future__ import annotations

import asyncio
import json
import random
import re
import threading
from collections.abc import Mapping
from typing import Any

import zenoh

from zbridge.bus.interface import FULL_QUEUES, SECURE, BusSettings, Tls
from zbridge.bus.tls.refusal import why_not
from zbridge.errors import BusError, BusRefused
from zbridge.fleet.topics import SizeBounds

OPEN_S = 60.0
"""Longest time for Zenoh to open a session: of some thousand, one never opened."""
RETRY_FIRST_MS, RETRY_MOST_MS, RETRY_FACTOR = (500, 1500), (2000, 4000), 1.5
"""Milliseconds between attempts to reconnect to a router: the first pause, the longest, and the growth factor."""
_INGRESS = ("ingress",)
_BOUNDED = ("put", "delete", "query")
_ORIGIN = re.compile(r"\s+at /.*", re.DOTALL)
"""The place in Zenoh's source at the end of its error texts; cut off."""


def zenoh_config(
    settings: BusSettings,
    *,
    wait_for_peers: bool = False,
    bounds: SizeBounds = (),
    within_s: float = 1.0,
    timestamps: bool = False,
) -> zenoh.Config:
    """Convert settings to a Zenoh configuration; raise BusError naming the setting that Zenoh rejects.

    within_s: time limit of an attempt to open a client session.
    """
    values: dict[str, Any] = {
        "mode": settings.effective_mode,
        "connect/endpoints": settings.connect,
        "scouting/multicast/enabled": settings.multicast,
        "open/return_conditions/connect_scouted": wait_for_peers,
        # A pool of 28 MB in every process, for payloads larger than any robot's.
        "transport/shared_memory/enabled": False,
        **FULL_QUEUES,
    }
    if timestamps:
        values["timestamping/enabled"] = True
    if settings.listen:
        values["listen/endpoints"] = settings.listen
    if bounds:
        values["low_pass_filter"] = [  # Zenoh drops input that is larger than its key allows
            {"id": str(number), "flows": _INGRESS, "messages": _BOUNDED, "key_exprs": key_exprs, "size_limit": most}
            for number, (key_exprs, most) in enumerate(bounds)
        ]
    if settings.connect:
        values["connect/retry"] = _retry()
    if settings.effective_mode == "client":
        values["connect/timeout_ms"] = int(within_s * 1000)
    if settings.tls is not None:
        values |= _secure_values(settings.tls)
    return write_config(values)


def _retry() -> dict[str, float]:
    """Choose the pauses between attempts to connect, at random: a thousand sessions may have lost one router."""
    first_ms, most_ms = random.randint(*RETRY_FIRST_MS), random.randint(*RETRY_MOST_MS)
    return {"period_init_ms": first_ms, "period_max_ms": most_ms, "period_increase_factor": RETRY_FACTOR}


def write_config(values: Mapping[str, Any]) -> zenoh.Config:
    """Convert values to a Zenoh configuration; raise BusError naming the one that Zenoh rejects."""
    config = zenoh.Config()
    for key, value in values.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise BusError(f"{key} = {value!r}: {in_short(error)}") from error
    return config


def _secure_values(tls: Tls) -> dict[str, Any]:
    """Make the settings for certificates: no scouting, no plain TCP, verified names."""
    at = "transport/link/tls"
    values: dict[str, Any] = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/protocols": list(SECURE),
        f"{at}/root_ca_certificate": tls.ca,
        f"{at}/verify_name_on_connect": True,
    }
    if tls.certificate and tls.key:
        values |= {
            f"{at}/enable_mtls": True,
            f"{at}/connect_certificate": tls.certificate,
            f"{at}/connect_private_key": tls.key,
        }
    return values


def in_short(error: zenoh.ZError) -> str:
    """Return the text of an error of Zenoh's, without its place in Zenoh's source."""
    return _ORIGIN.sub("", str(error))


def canonical(key_expr: str) -> str:
    """Return a key expression in Zenoh's canonical form; raise ValueError with Zenoh's reason where it is none."""
    try:
        return str(zenoh.KeyExpr.autocanonize(key_expr))
    except zenoh.ZError as error:
        raise ValueError(in_short(error).removeprefix(f"Invalid Key Expr `{key_expr}`: ")) from error


async def open_or_explain(config: zenoh.Config, settings: BusSettings, *, explain: bool = True) -> zenoh.Session:
    """Open a session; raise BusError, which names the cause if that can be found.

    explain: whether the router may be contacted; otherwise only our own files are checked.
    """
    try:
        return await open_session(config)
    except BusError as error:
        # Others open without a connection: what failed is something else, an address to listen at.
        finding = await why_not(settings, ask=explain) if settings.effective_mode == "client" else None
        if finding is None:
            raise
        raise (BusRefused if finding.refused else BusError)(finding.text) from error


async def open_session(config: zenoh.Config) -> zenoh.Session:
    """Open a session; raise BusError if that is not possible within :data:`OPEN_S`.

    A thread of its own is abandoned where Zenoh hangs; a session that opens when nobody waits for it is closed.
    """
    loop = asyncio.get_running_loop()
    opened: asyncio.Future[zenoh.Session | BusError] = loop.create_future()

    def attempt() -> None:
        result: zenoh.Session | BusError
        try:
            result = zenoh.open(config)
        except zenoh.ZError as error:
            result = BusError(in_short(error))
        try:
            loop.call_soon_threadsafe(take, result)
        except RuntimeError:  # the loop has ended
            _close(result)

    def take(result: zenoh.Session | BusError) -> None:
        if not opened.done():
            opened.set_result(result)
        else:
            threading.Thread(target=_close, args=(result,), name="zbridge-close-late", daemon=True).start()

    threading.Thread(target=attempt, name="zbridge-open", daemon=True).start()
    try:
        async with asyncio.timeout(OPEN_S):
            result = await opened
    except TimeoutError:
        raise BusError(f"Zenoh opened no session within {OPEN_S:g} s") from None
    if isinstance(result, BusError):
        raise result
    return result


def _close(result: zenoh.Session | BusError) -> None:
    if not isinstance(result, BusError):
        result.close()  # type: ignore[no-untyped-call]
