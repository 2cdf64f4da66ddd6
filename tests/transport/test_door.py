"""Sockets that go from one owner to another: nothing is read twice, nothing is lost, and no peer sees an end."""

from __future__ import annotations

import asyncio
import socket
import struct
from unittest.mock import Mock

import pytest

from tests.transport.recorder import LOCAL, Recorder, connected, until
from zbridge.errors import ProtocolError
from zbridge.transport import Door, Parcel, listen
from zbridge.transport.kernel import KERNEL
from zbridge.transport.tcp import attach

pytestmark = pytest.mark.both_loops


async def test_what_came_while_a_link_was_held_is_read_once_by_who_took_it_over() -> None:
    async with connected() as pair:
        pair.here.suspend()
        pair.there.write(b"early")
        parcel = Parcel()
        given = pair.here.export(parcel)
        await asyncio.sleep(0.05)
        assert not pair.near.data
        other = Recorder()
        pair.here.detach()
        await asyncio.sleep(0.05)
        link = await attach(given, parcel, other)
        pair.there.write(b" and late")
        await other.until("received", received=14)
        assert other.data == b"early and late"
        link.write(b"answer")
        await pair.far.until("received", received=6)
        link.abort()
        pair.near.lost("released")  # nobody tells it: that is the point


async def test_a_shut_door_keeps_who_comes_for_the_next_owner() -> None:
    door, came = Door(), []

    def receiver() -> Recorder:
        came.append(Recorder())
        return came[-1]

    async with listen(LOCAL, Recorder, door=door) as address:
        door.shut()
        await asyncio.sleep(0)
        with socket.create_connection((address.host, address.port)) as peer:
            parcel = Parcel()
            other = Door(door.export(parcel), parcel)
            async with listen(address, receiver, door=other) as again:
                assert again == address
                await asyncio.sleep(0.05)
                assert not came
                await other.open()
                peer.sendall(b"hello")
                await until(lambda: bool(came))
                await came[0].until("received", received=5)


def test_a_descriptor_is_taken_once_and_the_rest_is_closed() -> None:
    with socket.socket() as one:
        parcel = Parcel()
        assert [parcel.put(one.fileno()), parcel.put(one.fileno())] == [0, 1]
        taken = socket.socket(fileno=parcel.take(0))
        for number in (0, 2, None, "1"):
            with pytest.raises(ProtocolError, match="no descriptor"):
                parcel.take(number)
        parcel.close()
        parcel.close()
        taken.close()


async def test_a_connection_that_ended_before_it_was_attached_is_closed_once() -> None:
    adopted: list[socket.socket] = []

    def adopt(descriptor: int) -> socket.socket:
        adopted.append(socket.socket(fileno=descriptor))
        return adopted[0]

    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as peer:
        connection, _ = server.accept()
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closes with a reset
    receiver = Recorder()
    await attach({"tcp": 0}, Parcel([connection.detach()]), receiver, Mock(wraps=KERNEL, adopt=adopt))
    await receiver.until("lost")
    await asyncio.sleep(0.01)
    assert adopted[0].fileno() == -1, "its number may be that of another file by now"
