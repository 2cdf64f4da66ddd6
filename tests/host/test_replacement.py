"""What a supervisor leaves to the code in its place, the rehearsal of that code, and when it is asked for."""

import asyncio
import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from zbridge.errors import HandoverError, NotReady
from zbridge.host import fork_server, replacement
from zbridge.host import supervisor as module
from zbridge.host.deposit import Deposit
from zbridge.host.fd_channel import Deposited, FdChannel, Fork, Forked, Heartbeat, Opened, Rehearse, Shared, in_memory
from zbridge.host.files import Changes, Follower, RobotFile
from zbridge.host.fork_client import ForkClient
from zbridge.host.fork_server import serve
from zbridge.host.memory import MemoryWriter
from zbridge.host.process import GatewayProcess
from zbridge.host.replacement import (
    SIGNALS,
    VERSION,
    ProcessState,
    RunnerState,
    ServerState,
    SupervisorState,
    encode,
    replace,
    restore,
)
from zbridge.host.runner import Runner
from zbridge.host.supervisor import Supervisor
from zbridge.host.watchdog import DRIVEN_S, Watchdog
from zbridge.robot.observer import Boundary, LastStop, StopFrame
from zbridge.wire.frames import Partial

LAST = LastStop(True, (StopFrame(b"stop"), StopFrame(b"also", datagram=True)), 0.01, "established")
FILE = RobotFile(Path("r1.toml"), b"", ("fleet", "r1"))
NOBODY = 2**22 + 1
"""A process id that Linux never gives."""


def empty(**fields: object) -> SupervisorState:
    return msgspec.structs.replace(SupervisorState(("robots",), at=1.0), **fields)


def stored(state: SupervisorState) -> contextlib.AbstractContextManager[int]:
    return in_memory("state", encode(state))


def test_a_state_is_read_as_it_was_written_as_often_as_wanted() -> None:
    reports = (
        (Shared(), (9,)),
        (Opened(1, "r1"), (14, 15)),
        (Deposited(((1, 0),), 1, 5), ()),
        (Heartbeat(LAST, {1: Boundary()}, hands_over=True), ()),
    )
    process = ProcessState(7, 8, 1.5, Watchdog(2.0, DRIVEN_S, 0.1, 3), reports)
    robots = (
        RunnerState(
            "robots/r1.toml", b"\xff", ("fleet", "r1"), frozenset({"tcp 127.0.0.1 1"}), True, 2, 1, None, process
        ),
        RunnerState("robots/r2.toml", b"", None, failures=6, next_at=61.5),
    )
    faults = {"robots/r2.toml": "colour"}
    state = empty(runners=robots, server=ServerState(11, 12, b"\0stamp"), faults=faults, watch=True)
    with stored(state) as descriptor:
        assert [restore(descriptor), restore(descriptor)] == [state, state]
    assert set(state.descriptors) == {8, 9, 12, 14, 15}


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (msgspec.msgpack.encode({"version": VERSION + 1, "sources": 5}), f"of version {VERSION}: Invalid value"),
        (b"\xc1", "no state of a supervisor"),
        (msgspec.msgpack.encode(empty()).replace(b"robots", b"robot\xff"), "no state of a supervisor"),
        (b"", "no state of a supervisor"),
    ],
    ids=["version", "form", "text", "nothing"],
)
def test_what_is_no_state_of_this_version_is_refused_and_told_as_such(data: bytes, reason: str) -> None:
    with in_memory("state", data) as descriptor, pytest.raises(HandoverError, match=reason):
        restore(descriptor)


def test_no_state_is_said_in_one_line() -> None:
    reading, writing = os.pipe()
    os.close(writing)
    try:
        with pytest.raises(HandoverError, match="no state of a supervisor"):
            restore(reading)
    finally:
        os.close(reading)


def test_a_watchdog_resumes_with_what_it_knew() -> None:
    watchdog = Watchdog(100.0)
    watchdog.heartbeat(101.0, driven=True)
    watchdog.extend()
    again = msgspec.msgpack.decode(msgspec.msgpack.encode(watchdog), type=Watchdog)
    assert (again.deadline, again.heartbeats) == (watchdog.deadline, 1)


# A process and its robot


def resumed_process(state: ProcessState) -> GatewayProcess:
    process = GatewayProcess(state.pid, FdChannel.inherited(state.channel), FILE, wants_successor=lambda *_: None)
    process.resume(state)
    return process


