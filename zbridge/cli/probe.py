"""``zbridge probe``: prints what a device is, from its gateway if it has one, else after a handshake."""

from __future__ import annotations

import contextlib
import json
from typing import Any

from zbridge.bus import BusSettings
from zbridge.cli.terminal import builtins, console, errors
from zbridge.client import joined
from zbridge.doctor.probe import shake_hands
from zbridge.errors import BusError, BusRefused, LinkError, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Status
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import split_key
from zbridge.protocol.address import DeviceAddress
from zbridge.protocol.plugin import Protocol

WARNING = (
    "{address} has no gateway on the bus. Legacy robots give one usable connection per start of the robot program: "
    "probing uses it up, and the robot must be restarted before a gateway can connect. Give --yes to probe."
)


async def probe(
    settings: BusSettings,
    protocol: Protocol,
    address: DeviceAddress,
    *,
    realm: str,
    sure: bool,
    as_json: bool = False,
) -> int:
    """Print what the device is; return the exit code: 0 known, 1 no handshake, 2 not probed without ``sure``."""
    served = await _served(settings, address, realm)
    if served is not None:
        robot, status = served
        fields, code = builtins(status), 0
        if not as_json:
            console.print(shown(f"{address} is served by the gateway of {robot}:"))
    elif not sure:
        errors.print(WARNING.format(address=address))
        return 2
    else:
        try:
            robot, (fields, code) = None, await _talk(protocol, address)
        except LinkError as error:
            reason = str(error).removeprefix(f"{address}: ")
            errors.print(shown(f"{address}: {reason}"))
            if as_json:
                console.print(to_json({"address": str(address), "robot": None, "reason": reason}))
            return 1
    if as_json:
        console.print(to_json({"address": str(address), "robot": robot, **fields}))
    else:
        _show(fields)
    return code


async def _served(settings: BusSettings, address: DeviceAddress, realm: str) -> tuple[str, Status] | None:
    """Return the robot and status of the gateway on the bus that is connected to the address; None without one.

    Raises BusRefused if there is a bus that rejects us.
    """
    try:
        async with joined(settings, realm) as bus:
            answers = await bus.ask(f"{realm}/*/status")
        for answer in answers:
            with contextlib.suppress(PayloadError):
                status = payloads.decode(Status, answer.payload)
                split = split_key(answer.key)
                if split is not None and any(link.peer == str(address) for link in status.links):
                    return split[1], status
    except BusRefused:  # the device may have a gateway: do not contact it
        raise
    except BusError:
        pass
    return None


async def _talk(protocol: Protocol, address: DeviceAddress) -> tuple[dict[str, Any], int]:
    """Do a handshake with the device, and disconnect; return what was agreed, and the exit code; raise LinkError."""
    probed = await shake_hands(protocol, address)
    seen = probed.session
    fields = {
        "protocol": protocol.name,
        "dialect": probed.dialect,
        "version": seen.version,
        "features": list(seen.features),
        "transport": seen.transport,
        "reason": seen.reason,
        "malformed": seen.counters["malformed"],
    }
    return fields, int(not probed.established)


def _show(fields: dict[str, object]) -> None:
    for name, value in fields.items():
        if value not in (None, [], 0):
            console.print(shown(f"  {name}: {value if isinstance(value, str) else json.dumps(value)}"))
