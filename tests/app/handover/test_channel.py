"""The channel between a gateway and its successor: what is said of an end, whenever it comes."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import pytest

from zbridge.app.handover.channel import Channel, EndError
from zbridge.app.handover.messages import VERSION, Failed, Hello
from zbridge.errors import HandoverError

ENDED = "^the other side has ended$"


@pytest.fixture
def ends() -> Iterator[tuple[Channel, socket.socket]]:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield Channel(ours), theirs


async def test_an_end_is_told_as_such_while_sending_and_while_waiting(ends: tuple[Channel, socket.socket]) -> None:
    channel, other = ends
    other.close()
    with pytest.raises(EndError, match=ENDED):
        await channel.send(Hello(VERSION, os.getpid()))
    with pytest.raises(EndError, match=ENDED):
        await channel.receive(Hello, 5.0)


async def test_who_ends_with_a_message_of_ours_unread_has_ended(ends: tuple[Channel, socket.socket]) -> None:
    channel, other = ends
    await channel.send(Hello(VERSION, os.getpid()))
    other.close()
    with pytest.raises(EndError, match=ENDED):
        await channel.receive(Hello, 5.0)


async def test_the_last_word_of_who_takes_nothing_any_more_is_the_reason(ends: tuple[Channel, socket.socket]) -> None:
    channel, other = ends
    Channel(other).say(Failed("its file is wrong"))
    other.close()
    with pytest.raises(HandoverError, match="its file is wrong"):
        await channel.send(Hello(VERSION, os.getpid()))


async def test_a_message_that_cannot_be_read_is_told_as_such(ends: tuple[Channel, socket.socket]) -> None:
    channel, other = ends
    for data in (b"\xc1", b"\x82\xa4type\xa6failed\xa6reason\xa1\xff"):
        other.sendall(len(data).to_bytes(4, "big") + data)
        with pytest.raises(HandoverError, match="cannot be understood"):
            await channel.receive(Hello, 5.0)
