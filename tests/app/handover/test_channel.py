"""The channel between a gateway and its successor: what is said of an end, whenever it comes."""

from __future__ import annotations

import asyncio
import os
import socket
import tempfile
from collections.abc import Iterator

import pytest

from zbridge.app.handover import channel as channels
from zbridge.app.handover.channel import VERSION, EndError, Failed, Go, HandoverChannel, HandoverState, Hello
from zbridge.errors import HandoverError
from zbridge.transport import Parcel

ENDED = "^the other process has ended$"


@pytest.fixture
def ends() -> Iterator[tuple[HandoverChannel, socket.socket]]:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield HandoverChannel(ours), theirs


async def test_an_end_is_told_as_such_while_sending_and_while_waiting(
    ends: tuple[HandoverChannel, socket.socket],
) -> None:
    channel, other = ends
    other.close()
    with pytest.raises(EndError, match=ENDED):
        await channel.send(Hello(VERSION, os.getpid()))
    with pytest.raises(EndError, match=ENDED):
        await channel.receive(Hello, 5.0)


async def test_who_ends_with_a_message_of_ours_unread_has_ended(ends: tuple[HandoverChannel, socket.socket]) -> None:
    channel, other = ends
    await channel.send(Hello(VERSION, os.getpid()))
    other.close()
    with pytest.raises(EndError, match=ENDED):
        await channel.receive(Hello, 5.0)


async def test_the_last_word_of_who_takes_nothing_any_more_is_the_reason(
    ends: tuple[HandoverChannel, socket.socket],
) -> None:
    channel, other = ends
    HandoverChannel(other).send_now(Failed("its file is wrong"))
    other.close()
    with pytest.raises(HandoverError, match="its file is wrong"):
        await channel.send(Hello(VERSION, os.getpid()))


async def test_a_message_that_cannot_be_read_is_told_as_such(ends: tuple[HandoverChannel, socket.socket]) -> None:
    channel, other = ends
    for data in (b"\xc1", b"\x82\xa4type\xa6failed\xa6reason\xa1\xff"):
        other.sendall(len(data).to_bytes(4, "big") + data)
        with pytest.raises(HandoverError, match="sent an invalid message"):
            await channel.receive(Hello, 5.0)


async def test_any_number_of_descriptors_crosses_in_order_and_no_child_inherits_them(
    ends: tuple[HandoverChannel, socket.socket],
) -> None:
    channel, other = ends
    files = [tempfile.TemporaryFile() for _ in range(3)]  # noqa: SIM115
    numbers = [file.fileno() for file in files] * 70
    await channel.send(Hello(VERSION, 7), Parcel([os.dup(number) for number in numbers]))
    theirs = HandoverChannel(other)
    assert await theirs.receive(Hello, 5.0) == Hello(VERSION, 7)
    parcel = await theirs.receive_parcel(len(numbers), 5.0)
    assert [os.fstat(each).st_ino for each in parcel.descriptors] == [os.fstat(each).st_ino for each in numbers]
    assert not any(os.get_inheritable(each) for each in parcel.descriptors)
    parcel.close()
    for file in files:
        file.close()


async def test_descriptors_that_do_not_come_are_told_and_those_that_came_are_closed(
    ends: tuple[HandoverChannel, socket.socket],
) -> None:
    channel, other = ends
    with tempfile.TemporaryFile() as file:
        before = set(os.listdir("/proc/self/fd"))
        socket.send_fds(other, [b"."], [file.fileno()])
        with pytest.raises(HandoverError, match="no descriptors: timed out"):
            await channel.receive_parcel(2, 0.02)
        socket.send_fds(other, [b"."], [file.fileno()])
        other.sendall(b".")
        with pytest.raises(HandoverError, match="1 of 2 descriptors"):
            await channel.receive_parcel(2, 5.0)
        assert set(os.listdir("/proc/self/fd")) == before


async def test_a_message_that_is_not_expected_too_large_or_late_is_told(
    ends: tuple[HandoverChannel, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    channel, other = ends
    HandoverChannel(other).send_now(Go())
    with pytest.raises(HandoverError, match="received Go, expected Hello"):
        await channel.receive(Hello, 5.0)
    with pytest.raises(HandoverError, match=r"sent nothing for 0\.02 s"):
        await channel.receive(Hello, 0.02)
    other.sendall((2**26 + 1).to_bytes(4, "big"))
    with pytest.raises(HandoverError, match="message of 67108865 bytes exceeds 67108864"):
        await channel.receive(Hello, 5.0)


async def test_a_large_message_comes_whole(ends: tuple[HandoverChannel, socket.socket]) -> None:
    channel, other = ends
    given = HandoverState(VERSION, {"map": bytes(3 * 2**20)}, 0)
    sending = asyncio.ensure_future(channel.send(given))
    assert await HandoverChannel(other).receive(HandoverState, 5.0) == given
    await sending


async def test_who_takes_nothing_is_told_in_time(
    ends: tuple[HandoverChannel, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("SEND_S", "REASON_S"):
        monkeypatch.setattr(channels, name, 0.02)
    with pytest.raises(HandoverError, match="the other process is stalled: timed out"):
        await ends[0].send(HandoverState(VERSION, {"map": bytes(3 * 2**20)}, 0))


async def test_an_end_wakes_who_waits_and_may_be_told_twice(ends: tuple[HandoverChannel, socket.socket]) -> None:
    theirs = HandoverChannel(ends[1])
    waiting = asyncio.ensure_future(theirs.receive(Hello))
    await asyncio.sleep(0.02)
    theirs.close()
    theirs.close()
    with pytest.raises(EndError):
        await waiting
    with pytest.raises(EndError, match=ENDED):
        await ends[0].receive(Hello, 5.0)
