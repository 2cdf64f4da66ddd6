"""What a dead process left, with what the process before it had left: sockets are real, processes are played."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import msgspec
import pytest

from zbridge.app.handover.channel import VERSION, HandoverState
from zbridge.errors import HandoverError
from zbridge.host import duplicates
from zbridge.host.deposit import Deposit
from zbridge.host.fd_channel import Deposited
from zbridge.host.memory import MemoryWriter
from zbridge.robot.observer import Boundary, LastStop, StopFrame
from zbridge.wire.frames import Partial

STOP = LastStop(frames=(StopFrame(b"stop"),), state="established")


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(duplicates, "PERIOD_S", 0.0)


class Played:
    """A process: its memory, and what its supervisor has of it."""

    def __init__(self, stream: socket.socket, given: Played | None = None) -> None:
        self.deposit, self.memory, self._stream = Deposit(), MemoryWriter(), stream
        self.deposit.share(os.dup(self.memory.descriptor))
        self.memory.close_descriptor()
        self.link = 0
        if given is not None:
            self.deposit.predecessor, given.deposit = given.deposit, Deposit()

    def opens(self, link: int, name: str = "robot") -> None:
        self.link = link
        self.memory.begin(link)
        self.deposit.duplicates.opened(link, name, [os.dup(self._stream.fileno())], drives=True)

    def deposits(self, what: str) -> None:
        self.leaves(msgspec.msgpack.encode(HandoverState(VERSION, {}, 1, device={"what": what})))

    def leaves(self, data: bytes) -> None:
        self.deposit.note(Deposited(((self.link, 0),), self.memory.deposit(data), len(data)))

    def close(self) -> None:
        self.deposit.close()
        self.memory.close()


class Pair:
    """A robot's end of a stream, and the processes that have the other one."""

    def __init__(self) -> None:
        self.stream, self.robot = socket.socketpair()
        self.robot.setblocking(False)
        self.processes: list[Played] = []

    def process(self, given: Played | None = None) -> Played:
        self.processes.append(Played(self.stream, given))
        return self.processes[-1]

    def close(self) -> None:
        for process in self.processes:
            process.close()
        self.stream.close()
        self.robot.close()


@pytest.fixture
def pair() -> Iterator[Pair]:
    pair = Pair()
    yield pair
    pair.close()


def inherited(deposit: Deposit) -> tuple[str, Partial]:
    """Take what was left; give whose state it is, and where the stream stands."""
    given, parcel = deposit.inheritance()
    assert len(parcel) == 1
    parcel.close()
    assert given.device is not None
    return given.device["what"], given.partials[0]


def test_a_process_leaves_its_state_its_sockets_and_where_its_stream_was_cut(pair: Pair) -> None:
    process = pair.process()
    process.opens(1)
    process.deposits("first")
    process.memory.cut(1, Partial(b"half"))
    assert inherited(process.deposit) == ("first", Partial(b"half"))


def test_why_nothing_can_be_taken_over_is_told(pair: Pair) -> None:
    process = pair.process()

    def reason() -> str:
        with pytest.raises(HandoverError) as refused:
            process.deposit.inheritance()
        return str(refused.value)

    process.opens(1)
    assert "left no state" in reason()
    process.deposits("first")
    process.memory.reading(1)
    assert "died while it read" in reason()
    process.memory.cut(1, Partial())
    process.deposit.duplicates.set_boundaries({1: Boundary(outgoing=False)})
    assert "written half a frame" in reason()
    process.deposit.duplicates.set_boundaries({1: Boundary()})
    process.deposit.closed(1)
    assert "left no state" in reason()


def test_until_its_first_deposit_a_process_leaves_what_it_was_given(pair: Pair) -> None:
    before = pair.process()
    before.opens(1)
    before.deposits("before")
    before.memory.cut(1, Partial(skip=40))
    after = pair.process(before)
    assert inherited(after.deposit) == ("before", Partial(skip=40))
    after.opens(7)
    assert inherited(after.deposit) == ("before", Partial(skip=40)), "it has read nothing"
    after.memory.cut(7, Partial(skip=30))
    assert inherited(after.deposit) == ("before", Partial(skip=30)), "it has read ten bytes"
    after.memory.reading(7)
    with pytest.raises(HandoverError, match="died while it read"):
        after.deposit.inheritance()
    after.memory.cut(7, Partial())
    after.deposits("after")
    assert inherited(after.deposit) == ("after", Partial())
    assert after.deposit.predecessor is None


def test_a_third_process_leaves_what_the_first_deposited_if_nobody_has_since(pair: Pair) -> None:
    first = pair.process()
    first.opens(1)
    first.deposits("first")
    second = pair.process(first)
    second.opens(2)
    second.memory.cut(2, Partial(b"ab"))
    third = pair.process(second)
    assert inherited(third.deposit) == ("first", Partial(b"ab"))


async def test_the_stop_of_the_process_before_is_written_until_there_is_a_newer_one(pair: Pair) -> None:
    before = pair.process()
    before.opens(1)
    before.deposit.last = STOP
    after = pair.process(before)
    assert await after.deposit.stop(1)
    after.opens(2)
    after.deposit.last = LastStop()
    assert await after.deposit.stop(1), "over its own link, as it has told no stop"
    assert pair.robot.recv(100) == b"stopstop"
    after.deposit.last = LastStop(frames=(StopFrame(b"newer"),))
    assert await after.deposit.stop(1)
    assert pair.robot.recv(100) == b"newer"


def test_a_deposit_of_nothing_closes_what_was_given_so_that_the_robot_sees_an_end(pair: Pair) -> None:
    before = pair.process()
    before.opens(1)
    after = pair.process(before)
    pair.stream.close()
    assert after.deposit.has_links
    with pytest.raises(BlockingIOError):
        pair.robot.recv(1)
    after.deposit.note(Deposited())
    assert not after.deposit.has_links
    assert pair.robot.recv(1) == b""


def test_a_link_that_is_closed_on_purpose_is_closed_in_all_deposits(pair: Pair) -> None:
    before = pair.process()
    before.opens(1)
    after = pair.process(before)
    after.opens(2)
    pair.stream.close()
    after.deposit.closed(2)
    assert pair.robot.recv(1) == b""
    assert not after.deposit.has_links


@pytest.mark.parametrize("data", [b"\xc1", b"\x82\xa4type\xa5given\xa5setup\x81\xa1\xff\1"], ids=["form", "text"])
def test_a_state_that_cannot_be_read_is_told_as_such(pair: Pair, data: bytes) -> None:
    process = pair.process()
    process.opens(1)
    process.leaves(data)
    process.memory.cut(1, Partial())
    with pytest.raises(HandoverError, match="its deposit is invalid"):
        process.deposit.inheritance()
