"""A gateway that ends while it hands over: the restart is settled before the parts of the gateway end."""

from __future__ import annotations

import asyncio
import os
import socket
from contextlib import suppress

import pytest

from zbridge.app.config import plan
from zbridge.app.handover.channel import VERSION, HandoverChannel, HandoverState, Hello
from zbridge.app.handover.restarts import Restarts
from zbridge.app.handover.sequence import ColdStart
from zbridge.errors import HandoverError, NotReady
from zbridge.fleet.topics import KeySpace
from zbridge.protocol.kept import Exported
from zbridge.tasks import together
from zbridge.transport import Parcel


class PlayedPart:
    """A listener: notes each step."""

    def __init__(self) -> None:
        self.steps: list[str] = []

    async def prepare(self, reason: str, within_s: float) -> None:
        self.steps.append("prepare")

    async def shut(self) -> None:
        pass

    def suspend(self) -> None:
        self.steps.append("suspend")

    def export(self, parcel: Parcel) -> Exported:
        return {}

    async def resume(self) -> None:
        self.steps.append("resume")

    async def withdraw(self) -> None:
        pass

    async def detach(self) -> None:
        self.steps.append("detach")

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
        channel = HandoverChannel(socket.socket(fileno=os.dup(far_end.fileno())))
        self.task = asyncio.ensure_future(self._take(channel))

    async def _take(self, channel: HandoverChannel) -> None:
        await channel.send(Hello(VERSION, 0))
        with suppress(HandoverError):
            await channel.receive(HandoverState, 10.0)
            self.given.set()
            await channel.receive(Hello, 10.0)
        channel.close()

    def handed_over(self) -> bool:
        raise AssertionError("it never came up")


def hq_only(successor: PlayedSuccessor) -> Restarts:
    """Make the restarts of a gateway with one listener."""
    made = plan({"robot": {"name": "r1"}, "hq": [{"protocol": "alf", "listen": "tcp://127.0.0.1:0"}]})
    return Restarts(made, KeySpace("fleet", "r1"), ColdStart(), successor)


async def test_a_gateway_that_is_told_to_end_during_a_restart_takes_everything_back_before_its_parts_end() -> None:
    part, successor = PlayedPart(), PlayedSuccessor()
    restarts = hq_only(successor)
    restarts.listeners = [part]
    gateway = asyncio.ensure_future(together(part.run(), first=restarts.settle))
    restarting = asyncio.ensure_future(restarts.restart())
    await successor.given.wait()
    gateway.cancel()
    with pytest.raises(asyncio.CancelledError):
        await gateway
    await restarting
    await successor.task
    assert part.steps == ["prepare", "suspend", "resume", "ends"]
    assert not restarts.gone.is_set()
    with pytest.raises(NotReady, match="the gateway ends"):
        await restarts._restart()


async def test_a_robot_that_is_taken_while_the_successor_starts_is_stopped_and_handed_over_too() -> None:
    part, robot, successor = PlayedPart(), PlayedPart(), PlayedSuccessor()
    restarts = hq_only(successor)
    restarts.listeners = [part]
    restarting = asyncio.ensure_future(restarts.restart())
    restarts.device = robot  # type: ignore[assignment]
    await successor.given.wait()
    assert robot.steps == ["prepare", "suspend"]
    await restarts.settle()
    await restarting
    await successor.task


async def test_a_robot_that_is_taken_after_the_parts_were_stopped_refuses_the_restart() -> None:
    part, robot, successor = PlayedPart(), PlayedPart(), PlayedSuccessor()
    restarts = hq_only(successor)
    restarts.listeners = [part]

    async def prepare(reason: str, within_s: float) -> None:
        restarts.device = robot  # type: ignore[assignment]

    part.prepare = prepare  # type: ignore[method-assign]
    with pytest.raises(NotReady, match="the robot was acquired"):
        await restarts._restart()
    assert robot.steps == []
    assert part.steps == ["suspend", "resume"]
    await successor.task