async def test_a_process_is_known_as_before_with_its_page_its_kept_state_and_the_stop_of_its_robot() -> None:
    near, far = FdChannel.pair()
    told, (ours, robot) = FdChannel(far), socket.socketpair()
    memory = MemoryWriter()
    before = GatewayProcess(NOBODY, near, FILE, wants_successor=lambda *_: None)
    told.send(Shared(), [memory.descriptor])
    memory.close_descriptor()
    told.send(Opened(3, "robot"), [ours.fileno()])
    told.send(Deposited(((3, 0),), memory.deposit(b"given"), 5))
    told.send(Heartbeat(LAST, {3: Boundary(outgoing=False)}, hands_over=True))
    before.receive()
    asyncio.get_running_loop().remove_reader(near.fileno())
    state = msgspec.msgpack.decode(msgspec.msgpack.encode(before.state), type=ProcessState)
    reports = tuple((message, tuple(map(os.dup, descriptors))) for message, descriptors in state.reports)
    after = resumed_process(msgspec.structs.replace(state, channel=os.dup(state.channel), reports=reports))
    before.close()
    ours.close()
    assert (after.last, after.hands_over) == (LAST, True)
    assert after.watchdog == before.watchdog
    assert [each.boundary for each in after.deposit.duplicates] == [Boundary(outgoing=False)]
    kept, shared = after.deposit.deposited, after.deposit.memory
    assert kept is not None
    assert shared is not None
    assert (kept.sockets, shared.deposit(kept.area, kept.size)) == (((3, 0),), b"given")
    memory.cut(3, Partial(b"half"))
    assert shared.partial(3) == Partial(b"half"), "it sees the same memory"
    told.send(Heartbeat(LastStop(frames=(StopFrame(b"stop"),))))
    after.receive()
    after.deposit.duplicates.set_boundaries({3: Boundary()})
    assert await after.deposit.stop(1)
    assert robot.recv(100) == b"stop"
    told.send(Heartbeat(LastStop(state="offline")))
    after.receive()
    assert after.last.state == "offline", "it hears the same process"
    after.close()
    assert robot.recv(100) == b"", "nobody has a duplicate"
    told.close()
    robot.close()
    memory.close()


def runner() -> Runner:
    return Runner(FILE, ForkClient(["false"]), Fork("", ""), changed=lambda: None)


