"""``zbridge probe``: prints what a device is, from its gateway if it has one, else after a handshake."""

from __future__ import annotations

import asyncio
import contextlib
import json

import msgspec

from zbridge.bus import BusSettings
from zbridge.cli.bus import console, errors, joined
from zbridge.errors import BusError, BusRefused, LinkError, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Status
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import split_key
from zbridge.metrics import Metrics
from zbridge.protocol.address import DeviceAddress
from zbridge.protocol.plugin import Protocol
from zbridge.protocol.session import State
from zbridge.transport import Conversation, Link, connect

PROBE_S = 15.0
"""Longest time a handshake may take."""
WARNING = (
    "{address} has no gateway on the bus. Legacy robots give one usable connection per start of the robot program: "
    "probing uses it up, and the robot must be restarted before a gateway can connect. Give --yes to probe."
)


async def probe(settings: BusSettings, protocol: Protocol, address: DeviceAddress, *, realm: str, sure: bool) -> int:
    """Print what the device is; return the exit code: 0 known, 1 no handshake, 2 not probed without ``sure``."""
    served = await _served(settings, address, realm)
    if served is not None:
        robot, status = served
        console.print(shown(f"{address} is served by the gateway of {robot}:"))
        _show(msgspec.to_builtins(status))
        return 0
    if not sure:
        errors.print(WARNING.format(address=address))
        return 2
    return await _talk(protocol, address)


async def _served(settings: BusSettings, address: DeviceAddress, realm: str) -> tuple[str, Status] | None:
    """Return the robot and status of the gateway on the bus that is connected to the address; None without one.

    Raises BusRefused where there is a bus that refuses us.
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
    except BusRefused:  # whether the device has a gateway is not known: it must not be spoken to
        raise
    except BusError:
        pass
    return None


async def _talk(protocol: Protocol, address: DeviceAddress) -> int:
    """Do a handshake with the device, print what was agreed, and disconnect; return the exit code."""
    loop = asyncio.get_running_loop()
    robot = protocol.robot(protocol.options(), 1, Metrics())
    session = robot.session(robot.link_names[0], str(address))
    settled = asyncio.Event()

    def changed() -> None:
        if session.state is State.ESTABLISHED:
            settled.set()

    link: Link | None = None
    conversation = Conversation(session, loop, deliver=lambda messages: None, changed=changed)
    conversation.ended.add_done_callback(lambda _: settled.set())
    try:
        link = await connect(address, conversation)
        async with asyncio.timeout(PROBE_S):
            await settled.wait()
    except (LinkError, TimeoutError) as error:
        errors.print(shown(f"{address}: {error or 'no handshake'}"))
        return 1
    finally:
        established, seen = session.version is not None, session.snapshot()
        await _hang_up(conversation, link)
    _show(
        {
            "protocol": protocol.name,
            "dialect": robot.dialect,
            "version": seen.version or None,
            "features": list(seen.features),
            "transport": seen.transport,
            "reason": seen.reason,
            "malformed": seen.counters["malformed"],
        }
    )
    return 0 if established else 1


async def _hang_up(conversation: Conversation, link: Link | None) -> None:
    conversation.close("probed")
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(1.0):
            await asyncio.shield(conversation.ended)
    conversation.abandon()
    if link is not None:
        await link.ended()


def _show(fields: dict[str, object]) -> None:
    for name, value in fields.items():
        if value not in (None, [], 0):
            console.print(shown(f"  {name}: {value if isinstance(value, str) else json.dumps(value)}"))
