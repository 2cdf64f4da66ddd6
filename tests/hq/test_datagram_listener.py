"""A listener at a UDP port, over real sockets: admission, limits, freezes, and the restart of its gateway."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
from collections.abc import AsyncIterator
from typing import Any

import msgspec
import pytest

from tests.hq.scene import Scene, ToySide, framed
from tests.transport.recorder import heard_by, udp_socket, until
from zbridge.clocks import Clocks
from zbridge.hq import client as clients
from zbridge.hq.listener import Listener
from zbridge.hq.settings import HqSettings, ListenerPlan
from zbridge.metrics import Metrics
from zbridge.protocol.address import DatagramAddress
from zbridge.protocol.kept import Exported
from zbridge.protocol.plugin import Protocol
from zbridge.transport import Parcel, sources


class HandedSide(ToySide):
    hands_over = True


class Desk:
    """A listener of the toy protocol at a UDP port, and programs that send to it."""

    def __init__(self, stack: contextlib.AsyncExitStack) -> None:
        self.stack = stack
        self.scene = Scene()
        self.metrics = Metrics()

    def listener(
        self,
        address: DatagramAddress,
        exported: tuple[Exported, Parcel] | None = None,
        allow: str = "127.0.0.0/8",
        to: tuple[DatagramAddress, ...] = (),
        **settings: Any,
    ) -> Listener:
        protocol = Protocol("toy", "", HqSettings, 1, robot=None, simulate=None, hq=HandedSide, datagrams=True)  # type: ignore[arg-type]
        limits = HqSettings(protocol="toy", listen=str(address), **settings)
        plan = ListenerPlan(protocol, None, address, limits, (ipaddress.ip_network(allow),), to=to)
        scene = self.scene
        clocks = Clocks(lambda: scene.now, raw_ms=lambda: scene.now * 1000)
        return Listener(plan, "toy", scene.robot, scene.manager, self.metrics, clocks, exported)

    async def begin(self, **settings: Any) -> Listener:
        listener = self.listener(DatagramAddress("127.0.0.1", 0), **settings)
        self.run(listener)
        await asyncio.wait_for(listener.ready.wait(), 1.0)
        return listener

    def run(self, listener: Listener, begin: Any = None) -> None:
        task = asyncio.create_task(listener.run(begin))

        async def end() -> None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

        self.stack.push_async_callback(end)

    def program(self, listener: Listener) -> socket.socket:
        made = self.stack.enter_context(contextlib.closing(udp_socket(("127.0.0.1", 0))))
        made.connect((listener.address.host, listener.address.port))
        return made

    def count(self, name: str, **labels: str) -> int:
        return self.metrics.total(name, **labels)


@pytest.fixture
async def desk() -> AsyncIterator[Desk]:
    async with contextlib.AsyncExitStack() as stack:
        yield Desk(stack)


async def heard(program: socket.socket, message: bytes) -> None:
    """Wait until a program hears that."""
    while (await heard_by(program))[0] != framed(message):
        pass


async def test_two_programs_drive_by_turns_and_the_one_too_many_is_turned_away(desk: Desk) -> None:
    listener = await desk.begin(clients=2)
    one, two, three = (desk.program(listener) for _ in range(3))
    one.send(framed(b"hi"))
    await heard(one, b"welcome")
    two.send(framed(b"hi"))
    await heard(two, b"welcome")
    one.send(framed(b"stand") + framed(b"go") + framed(b"half")[:2])
    await until(lambda: desk.scene.driven() == [0.5])
    assert desk.count("hq_malformed_frames") == 1
    for _ in range(20):
        three.send(framed(b"hi"))
    await until(lambda: desk.count("hq_foreign_datagrams") == 19)
    assert (desk.count("hq_connections", outcome="turned_away"), sorted(listener.clients)) == (1, [2, 3])
    assert [client.session.transport for client in listener.clients.values()] == ["udp", "udp"]


async def test_a_client_is_gone_after_silence_but_not_one_it_was_told_of(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clients, "SWEEP_S", 0.3)
    monkeypatch.setattr(sources, "SILENT_S", 0.3)
    with contextlib.closing(udp_socket(("127.0.0.1", 0))) as ground:
        to = (DatagramAddress(*ground.getsockname()),)
        listener = await desk.begin(to=to, idle_s=0.3, clients=2)
        await heard(ground, b"who are you")
        program = desk.program(listener)
        program.send(framed(b"hi"))
        await heard(program, b"welcome")
        assert sorted(listener.clients) == [2, 3]
        await until(lambda: sorted(listener.clients) == [2])
        _, there = ground.getsockname(), (listener.address.host, listener.address.port)
        ground.sendto(framed(b"hi"), there)
        await heard(ground, b"welcome")
        await asyncio.sleep(0.5)
        assert sorted(listener.clients) == [2]


async def test_an_address_to_that_is_not_allowed_and_a_flood_of_frames_are_no_clients(desk: Desk) -> None:
    listener = await desk.begin(rate_hz=5.0, allow="127.0.0.1/32", to=(DatagramAddress("127.0.0.2", 9),))
    program = desk.program(listener)
    program.send(framed(b"hi"))
    await heard(program, b"welcome")
    for _ in range(50):
        program.send(framed(b"stand"))
    await until(lambda: listener.clients == {} and desk.count("hq_foreign_datagrams") > 30)
    assert desk.count("hq_connections", outcome="turned_away") == 1
    assert desk.count("hq_connections", outcome="accepted") == 1


async def test_what_waited_while_the_process_was_frozen_moves_nothing(desk: Desk) -> None:
    listener = await desk.begin()
    program = desk.program(listener)
    program.send(framed(b"hi"))
    await heard(program, b"welcome")
    program.send(framed(b"stand") + framed(b"go"))
    await until(lambda: desk.scene.driven() == [0.5])
    program.send(framed(b"go"))
    desk.scene.skip(2.0)
    await until(lambda: desk.count("hq_refused") > 0)
    assert desk.scene.driven() == []


async def test_a_restart_hands_the_socket_over_with_all_clients(desk: Desk) -> None:
    old = await desk.begin()
    one, two = desk.program(old), desk.program(old)
    for program in (one, two):
        program.send(framed(b"hi"))
        await heard(program, b"welcome")
    await old.handover.prepare("restart", 1.0)
    await old.handover.shut()
    old.handover.suspend()
    two.send(framed(b"stand") + framed(b"go"))
    parcel = Parcel()
    state = msgspec.msgpack.decode(msgspec.msgpack.encode(old.handover.export(parcel)))
    new = desk.listener(old.address, (state, parcel))  # type: ignore[arg-type]
    desk.run(new, old.handover.detach)
    await asyncio.wait_for(new.ready.wait(), 1.0)
    assert (sorted(new.clients), new.address) == ([2, 3], old.address)
    await until(lambda: desk.scene.driven() == [0.5])
    desk.scene.pose(3.0)
    await heard(one, b"at 3")
    await heard(two, b"at 3")
    desk.program(new).send(framed(b"hi"))
    await until(lambda: sorted(new.clients) == [2, 3, 4])


async def test_a_restart_that_fails_leaves_the_clients_where_they_were(desk: Desk) -> None:
    listener = await desk.begin()
    program = desk.program(listener)
    program.send(framed(b"hi"))
    await heard(program, b"welcome")
    await listener.handover.prepare("restart", 1.0)
    await listener.handover.shut()
    listener.handover.suspend()
    program.send(framed(b"stand") + framed(b"go"))
    await listener.handover.resume()
    await until(lambda: desk.scene.driven() == [0.5])
