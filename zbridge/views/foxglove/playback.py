"""A recording as a source: plays, pauses and seeks as viewers say; all viewers see the same time.

Messages are read ahead on a thread, ``BATCH`` at a time, and shown when the clock of the playback reaches their times.
After a seek, and when a channel is first wanted, viewers are shown the last message of it before that time: of streams
those of the last ``RECENT_S``, of what changes rarely (``RARE``) those of any time. A recording that was cut off has no
index: it is read from its begin, up to the cut.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import msgspec
from mcap.reader import NonSeekingReader, SeekingReader

from zbridge.errors import ZbridgeError, describe
from zbridge.log import Log
from zbridge.tasks import occurs
from zbridge.views.foxglove import replies
from zbridge.views.foxglove.hub import Hub, Subscriber
from zbridge.views.foxglove.replies import PlaybackStatus
from zbridge.views.foxglove.requests import PlaybackRequest
from zbridge.views.foxglove.source import ViewerSource
from zbridge.views.pictures import ViewerChannel
from zbridge.views.recording.player import PlaybackClock
from zbridge.views.schemas import Schema

log = Log("zbridge.foxglove")

BATCH = 64
"""Messages that are read at once."""
TICK_S = 1 / 30
"""The time is told so often while the recording runs."""
LATE_S = 0.25
"""How far what is shown may be behind the clock before the clock waits for it."""
RECENT_S = 5.0
RARE = ("foxglove.Grid", "zbridge.Status.v1", "zbridge.Control.v1", "zbridge.Scanner.v1", "zbridge.Devices.v1")
"""Schemas of what is shown however old it is."""
_S_NS = 1_000_000_000
CHANNELS = 4096
"""Most channels of a recording that are shown."""
RECORD_BYTES = 256 * 1024 * 1024
"""The longest record that is read."""
SCHEMA_BYTES = 1024 * 1024
"""The longest schema that viewers are told; a channel with a longer one is left out."""
TOPIC_CHARACTERS = 1024
SHOWN = ("protobuf", "json", "ros1", "cdr", "flatbuffer")
"""Encodings that viewers read; the fleet messages of a recording (MessagePack) are for other readers."""
_LAST_NS = 2**63 - 1


class PlayedMessage(msgspec.Struct, frozen=True, gc=False):
    """A recorded message. log_ns: Unix nanoseconds."""

    topic: str
    log_ns: int
    payload: bytes


class IndexedRecording:
    """A recording in a file; raises ZbridgeError, which names the file, if nothing of it can be shown.

    whole: whether it has an index. begin_ns, end_ns: its first and last time, Unix nanoseconds.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.whole = True
        self.begin_ns = self.end_ns = 0
        self.channels: dict[str, ViewerChannel] = {}
        try:
            with path.open("rb") as file:
                self.whole = self._read_index(file)
            if not self.whole:
                self._read_through()
        except OSError as error:
            raise ZbridgeError(f"{path}: {error.strerror or error}") from error
        if not self.channels or not 0 <= self.begin_ns <= self.end_ns <= _LAST_NS:
            raise ZbridgeError(f"{path}: nothing in it that a viewer can show")

    def __repr__(self) -> str:
        return f"<IndexedRecording {self.path}, {len(self.channels)} channels>"

    def messages(self, from_ns: int) -> Iterator[PlayedMessage]:
        """Yield the messages from a time on, in the order of their times; of a cut recording as they were written.

        The first thing that cannot be read is the end. Raise OSError.
        """
        with self.path.open("rb") as file:
            for _, channel, message in self._until_fault(file, starting_at=from_ns):
                if channel.topic in self.channels:
                    yield PlayedMessage(channel.topic, message.log_time, message.data)

    def last_before(self, topics: Iterable[str], at_ns: int, since_ns: int) -> list[PlayedMessage]:
        """Return the last message of each topic until a time, inclusive, but of none from before ``since_ns``."""
        wanted, found = set(topics), dict[str, PlayedMessage]()
        if not wanted or at_ns < since_ns:
            return []
        with self.path.open("rb") as file:
            entries = self._until_fault(
                file, topics=list(wanted), starting_at=since_ns, ending_at=at_ns, reverse=self.whole
            )
            for _, channel, message in entries:
                if not self.whole or channel.topic not in found:
                    found[channel.topic] = PlayedMessage(channel.topic, message.log_time, message.data)
                if self.whole and len(found) == len(wanted):
                    break
        return sorted(found.values(), key=lambda message: message.log_ns)

    def _read_index(self, file: IO[bytes]) -> bool:
        """Read channels and times from the index; False if there is none."""
        try:
            summary = SeekingReader(file, record_size_limit=RECORD_BYTES).get_summary()
        except Exception:  # whatever a damaged index makes the library raise: the messages may still be good
            return False
        if summary is None or summary.statistics is None or not summary.chunk_indexes:
            return False
        for channel in summary.channels.values():
            self._add(channel, summary.schemas.get(channel.schema_id))
        self.begin_ns = summary.statistics.message_start_time
        self.end_ns = summary.statistics.message_end_time
        return True

    def _read_through(self) -> None:
        """Read everything up to the cut, for channels and times."""
        self.begin_ns = _LAST_NS
        with self.path.open("rb") as file:
            for schema, channel, message in self._until_fault(file):
                self._add(channel, schema)
                self.begin_ns = min(self.begin_ns, message.log_time)
                self.end_ns = max(self.end_ns, message.log_time)

    def _add(self, channel: Any, schema: Any) -> None:
        encoding = channel.message_encoding
        if encoding not in SHOWN or len(self.channels) >= CHANNELS or len(channel.topic) > TOPIC_CHARACTERS:
            return
        name, kind, data = (schema.name, schema.encoding, schema.data) if schema is not None else ("", "", b"")
        if len(data) <= SCHEMA_BYTES and len(name) <= TOPIC_CHARACTERS:
            shown = ViewerChannel(channel.topic, channel.topic, Schema(name, kind, data, encoding))
            self.channels.setdefault(channel.topic, shown)

    def _until_fault(self, file: IO[bytes], **filters: Any) -> Iterator[tuple[Any, Any, Any]]:
        """Yield schema, channel and message up to what cannot be read. The order of times needs the index."""
        try:
            reader: type[SeekingReader | NonSeekingReader] = SeekingReader if self.whole else NonSeekingReader
            yield from reader(file, record_size_limit=RECORD_BYTES).iter_messages(log_time_order=self.whole, **filters)
        except OSError:
            raise
        except Exception as error:  # whatever the library raises; a cut is the usual cause
            log.info("recording_cut", "{file}: read up to: {error}", file=self.path, error=describe(error))


