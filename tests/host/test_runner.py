"""One robot of a supervisor: crashes and restarts, step by step. The test plays what sleeping processes tell."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import msgspec
import pytest

from zbridge.app.handover.channel import VERSION, EndError, Go, HandoverChannel, HandoverState, Hello, Up
from zbridge.errors import NotReady
from zbridge.host import duplicates, succession
from zbridge.host import runner as module
from zbridge.host.fd_channel import (
    Deposited,
    FdChannel,
    Fork,
    Heartbeat,
    Opened,
    Shared,
    Started,
    Succeeded,
    WantSuccessor,
)
from zbridge.host.files import RobotFile, check
from zbridge.host.memory import MemoryWriter
from zbridge.host.process import GatewayProcess
from zbridge.host.runner import RESUMED_CRASHES, Runner
from zbridge.host.succession import Make
from zbridge.robot.observer import LastStop, StopFrame
from zbridge.wire.frames import Partial

SOON_S = 10.0
STOP = LastStop(frames=(StopFrame(b"stop."),), state="established")


class Child:
    """A process that sleeps, and what it tells: the gateway of one robot, whose stream the test has."""

    def __init__(self, file: RobotFile, stream: socket.socket, take_over: int | None) -> None:
        self.file = file
        self.channel, self._far = FdChannel.pair()
        self._told, self._memory = FdChannel(self._far), MemoryWriter()
        self._stream = stream
        self.handover = HandoverChannel(socket.socket(fileno=os.dup(take_over))) if take_over is not None else None
        self.pid = os.posix_spawnp("sleep", ["sleep", "3600"], {}, setsigmask=[signal.SIGUSR2])
        self.tell(Shared(), self._memory.descriptor)
        self._memory.close_descriptor()
        self.tell(Heartbeat(hands_over=True))

    def tell(self, message: object, *descriptors: int) -> None:
        assert self._told.send(message, descriptors)  # type: ignore[arg-type]

    def serves(self, what: str, partial: Partial | None = None) -> None:
        """Have the robot's stream, and deposit a state and a stop."""
        self.opens()
        self.deposits(what)
        if partial is not None:
            self._memory.cut(1, partial)

    def opens(self) -> None:
        self._memory.begin(1)
        self.tell(Opened(1, "robot"), self._stream.fileno())

    def deposits(self, what: str) -> None:
        data = msgspec.msgpack.encode(HandoverState(VERSION, {}, 1, device={"what": what}))
        area = self._memory.deposit(data)
        self.tell(Deposited(((1, 0),), area, len(data)))
        self._memory.commit(area)
        self.tell(Heartbeat(STOP, hands_over=True))

    def dies(self) -> None:
        os.kill(self.pid, signal.SIGKILL)
        self._told.close()
        if self.handover is not None:
            self.handover.close()

    async def answer(self) -> Started:
        """Wait for the answer to what it asked for."""
        while True:
            with contextlib.suppress(BlockingIOError):
                received = self._told.receive()
                assert received is not None
                assert isinstance(received[0], Started)
                return received[0]
            await asyncio.sleep(0.001)

    # As a successor

    async def takes_over(self) -> tuple[str, Partial]:
        """Say hello, take what is given, and say that it is up; give whose state it is, and where the stream stands."""
        assert self.handover is not None
        await self.handover.send(Hello(VERSION, self.pid))
        given = await self.handover.receive(HandoverState, SOON_S)
        (await self.handover.receive_parcel(1, SOON_S)).close()
        await self.handover.send(Up())
        assert given.device is not None
        return given.device["what"], given.partials[0]

    async def goes(self) -> None:
        assert self.handover is not None
        await self.handover.receive(Go, SOON_S)

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
        if self.channel.fileno() >= 0:
            asyncio.get_running_loop().remove_reader(self.channel.fileno())
            self.channel.close()
        self._told.close()
        self._memory.close()
        if self.handover is not None:
            self.handover.close()


