"""What a gateway process tells its supervisor: the device and the links are played, the channel is a real socket."""

import asyncio
import logging
import os
import signal
import socket
from collections.abc import AsyncIterator, Iterator

import msgspec
import pytest

from tests.fake_link import FakeLink
from zbridge.app.handover.channel import VERSION, HandoverState
from zbridge.errors import HandoverError
from zbridge.host import child
from zbridge.host.child import Reporter
from zbridge.host.fd_channel import (
    Closed,
    Deposited,
    FdChannel,
    Heartbeat,
    Message,
    MetricsRead,
    Opened,
    ReadMetrics,
    Shared,
    Started,
    Succeeded,
    WantSuccessor,
    close_all,
)
from zbridge.host.memory import DEPOSIT_BYTES, SLOTS, MemoryReader
from zbridge.metrics.exposition import FamilyLines
from zbridge.protocol.kept import Budget
from zbridge.robot.observer import Boundary, LastStop, StopFrame
from zbridge.transport import Parcel
from zbridge.wire.frames import Partial


class PlayedDevice:
    """A device whose state the test sets."""

    def __init__(self) -> None:
        self.now = LastStop(frames=(StopFrame(b"stop"),), state="established")
        self.stands = Boundary()
        self.rest: Partial | None = Partial()

    @property
    def driven(self) -> bool:
        return self.now.driven

    @property
    def state(self) -> str:
        return self.now.state

    def last_stop(self) -> LastStop:
        return self.now

    def boundary(self, name: str) -> Boundary:
        return self.stands

    def partial(self, name: str, most_bytes: int) -> Partial | None:
        return self.rest


class Scene:
    """A reporter, its device, and the supervisor's end of the channel."""

    def __init__(self) -> None:
        self.channel, far = FdChannel.pair()
        self.far = FdChannel(far)
        self.reporter, self.device = Reporter(self.far), PlayedDevice()
        self.descriptors = 0
        self.reporter.begin()
        received = self.channel.receive()
        assert received is not None
        shared, (descriptor,) = received
        assert shared == Shared()
        self.memory = MemoryReader(descriptor)
        self.reporter.began(self.device)
        assert self.told()[:2] == [Heartbeat(LastStop()), Deposited()], "the first deposit tells that there is nothing"

    def close(self) -> None:
        self.reporter.close()
        self.channel.close()
        self.memory.close()

    def told(self) -> list[Message]:
        """What was told since."""
        messages = list[Message]()
        while True:
            try:
                received = self.channel.receive()
            except BlockingIOError:
                return messages
            assert received is not None
            messages.append(received[0])
            self.descriptors = len(received[1])
            close_all(received[1])

    async def soon(self, seconds: float = 0.0) -> list[Message]:
        """What is told within a while, at least one message."""
        await asyncio.sleep(seconds)
        messages = self.told()
        for _ in range(1000):
            if messages:
                break
            await asyncio.sleep(0.01)
            messages = self.told()
        return messages


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    scene = Scene()
    yield scene
    scene.close()


@pytest.fixture
def sock() -> Iterator[socket.socket]:
    with socket.socket() as sock:
        yield sock


async def test_a_loop_that_turns_beats_and_more_often_while_the_robot_is_driven(scene: Scene, monkeypatch) -> None:
    monkeypatch.setattr(child, "HEARTBEAT_S", 3600.0)
    monkeypatch.setattr(child, "DRIVEN_HEARTBEAT_S", 0.01)
    scene.device.now = LastStop(driven=True, state="established")
    scene.reporter.changed()
    assert scene.told() == [Heartbeat(scene.device.now)], "at once"
    assert (await scene.soon())[0] == Heartbeat(scene.device.now)
    scene.device.now = LastStop(state="established")
    scene.reporter.changed()
    scene.told()
    await asyncio.sleep(0.05)
    assert scene.told() == []