class Playback(ViewerSource):
    """Plays a recording."""

    def __init__(self, hub: Hub, recording: IndexedRecording) -> None:
        super().__init__(hub)
        self.capabilities = ("time", "playbackControl")
        self.times_ns = (recording.begin_ns, recording.end_ns)
        self._recording = recording
        self._clock = PlaybackClock(recording.begin_ns, recording.end_ns)
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()
        self._backfill: set[str] = set()
        """Topics whose last message before now is to be shown."""
        self._from_ns: int | None = recording.begin_ns
        """Where reading begins anew; None while it continues."""
        hub.offer(recording.channels.values())
        hub.on_wanted = self._on_wanted

    def __repr__(self) -> str:
        return f"<Playback {self._recording!r} {self._clock!r}>"

    # What viewers do

    def greet(self, viewer: Subscriber) -> None:
        viewer.say(self._state(sought=False, request_id=""))
        viewer.say(replies.time(self._now_ns()))

    def play(self, viewer: Subscriber, request: PlaybackRequest) -> None:
        """Play or pause, from another time if one is named. The others are told without the id of the request."""
        now = self._loop.time()
        sought = request.seek_ns is not None or (request.play and self._clock.ended)
        if request.seek_ns is not None:
            self._clock.seek(request.seek_ns, now)
        if request.play:
            self._clock.play(request.speed, now)
        else:
            self._clock.pause(now)
            self._clock.speed = request.speed
        if sought:
            self._from_ns = self._clock.now_ns(now)
            self._backfill.update(channel.topic for channel in self.hub.wanted())
        viewer.say(self._state(sought=sought, request_id=request.request_id))
        others = self._state(sought=sought, request_id="")
        for other in self.hub.viewers:
            if other is not viewer:
                other.say(others)
        self._changed.set()

    def _on_wanted(self, channel: ViewerChannel, wanted: bool) -> None:
        if wanted:
            self._backfill.add(channel.topic)
            self._changed.set()

    # What is shown

    async def run(self) -> None:
        """Show messages when their time comes, until cancelled."""
        ahead: list[PlayedMessage] = []
        entries: Iterator[PlayedMessage] = iter(())
        sent_at, read_all = 0.0, False
        while True:
            self._changed.clear()
            if self._backfill:
                await self._show_last()
                continue
            if self._from_ns is not None:  # what was recorded at this very time was shown as the last before it
                entries, ahead, self._from_ns = self._recording.messages(self._from_ns + 1), [], None
                read_all = False
            if not ahead and not read_all:
                ahead = await asyncio.to_thread(list, itertools.islice(entries, BATCH))
                if self._from_ns is not None:  # a seek came meanwhile
                    continue
                read_all = len(ahead) < BATCH
                ahead.reverse()
            now = self._loop.time()
            if ahead and self._clock.playing and self._clock.wait_s(ahead[-1].log_ns, now) < -LATE_S:
                self._clock.seek(ahead[-1].log_ns, now)  # reading cannot keep up with the clock
            while ahead and self._clock.playing and self._clock.wait_s(ahead[-1].log_ns, now) <= 0:
                message = ahead.pop()
                self.hub.publish(message.topic, message.log_ns, message.payload)
            if self._clock.playing and now - sent_at >= TICK_S:
                sent_at = now
                self._send_time(ended=read_all and not ahead)
            await self._wait(ahead)

    async def _wait(self, ahead: list[PlayedMessage]) -> None:
        """Wait for the next message, the next tick, or a viewer."""
        wait_s: float | None = None
        if self._clock.playing:
            wait_s = TICK_S
            if ahead:
                wait_s = max(0.0, min(TICK_S, self._clock.wait_s(ahead[-1].log_ns, self._loop.time())))
        await occurs(self._changed, wait_s)

    def _send_time(self, *, ended: bool) -> None:
        now_ns = self._now_ns()
        self.hub.say(replies.time(now_ns))
        if ended and now_ns >= self._clock.end_ns:
            self._clock.pause(self._loop.time())
            self.hub.say(self._state(sought=False, request_id=""))

    async def _show_last(self) -> None:
        """Show the last messages before now of the channels that wait for them."""
        topics, self._backfill = self._backfill, set()
        channels = self._recording.channels
        rare = {topic for topic in topics if channels[topic].schema.name in RARE}
        at_ns = self._now_ns()
        recent_ns = max(self._clock.begin_ns, at_ns - int(RECENT_S * _S_NS))
        for group, since_ns in ((rare, self._clock.begin_ns), (topics - rare, recent_ns)):
            for message in await asyncio.to_thread(self._recording.last_before, group, at_ns, since_ns):
                self.hub.publish(message.topic, message.log_ns, message.payload)
        if not self._clock.playing:
            self.hub.say(replies.time(at_ns))

    def _now_ns(self) -> int:
        return self._clock.now_ns(self._loop.time())

    def _state(self, *, sought: bool, request_id: str) -> bytes:
        clock, now_ns = self._clock, self._now_ns()
        status = PlaybackStatus.PLAYING if clock.playing else PlaybackStatus.PAUSED
        if clock.ended:
            status = PlaybackStatus.ENDED
        return replies.playback_state(status, now_ns, clock.speed, sought=sought, request_id=request_id)