@pytest.fixture
async def running() -> AsyncIterator[tuple[Runner, asyncio.Task[None], FdChannel]]:
    """A runner that was resumed with a process, and the process's end of the channel."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    made, end = runner(), FdChannel(far)
    process = ProcessState(NOBODY, near.detach(), 0.0, Watchdog(0.0, 1.0))
    made.resume(RunnerState("r1.toml", b"", ("fleet", "r1"), restarts=4, failures=2, process=process))
    task = asyncio.ensure_future(made.run())
    await asyncio.sleep(0)
    yield made, task, end
    assert made.process is not None
    made.process.close()
    task.cancel()
    await asyncio.wait([task])
    end.close()


async def test_a_resumed_runner_keeps_its_process_and_its_counts(
    running: tuple[Runner, asyncio.Task[None], FdChannel],
) -> None:
    made, _, _ = running
    assert made.is_idle
    kept = made.snapshot
    assert (kept.restarts, kept.failures, kept.next_at) == (4, 2, None)
    assert kept.process is not None
    assert kept.process.pid == NOBODY


@pytest.mark.parametrize("what", ["asked_to_end", "killed", "restarting", "given"])
async def test_a_runner_with_something_under_way_is_not_calm(
    running: tuple[Runner, asyncio.Task[None], FdChannel], what: str
) -> None:
    made, _, _ = running
    assert made.process is not None
    match what:
        case "killed":
            made.process.kill("hung")
        case "restarting":
            made.restart(FILE)
            await asyncio.sleep(0)
        case "given":
            made.process.deposit.predecessor = Deposit()
        case _:
            setattr(made.process, what, True)
    assert not made.is_idle


async def test_a_resumed_runner_waits_for_its_next_process_until_the_same_time() -> None:
    made, at = runner(), time.monotonic() + 3000.0
    made.resume(RunnerState("r1.toml", b"", ("fleet", "r1"), failures=6, next_at=at))
    task = asyncio.ensure_future(made.run())
    await asyncio.sleep(0)
    assert made.is_idle
    assert made.snapshot.next_at == at
    task.cancel()
    await asyncio.wait([task])


# The replacement


async def agree(state: int) -> None:
    """Read a state, as the installed code does that takes it."""
    restore(state)


async def refuse(state: int) -> None:
    raise NotReady("broken")


async def test_code_that_does_not_take_the_state_replaces_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replacement, "_execute", lambda *_: pytest.fail("executed"))
    with pytest.raises(NotReady, match="broken"):
        await replace([], empty, refuse)


async def test_a_command_that_is_not_there_replaces_nothing() -> None:
    with pytest.raises(FileNotFoundError):
        await replace(["/no/such/program"], empty, agree)


@pytest.mark.parametrize(
    ("error", "answer"),
    [(None, ""), (HandoverError("a state"), "a state"), (KeyError(1), "KeyError: 1 in")],
)
def test_a_fork_server_reads_the_state_in_place_of_the_supervisor_and_answers(
    monkeypatch: pytest.MonkeyPatch, error: Exception | None, answer: str
) -> None:
    near, far = FdChannel.pair()
    read: list[SupervisorState] = []

    def read_state(state: int) -> None:
        read.append(restore(state))
        if error is not None:
            raise error

    monkeypatch.setattr(fork_server, "restore", read_state)
    monkeypatch.setattr(fork_server, "_import_all", lambda: None)
    monkeypatch.setattr(fork_server.signal, "signal", lambda *_: None)
    with stored(empty()) as descriptor:
        near.send(Rehearse(), [descriptor])
    far.shutdown(socket.SHUT_RD)  # the end, after the request
    serve(FdChannel(far), lambda _: pytest.fail("forked"))
    assert read == [empty()]
    near.receive()
    received = near.receive()
    assert received is not None
    forked = received[0]
    assert isinstance(forked, Forked)
    expected = f"the installed code does not start: {answer}" if answer else ""
    assert (forked.pid, (forked.reason or "")[: len(expected)]) == (0 if answer else os.getpid(), expected)
    near.close()
    far.close()


async def test_the_moment_comes_when_nothing_is_under_way_and_an_exec_that_fails_leaves_everything_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours, theirs = socket.socketpair()
    state = empty(server=ServerState(1, ours.fileno(), b""))
    looks = iter([False, True, False, True, False] + [True] * 9)
    seen: list[tuple[bool, bool]] = []

    def fail(*_: object) -> None:
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
        seen.append((os.get_inheritable(ours.fileno()), set(SIGNALS) <= blocked))
        raise OSError(8, "Exec format error")

    monkeypatch.setattr(replacement, "LOOK_S", 0.0)
    monkeypatch.setattr(os, "execv", fail)
    with pytest.raises(OSError, match="Exec format error"):
        await replace(["zbridge"], lambda: state if next(looks) else None, agree)
    assert seen == [(True, True)]
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(SIGNALS)
    ours.close()
    theirs.close()


async def test_without_such_a_moment_nothing_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replacement, "CALM_S", 0.0)
    with pytest.raises(HandoverError, match="was being started or ended"):
        await replace(["false"], lambda: None, agree)


async def test_files_are_read_off_the_event_loop_which_watches_the_gateways(monkeypatch: pytest.MonkeyPatch) -> None:
    forks: Any = PlayedForks()
    supervisor, looked = Supervisor(SupervisorState((), watch=True), forks), threading.Event()
    seen: list[bool] = []

    def poll(_: Follower, running: object, *, twice: bool) -> Changes:
        seen.append(looked.wait(10.0))
        return Changes()

    monkeypatch.setattr(Follower, "poll", poll)
    supervisor.reload()
    following = asyncio.ensure_future(supervisor.follow())
    asyncio.get_running_loop().call_later(0.01, looked.set)  # never called while the loop reads files
    async with asyncio.timeout(30.0):
        while not seen:  # noqa: ASYNC110
            await asyncio.sleep(0.001)
    following.cancel()
    await asyncio.wait([following])
    assert seen == [True]


class PlayedForks:
    """The fork server of an installation that the test names."""

    stamp: bytes | None = b"one"
    refused = unsettled = False

    async def renew(self) -> None:
        pass

    async def rehearse(self, state: int) -> None:
        pass


@pytest.mark.parametrize(
    ("stamp", "asked", "forced", "refused", "replaced"),
    [
        (b"one", True, False, False, 0),
        (b"two", False, False, False, 1),
        (b"two", True, False, False, 1),
        (b"one", True, True, False, 1),
        (b"one", True, True, True, 0),
    ],
)
async def test_the_supervisor_is_replaced_when_its_fork_server_was_or_when_it_is_told_to(
    monkeypatch: pytest.MonkeyPatch, *, stamp: bytes, asked: bool, forced: bool, refused: bool, replaced: int
) -> None:
    calls: list[object] = []

    async def refuse(*arguments: object) -> None:
        calls.append(arguments)
        raise NotReady("not now")

    monkeypatch.setattr(module, "replace", refuse)
    forks: Any = PlayedForks()
    supervisor = Supervisor(SupervisorState(()), forks)
    forks.stamp, forks.refused = stamp, refused
    if forced:
        supervisor.renew()
    await supervisor.follow_code(asked=asked)
    assert len(calls) == replaced
    await supervisor.follow_code(asked=False)
    assert len(calls) == replaced, "what failed is tried again when somebody asks"


async def test_a_supervisor_that_is_told_to_replace_its_code_waits_until_the_installer_has_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    commands: list[list[str]] = []

    async def note(command: list[str], *_: object) -> None:
        commands.append(command)

    monkeypatch.setattr(module, "replace", note)
    forks: Any = PlayedForks()
    supervisor = Supervisor(SupervisorState(("robots",), watch=True), forks)
    forks.unsettled = True
    supervisor.renew()
    await supervisor.follow_code(asked=True)
    assert commands == []
    forks.unsettled = False
    await supervisor.follow_code(asked=False)
    assert [command[-4:] for command in commands] == [["zbridge", "run", "--watch", "robots"]]
