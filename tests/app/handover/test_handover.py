"""A gateway and its successor, both played but for the steps between them: who has the robot whatever fails when."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
from collections.abc import AsyncIterator

import pytest

from zbridge.app.handover.channel import VERSION, Go, HandoverChannel, HandoverState, Hello, Up
from zbridge.app.handover.sequence import Incoming, Outgoing
from zbridge.errors import HandoverError, NotReady, Refused, Unsupported
from zbridge.protocol.kept import Exported
from zbridge.transport import Parcel

SOON_S = 10.0


class PlayedPart:
    """What is handed over: notes each step."""

    def __init__(self, steps: list[str]) -> None:
        self._steps = steps
        self.refuses: Refused | None = None
        self.drained = asyncio.Event()
        """Set when what was published has left."""
        self.drained.set()

    async def prepare(self, reason: str, within_s: float) -> None:
        self._steps.append("prepare")
        if self.refuses is not None:
            raise self.refuses

    async def shut(self) -> None:
        self._steps.append("shut")

    def suspend(self) -> None:
        self._steps.append("suspend")

    def export(self, parcel: Parcel) -> Exported:
        return {}

    async def resume(self) -> None:
        self._steps.append("resume")

    async def withdraw(self) -> None:
        self._steps.append("withdraw")
        await self.drained.wait()

    async def detach(self) -> None:
        self._steps.append("detach")


class PlayedSuccessor:
    """Starts a process that sleeps; the test plays what it says. looks_after: whether there is a supervisor."""

    def __init__(self, steps: list[str], *, looks_after: bool) -> None:
        self.process = subprocess.Popen(["sleep", "3600"])
        self.channel: HandoverChannel
        self.unheard = False
        """Set when the supervisor hears nothing."""
        self._steps, self._looks_after = steps, looks_after

    async def start_successor(self, far_end: socket.socket) -> None:
        self.channel = HandoverChannel(socket.socket(fileno=os.dup(far_end.fileno())))

    def handed_over(self) -> bool:
        if self.unheard:
            raise HandoverError("the supervisor does not listen")
        self._steps.append("handed over")
        return self._looks_after

    async def comes_up(self) -> None:
        await self.channel.send(Hello(VERSION, self.process.pid))
        await self.channel.receive(HandoverState, SOON_S)
        await self.channel.send(Up())

    def dies(self) -> None:
        self.process.kill()
        self.channel.close()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self.channel.close()


class Scene:
    def __init__(self, *, looks_after: bool) -> None:
        self.steps: list[str] = []
        self.successor = PlayedSuccessor(self.steps, looks_after=looks_after)
        describe = lambda parcel: HandoverState(VERSION, {}, 0)  # noqa: E731
        self.part = PlayedPart(self.steps)
        self.outgoing = Outgoing(self.successor, lambda: [self.part], describe)

    async def begun(self) -> asyncio.Task[int]:
        """Begin to hand over, until the successor is started."""
        running = asyncio.ensure_future(self.outgoing.run())
        while not hasattr(self.successor, "channel"):  # noqa: ASYNC110
            await asyncio.sleep(0.001)
        return running

    async def up(self) -> asyncio.Task[int]:
        """Hand over until the successor is up; give the task, which waits to say *go*."""
        self.part.drained.clear()
        running = await self.begun()
        await self.successor.comes_up()
        while "withdraw" not in self.steps:  # noqa: ASYNC110
            await asyncio.sleep(0.001)
        return running


@pytest.fixture(params=[True, False])
async def scene(request: pytest.FixtureRequest) -> AsyncIterator[Scene]:
    made = Scene(looks_after=request.param)
    yield made
    made.successor.close()


supervised = pytest.mark.parametrize("scene", [True], indirect=True)
alone = pytest.mark.parametrize("scene", [False], indirect=True)


async def test_the_supervisor_is_told_before_the_successor_hears_go(scene: Scene) -> None:
    running = await scene.up()
    with pytest.raises(HandoverError, match="sent nothing"):
        await scene.successor.channel.receive(Go, 0.01)
    assert "handed over" not in scene.steps
    scene.part.drained.set()
    await scene.successor.channel.receive(Go, SOON_S)
    assert await running == scene.successor.process.pid
    assert scene.steps == ["prepare", "shut", "suspend", "withdraw", "handed over", "detach"]


@supervised
async def test_from_go_on_nothing_leads_back_where_a_supervisor_looks_after_the_robot(scene: Scene) -> None:
    running = await scene.up()
    scene.successor.dies()
    scene.part.drained.set()
    await running
    assert scene.steps == ["prepare", "shut", "suspend", "withdraw", "handed over", "detach"], (
        "the successor has crashed"
    )


@alone
async def test_a_successor_that_cannot_be_told_to_go_leaves_everything_where_nobody_else_looks_after_it(
    scene: Scene,
) -> None:
    running = await scene.up()
    scene.successor.dies()
    scene.part.drained.set()
    with pytest.raises(NotReady, match="the other side has ended"):
        await running
    assert scene.steps[-1] == "resume"


async def test_a_gateway_that_ends_meanwhile_takes_everything_back_first(scene: Scene) -> None:
    running = await scene.up()
    scene.outgoing.give_up()
    scene.part.drained.set()
    with pytest.raises(NotReady, match="the gateway ends"):
        await running
    assert scene.steps == ["prepare", "shut", "suspend", "withdraw", "resume"]
    assert scene.successor.process.wait(SOON_S) == -signal.SIGKILL, "before it continues"


async def test_a_gateway_that_ends_before_its_successor_says_hello_waits_for_nothing(scene: Scene) -> None:
    running = asyncio.ensure_future(scene.outgoing.run())
    while not hasattr(scene.successor, "channel"):  # noqa: ASYNC110
        await asyncio.sleep(0.001)
    scene.outgoing.give_up()
    with pytest.raises(NotReady, match="the gateway ends"):
        await asyncio.wait_for(running, SOON_S)
    with pytest.raises(HandoverError, match="the gateway ends"):  # an end without a word would let it begin
        await scene.successor.channel.receive(HandoverState, SOON_S)
    assert scene.steps == []


async def test_from_go_on_a_gateway_that_ends_leaves_everything_to_its_successor(scene: Scene) -> None:
    running = await scene.up()
    scene.part.drained.set()
    await scene.successor.channel.receive(Go, SOON_S)
    scene.outgoing.give_up()
    await running
    assert scene.steps[-1] == "detach"


@supervised
async def test_without_the_supervisors_ear_nothing_is_handed_over(scene: Scene) -> None:
    running = await scene.up()
    scene.successor.unheard = True
    scene.part.drained.set()
    with pytest.raises(NotReady, match="does not listen"):
        await running
    assert scene.steps[-1] == "resume"
    assert scene.successor.process.wait(SOON_S) == -signal.SIGKILL, "before it continues"


async def test_a_successor_of_another_version_is_told_and_nothing_has_changed(scene: Scene) -> None:
    running = await scene.begun()
    await scene.successor.channel.send(Hello(VERSION + 1, scene.successor.process.pid))
    told = f"the successor takes states of version {VERSION + 1}, this gateway has {VERSION}"
    with pytest.raises(NotReady, match=told):
        await running
    with pytest.raises(HandoverError, match=told):
        await scene.successor.channel.receive(HandoverState, SOON_S)
    assert scene.steps == []


async def test_a_part_that_cannot_be_handed_over_refuses_the_restart_and_everything_goes_on(scene: Scene) -> None:
    scene.part.refuses = Unsupported("this robot cannot be handed over")
    running = await scene.begun()
    await scene.successor.channel.send(Hello(VERSION, scene.successor.process.pid))
    with pytest.raises(Unsupported, match="this robot cannot be handed over"):
        await running
    assert scene.steps == ["prepare", "resume"]
    assert scene.successor.process.wait(SOON_S) == -signal.SIGKILL


async def test_a_gateway_that_ends_meanwhile_takes_everything_back_to_take_leave(scene: Scene) -> None:
    running = await scene.up()
    running.cancel()
    with pytest.raises(asyncio.CancelledError):
        await running
    assert scene.steps[-1] == "resume"
    assert scene.successor.process.wait(SOON_S) == -signal.SIGKILL


async def test_without_a_free_descriptor_a_restart_is_refused(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise OSError(24, "Too many open files")

    with socket.socket() as end:
        await scene.successor.start_successor(end)
    monkeypatch.setattr(socket, "socketpair", fail)
    with pytest.raises(NotReady, match=r"not restarted: .*Too many open files"):
        await scene.outgoing.run()
    assert scene.steps == []


@pytest.mark.parametrize("supervised", [True, False])
async def test_a_gateway_that_dies_before_go_leaves_the_robot_to_its_successor_or_to_the_supervisor(
    supervised: bool,
) -> None:
    near, far = socket.socketpair()
    before, incoming = HandoverChannel(near), Incoming(far, {}, supervised=supervised)
    receiving = asyncio.ensure_future(incoming.receive())
    await before.receive(Hello, SOON_S)
    await before.send(HandoverState(VERSION, {}, 0))
    await receiving
    finishing = asyncio.ensure_future(incoming.finish())
    await before.receive(Up, SOON_S)
    before.close()
    if supervised:
        with pytest.raises(HandoverError, match="the supervisor stops its robot"):
            await finishing
    else:
        await finishing
    assert incoming.begun.is_set() is not supervised
    incoming.fail("the test ends")
