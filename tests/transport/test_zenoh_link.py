"""A link that is a Zenoh session: its frames are carried out on a bus, and what comes is bounded."""

from __future__ import annotations

import asyncio

import pytest

from tests.fake_bus import FakeBus
from tests.transport.recorder import Recorder
from zbridge.errors import LinkError
from zbridge.metrics import Metrics
from zbridge.protocol.address import ZenohAddress
from zbridge.protocol.samples import KeyedSample, SampleKind, read_sample, sample_end, subscription, write_sample
from zbridge.transport import zenoh_link
from zbridge.transport.zenoh_link import DECLARED, ZenohLink
from zbridge.wire.frames import FrameBuffer


class Scene:
    def __init__(self) -> None:
        self.other = FakeBus("other")
        self.own = self.other.join("own")
        self.metrics, self.recorder = Metrics(), Recorder()
        self.link = ZenohLink("tcp://h:1", self.own, self.metrics, self.recorder)
        self.link.begin(ends=True)

    def write(self, *written: KeyedSample) -> None:
        for sample in written:
            self.link.write(write_sample(sample))

    @property
    def read(self) -> list[KeyedSample]:
        frames = FrameBuffer(sample_end, 65536).feed(bytes(self.recorder.data))
        return [read_sample(frame) for frame in frames]


def kinds(read: list[KeyedSample]) -> list[SampleKind]:
    return [sample.kind for sample in read]


async def test_the_session_is_told_its_id_and_the_time_first() -> None:
    scene = Scene()
    (opened,) = scene.read
    assert (opened.kind, opened.payload) == (SampleKind.OPENED, b"own")
    assert opened.stamp_ns > 10**18


async def test_what_is_written_is_declared_and_put_and_what_comes_of_it_is_read() -> None:
    scene = Scene()
    scene.other.announce("t/old")
    scene.write(subscription("k/*"), KeyedSample(SampleKind.WATCH, "t/*"), KeyedSample(SampleKind.ANNOUNCE, "mine/1"))
    scene.other.frames("k/1", lambda listened: None).put(b"payload", b"shown")
    token = scene.other.announce("t/new")
    token.close()
    await asyncio.sleep(0)
    _, *read = [(one.kind, one.key, one.payload, one.attachment) for one in scene.read]
    assert sorted(read) == [
        (SampleKind.SAMPLE, "k/1", b"payload", b"shown"),
        (SampleKind.APPEARED, "t/new", b"", None),
        (SampleKind.APPEARED, "t/old", b"", None),
        (SampleKind.GONE, "t/new", b"", None),
    ]
    assert await scene.other.alive("mine/*") == ["mine/1"]
    scene.write(KeyedSample(SampleKind.PUT, "out", b"1", b"2"), KeyedSample(SampleKind.WITHDRAW, "mine/1"))
    assert scene.other.values("out") == [b"1"]
    assert await scene.other.alive("mine/*") == []


async def test_to_watch_again_asks_for_the_tokens_that_are_there() -> None:
    scene = Scene()
    scene.write(KeyedSample(SampleKind.WATCH, "t/*"))
    scene.other.announce("t/1")
    scene.recorder.data.clear()
    scene.write(*[KeyedSample(SampleKind.WATCH, "t/*")] * 3)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert [(one.kind, one.key) for one in scene.read] == [(SampleKind.APPEARED, "t/1")]


async def test_what_comes_while_nothing_is_read_is_dropped_and_told() -> None:
    scene = Scene()
    scene.write(subscription("k"))
    scene.link.pause_reading()
    scene.other.frames("k", lambda listened: None).put(b"lost")
    scene.link.resume_reading()
    scene.metrics.count("bus_dropped", queue="bus_in").value += 2
    scene.link._report()
    told = [sample.count for sample in scene.read if sample.kind is SampleKind.DROPPED]
    assert told == [3]
    assert SampleKind.SAMPLE not in kinds(scene.read)


async def test_samples_that_come_too_fast_are_dropped_before_they_are_copied() -> None:
    link = Scene().link
    sort = link._sort()
    priorities = [sort("k", None, 0, bytes) for _ in range(5000)]
    assert 1990 <= sum(priority is not None for priority in priorities) <= 3000
    assert link._above == priorities.count(None)


async def test_keys_are_bounded() -> None:
    scene = Scene()
    scene.write(*(subscription(f"k/{number}") for number in range(DECLARED)))
    scene.write(subscription("k/0"))
    with pytest.raises(LinkError, match="more than 256 keys"):
        scene.write(subscription("k/more"))


async def test_a_link_ends_once_with_its_last_connection() -> None:
    scene = Scene()
    scene.own.connection(up=False)
    scene.link.close()
    await scene.link.ended()
    await asyncio.sleep(0)
    assert (scene.recorder.calls.count("lost"), scene.recorder.reason) == (1, "connection lost: the router is gone")
    scene.write(KeyedSample(SampleKind.PUT, "out", b"1"))
    assert (scene.link.ready, scene.other.values("out")) == (False, [])


async def test_a_router_that_is_not_there_is_a_link_error() -> None:
    with pytest.raises(LinkError, match=r"tcp://127\.0\.0\.1:9: "):
        await zenoh_link.connect(ZenohAddress("127.0.0.1", 9), Recorder())