class PlayedLauncher:
    """Starts children; keeps all of them, and the files that they run by."""

    def __init__(self, make: Make, stream: socket.socket) -> None:
        self.children: list[Child] = []
        self.refuses: list[NotReady] = []
        self._make, self._stream = make, stream

    async def start(self, file: RobotFile, take_over: int | None = None, **how: object) -> GatewayProcess:
        if self.refuses:
            raise self.refuses.pop()
        self.children.append(child := Child(file, self._stream, take_over))
        return self._make(child.pid, child.channel, file)


class Scene:
    """A runner, its children, and the robot's end of the stream."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path = path
        self.write('[robot]\nname = "r1"\n[device]\nprotocol = "tcpudp"\nconnect = ["tcp://127.0.0.1:1"]\n')
        file = check(path, path.read_bytes())
        assert file.fault is None
        self.stream, self.robot = socket.socketpair()
        self.robot.setblocking(False)
        monkeypatch.setattr(module, "Launcher", self._launch)
        self.runner = Runner(file, None, Fork("", ""), changed=lambda: None)  # type: ignore[arg-type]
        self._tasks = [asyncio.ensure_future(self.runner.run()), asyncio.ensure_future(self._reap())]

    def _launch(self, _: object, make: Make, request: Fork) -> PlayedLauncher:
        self.launcher = PlayedLauncher(make, self.stream)
        return self.launcher

    async def _reap(self) -> None:
        while True:
            for process in self.runner.processes:
                process.reap()
            await asyncio.sleep(0.001)

    def write(self, content: str) -> None:
        """Write the robot's file."""
        self.path.write_text(content)

    def be_fifo(self) -> None:
        """Let a FIFO be where the robot's file was."""
        self.path.unlink()
        os.mkfifo(self.path)

    async def child(self, number: int) -> Child:
        """Wait for a child by its number, from 0."""
        await self.until(lambda: len(self.launcher.children) > number)
        return self.launcher.children[number]

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(SOON_S):
            while not condition():  # noqa: ASYNC110
                await asyncio.sleep(0.001)

    async def successor(self, child: Child) -> Child:
        """Let a child ask for a successor; give it."""
        near, far = socket.socketpair()
        child.tell(WantSuccessor(), far.fileno())
        near.close()
        far.close()
        number = len(self.launcher.children)
        assert (await child.answer()).reason is None
        return self.launcher.children[number]

    def read(self) -> bytes:
        """What the robot has read since; b"" where it saw an end."""
        with contextlib.suppress(BlockingIOError):
            return self.robot.recv(1000)
        return b"nothing"

    async def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.wait(self._tasks)
        for process in self.runner.processes:
            process.close()
        for child in self.launcher.children:
            child.close()
        self.stream.close()
        self.robot.close()


@pytest.fixture
async def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Scene]:
    for each in (duplicates, succession, module):
        monkeypatch.setattr(each, "PERIOD_S", 0.0)
    made = Scene(tmp_path / "r1.toml", monkeypatch)
    yield made
    await made.close()