async def test_another_stop_is_told_with_the_command_that_made_it(scene: Scene) -> None:
    scene.reporter.changed()
    assert scene.told() == []
    await asyncio.sleep(child.INSPECT_S)
    scene.device.now = LastStop(frames=(StopFrame(b"mode"), StopFrame(b"stop", True)), gap_s=0.1, state="established")
    scene.reporter.changed()
    assert scene.told() == [Heartbeat(scene.device.now)]


async def test_a_stop_that_a_command_changed_is_told_at_once_however_many_commands_come(scene: Scene) -> None:
    scene.reporter.changed()
    scene.device.now = LastStop(frames=(StopFrame(b"mode"), StopFrame(b"stop")), state="established")
    scene.reporter.changed()
    assert scene.told() == [], "looked at a moment ago"
    scene.reporter.changed(at_once=True)
    assert scene.told() == [Heartbeat(scene.device.now)]


async def test_a_link_comes_with_its_sockets_and_goes_at_once(scene: Scene, sock: socket.socket) -> None:
    link = FakeLink()
    link.descriptors = (sock.fileno(),)
    scene.reporter.linked("robot", link, True)
    assert scene.told() == [Opened(1, "robot")]
    assert scene.descriptors == 1
    scene.device.stands = Boundary(outgoing=False)
    scene.device.now = LastStop(state="handshaking")
    scene.reporter.changed()
    assert scene.told() == [Heartbeat(scene.device.now, {1: Boundary(outgoing=False)})]
    scene.reporter.linked("robot", link, False)
    scene.reporter.linked("robot", link, False)
    assert scene.told() == [Closed(1)]


async def test_a_socket_for_datagrams_that_is_opened_later_comes_with_the_next_beat(
    scene: Scene, sock: socket.socket
) -> None:
    link = FakeLink()
    link.descriptors = (sock.fileno(),)
    scene.reporter.linked("robot", link, True)
    with socket.socket(type=socket.SOCK_DGRAM) as datagrams:
        link.descriptors = (sock.fileno(), datagrams.fileno())
        scene.told()
        scene.device.now = LastStop(state="handshaking")
        scene.reporter.changed()
        assert scene.told() == [Opened(1, "robot"), Heartbeat(scene.device.now, {1: Boundary()})]


async def test_the_first_link_drives(scene: Scene, sock: socket.socket) -> None:
    for name in ("drive", "laser"):
        link = FakeLink()
        link.descriptors = (sock.fileno(),)
        scene.reporter.linked(name, link, True)
    assert scene.told() == [Opened(1, "drive"), Opened(2, "laser", drives=False)]


async def test_a_device_that_has_left_its_robot_leaves_no_stop(scene: Scene) -> None:
    scene.reporter.ended()
    assert scene.told() == [Heartbeat()]
    scene.reporter.changed()
    assert scene.told() == []


async def test_a_successor_is_asked_for_with_its_socket_and_the_answer_awaited(scene: Scene) -> None:
    near, far = socket.socketpair()
    with near, far:
        asking = asyncio.ensure_future(scene.reporter.start_successor(far))
        assert await scene.soon() == [WantSuccessor()]
        assert scene.descriptors == 1
        assert not asking.done()
        scene.channel.send(Started())
        await asking
        assert scene.reporter.handed_over(), "the supervisor looks after the robot"
        assert scene.told() == [Succeeded()]
        while scene.far.send(Heartbeat()):
            pass
        with pytest.raises(HandoverError, match="does not listen"):
            scene.reporter.handed_over()


async def test_why_no_successor_was_started_is_told(scene: Scene, monkeypatch) -> None:
    near, far = socket.socketpair()
    with near, far:
        asking = asyncio.ensure_future(scene.reporter.start_successor(far))
        await scene.soon()
        scene.channel.send(Started("a faulty file"))
        with pytest.raises(HandoverError, match="a faulty file"):
            await asking
        monkeypatch.setattr(child, "ANSWER_S", 0.01)
        with pytest.raises(HandoverError, match="no successor within"):
            await scene.reporter.start_successor(far)


