"""The gateway that comes: what it takes over, what it refuses, and when it begins. The test plays the other one."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Iterator
from typing import Any

import pytest

from zbridge.app.handover.channel import VERSION, Failed, Go, HandoverChannel, HandoverState, Hello, Up
from zbridge.app.handover.sequence import Incoming
from zbridge.errors import HandoverError
from zbridge.transport import Parcel

SOON_S = 10.0
SETUP = {"robot": {"name": "r1"}, "hq[0]": ["alf"]}


@pytest.fixture
def pair() -> Iterator[tuple[HandoverChannel, Incoming]]:
    near, far = socket.socketpair()
    before, incoming = HandoverChannel(near), Incoming(far, SETUP)
    yield before, incoming
    before.close()
    incoming.parcel.close()
    incoming.fail("the test ends")


async def received(
    pair: tuple[HandoverChannel, Incoming], given: HandoverState, parcel: Parcel | None = None
) -> HandoverState:
    """Let the gateway before give something; return what the one that comes makes of it."""
    before, incoming = pair
    receiving = asyncio.ensure_future(incoming.receive())
    hello = await before.receive(Hello, SOON_S)
    assert (hello.version, hello.pid) == (VERSION, os.getpid())
    await before.send(given, parcel)
    await receiving
    return incoming.state


async def test_state_and_descriptors_are_taken_over_together(pair: tuple[HandoverChannel, Incoming]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        parcel = Parcel()
        parcel.put(server.fileno())
        given = HandoverState(VERSION, SETUP, len(parcel), claim={"since": 1.0}, device={"a": 1}, listeners=({"b": 2},))
        assert await received(pair, given, parcel) == given
        parcel.close()
        (taken,) = pair[1].parcel.descriptors
        assert os.fstat(taken).st_ino == os.fstat(server.fileno()).st_ino


CHANGED: list[tuple[dict[str, Any], str]] = [
    ({"version": VERSION + 1}, f"a state of version {VERSION + 1}: this zbridge accepts {VERSION}"),
    ({"version": VERSION - 1}, f"a state of version {VERSION - 1}: this zbridge accepts {VERSION}"),
    ({"setup": {**SETUP, "hq[0]": ["tcpudp"]}}, r"hq\[0\] was changed: stop and start the gateway instead"),
    ({"setup": {"hq[0]": ["alf"]}}, "robot was changed"),
    ({"setup": {**SETUP, "hq[1]": ["alf"]}}, r"hq\[1\] was changed"),
    ({"descriptors": 3}, "no descriptors|of 3 descriptors"),
]


@pytest.mark.parametrize(("fields", "told"), CHANGED)
async def test_what_another_version_or_another_configuration_made_is_refused(
    pair: tuple[HandoverChannel, Incoming], fields: dict[str, Any], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("zbridge.app.handover.sequence.PARCEL_S", 0.05)
    with pytest.raises(HandoverError, match=told):
        await received(pair, HandoverState(**{"version": VERSION, "setup": SETUP, "descriptors": 0, **fields}))


async def test_it_is_up_when_the_last_part_is_taken_over_and_every_part_begins_at_the_word(
    pair: tuple[HandoverChannel, Incoming],
) -> None:
    before, incoming = pair
    await received(pair, HandoverState(VERSION, SETUP, 0, device={}, listeners=({}, {})))
    parts = [asyncio.ensure_future(incoming.part_restored()) for _ in range(2)]
    with pytest.raises(HandoverError, match="sent nothing"):
        await before.receive(Up, 0.02)
    parts.append(asyncio.ensure_future(incoming.part_restored()))
    await before.receive(Up, SOON_S)
    assert not any(part.done() for part in parts)
    assert not incoming.begun.is_set()
    await before.send(Go())
    await asyncio.gather(*parts)
    assert incoming.begun.is_set()


async def test_a_robot_that_is_not_served_is_no_part(pair: tuple[HandoverChannel, Incoming]) -> None:
    before, incoming = pair
    await received(pair, HandoverState(VERSION, SETUP, 0, listeners=({},)))
    part = asyncio.ensure_future(incoming.part_restored())
    await before.receive(Up, SOON_S)
    await before.send(Go())
    await part


async def test_a_gateway_that_takes_everything_back_ends_its_successor(pair: tuple[HandoverChannel, Incoming]) -> None:
    before, incoming = pair
    await received(pair, HandoverState(VERSION, SETUP, 0))
    finishing = asyncio.ensure_future(incoming.finish())
    await before.receive(Up, SOON_S)
    await before.send(Failed("the robot moves"))
    with pytest.raises(HandoverError, match="the robot moves"):
        await finishing
    assert not incoming.begun.is_set()


async def test_why_a_successor_ends_is_told(pair: tuple[HandoverChannel, Incoming]) -> None:
    before, incoming = pair
    incoming.fail("its file is wrong")
    with pytest.raises(HandoverError, match="its file is wrong"):
        await before.receive(Hello, SOON_S)
    with pytest.raises(HandoverError, match="the other process has ended"):
        await before.receive(Hello, SOON_S)
