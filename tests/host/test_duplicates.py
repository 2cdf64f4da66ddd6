"""The stop over duplicates of real sockets, and the end that a peer sees."""

import asyncio
import contextlib
import os
import socket
import threading
from collections.abc import Iterator

import pytest

from zbridge.host import duplicates
from zbridge.host.duplicates import Duplicates
from zbridge.host.memory import SLOTS
from zbridge.robot.observer import Boundary, LastStop, StopFrame

STOP = LastStop(driven=True, frames=(StopFrame(b"one"), StopFrame(b"two")))


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(duplicates, "PERIOD_S", 0.0)


class Robot:
    """The robot's end of a TCP connection, and the gateway's, which the dead process had."""

    def __init__(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            self.gateway = socket.create_connection(server.getsockname())
            self.end, _ = server.accept()
        self.end.settimeout(5.0)

    def crash(self) -> None:
        self.gateway.close()

    def close(self) -> None:
        self.gateway.close()
        self.end.close()


@pytest.fixture
def robot() -> Iterator[Robot]:
    with contextlib.closing(Robot()) as robot:
        yield robot


@pytest.fixture
def kept(robot: Robot) -> Iterator[Duplicates]:
    with contextlib.closing(Duplicates()) as kept:
        kept.opened(1, "robot", [os.dup(robot.gateway.fileno())], drives=True)
        robot.crash()
        yield kept


async def test_the_stop_is_written_several_times_frame_by_frame(robot: Robot, kept: Duplicates) -> None:
    assert await kept.stop(STOP) is True
    kept.close()
    received = b"".join(iter(lambda: robot.end.recv(100), b""))
    assert received == b"onetwo" * duplicates.TIMES


async def test_a_link_that_does_not_drive_gets_no_stop(robot: Robot) -> None:
    with contextlib.closing(Duplicates()) as kept:
        kept.opened(1, "laser", [os.dup(robot.gateway.fileno())], drives=False)
        assert await kept.stop(STOP) is None


async def test_a_frame_that_was_begun_is_not_continued_with_a_stop(robot: Robot, kept: Duplicates) -> None:
    kept.set_boundaries({1: Boundary(outgoing=False), 9: Boundary()})
    assert await kept.stop(STOP) is False
    kept.close()
    assert robot.end.recv(100) == b""


async def test_no_stop_is_written_where_there_is_none(kept: Duplicates) -> None:
    assert await kept.stop(LastStop(driven=True)) is None


async def test_a_robot_that_has_gone_takes_no_stop(robot: Robot, kept: Duplicates) -> None:
    robot.end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    robot.end.close()
    assert await kept.stop(STOP) is False


async def test_a_duplicate_that_is_dropped_shows_the_robot_the_end(robot: Robot, kept: Duplicates) -> None:
    kept.closed(2)
    kept.closed(1)
    assert robot.end.recv(100) == b""
    assert len(kept) == 0


async def test_datagrams_go_from_the_gateways_port_to_the_address_of_the_stream(robot: Robot) -> None:
    with contextlib.closing(Duplicates()) as kept, contextlib.ExitStack() as stack:
        own, theirs = (stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(2))
        own.bind(("127.0.0.1", 0))
        theirs.bind(robot.end.getsockname())
        theirs.settimeout(5.0)
        kept.opened(1, "robot", [os.dup(robot.gateway.fileno())], drives=True)
        last = LastStop(driven=True, frames=(StopFrame(b"stop", True),))
        assert await kept.stop(last) is False, "its socket for datagrams is not known yet"
        kept.opened(1, "robot", [os.dup(robot.gateway.fileno()), os.dup(own.fileno())], drives=True)
        assert await kept.stop(last) is True
        assert theirs.recvfrom(100) == (b"stop", own.getsockname())


def test_what_is_no_link_and_links_beyond_the_bound_are_closed(tmp_path: object) -> None:
    before = len(os.listdir("/proc/self/fd"))
    kept = Duplicates()
    kept.opened(1, "file", [os.open("/proc/self/stat", os.O_RDONLY)], drives=True)
    assert len(kept) == 0
    with socket.socket() as one:
        for link in range(SLOTS + 3):
            kept.opened(link, "robot", [os.dup(one.fileno())], drives=True)
        assert len(kept) == SLOTS
        kept.close()
    assert len(os.listdir("/proc/self/fd")) == before


async def test_a_robot_that_is_held_up_in_its_sending_reads_its_stop_before_the_end() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as ours:
        robot, _ = server.accept()
        ours.setblocking(False)
        read: list[bytes] = []

        def talk() -> None:
            with robot, contextlib.suppress(OSError):
                robot.sendall(bytes(8_000_000))  # more than both sides keep
                while data := robot.recv(100):
                    read.append(data)

        thread = threading.Thread(target=talk)
        thread.start()
        await asyncio.sleep(0.2)
        kept = Duplicates()
        kept.opened(1, "robot", [os.dup(ours.fileno())], drives=True)
        kept.set_boundaries({1: Boundary()})
        ours.close()
        assert await kept.stop(LastStop(frames=(StopFrame(b"stop"),)), 1)
        await kept.drain()
        thread.join(5)
    assert b"".join(read) == b"stop"
