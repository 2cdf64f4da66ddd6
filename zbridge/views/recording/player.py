"""Plays a recording: calls back with each message when it is due. A thread of its own, for it keeps time more exactly.

Theory of operation. :class:`PlaybackClock` tells the time of the recording. The :class:`Player` reads one message after
the other, sleeps until it is due, and hands it on. A message whose time is before that of its predecessor is due
at once. A pause moves all that follows by its length.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path

from zbridge.log import Log
from zbridge.views.recording.reader import RecordedMessage, RecordingReader, open_recording
from zbridge.views.recording.selection import Selection

log = Log("zbridge.views.recording")

POLL_S = 0.05
"""Longest sleep between two checks for a pause or an end."""


class PlaybackClock:
    """The time of a recording that is played: runs, pauses, jumps. Sans-IO; real time is an argument, seconds.

    It is paused at the begin until :meth:`play`. begin_ns, end_ns: the first and the last time of the recording.
    """

    def __init__(self, begin_ns: int, end_ns: int) -> None:
        self.begin_ns = begin_ns
        self.end_ns = end_ns
        self.playing = False
        self.speed = 1.0
        self._at_ns = begin_ns
        self._since = 0.0

    def __repr__(self) -> str:
        return f"<PlaybackClock {'playing' if self.playing else 'paused'} at {self._at_ns} x {self.speed:g}>"

    @property
    def ended(self) -> bool:
        """Whether it is paused at the end."""
        return not self.playing and self._at_ns >= self.end_ns

    def now_ns(self, now: float) -> int:
        if not self.playing:
            return self._at_ns
        return min(self.end_ns, self._at_ns + int((now - self._since) * self.speed * 1e9))

    def play(self, speed: float, now: float) -> None:
        """Run from here on, at so many times the recording's speed; from the begin where it has ended."""
        at_ns = self.now_ns(now)
        self._set(self.begin_ns if self.ended else at_ns, now)
        self.playing, self.speed = True, speed

    def pause(self, now: float) -> None:
        self._set(self.now_ns(now), now)
        self.playing = False

    def seek(self, to_ns: int, now: float) -> None:
        """Jump, within the recording."""
        self._set(max(self.begin_ns, min(self.end_ns, to_ns)), now)

    def wait_s(self, for_ns: int, now: float) -> float:
        """Return the real time until a time of the recording; 0 or less if it is past."""
        return (for_ns - self.now_ns(now)) / 1e9 / self.speed

    def _set(self, at_ns: int, now: float) -> None:
        self._at_ns, self._since = at_ns, now


class Player:
    """Plays a file from :meth:`start` to its end or :meth:`close`.

    play: called on the player's thread with a message, and whether it is selected: those before the selected part are
    not due. ended: called there at the end, with what is wrong with the file, or None.
    """

    def __init__(
        self,
        path: Path,
        selection: Selection,
        play: Callable[[RecordedMessage, bool], object],
        ended: Callable[[str | None], object],
        *,
        speed: float = 1.0,
        loop: bool = False,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self.played = 0
        self._path = path
        self._selection = selection
        self._play = play
        self._ended = ended
        self._time = PlaybackClock(0, 2**64)
        self._speed = speed
        self._loop = loop
        self._clock = clock
        self._time.play(speed, clock())
        self._sleep = sleep
        self._closing = False
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="zbridge-replay", daemon=True)

    def __repr__(self) -> str:
        return f"<Player {self._path.name} {self._time!r}>"

    @property
    def paused(self) -> bool:
        """Whether it waits for :meth:`resume`."""
        return not self._time.playing

    def start(self) -> None:
        self._thread.start()

    def pause(self) -> None:
        """Pause until :meth:`resume`; from any thread."""
        with self._lock:
            self._time.pause(self._clock())

    def resume(self) -> None:
        """Continue; from any thread."""
        with self._lock:
            self._time.play(self._speed, self._clock())

    def close(self, timeout_s: float = 2.0) -> None:
        """End, and wait for the thread; idempotent."""
        self._closing = True
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    def _run(self) -> None:
        fault: str | None = "the player failed"
        try:
            while True:
                before = self.played
                fault = self._play_once()
                if self._closing or not self._loop or self.played == before:
                    return
        except Exception as error:
            log.exception("replay_failed", "the replay failed")
            fault = f"{type(error).__name__}: {error}"
        finally:
            self._ended(fault)

    def _play_once(self) -> str | None:
        begun = False
        with open_recording(self._path) as file:
            reader = RecordingReader(file)
            for message in reader.messages():
                if self._closing:
                    return None
                if not self._selection.includes(message):
                    if message.log_ns < self._selection.since_ns:
                        self._play(message, False)
                    continue
                if not begun:
                    begun = True
                    with self._lock:
                        self._time.seek(message.log_ns, self._clock())
                if not self._wait(message.log_ns):
                    return None
                self._play(message, True)
                self.played += 1
        return None if reader.ended else reader.fault

    def _wait(self, log_ns: int) -> bool:
        """Sleep until a moment is due; False if the player ends."""
        while not self._closing:
            with self._lock:
                wait_s = math.inf if self.paused else self._time.wait_s(log_ns, self._clock())
            if wait_s > 0:
                self._sleep(min(wait_s, POLL_S))
            if wait_s <= POLL_S and not self.paused:  # reading the clock again would only make it late
                return not self._closing
        return False
