"""A recording as viewers see it: what is shown when it plays, pauses, jumps and ends. The recording is a list here."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest

from zbridge.views.foxglove.hub import Hub
from zbridge.views.foxglove.playback import LATE_S, RECENT_S, Playback, PlayedMessage
from zbridge.views.foxglove.requests import PlaybackRequest
from zbridge.views.pictures import ViewerChannel
from zbridge.views.schemas import Schema

pytestmark = pytest.mark.jumping

BEGIN_NS, S_NS = 1_700_000_000_000_000_000, 1_000_000_000
PLAYING, PAUSED, ENDED = 0, 1, 3
CHANNELS = {
    topic: ViewerChannel(topic, "", Schema(schema, "jsonschema", b"{}", "json"))
    for topic, schema in (("/r1/pose", "foxglove.PoseInFrame"), ("/r1/map", "foxglove.Grid"))
}


def message(topic: str, second: float) -> PlayedMessage:
    return PlayedMessage(topic, BEGIN_NS + round(second * S_NS), f"{topic} {second:g}".encode())


class Recording:
    """A map at the begin, and ten poses, one a second. slow_s: for which each read takes."""

    begin_ns, end_ns = BEGIN_NS, BEGIN_NS + 10 * S_NS
    channels = CHANNELS

    def __init__(self) -> None:
        poses = [message("/r1/pose", second) for second in range(11)]
        self.entries = sorted([message("/r1/map", 0.5), *poses], key=lambda each: each.log_ns)
        self.reads = 0

    def messages(self, from_ns: int) -> Iterator[PlayedMessage]:
        self.reads += 1
        return iter([each for each in self.entries if each.log_ns >= from_ns])

    def last_before(self, topics: set[str], at_ns: int, since_ns: int) -> list[PlayedMessage]:
        found = {each.topic: each for each in self.entries if each.topic in topics and since_ns <= each.log_ns <= at_ns}
        return list(found.values())


class Viewer:
    """What a viewer was shown and told."""

    def __init__(self) -> None:
        self.shown: list[str] = []
        self.states: list[tuple[int, float, float, bool, str]] = []
        """Status, time in seconds, speed, whether the time has jumped, id of the request."""
        self.times: list[float] = []
        self.name, self.may_drive = "ann", False

    def show(self, subscription: int, data: bytes) -> None:
        self.shown.append(data[13:].decode())

    def say(self, told: str | bytes) -> None:
        if isinstance(told, bytes) and told[0] == 2:
            self.times.append((struct.unpack("<Q", told[1:])[0] - BEGIN_NS) / S_NS)
        elif isinstance(told, bytes) and told[0] == 5:
            status, at_ns, speed, sought, _ = struct.unpack_from("<BQfBI", told, 1)
            self.states.append((status, (at_ns - BEGIN_NS) / S_NS, speed, bool(sought), told[19:].decode()))

    def warn(self, text: str) -> None:
        """Nothing is refused here."""

    def ended(self, subscription: int) -> None:
        """Channels stay."""

    def parameters_changed(self, values: Any) -> None:
        """There are none."""


class Scene:
    def __init__(self) -> None:
        self.hub, self.recording = Hub(), Recording()
        self.playback = Playback(self.hub, self.recording)  # type: ignore[arg-type]
        self.viewer, self.other = Viewer(), Viewer()
        for viewer in (self.viewer, self.other):
            self.hub.join(viewer)

    def subscribe(self, viewer: Viewer, *topics: str) -> None:
        for topic in topics:
            assert self.hub.subscribe(viewer, 1, list(CHANNELS).index(topic) + 1)

    async def asks(self, *, play: bool, seek: float | None = None, speed: float = 1.0) -> None:
        seek_ns = None if seek is None else BEGIN_NS + round(seek * S_NS)
        self.playback.play(self.viewer, PlaybackRequest(play, speed, seek_ns, "id"))
        await asyncio.sleep(0.001)

    def seen(self, viewer: Viewer | None = None) -> list[str]:
        """Give what was shown since."""
        viewer = viewer or self.viewer
        shown, viewer.shown = viewer.shown, []
        return shown


@pytest.fixture
async def scene(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Scene]:
    async def inline(work: Any, *arguments: Any) -> Any:
        await asyncio.sleep(0)
        return work(*arguments)

    monkeypatch.setattr(asyncio, "to_thread", inline)
    made = Scene()
    running = asyncio.ensure_future(made.playback.run())
    await asyncio.sleep(0.001)
    yield made
    running.cancel()
    await asyncio.wait([running])


def poses(*seconds: int) -> list[str]:
    return [f"/r1/pose {second}" for second in seconds]


async def test_a_recording_rests_at_its_begin_until_it_is_played(scene: Scene) -> None:
    assert (scene.playback.capabilities, scene.playback.times_ns) == (
        ("time", "playbackControl"),
        (BEGIN_NS, BEGIN_NS + 10 * S_NS),
    )
    scene.subscribe(scene.viewer, "/r1/pose")
    scene.playback.greet(scene.viewer)
    assert scene.viewer.states == [(PAUSED, 0.0, 1.0, False, "")]
    assert scene.viewer.times == [0.0]
    await asyncio.sleep(100.0)
    assert scene.seen() == poses(0)


async def test_messages_are_shown_at_their_times_by_the_speed_that_is_asked_for(scene: Scene) -> None:
    scene.subscribe(scene.viewer, "/r1/pose", "/r1/map")
    await asyncio.sleep(0.001)
    scene.seen()
    await scene.asks(play=True)
    assert scene.viewer.states[-1] == (PLAYING, 0.0, 1.0, False, "id")
    assert scene.other.states[-1] == (PLAYING, 0.0, 1.0, False, ""), "the others are told without the id"
    await asyncio.sleep(2.5)
    assert scene.seen() == ["/r1/map 0.5", *poses(1, 2)]
    assert scene.viewer.times[-1] == pytest.approx(2.5, abs=0.05)
    assert 35 < len(scene.viewer.times) < 80, "thirty times a second at most"
    await scene.asks(play=True, speed=4.0)
    await asyncio.sleep(1.0)
    assert scene.seen() == poses(3, 4, 5, 6)


async def test_a_pause_shows_nothing_and_keeps_the_place_and_the_speed(scene: Scene) -> None:
    scene.subscribe(scene.viewer, "/r1/pose")
    await scene.asks(play=True)
    await asyncio.sleep(2.5)
    await scene.asks(play=False, speed=2.0)
    status, at, *rest = scene.viewer.states[-1]
    assert (status, at, rest) == (PAUSED, pytest.approx(2.5, abs=0.01), [2.0, False, "id"])
    scene.seen()
    count = len(scene.viewer.times)
    await asyncio.sleep(100.0)
    assert (scene.seen(), len(scene.viewer.times)) == ([], count)
    await scene.asks(play=True, speed=2.0)
    await asyncio.sleep(0.8)
    assert scene.seen() == poses(3, 4)


@pytest.mark.parametrize("play", [True, False])
async def test_a_jump_shows_what_was_there_before_it_and_goes_on_from_there(scene: Scene, play: bool) -> None:
    scene.subscribe(scene.viewer, "/r1/pose", "/r1/map")
    await asyncio.sleep(0.001)
    scene.seen()
    await scene.asks(play=play, seek=7.0)
    assert scene.viewer.states[-1] == (PLAYING if play else PAUSED, 7.0, 1.0, True, "id")
    assert sorted(scene.seen()) == ["/r1/map 0.5", *poses(7)], "a map is shown however old it is, and nothing twice"
    assert scene.viewer.times[-1] == pytest.approx(7.0, abs=0.01)
    await asyncio.sleep(1.5)
    assert scene.seen() == (poses(8) if play else [])


async def test_a_stream_that_ended_long_before_the_jump_is_not_shown(scene: Scene) -> None:
    del scene.recording.entries[3:]  # the map, and poses of the first second
    scene.subscribe(scene.viewer, "/r1/pose", "/r1/map")
    await asyncio.sleep(0.001)
    scene.seen()
    await scene.asks(play=False, seek=1.0 + RECENT_S)
    assert sorted(scene.seen()) == ["/r1/map 0.5", *poses(1)]
    await scene.asks(play=False, seek=1.1 + RECENT_S)
    assert scene.seen() == ["/r1/map 0.5"]


async def test_who_subscribes_later_is_shown_the_last_message_too(scene: Scene) -> None:
    scene.subscribe(scene.viewer, "/r1/pose")
    await scene.asks(play=False, seek=3.0)
    scene.seen()
    scene.subscribe(scene.other, "/r1/pose")
    await asyncio.sleep(0.001)
    assert scene.seen(scene.other) == poses(3)


async def test_a_recording_ends_and_is_played_again_from_its_begin(scene: Scene) -> None:
    scene.subscribe(scene.viewer, "/r1/pose")
    await scene.asks(play=True, seek=8.0)
    await asyncio.sleep(3.0)
    assert scene.seen()[-1:] == poses(10)
    assert scene.viewer.states[-1] == (ENDED, 10.0, 1.0, False, "")
    count = len(scene.viewer.states)
    await asyncio.sleep(100.0)
    assert len(scene.viewer.states) == count, "told once"
    await scene.asks(play=True)
    assert scene.viewer.states[-1] == (PLAYING, 0.0, 1.0, True, "id")
    await asyncio.sleep(1.5)
    assert scene.seen() == poses(0, 1)


async def test_the_time_waits_for_a_disk_that_is_slow(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    async def slow(work: Any, *arguments: Any) -> Any:
        await asyncio.sleep(4.0)
        return work(*arguments)

    scene.subscribe(scene.viewer, "/r1/pose")
    await asyncio.sleep(0.001)
    scene.seen()
    monkeypatch.setattr(asyncio, "to_thread", slow)
    await scene.asks(play=True, seek=2.0)
    await asyncio.sleep(12.1)  # two reads of what was there before, and one of what follows
    assert scene.seen() == poses(2, 3)
    assert scene.viewer.times[-1] == pytest.approx(3.0, abs=LATE_S)
    await asyncio.sleep(2.0)
    assert scene.seen() == poses(4, 5)


async def test_a_process_that_is_late_at_the_end_shows_what_it_has_not_read_yet(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("zbridge.views.foxglove.playback.BATCH", 4)
    scene.subscribe(scene.viewer, "/r1/pose")
    await scene.asks(play=True, seek=1.0, speed=50.0)
    asyncio.get_running_loop().pause(LATE_S - 0.02)  # type: ignore[attr-defined]
    await asyncio.sleep(2.0)
    assert scene.seen()[-9:] == [f"/r1/pose {second}" for second in range(2, 11)]
    assert scene.viewer.states[-1][0] == ENDED