GIVEN = HandoverState(VERSION, {}, 1, claim={"since": 1.0}, device={"links": []})


def linked(scene: Scene, sock: socket.socket, name: str = "robot") -> FakeLink:
    link = FakeLink()
    link.descriptors = (sock.fileno(),)
    scene.reporter.linked(name, link, True)
    scene.told()
    return link


def deposit(scene: Scene, state: str) -> Deposited:
    """Let the state of the robot become another one, with which the deposit is made anew."""
    scene.device.now = LastStop(state=state)
    scene.reporter.changed()
    return next(message for message in scene.told() if isinstance(message, Deposited))


async def test_what_a_successor_needs_is_deposited_with_its_sockets(scene: Scene, sock: socket.socket) -> None:
    linked(scene, sock)
    left = [GIVEN]

    def keep(parcel: Parcel, budget: Budget) -> HandoverState | None:
        parcel.put(sock.fileno())
        return left[0] if left else None

    scene.reporter.describe = keep
    kept = deposit(scene, "handshaking")
    assert msgspec.msgpack.decode(scene.memory.deposit(kept.area, kept.size), type=HandoverState) == GIVEN
    assert kept.sockets == ((1, 0),)
    left[0] = msgspec.structs.replace(GIVEN, claim={"since": 2.0})
    newer = deposit(scene, "established")
    assert newer.area != kept.area, "the one before it is still there if this process dies now"
    left.clear()
    assert deposit(scene, "closing") == Deposited(), "nobody could continue any more"


async def test_another_stop_comes_with_another_deposit(scene: Scene, sock: socket.socket) -> None:
    linked(scene, sock)
    numbers = iter(range(9))

    def keep(parcel: Parcel, budget: Budget) -> HandoverState:
        parcel.put(sock.fileno())
        return msgspec.structs.replace(GIVEN, claim={"since": next(numbers)})

    scene.reporter.describe = keep
    await asyncio.sleep(child.INSPECT_S)
    scene.device.now = LastStop(frames=(StopFrame(b"mode"), StopFrame(b"stop")), state="established")
    scene.reporter.changed()
    assert isinstance(scene.told()[0], Deposited), (
        "a robot that drives itself is stopped by another session than before"
    )


async def test_what_is_published_for_the_first_time_is_deposited_soon_and_once(
    scene: Scene, sock: socket.socket
) -> None:
    linked(scene, sock)
    said = ["nothing"]

    def keep(parcel: Parcel, budget: Budget) -> HandoverState:
        parcel.put(sock.fileno())
        return msgspec.structs.replace(GIVEN, claim={"since": said[-1]})

    scene.reporter.describe = keep
    deposit(scene, "established")
    said.append("what is said once in a connection")
    for _ in range(100):
        scene.reporter.published()
    (kept,) = await scene.soon(2 * child.INSPECT_S)
    assert isinstance(kept, Deposited)
    assert b"said once" in scene.memory.deposit(kept.area, kept.size)


