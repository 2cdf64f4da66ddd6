"""A recording as a source: plays, pauses and seeks as viewers say; all viewers see the same time.

Messages are read ahead on a thread, ``BATCH`` at a time, and shown when the clock of the playback reaches their times.
After a seek, and when a channel is first wanted, viewers are shown the last message of it before that time: of streams
those of the last ``RECENT_S``, of what changes rarely (``RARE``) those of any time.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import Iterator

from zbridge.views.foxglove import replies
from zbridge.views.foxglove.hub import Hub, Subscriber
from zbridge.views.foxglove.recording import IndexedRecording, PlayedMessage
from zbridge.views.foxglove.replies import PlaybackStatus
from zbridge.views.foxglove.requests import PlaybackRequest
from zbridge.views.foxglove.source import ViewerSource
from zbridge.views.pictures import ViewerChannel
from zbridge.views.recording.player import PlaybackClock

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
        hub.on_subscribed = self._on_subscribed

    def __repr__(self) -> str:
        return f"<Playback {self._recording!r} {self._clock!r}>"

    # What viewers do

    def greet(self, viewer: Subscriber) -> None:
        """Tell a new viewer what is being played."""
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

    def _on_subscribed(self, channel: ViewerChannel, viewer: Subscriber, subscription: int) -> None:
        self._on_wanted(channel, True)

    # What is shown

    async def run(self) -> None:
        """Show messages when their time comes, until cancelled."""
        ahead: list[PlayedMessage] = []
        entries: Iterator[PlayedMessage] = iter(())
        sent_at = 0.0
        while True:
            self._changed.clear()
            if self._backfill:
                await self._show_last()
                continue
            if self._from_ns is not None:  # what was recorded at this very time was shown as the last before it
                entries, ahead, self._from_ns = self._recording.messages(self._from_ns + 1), [], None
            if not ahead:
                ahead = await self._read(entries)
                if self._from_ns is not None:  # a seek came meanwhile
                    continue
                ahead.reverse()
            now = self._loop.time()
            self._hold_back(ahead, now)
            while ahead and self._clock.playing and self._clock.wait_s(ahead[-1].log_ns, now) <= 0:
                message = ahead.pop()
                self.hub.publish(message.topic, message.log_ns, message.payload)
            if self._clock.playing and now - sent_at >= TICK_S:
                sent_at = now
                self._send_time(ended=not ahead)
            await self._wait(ahead)

    async def _wait(self, ahead: list[PlayedMessage]) -> None:
        """Wait for the next message, the next tick, or a viewer."""
        wait_s: float | None = None
        if self._clock.playing:
            wait_s = TICK_S
            if ahead:
                wait_s = max(0.0, min(TICK_S, self._clock.wait_s(ahead[-1].log_ns, self._loop.time())))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                await self._changed.wait()

    def _hold_back(self, ahead: list[PlayedMessage], now: float) -> None:
        """Let the clock wait where reading cannot keep up with it."""
        if ahead and self._clock.playing and self._clock.wait_s(ahead[-1].log_ns, now) < -LATE_S:
            self._clock.seek(ahead[-1].log_ns, now)

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

    async def _read(self, entries: Iterator[PlayedMessage]) -> list[PlayedMessage]:
        return await asyncio.to_thread(lambda: list(itertools.islice(entries, BATCH)))

    def _now_ns(self) -> int:
        return self._clock.now_ns(self._loop.time())

    def _state(self, *, sought: bool, request_id: str) -> bytes:
        clock, now_ns = self._clock, self._now_ns()
        status = PlaybackStatus.PLAYING if clock.playing else PlaybackStatus.PAUSED
        if clock.ended:
            status = PlaybackStatus.ENDED
        return replies.playback_state(status, now_ns, clock.speed, sought=sought, request_id=request_id)
