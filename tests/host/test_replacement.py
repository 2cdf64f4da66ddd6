"""What a supervisor leaves to the code in its place, the rehearsal of that code, and when it is asked for."""

import asyncio
import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from zbridge.errors import HandoverError
from zbridge.host import replacement
from zbridge.host import supervisor as module
from zbridge.host.deposit import Deposit
from zbridge.host.fd_channel import Deposited, FdChannel, Heartbeat, Opened, Shared
from zbridge.host.files import Changes, Follower, RobotFile
from zbridge.host.fork_client import ForkClient
from zbridge.host.memory import MemoryWriter
from zbridge.host.process import GatewayProcess
from zbridge.host.replacement import (
    SIGNALS,
    VERSION,
    ProcessState,
    RunnerState,
    ServerState,
    SupervisorState,
    replace,
    restore,
    store,
)
from zbridge.host.runner import Runner
from zbridge.host.settings import HostSettings
from zbridge.host.supervisor import Supervisor
from zbridge.host.watchdog import DRIVEN_S, Watchdog
from zbridge.robot.observer import Boundary, LastStop, StopFrame
from zbridge.wire.frames import Partial

LAST = LastStop(True, (StopFrame(b"stop"), StopFrame(b"also", datagram=True)), 0.01, "established")
FILE = RobotFile(Path("r1.toml"), b"", ("fleet", "r1"))
NOBODY = 2**22 + 1
"""A process id that Linux never gives."""


def empty(**fields: object) -> SupervisorState:
    return msgspec.structs.replace(SupervisorState(VERSION, ("robots",), at=1.0, check_at=2.0), **fields)


@contextlib.contextmanager
def stored(state: SupervisorState) -> Iterator[int]:
    descriptor = store(state)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def test_a_state_is_read_as_it_was_written_as_often_as_wanted() -> None:
    process = ProcessState(7, 8, 1.5, Watchdog(2.0, DRIVEN_S, 0.1, 3), LAST, 9, True, Deposited(((1, 0),), 1, 5), ())
    robots = (
        RunnerState("robots/r1.toml", b"\xff", ("fleet", "r1"), 2, 1, None, process),
        RunnerState("robots/r2.toml", b"", None, 0, 6, 61.5),
    )
    faults = {"robots/r2.toml": "colour"}
    state = empty(runners=robots, server=ServerState(11, 12, b"\0stamp"), leaving=(13,), faults=faults, watch=True)
    with stored(state) as descriptor:
        assert [restore(descriptor), restore(descriptor)] == [state, state]
    assert set(state.descriptors) == {8, 9, 12}


def test_a_state_of_another_version_is_refused_whatever_else_it_has() -> None:
    other = msgspec.msgpack.encode({"version": VERSION + 1, "sources": 5})
    descriptor = os.memfd_create("state")
    try:
        os.write(descriptor, other)
        with pytest.raises(HandoverError, match=f"version {VERSION + 1}, this code accepts version {VERSION}"):
            restore(descriptor)
    finally:
        os.close(descriptor)


@pytest.mark.parametrize(
    "data", [b"\xc1", b"\x82\xa7version" + bytes([VERSION]) + b"\xa7sources\x91\xa1\xff"], ids=["form", "text"]
)
def test_what_is_no_state_is_told_as_such(data: bytes) -> None:
    descriptor = os.memfd_create("state")
    try:
        os.write(descriptor, data)
        with pytest.raises(HandoverError, match="no state of a supervisor"):
            restore(descriptor)
    finally:
        os.close(descriptor)


def test_no_state_is_said_in_one_line() -> None:
    reading, writing = os.pipe()
    os.close(writing)
    try:
        with pytest.raises(HandoverError, match="no state of a supervisor"):
            restore(reading)
    finally:
        os.close(reading)


def test_the_fields_of_a_state_keep_the_names_that_other_versions_read() -> None:
    process = ProcessState(7, 8, 1.5, Watchdog(2.0, DRIVEN_S, 0.1, 3), LAST, 9, True, Deposited())
    state = SupervisorState(VERSION, (), 100.0, 101.0, server=ServerState(5, 6, b"stamp"))
    written = msgspec.to_builtins(process)
    assert (written["post"], written["page"], written["kept"]["area"]) == (8, 9, -1)
    assert written["heart"] == {"last": 2.0, "patience_s": DRIVEN_S, "excused_s": 0.1, "beats": 3}
    assert (msgspec.to_builtins(state)["look_at"], msgspec.to_builtins(state)["server"]["post"]) == (101.0, 6)


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
    after = resumed_process(
        msgspec.structs.replace(
            state,
            channel=os.dup(state.channel),
            memory=os.dup(state.memory or 0),
            links=tuple(msgspec.structs.replace(link, stream=os.dup(link.stream or 0)) for link in state.links),
        )
    )
    before.close()
    ours.close()
    assert (after.last, after.hands_over) == (LAST, True)
    assert after.watchdog == before.watchdog
    assert after.deposit.duplicates.state[0].boundary == Boundary(outgoing=False)
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
    return Runner(FILE, ForkClient(["false"]), verbose=False, changed=lambda: None)


