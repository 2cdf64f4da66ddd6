"""Hands the connections of a gateway that died on to its successor, in place of the dead process.

The successor takes over as in a restart (:mod:`zbridge.app.handover`): it holds everything until the word to go, which
comes when the robot's stop is written: two processes never write to one socket.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable

from zbridge.app.handover.channel import Channel
from zbridge.app.handover.messages import Given, Go, Hello, Up
from zbridge.app.supervisor.duplicates import PERIOD_S
from zbridge.errors import HandoverError
from zbridge.transport import Parcel

START_S = 10.0
"""Longest time until the successor has joined the bus."""
TAKE_OVER_S = 5.0


async def bequeath(near: socket.socket, given: Given, parcel: Parcel, stopped: Awaitable[object]) -> None:
    """Give a successor what a dead process left, once its robot's stop is written; raise HandoverError."""
    channel = Channel(near)
    try:
        hello = await channel.receive(Hello, START_S)
        if hello.version != given.version:
            raise HandoverError(f"it takes states of version {hello.version}, the dead process left {given.version}")
        await channel.send(given, parcel)
        await channel.receive(Up, TAKE_OVER_S)
        await stopped
        await asyncio.sleep(PERIOD_S)  # the successor begins with a stop: the robot must not read both as one packet
        await channel.send(Go())
    finally:
        channel.close()
        parcel.close()