async def test_the_robot_of_a_process_that_died_is_stopped_first_and_keeps_its_connection(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first", Partial(b"half"))
    first.dies()
    second = await scene.child(1)
    assert await second.takes_over() == ("first", Partial(b"half"))
    await second.goes()
    assert scene.read() == 4 * b"stop."
    second.serves("second")
    await scene.until(lambda: scene.runner.is_idle)
    assert scene.runner.restarts == 1


async def test_what_one_successor_does_not_take_over_is_offered_to_another_one(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first")
    first.dies()
    (await scene.child(1)).dies()
    third = await scene.child(2)
    assert await third.takes_over() == ("first", Partial())
    await third.goes()
    assert scene.read() == 4 * b"stop."


async def test_a_successor_that_dies_before_its_first_deposit_leaves_what_it_was_given(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first", Partial(skip=9))
    second = await scene.successor(first)
    first.tell(Succeeded())
    await scene.until(lambda: scene.runner.process is not None and scene.runner.process.pid == second.pid)
    second.opens()
    second.dies()
    third = await scene.child(2)
    assert await third.takes_over() == ("first", Partial(skip=9))
    await third.goes()
    assert scene.read() == 4 * b"stop.", "it had read nothing, but granted leases"
    assert not scene.launcher.children[0].file.fault


async def test_what_a_process_took_over_after_a_crash_is_left_to_the_next_one_if_it_dies_at_once(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first", Partial(skip=9))
    first.dies()
    for number in (1, 2):
        successor = await scene.child(number)
        assert await successor.takes_over() == ("first", Partial(skip=9))
        await successor.goes()
        successor.opens()
        if number == 1:
            successor.dies()
    assert scene.read() == 8 * b"stop.", "after each crash"


async def test_a_successor_that_dies_at_the_word_to_go_has_crashed_though_its_end_is_seen_first(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first")
    second = await scene.successor(first)
    assert scene.runner.process is not None
    asyncio.get_running_loop().remove_reader(scene.runner.process.channel.fileno())  # its word is heard late
    first.tell(Succeeded())
    second.dies()
    third = await scene.child(2)
    assert await third.takes_over() == ("first", Partial())
    await third.goes()
    assert scene.read() == 4 * b"stop."


async def test_a_successor_that_ends_before_it_has_the_robot_changes_nothing(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first")
    (await scene.successor(first)).dies()
    await scene.until(lambda: scene.runner.is_idle)
    assert scene.runner.process is not None
    assert scene.runner.process.pid == first.pid
    assert scene.read() == b"nothing"


async def test_a_process_that_dies_before_it_has_handed_over_leaves_its_connection_to_a_new_successor(
    scene: Scene,
) -> None:
    first = await scene.child(0)
    first.serves("first")
    second = await scene.successor(first)
    first.dies()
    third = await scene.child(2)
    assert await third.takes_over() == ("first", Partial())
    with pytest.raises(EndError):  # the channel of the one that waited ended with the first process
        await second.takes_over()
    with pytest.raises(ProcessLookupError):
        os.kill(second.pid, 0)
    await third.goes()
    assert scene.read() == 4 * b"stop."


async def test_a_process_that_has_handed_over_is_no_crash_whatever_becomes_of_it(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first")
    second = await scene.successor(first)
    first.tell(Succeeded())
    first.dies()
    second.serves("second")
    await scene.until(lambda: scene.runner.is_idle)
    assert scene.runner.process is not None
    assert scene.runner.process.pid == second.pid
    assert scene.read() == b"nothing"
    assert len(scene.launcher.children) == 2


async def test_the_third_crash_in_a_row_is_the_last_one_that_keeps_the_connection(scene: Scene) -> None:
    child = await scene.child(0)
    child.serves("0")
    for number in range(1, RESUMED_CRASHES + 1):
        child.dies()
        child = await scene.child(number)
        await child.takes_over()
        await child.goes()
        child.serves(str(number))
    scene.stream.close()
    child.dies()
    await scene.until(lambda: scene.read() == b"")
    assert (await scene.child(RESUMED_CRASHES + 1)).handover is None, "it connects anew"


async def test_after_a_crash_the_robot_is_served_by_the_content_that_ran_whatever_the_file_holds(
    scene: Scene,
) -> None:
    first = await scene.child(0)
    first.serves("first")
    scene.write("nonsense")
    first.dies()
    second = await scene.child(1)
    assert second.file.content == first.file.content
    second.dies()
    third = await scene.child(2)
    assert third.file.content == first.file.content
    third.dies()
    assert (await scene.child(3)).file.content == first.file.content, "also the one that connects anew"


async def test_a_restart_reads_the_file_and_what_was_read_counts_when_the_successor_has_the_robot(
    scene: Scene,
) -> None:
    first = await scene.child(0)
    first.serves("first")
    content = first.file.content.decode() + "[control]\nlease_s = 2.0\n"
    scene.write(content)
    second = await scene.successor(first)
    assert second.file.content == content.encode()
    assert scene.runner.file.content == first.file.content
    first.tell(Succeeded())
    await scene.until(lambda: scene.runner.file.content == content.encode())


async def test_a_restart_with_a_file_that_cannot_be_read_is_refused_with_the_reason(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first")
    scene.be_fifo()
    near, far = socket.socketpair()
    with near, far:
        first.tell(WantSuccessor(), far.fileno())
        assert (await first.answer()).reason == f"{scene.path}: expected a regular file"
    assert len(scene.launcher.children) == 1


def _only_kill(process: GatewayProcess, number: int) -> None:
    """Signal a process that bears every other signal."""
    if number == signal.SIGKILL:
        os.kill(process.pid, number)


async def test_a_changed_file_whose_successor_cannot_be_started_ends_the_process_and_starts_another_one(
    scene: Scene,
) -> None:
    first = await scene.child(0)
    await scene.until(lambda: scene.runner.process is not None and scene.runner.process.hands_over)
    scene.runner.restart(scene.runner.file)
    scene.launcher.refuses = [NotReady("no fork server")]
    near, far = socket.socketpair()
    with near, far:
        first.tell(WantSuccessor(), far.fileno())
        assert (await first.answer()).reason == "no fork server"
    assert (await scene.child(1)).file == scene.runner.file
    assert (scene.runner.restarts, scene.runner.state) == (0, "offline"), "it was asked for"


async def test_the_end_of_a_runner_ends_its_process_in_order_and_starts_no_other_one(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first")
    await asyncio.wait_for(scene.runner.end(), SOON_S)
    await scene.until(lambda: not scene.runner.processes)
    assert scene.runner.state == "down"
    assert len(scene.launcher.children) == 1


async def test_a_process_that_does_not_end_is_killed(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "END_S", 0.01)
    await scene.child(0)
    await scene.until(lambda: scene.runner.process is not None)
    assert scene.runner.process is not None
    monkeypatch.setattr(GatewayProcess, "signal", _only_kill)
    await asyncio.wait_for(scene.runner.end(), SOON_S)
    await scene.until(lambda: scene.runner.process is None)


async def test_a_successor_that_the_supervisor_has_no_descriptor_for_is_refused_at_once(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first")
    first.tell(WantSuccessor())  # the kernel drops what finds no room in the receiver's table
    assert (await first.answer()).reason == "the supervisor has no free descriptor"
    assert len(scene.launcher.children) == 1


async def test_a_file_that_changes_while_its_process_dies_restarts_the_process_that_goes_on(scene: Scene) -> None:
    first = await scene.child(0)
    first.serves("first")
    await scene.until(lambda: scene.runner.process is not None and scene.runner.process.deposit.deposited is not None)
    changed = msgspec.structs.replace(scene.runner.file, content=b"changed")
    scene.runner.restart(changed)
    await asyncio.sleep(0)
    first.dies()
    second = await scene.child(1)
    assert second.file.content == first.file.content, "the state that was left is of the content that ran"
    await second.takes_over()
    await second.goes()
    second.serves("second")
    await scene.until(lambda: scene.runner.process is not None and scene.runner.process.hands_over)
    third = await scene.successor(second)
    second.tell(Succeeded())
    assert third is scene.launcher.children[2]


@pytest.mark.parametrize("failure", ["pair", "inheritance"])
async def test_a_runner_without_free_descriptors_stops_the_robot_and_tries_again_later(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, failure: str
) -> None:
    first = await scene.child(0)
    first.serves("first")
    await scene.until(lambda: scene.runner.process is not None and scene.runner.process.deposit.deposited is not None)

    def fail(*_: object) -> object:
        raise OSError(24, "Too many open files")

    if failure == "pair":
        scene.launcher.refuses = [NotReady("Too many open files") for _ in range(2)]
    else:
        monkeypatch.setattr(socket, "socketpair", fail)
    first.dies()
    await scene.until(lambda: scene.runner.snapshot.next_at is not None)
    monkeypatch.undo()
    assert scene.read() == 4 * b"stop."
    assert (await scene.child(1)).handover is None
