"""One gateway process as its supervisor sees it: how it ended, and what it told. The process itself sleeps."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import pytest

from zbridge.host.fd_channel import (
    Deposited,
    FdChannel,
    Heartbeat,
    MetricsRead,
    Opened,
    ReadMetrics,
    Shared,
    Started,
    Succeeded,
    WantSuccessor,
    in_memory,
)
from zbridge.host.files import RobotFile
from zbridge.host.memory import MemoryWriter
from zbridge.host.process import METRICS_BYTES, GatewayProcess
from zbridge.metrics.exposition import FamilyLines
from zbridge.robot.observer import LastStop

FILE = RobotFile(Path("r1.toml"), b"", ("fleet", "r1"))
SOON_S = 10.0


class Scene:
    """A process that sleeps, and the end at which it tells things."""

    def __init__(self) -> None:
        near, far = FdChannel.pair()
        self.told = FdChannel(far)
        self.wanted: list[socket.socket] = []
        self.changes = 0
        self.process = GatewayProcess(
            os.posix_spawnp("sleep", ["sleep", "3600"], {}),
            near,
            FILE,
            wants_successor=lambda _, end: self.wanted.append(end),
            changed=self._change,
        )

    def _change(self) -> None:
        self.changes += 1

    async def reaped(self) -> None:
        async with asyncio.timeout(SOON_S):
            while not self.process.over.done():
                self.process.reap()
                await asyncio.sleep(0.001)

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            os.kill(self.process.pid, signal.SIGKILL)
            os.waitpid(self.process.pid, 0)
        self.process.close()
        self.told.close()
        for end in self.wanted:
            end.close()


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    made = Scene()
    yield made
    made.close()


# Its end


async def test_a_process_that_runs_has_not_ended(scene: Scene) -> None:
    scene.process.reap()
    assert not scene.process.is_over
    assert scene.process.how is None
    assert not await scene.process.gone(0.001)


async def test_a_process_that_is_killed_by_somebody_has_crashed(scene: Scene) -> None:
    os.kill(scene.process.pid, signal.SIGTERM)
    await scene.reaped()
    assert await scene.process.ended() == scene.process.how == "was killed by SIGTERM"
    assert scene.process.is_over
    scene.process.signal(signal.SIGKILL)  # it has ended: its number may be another process's


@pytest.mark.parametrize(("status", "how"), [(0, None), (3 << 8, "ended with exit code 3")])
async def test_an_exit_code_tells_whether_a_process_ended_in_order(scene: Scene, status: int, how: str | None) -> None:
    scene.process.over.set_result(status)
    assert await scene.process.ended() == how


async def test_a_process_that_hung_is_killed_and_counts_as_ended_though_nobody_has_seen_its_end(scene: Scene) -> None:
    ending = asyncio.ensure_future(scene.process.ended())
    await asyncio.sleep(0.001)
    assert not ending.done()
    scene.process.kill("sent no heartbeat")
    scene.process.kill("another reason")
    assert await asyncio.wait_for(ending, SOON_S) == "sent no heartbeat"
    assert scene.process.is_over
    await scene.reaped()
    assert scene.process.how == "was killed by SIGKILL"


async def test_all_that_a_process_told_before_it_died_counts(scene: Scene) -> None:
    for number in range(200):
        scene.told.send(Heartbeat(LastStop(state=f"state {number}")))
    scene.process.over.set_result(9)
    await scene.process.ended()
    assert scene.process.last.state == "state 199"
    assert scene.process.watchdog.heartbeats == 200


# What it tells


async def test_a_beat_tells_state_motion_and_whether_the_process_can_hand_over(scene: Scene) -> None:
    scene.told.send(Heartbeat(LastStop(driven=True, state="established"), hands_over=True))
    assert not scene.process.receive(), "there is no more"
    assert (scene.process.last.driven, scene.process.hands_over, scene.changes) == (True, True, 1)
    scene.told.send(Heartbeat(LastStop(state="established")))
    scene.process.receive()
    assert (scene.process.hands_over, scene.changes) == (False, 1), "the state is the same"
    scene.told.send(Heartbeat(LastStop(state="closed")))
    scene.process.receive()
    assert scene.changes == 2


async def test_others_have_their_turn_while_a_process_tells_much(scene: Scene) -> None:
    for _ in range(70):
        scene.told.send(Heartbeat())
    assert scene.process.receive(), "there is more"
    assert scene.process.watchdog.heartbeats == 64
    assert not scene.process.receive()
    assert scene.process.watchdog.heartbeats == 70


async def test_what_cannot_be_read_is_left_out(scene: Scene) -> None:
    os.write(scene.told.fileno(), b"\xc1")
    scene.told.send(Heartbeat())
    scene.process.receive()
    assert scene.process.watchdog.heartbeats == 1


async def test_a_successor_is_wanted_with_a_socket_and_refused_without(scene: Scene) -> None:
    near, far = socket.socketpair()
    with near, far:
        scene.told.send(WantSuccessor(), [far.fileno()])
        scene.told.send(WantSuccessor())
        scene.process.receive()
        (end,) = scene.wanted
        end.send(b"hello")
        assert near.recv(10) == b"hello"
    assert scene.told.receive() == (Started("the supervisor has no free descriptor"), [])


async def test_memory_is_shared_once_and_no_descriptor_is_left_open(scene: Scene) -> None:
    memory, before = MemoryWriter(), len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        scene.told.send(Shared(), [memory.descriptor])
    scene.told.send(Heartbeat(), [memory.descriptor])
    scene.process.receive()
    assert scene.process.deposit.memory is not None
    assert len(os.listdir("/proc/self/fd")) == before + 2, "the memory, and its mapping"
    memory.close_descriptor()
    memory.close()


async def test_what_a_process_tells_after_it_has_handed_over_is_its_successors_no_more(scene: Scene) -> None:
    scene.told.send(Heartbeat(LastStop(state="established")))
    scene.told.send(Succeeded())
    scene.told.send(Heartbeat(LastStop(state="closed")))
    scene.process.receive()
    assert (scene.process.succeeded, scene.process.is_over, scene.process.last.state) == (True, True, "established")
    assert await asyncio.wait_for(scene.process.ended(), SOON_S) is None


async def test_the_deposit_of_a_process_counts_until_its_successor_has_one(scene: Scene) -> None:
    for quick in (False, True):
        successor = Scene()
        if quick:
            successor.process.deposit.note(Deposited((), 0, 0))
        deposit = scene.process.deposit
        scene.process.hand_deposit_to(successor.process)
        assert (successor.process.deposit.predecessor is deposit) is not quick
        assert scene.process.deposit is not deposit
        successor.close()


async def test_a_process_that_is_closed_leaves_no_descriptor_open(scene: Scene) -> None:
    before = len(os.listdir("/proc/self/fd"))
    with socket.create_server(("127.0.0.1", 0)) as server:
        scene.told.send(Opened(1, "robot"), [server.fileno()])
        scene.process.receive()
    scene.process.close()
    scene.process.close()
    assert len(os.listdir("/proc/self/fd")) == before - 1, "its end of the channel is closed too"


# Its metrics


async def test_the_metrics_of_a_process_are_those_of_the_last_question(scene: Scene) -> None:
    lines = [FamilyLines("zbridge_refused_total", "counter", "Refused.", "zbridge_refused_total 1\n")]
    first, second = scene.process.ask_metrics(), scene.process.ask_metrics()
    assert [scene.told.receive() for _ in range(2)] == [(ReadMetrics(1), []), (ReadMetrics(2), [])]
    answer(scene, 1, b"late")
    assert not second.done()
    answer(scene, 2, msgspec.msgpack.encode(lines))
    assert second.result() == lines
    answer(scene, 2, msgspec.msgpack.encode([]))
    assert second.result() == lines
    assert not first.done()


@pytest.mark.parametrize(
    "content", [b"\xc1", msgspec.msgpack.encode([1]), b"\x91\x94" * 1000, b"\xdc\xff\xff" + bytes(METRICS_BYTES)]
)
async def test_invalid_metrics_are_none_and_told(
    scene: Scene, caplog: pytest.LogCaptureFixture, content: bytes
) -> None:
    asked = scene.process.ask_metrics()
    answer(scene, 1, content)
    reading, writing = os.pipe()
    scene.told.send(MetricsRead(1), [reading])  # no file at all
    scene.told.send(MetricsRead(1))
    scene.process.receive()
    for descriptor in (reading, writing):
        os.close(descriptor)
    assert not asked.done()
    assert caplog.text.count("sent invalid metrics") == 2


def answer(scene: Scene, number: int, content: bytes) -> None:
    """Let the process answer a question for its metrics."""
    before = len(os.listdir("/proc/self/fd"))
    with in_memory("metrics", content) as descriptor:
        scene.told.send(MetricsRead(number), [descriptor])
    scene.process.receive()
    assert len(os.listdir("/proc/self/fd")) == before
