"""The thread that reads a stream and says how late it was, on a pair of sockets."""

from __future__ import annotations

import queue
import socket
import time
from collections.abc import Iterator

import pytest

from zbridge.simulation.stream_reader import Read, StreamReader

SOON_S = 5.0


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield ours, theirs


def test_each_read_is_given_up_to_the_end_of_the_stream(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    reads: queue.Queue[Read] = queue.Queue()
    reader = StreamReader(ours, time.time(), reads.put)
    reader.start()
    theirs.send(b"one")
    assert reads.get(timeout=SOON_S).data == b"one"
    theirs.send(b"two")
    second = reads.get(timeout=SOON_S)
    assert (second.data, second.why) == (b"two", "")
    theirs.close()
    assert reads.get(timeout=SOON_S).data == b""
    reader.join(SOON_S)
    assert not reader.is_alive()


def test_data_that_waited_unread_makes_the_reader_late(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    reads: queue.Queue[Read] = queue.Queue()
    reader = StreamReader(ours, time.time() - 0.5, reads.put)
    theirs.send(b"one")
    reader.start()
    assert reads.get(timeout=SOON_S).late_s >= 0.5
    theirs.close()
    reader.join(SOON_S)
