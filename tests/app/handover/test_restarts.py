"""A gateway that ends while it hands over: the restart is settled before the parts of the gateway end."""

from __future__ import annotations

import asyncio
import os
import socket
from contextlib import suppress

import pytest

from zbridge.app.config import plan
from zbridge.app.handover.channel import Channel
from zbridge.app.handover.messages import VERSION, Given, Hello
from zbridge.app.handover.restarts import Restarts
from zbridge.app.tasks import together
from zbridge.errors import HandoverError, NotReady
from zbridge.fleet.topics import KeySpace
from zbridge.protocol.kept import Exported
from zbridge.transport import Parcel


class PlayedPart:
    """A listener: notes each step."""

    def __init__(self) -> None:
        self.steps: list[str] = []

    async def prepare(self, reason: str, within_s: float) -> None:
        self.steps.append("prepare")

    async def shut(self) -> None:
        pass

    def hold(self) -> None:
        self.steps.append("hold")

    def hand_over(self, parcel: Parcel) -> Exported:
        return {}

    async def go_on(self) -> None:
        self.steps.append("go on")

    def withdraw(self) -> None:
        pass

    async def release(self) -> None:
        self.steps.append("release")

    async def run(self) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            self.steps.append("ends")


class PlayedSuccessor:
    """Takes what it is given, and never comes up."""

    def __init__(self) -> None:
        self.given = asyncio.Event()
        self.task: asyncio.Task[None]

    async def start_successor(self, far_end: socket.socket) -> None:
        channel = Channel(socket.socket(fileno=os.dup(far_end.fileno())))
        self.task = asyncio.ensure_future(self._take(channel))

    async def _take(self, channel: Channel) -> None:
        await channel.send(Hello(VERSION, 0))
        await channel.receive(Given, 10.0)
        self.given.set()
        with suppress(HandoverError):
            await channel.receive(Hello, 10.0)
        channel.close()

    def handed_over(self) -> bool:
        raise AssertionError("it never came up")


async def test_a_gateway_that_is_told_to_end_during_a_restart_takes_everything_back_before_its_parts_end() -> None:
    part, successor = PlayedPart(), PlayedSuccessor()
    made = plan({"robot": {"name": "r1"}, "hq": [{"protocol": "alf", "listen": "tcp://127.0.0.1:0"}]})
    restarts = Restarts(made, KeySpace("fleet", "r1"), None, successor)
    restarts.listeners = [part]
    gateway = asyncio.ensure_future(together(part.run(), first=restarts.settle))
    restarting = asyncio.ensure_future(restarts.restart())
    await successor.given.wait()
    gateway.cancel()
    with pytest.raises(asyncio.CancelledError):
        await gateway
    await restarting
    await successor.task
    assert part.steps == ["prepare", "hold", "go on", "ends"]
    assert not restarts.gone.is_set()
    with pytest.raises(NotReady, match="the gateway ends"):
        await restarts._restart()
