"""The time of a recording that is being played: runs, rests, jumps. Sans-IO; real time is an argument, seconds."""

from __future__ import annotations


class PlaybackClock:
    """Rests at the begin until it is told to play. begin_ns, end_ns: the first and the last time of the recording."""

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
        """Whether it rests at the end."""
        return not self.playing and self._at_ns >= self.end_ns

    def now_ns(self, now: float) -> int:
        """Return the time of the recording."""
        if not self.playing:
            return self._at_ns
        return min(self.end_ns, self._at_ns + int((now - self._since) * self.speed * 1e9))

    def play(self, speed: float, now: float) -> None:
        """Run from here on, at so many times the recording's speed; from the begin where it has ended."""
        at_ns = self.now_ns(now)
        self._set(self.begin_ns if self.ended else at_ns, now)
        self.playing, self.speed = True, speed

    def pause(self, now: float) -> None:
        """Rest here."""
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
