"""Plays a recording: calls back with each message when it is due. A thread of its own, for it keeps time more exactly.

Theory of operation. :class:`Pace` says when a moment of the recording is due, and has no clock. The :class:`Player`
reads one message after the other, sleeps until it is due, and hands it on. A message whose time is before the one that
stands before it is due at once. A pause moves all that follows by its length.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from pathlib import Path

from zbridge.views.recording.reader import Message, Reader, open_recording
from zbridge.views.recording.selection import Selection

log = logging.getLogger("zbridge.views.recording")

NAP_S = 0.05
"""Longest sleep between two looks at a pause or an end."""


class Pace:
    """When a moment of the recording is due. speed: seconds of the recording per second. Sans-IO."""

    def __init__(self, speed: float = 1.0) -> None:
        self._speed = speed
        self._begun = 0.0
        self._first_ns: int | None = None
        self._paused_at: float | None = None

    def __repr__(self) -> str:
        return f"<Pace {self._speed:g}{' paused' if self.paused else ''}>"

    @property
    def paused(self) -> bool:
        """Whether nothing is due."""
        return self._paused_at is not None

    def begin(self, first_ns: int, now: float) -> None:
        """Begin: this moment is due now."""
        self._first_ns, self._begun = first_ns, now
        if self._paused_at is not None:
            self._paused_at = now

    def due(self, log_ns: int) -> float:
        """Return when a moment is due, were there no further pause; the first moment asked for begins at 0."""
        assert self._first_ns is not None
        return self._begun + (log_ns - self._first_ns) / 1e9 / self._speed

    def pause(self, now: float) -> None:
        """Let nothing be due until :meth:`resume`; idempotent."""
        if self._paused_at is None:
            self._paused_at = now

    def resume(self, now: float) -> None:
        """Go on where it was paused; idempotent."""
        if self._paused_at is not None:
            self._begun += now - self._paused_at
            self._paused_at = None


class Player:
    """Plays a file from :meth:`start` to its end or :meth:`close`. play: called on the player's thread.

    ended: called there at the end, with what is wrong with the file, or None. skip: called with what stands before the
    selected part.
    """

    def __init__(
        self,
        path: Path,
        selection: Selection,
        play: Callable[[Message], object],
        ended: Callable[[str | None], object],
        *,
        skip: Callable[[Message], object] = lambda message: None,
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
        self._skip = skip
        self._pace = Pace(speed)
        self._loop = loop
        self._clock = clock
        self._sleep = sleep
        self._closing = False
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="zbridge-replay", daemon=True)

    def __repr__(self) -> str:
        return f"<Player {self._path.name} {self._pace!r}>"

    @property
    def paused(self) -> bool:
        """Whether it waits for :meth:`resume`."""
        return self._pace.paused

    def start(self) -> None:
        """Begin to play."""
        self._thread.start()

    def pause(self) -> None:
        """Stand still until :meth:`resume`; from any thread."""
        with self._lock:
            self._pace.pause(self._clock())

    def resume(self) -> None:
        """Go on; from any thread."""
        with self._lock:
            self._pace.resume(self._clock())

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
            log.exception("the replay failed")
            fault = f"{type(error).__name__}: {error}"
        finally:
            self._ended(fault)

    def _play_once(self) -> str | None:
        begun = False
        with open_recording(self._path) as file:
            reader = Reader(file)
            for message in reader.messages():
                if self._closing:
                    return None
                if not self._selection.takes(message):
                    if message.log_ns < self._selection.since_ns:
                        self._skip(message)
                    continue
                if not begun:
                    begun = True
                    with self._lock:
                        self._pace.begin(message.log_ns, self._clock())
                if not self._wait(message.log_ns):
                    return None
                self._play(message)
                self.played += 1
        return None if reader.ended else reader.fault

    def _wait(self, log_ns: int) -> bool:
        """Sleep until a moment is due; False where the player ends."""
        while not self._closing:
            with self._lock:
                wait_s = math.inf if self._pace.paused else self._pace.due(log_ns) - self._clock()
            if wait_s > 0:
                self._sleep(min(wait_s, NAP_S))
            if wait_s <= NAP_S and not self._pace.paused:  # another look at the clock would only make it late
                return not self._closing
        return False