@pytest.mark.parametrize("fault", ["a name that is not UTF-8", "too large", "raises"])
async def test_a_deposit_that_cannot_be_made_is_told_once_and_the_beats_go_on(
    scene: Scene, sock: socket.socket, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    linked(scene, sock)

    def keep(parcel: Parcel, budget: Budget) -> HandoverState | None:
        if fault == "raises":
            raise KeyError("a protocol's fault")
        value = "\udcff" if "UTF-8" in fault else bytes(DEPOSIT_BYTES)
        return msgspec.structs.replace(GIVEN, device={"links": [value]})

    scene.reporter.describe = keep
    for state in ("handshaking", "established", "closing"):
        scene.device.now = LastStop(state=state)
        scene.reporter.changed()
        assert scene.told() == [Heartbeat(scene.device.now, {1: Boundary()})]
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "a crash would end the robot's connection" in record.getMessage()


async def test_what_is_left_out_of_a_deposit_is_told_once_a_minute_at_most(
    scene: Scene, sock: socket.socket, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO)
    linked(scene, sock)
    sizes = iter((child.VALUE_BYTES, child.VALUE_BYTES + 1, child.VALUE_BYTES + 2))

    def keep(parcel: Parcel, budget: Budget) -> HandoverState:
        size = next(sizes)
        parcel.put(sock.fileno())
        admitted = budget.admits("Robot.map", bytes(size))
        return msgspec.structs.replace(GIVEN, device={"links": [size], "map": admitted})

    scene.reporter.describe = keep
    for state in ("handshaking", "established", "closing"):
        deposit(scene, state)
    (record,) = caplog.records
    assert record.getMessage() == (
        "after a crash the next process would begin without Robot.map: 131073 bytes, more than 131072"
    )


async def test_the_shared_memory_tells_at_any_time_where_the_stream_of_a_link_was_cut(
    scene: Scene, sock: socket.socket
) -> None:
    link = linked(scene, sock)
    seen = [scene.memory.partial(1), scene.memory.is_touched(1)]
    link.reads()  # bytes are about to be taken from the kernel
    seen.append(scene.memory.partial(1))
    scene.reporter.read("robot", lambda most_bytes: Partial(b"half"))
    seen.append(scene.memory.partial(1))
    link.reads()
    scene.reporter.read("robot", lambda most_bytes: None)
    seen.append(scene.memory.partial(1))
    scene.device.rest = Partial(skip=7)
    deposit_beat = LastStop(state="handshaking")
    scene.device.now = deposit_beat
    scene.reporter.changed()
    seen.append(scene.memory.partial(1))
    assert seen == [Partial(), False, None, Partial(b"half"), None, Partial(skip=7)]


async def test_a_link_that_comes_and_goes_often_leaves_the_slots_of_others_alone(
    scene: Scene, sock: socket.socket
) -> None:
    linked(scene, sock, "drive")
    scene.reporter.read("drive", lambda most_bytes: Partial(b"drive"))
    for _ in range(3 * SLOTS):
        laser = FakeLink()
        scene.reporter.linked("laser", laser, True)
        laser.reads()
        scene.reporter.linked("laser", laser, False)
        laser.reads()  # one that ends late
    assert scene.memory.partial(1) == Partial(b"drive")


async def test_the_end_of_the_supervisor_ends_the_process_in_order(scene: Scene) -> None:
    ended = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    scene.channel.close()
    async with asyncio.timeout(10):
        await ended.wait()
    asyncio.get_running_loop().remove_signal_handler(signal.SIGTERM)


# Its metrics


async def test_a_question_for_the_metrics_is_answered_in_memory_and_a_fault_answers_nothing(scene, caplog) -> None:
    lines = [FamilyLines("zbridge_refused_total", "counter", "Refused.", "zbridge_refused_total 1\n")]
    scene.reporter.metrics = lambda: lines
    scene.channel.send(ReadMetrics(7))
    await asyncio.sleep(0.01)
    received = scene.channel.receive()
    assert received is not None
    message, (descriptor,) = received
    assert message == MetricsRead(7)
    assert msgspec.msgpack.decode(os.pread(descriptor, 10_000, 0), type=list[FamilyLines]) == lines
    close_all([descriptor])

    def fail() -> list[FamilyLines]:
        raise KeyError("broken")

    scene.reporter.metrics = fail
    scene.channel.send(ReadMetrics(8))
    await asyncio.sleep(0.01)
    assert scene.told() == []
    assert "the metrics cannot be read" in caplog.text


async def test_a_beat_tells_what_is_missing(scene: Scene) -> None:
    scene.reporter.missing = lambda: ("no bus",)
    scene.device.now = LastStop(driven=True)
    scene.reporter.changed()
    (heartbeat,) = (message for message in await scene.soon() if isinstance(message, Heartbeat))
    assert heartbeat.missing == ("no bus",)
