"""Decides when a gateway process counts as hung. Sans-IO: time is an argument, in seconds.

A robot that moves when its gateway hangs has to rest within 1.5 s: a driven process is given 0.8 s without a beat (it
beats five times a second), which leaves 0.7 s for a busy machine and the stop. Where the machine held up the supervisor
itself, the beats may be late for the same reason, and get a little longer.
"""

from __future__ import annotations

import msgspec

DRIVEN_S = 0.8
"""Longest time without a beat while the robot is driven."""
IDLE_S = 5.0
"""The same while it is not driven."""
FIRST_S = 30.0
"""Longest time until the first beat: thirty processes that start at once share the processors."""
EXCUSED_S = 0.2
"""What is added for a supervisor that was held up itself."""


class HeartState(msgspec.Struct, frozen=True):
    """What a heart knows, in seconds of the monotonic clock."""

    last: float
    patience_s: float
    excused_s: float = 0.0
    beats: int = 0


class Heart:
    """The beats of one process, from its start at ``now``."""

    def __init__(self, now: float) -> None:
        self._last = now
        self._patience_s = FIRST_S
        self._excused_s = 0.0
        self.beats = 0

    def __repr__(self) -> str:
        return f"<Heart {self.beats} beats>"

    @classmethod
    def of(cls, state: HeartState) -> Heart:
        """Make a heart that goes on."""
        heart = cls(state.last)
        heart._patience_s, heart._excused_s, heart.beats = state.patience_s, state.excused_s, state.beats
        return heart

    @property
    def state(self) -> HeartState:
        """What :meth:`of` needs."""
        return HeartState(self._last, self._patience_s, self._excused_s, self.beats)

    def beat(self, now: float, *, driven: bool) -> None:
        """Note a beat."""
        self.beats += 1
        self._last, self._excused_s = now, 0.0
        self._patience_s = DRIVEN_S if driven else IDLE_S

    def excuse(self) -> None:
        """Wait longer for the next beat: the supervisor itself did not run for a while, so neither did the process."""
        self._excused_s = EXCUSED_S

    @property
    def deadline(self) -> float:
        """The time at which the process counts as hung."""
        return self._last + self._patience_s + self._excused_s

    def silent_s(self, now: float) -> float:
        """Give the seconds since the last beat."""
        return now - self._last
