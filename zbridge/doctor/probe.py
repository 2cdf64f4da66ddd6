"""A handshake with a robot, for those who ask for it: legacy robots give one connection for each start."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import msgspec

from zbridge.app.config import GatewayPlan
from zbridge.doctor.findings import Finding, Layer, error, note
from zbridge.errors import LinkError
from zbridge.fleet.processes import SessionEntry
from zbridge.metrics import Metrics
from zbridge.protocol.address import DeviceAddress
from zbridge.protocol.plugin import Protocol
from zbridge.protocol.session import State
from zbridge.transport import Conversation, ConversationHooks, Link, connect

PROBE_S = 15.0
"""Time limit of a handshake, seconds."""
VERSION_S = 1.0
"""Seconds for which a version is waited for that is not agreed in the handshake."""
LOOK_S = 0.02


class Probed(msgspec.Struct, frozen=True):
    """What a handshake found. established: whether it led to a session; else ``session.reason`` says why not."""

    session: SessionEntry
    dialect: str | None
    established: bool


async def shake_hands(protocol: Protocol, address: DeviceAddress, options: Any = None) -> Probed:
    """Do a handshake with a robot, and disconnect; raise LinkError if there is no connection, or no end of it."""
    loop = asyncio.get_running_loop()
    robot = protocol.robot(options if options is not None else protocol.options(), 1, Metrics())
    session = robot.session(robot.link_names[0], str(address))
    settled = asyncio.Event()

    def changed() -> None:
        if session.state is State.ESTABLISHED:
            settled.set()

    link: Link | None = None
    conversation = Conversation(session, loop, ConversationHooks(changed=changed))
    conversation.ended.add_done_callback(lambda _: settled.set())
    try:
        link = await connect(address, conversation)
        async with asyncio.timeout(PROBE_S):
            await settled.wait()
        for _ in range(round(VERSION_S / LOOK_S)):
            if session.version or session.over:
                break
            await asyncio.sleep(LOOK_S)
    except TimeoutError as error:
        raise LinkError(f"no handshake within {PROBE_S:g} s") from error
    finally:
        probed = Probed(session.snapshot(), robot.dialect, session.version is not None)
        await _hang_up(conversation, link)
    return probed


async def probe(plan: GatewayPlan) -> list[Finding]:
    """Contact the robot of a file; its gateway must not run."""
    device = plan.device
    if device is None:
        return []
    address = device.addresses[0]
    try:
        probed = await shake_hands(device.protocol, address, device.options)
        failure = None if probed.established else probed.session.reason or "the connection ended"
    except LinkError as fault:
        failure = str(fault)
    if failure is None:
        agreed = " ".join(filter(None, (device.protocol.name, probed.dialect, probed.session.version)))
        answers = f"{address} answers ({agreed}); the probe used its connection"
        return [note(Layer.ROBOT, "probed", answers, "restart the robot's program, then zbridge run FILE")]
    advised = device.protocol.advise([failure])
    if advised:
        return [error(Layer.ROBOT, each.code, f"{address}: {each.text} ({failure})", each.remedy) for each in advised]
    remedy = "check that the robot's program runs, its address, and the network to it"
    return [error(Layer.ROBOT, "no_handshake", failure, remedy)]


async def _hang_up(conversation: Conversation, link: Link | None) -> None:
    conversation.close("probed")
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(1.0):
            await asyncio.shield(conversation.ended)
    conversation.abandon()
    if link is not None:
        await link.ended()
