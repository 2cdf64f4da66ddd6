"""Messages and file descriptors between two ends of a real socket."""

import contextlib
import os
import socket
from collections.abc import Iterator

import pytest

from zbridge.host.fd_channel import (
    Closed,
    FdChannel,
    Fork,
    Forked,
    Heartbeat,
    Message,
    Opened,
    Ready,
    Started,
    Succeeded,
    close_all,
)
from zbridge.host.fd_channel import WantSuccessor as Want
from zbridge.robot.observer import Boundary, LastStop, StopFrame

STOP = LastStop(driven=True, frames=(StopFrame(b"\x01"), StopFrame(b"\x02", True)), gap_s=0.1, state="established")
MESSAGES: list[Message] = [
    Heartbeat(STOP, {3: Boundary(outgoing=False)}, hands_over=True),
    Opened(3, "vehicle", drives=False),
    Closed(3),
    Want(),
    Succeeded(),
    Started("a faulty file"),
    Fork("/etc/r1.toml", "r1", verbose=True),
    Forked(7),
    Ready(2),
]


@pytest.fixture
def ends() -> Iterator[tuple[FdChannel, FdChannel]]:
    near, far = FdChannel.pair()
    other = FdChannel(far)
    yield near, other
    near.close()
    other.close()


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_message_arrives_as_it_was_sent(ends: tuple[FdChannel, FdChannel], message: Message) -> None:
    assert ends[0].send(message)
    assert ends[1].receive() == (message, [])


def test_a_descriptor_arrives_as_one_for_the_same_file(ends: tuple[FdChannel, FdChannel]) -> None:
    reading, writing = os.pipe()
    ends[0].send(Want(), [writing])
    os.close(writing)
    received = ends[1].receive()
    assert received is not None
    (descriptor,) = received[1]
    assert not os.get_inheritable(descriptor)
    os.write(descriptor, b"x")
    assert os.read(reading, 9) == b"x"
    close_all([reading, descriptor])


def test_the_end_of_the_other_process_is_seen_after_its_last_message(ends: tuple[FdChannel, FdChannel]) -> None:
    with pytest.raises(BlockingIOError):
        ends[1].receive()
    ends[0].send(Succeeded())
    ends[0].close()
    assert ends[1].receive() == (Succeeded(), [])
    assert ends[1].receive() is None
    assert not ends[1].send(Succeeded())


def test_what_a_process_told_before_it_died_is_seen_though_it_left_something_unread(
    ends: tuple[FdChannel, FdChannel],
) -> None:
    ends[1].send(Started())
    ends[0].send(Heartbeat())
    ends[0].send(Succeeded())
    ends[0].close()
    assert [ends[1].receive() for _ in range(3)] == [(Heartbeat(), []), (Succeeded(), []), None]


def test_what_finds_no_room_is_counted_and_does_not_block(ends: tuple[FdChannel, FdChannel]) -> None:
    while ends[0].send(Heartbeat()):
        pass
    assert ends[0].unsent == 1


@pytest.mark.parametrize("data", [b"\xc1", b"\x82\xa4type\xa7started\xa6reason\xa1\xff"], ids=["form", "text"])
def test_what_is_no_message_is_an_error_and_its_descriptors_are_closed(data: bytes) -> None:
    near, far = FdChannel.pair()
    with far, contextlib.closing(near), socket.socket() as sent:
        before = len(os.listdir("/proc/self/fd"))
        socket.send_fds(far, [data], [sent.fileno()])
        with pytest.raises(ValueError, match=r"malformed|utf-8") as raised:
            near.receive()
        assert type(raised.value) is ValueError
        assert len(os.listdir("/proc/self/fd")) == before
