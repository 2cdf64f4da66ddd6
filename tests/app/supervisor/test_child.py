"""What a gateway process tells its supervisor: the device and the links are played, the post is a real socket."""

import asyncio
import mmap
import os
import signal
import socket
from collections.abc import AsyncIterator, Iterator

import msgspec
import pytest

from zbridge.app.handover.messages import Given
from zbridge.app.supervisor import child
from zbridge.app.supervisor.child import Reporter
from zbridge.app.supervisor.messages import (
    PAGE_BYTES,
    Beat,
    Closed,
    Kept,
    Message,
    Opened,
    Shared,
    Started,
    Succeeded,
    WantSuccessor,
)
from zbridge.app.supervisor.post import Post, close_all
from zbridge.errors import HandoverError
from zbridge.robot.observer import Boundary, LastStop, StopFrame
from zbridge.transport import Parcel
from zbridge.transport.fake import FakeLink


class PlayedDevice:
    """A device whose state the test sets."""

    def __init__(self) -> None:
        self.now = LastStop(frames=(StopFrame(b"stop"),), state="established")
        self.stands = Boundary()

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


class Scene:
    """A reporter, its device, and the supervisor's end of the post."""

    def __init__(self) -> None:
        self.post, far = Post.pair()
        self.reporter, self.device = Reporter(Post(far)), PlayedDevice()
        self.descriptors = 0
        self.reporter.begin()
        received = self.post.receive()
        assert received is not None
        shared, (self.page,) = received
        assert shared == Shared()
        self.reporter.began(self.device)
        self.told()

    def close(self) -> None:
        self.reporter.close()
        self.post.close()
        os.close(self.page)

    def told(self) -> list[Message]:
        """What was told since."""
        messages = list[Message]()
        while True:
            try:
                received = self.post.receive()
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
    monkeypatch.setattr(child, "BEAT_S", 3600.0)
    monkeypatch.setattr(child, "DRIVEN_BEAT_S", 0.01)
    scene.device.now = LastStop(driven=True, state="established")
    scene.reporter.changed()
    assert scene.told() == [Beat(scene.device.now)], "at once"
    assert await scene.soon() == [Beat(scene.device.now)]
    scene.device.now = LastStop(state="established")
    scene.reporter.changed()
    scene.told()
    await asyncio.sleep(0.05)
    assert scene.told() == []


async def test_another_stop_is_told_with_the_command_that_made_it(scene: Scene) -> None:
    scene.reporter.changed()
    assert scene.told() == []
    await asyncio.sleep(child.LOOK_S)
    scene.device.now = LastStop(frames=(StopFrame(b"mode"), StopFrame(b"stop", True)), gap_s=0.1, state="established")
    scene.reporter.changed()
    assert scene.told() == [Beat(scene.device.now)]


async def test_a_link_comes_with_its_sockets_and_goes_at_once(scene: Scene, sock: socket.socket) -> None:
    link = FakeLink()
    link.descriptors = (sock.fileno(),)
    scene.reporter.linked("robot", link, True)
    assert scene.told() == [Opened(1, "robot")]
    assert scene.descriptors == 1
    scene.device.stands = Boundary(incoming=False)
    scene.device.now = LastStop(state="handshaking")
    scene.reporter.changed()
    assert scene.told() == [Beat(scene.device.now, {1: Boundary(incoming=False)})]
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
        assert scene.told() == [Opened(1, "robot"), Beat(scene.device.now, {1: Boundary()})]


async def test_the_first_link_drives(scene: Scene, sock: socket.socket) -> None:
    for name in ("drive", "laser"):
        link = FakeLink()
        link.descriptors = (sock.fileno(),)
        scene.reporter.linked(name, link, True)
    assert scene.told() == [Opened(1, "drive"), Opened(2, "laser", drives=False)]


async def test_a_device_that_has_left_its_robot_leaves_no_stop(scene: Scene) -> None:
    scene.reporter.ended()
    assert scene.told() == [Beat()]
    scene.reporter.changed()
    assert scene.told() == []


async def test_a_successor_is_asked_for_with_its_socket_and_the_answer_awaited(scene: Scene) -> None:
    near, far = socket.socketpair()
    with near, far:
        asking = asyncio.ensure_future(scene.reporter.start_successor(far))
        assert await scene.soon() == [WantSuccessor()]
        assert scene.descriptors == 1
        assert not asking.done()
        scene.post.send(Started())
        await asking
        scene.reporter.succeeded()
        assert scene.told() == [Succeeded()]


async def test_why_no_successor_was_started_is_told(scene: Scene, monkeypatch) -> None:
    near, far = socket.socketpair()
    with near, far:
        asking = asyncio.ensure_future(scene.reporter.start_successor(far))
        await scene.soon()
        scene.post.send(Started("a faulty file"))
        with pytest.raises(HandoverError, match="a faulty file"):
            await asking
        monkeypatch.setattr(child, "ANSWER_S", 0.01)
        with pytest.raises(HandoverError, match="no successor within"):
            await scene.reporter.start_successor(far)


async def test_what_a_successor_needs_is_deposited_with_its_sockets(scene: Scene, sock: socket.socket) -> None:
    link = FakeLink()
    link.descriptors = (sock.fileno(),)
    scene.reporter.linked("robot", link, True)
    given = Given(1, {}, 1, claim={"since": 1.0}, device={"links": []})
    left = [given]

    def keep(parcel: Parcel) -> Given | None:
        parcel.put(sock.fileno())
        return left[0] if left else None

    scene.reporter.keep = keep
    scene.told()
    scene.device.now = LastStop(state="handshaking")
    scene.reporter.changed()
    kept = next(message for message in scene.told() if isinstance(message, Kept))
    assert msgspec.msgpack.decode(kept.given, type=Given) == given
    assert kept.sockets == ((1, 0),)
    left.clear()
    scene.device.now = LastStop(state="closing")
    scene.reporter.changed()
    assert Kept() in scene.told(), "nobody could go on any more"


async def test_the_shared_page_tells_at_any_time_whether_a_link_is_between_frames(sock: socket.socket) -> None:
    scene = Scene()
    link = FakeLink()
    link.descriptors = (sock.fileno(),)
    scene.reporter.linked("robot", link, True)
    with mmap.mmap(scene.page, PAGE_BYTES, prot=mmap.PROT_READ) as page:
        seen = [page[1]]
        scene.reporter.read("robot")
        seen.append(page[1])
        link.reads()  # bytes are about to be taken from the kernel
        seen.append(page[1])
        scene.device.stands = Boundary(incoming=False)
        scene.reporter.read("robot")
        seen.append(page[1])
        scene.device.stands = Boundary()
        scene.reporter.read("robot")
        scene.reporter.linked("robot", link, False)
        seen.append(page[1])
    assert seen == [0, 1, 0, 0, 0]
    scene.close()


async def test_the_end_of_the_supervisor_ends_the_process_in_order(scene: Scene) -> None:
    ended = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    scene.post.close()
    async with asyncio.timeout(10):
        await ended.wait()
    asyncio.get_running_loop().remove_signal_handler(signal.SIGTERM)