@pytest.fixture
async def running() -> AsyncIterator[tuple[Runner, asyncio.Task[None], FdChannel]]:
    """A runner that was resumed with a process, and the process's end of the channel."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    made, end = runner(), FdChannel(far)
    process = ProcessState(NOBODY, near.detach(), 0.0, Watchdog(0.0, 1.0), LAST)
    made.resume(RunnerState("r1.toml", b"", ("fleet", "r1"), 4, 2, process=process))
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
    restarting: asyncio.Future[None] | None = None
    match what:
        case "killed":
            made.process.kill("hung")
        case "restarting":
            restarting = asyncio.ensure_future(made.restart(FILE))
            await asyncio.sleep(0)
        case "given":
            made.process.deposit.predecessor = Deposit()
        case _:
            setattr(made.process, what, True)
    assert not made.is_idle
    if restarting is not None:
        restarting.cancel()


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

READS = "import sys; from zbridge.host.replacement import restore; restore(int(sys.argv[-1]))"


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import sys; sys.exit('broken: it is')", "the installed code does not start: broken: it is"),
        ("import sys; sys.exit(3)", "the installed code does not start: exit code 3"),
        ("import time; time.sleep(60)", "the installed code did not start within 0.2 s"),
    ],
)
async def test_code_that_does_not_start_replaces_nothing(
    monkeypatch: pytest.MonkeyPatch, code: str, reason: str
) -> None:
    monkeypatch.setattr(replacement, "_execute", lambda *_: pytest.fail("executed"))
    if "sleep" in code:
        monkeypatch.setattr(replacement, "REHEARSAL_S", 0.2)
    with pytest.raises(HandoverError, match=reason):
        await replace(python(code), empty)


async def test_a_command_that_is_not_there_replaces_nothing() -> None:
    with pytest.raises(HandoverError, match="No such file"):
        await replace(["/no/such/program"], empty)


async def test_the_moment_comes_when_nothing_is_under_way_and_an_exec_that_fails_leaves_everything_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours, theirs = socket.socketpair()
    state, looks = (
        empty(server=ServerState(1, ours.fileno(), b"")),
        iter([False, True, False, True, False] + [True] * 9),
    )
    seen: list[tuple[bool, bool]] = []

    def fail(*_: object) -> None:
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
        seen.append((os.get_inheritable(ours.fileno()), set(SIGNALS) <= blocked))
        raise OSError(8, "Exec format error")

    monkeypatch.setattr(replacement, "LOOK_S", 0.0)
    monkeypatch.setattr(os, "execv", fail)
    with pytest.raises(HandoverError, match="Exec format error"):
        await replace(python(READS), lambda: state if next(looks) else None)
    assert seen == [(True, True)]
    assert not os.get_inheritable(ours.fileno())
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(SIGNALS)
    ours.close()
    theirs.close()


async def test_without_such_a_moment_nothing_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replacement, "CALM_S", 0.0)
    with pytest.raises(HandoverError, match="was being started or ended"):
        await replace(["false"], lambda: None)


async def test_files_are_read_off_the_event_loop_which_watches_the_gateways(monkeypatch: pytest.MonkeyPatch) -> None:
    forks: Any = PlayedForks()
    supervisor, looked = Supervisor((), HostSettings(), forks, watch=True, verbose=False), threading.Event()
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

    stamp: str | None = "one"
    refused = unsettled = False

    async def renew(self) -> None:
        pass


@pytest.mark.parametrize(
    ("stamp", "asked", "forced", "refused", "replaced"),
    [
        ("one", True, False, False, 0),
        ("two", False, False, False, 1),
        ("two", True, False, False, 1),
        ("one", True, True, False, 1),
        ("one", True, True, True, 0),
    ],
)
async def test_the_supervisor_is_replaced_when_its_fork_server_was_or_when_it_is_told_to(
    monkeypatch: pytest.MonkeyPatch, *, stamp: str, asked: bool, forced: bool, refused: bool, replaced: int
) -> None:
    calls: list[object] = []

    async def refuse(*arguments: object) -> None:
        calls.append(arguments)
        raise HandoverError("not now")

    monkeypatch.setattr(module, "replace", refuse)
    forks: Any = PlayedForks()
    supervisor = Supervisor((), HostSettings(), forks, watch=False, verbose=False, itself=["zbridge"])
    forks.stamp, forks.refused = stamp, refused
    if forced:
        supervisor.renew()
    await supervisor.follow_code(asked=asked)
    assert len(calls) == replaced
    await supervisor.follow_code(asked=False)
    assert len(calls) == replaced, "what failed is tried again when somebody asks"
