"""What a session still has to write: one frame at a time, spaced, the newest motion first. Sans-IO.

Fragile peers take one read as one packet, so a frame is handed out only when ``gap_s`` has passed since
the one before. Frames that come once wait in a bounded queue. Frames that stand (a drive command that is
repeated while the robot moves, a stop that is repeated for a second) have a named slot each, and a newer
one replaces what stands there.
"""

from __future__ import annotations

import math
from collections import deque

from zbridge.errors import Code, NotReady

URGENT = 256
"""Frames of a stop that may wait: one for each motor there can be."""
LIMIT = 64
"""Frames that may wait; one more is refused."""


class _Standing:
    """The frames of one slot: sent as a group, then again every ``period_s`` until ``until``."""

    __slots__ = ("due", "frames", "period_s", "position", "until")

    def __init__(self, frames: tuple[bytes, ...], due: float, period_s: float, until: float) -> None:
        self.frames = frames
        self.position = 0
        self.due = due
        self.period_s = period_s
        self.until = until

    def step(self, now: float) -> bytes:
        frame = self.frames[self.position]
        self.position += 1
        if self.position == len(self.frames):
            self.position = 0
            self.due = now + self.period_s
        return frame

    @property
    def over(self) -> bool:
        return self.position == 0 and (self.due > self.until or self.due == math.inf)


class Outbox:
    """Frames on their way out. ``gap_s``: least time between two writes, seconds."""

    def __init__(self, gap_s: float, limit: int = LIMIT) -> None:
        self.gap_s = gap_s
        self._limit = limit
        self._queue: deque[bytes] = deque()
        self._urgent: deque[bytes] = deque(maxlen=URGENT)
        self._standing: dict[str, _Standing] = {}
        self._free_at = -math.inf
        self._turn_of_queue = False
        self._exempt: deque[bytes] = deque()
        self._quiet_until = -math.inf

    def __repr__(self) -> str:
        return f"<Outbox {len(self._queue)} waiting, standing {sorted(self._standing)}>"

    def __len__(self) -> int:
        return len(self._exempt) + len(self._urgent) + len(self._queue)

    @property
    def idle(self) -> bool:
        """Whether nothing waits and nothing stands."""
        return not (self._standing or self._queue or self._urgent or self._exempt)

    def put(self, frame: bytes) -> None:
        """Queue a frame that is sent once; raise Refused when too many wait."""
        if len(self._queue) >= self._limit:
            raise NotReady(f"{self._limit} packets wait for the robot", Code.BUSY)
        self._queue.append(frame)

    def quiet(self, until: float) -> None:
        """Give nothing out before ``until`` but what :meth:`put_exempt` was given."""
        self._quiet_until = until

    def put_exempt(self, frame: bytes) -> None:
        """Queue a frame that goes first, and through a silence; raise Refused when too many wait."""
        if len(self._exempt) >= self._limit:
            raise NotReady(f"{self._limit} packets of the handshake wait", Code.BUSY)
        self._exempt.append(frame)

    def withdraw(self, frame: bytes) -> bool:
        """Take back a frame that :meth:`put_exempt` was given; False where it was given out already."""
        waiting = [kept for kept in self._exempt if kept is not frame]
        found = len(waiting) < len(self._exempt)
        self._exempt = deque(waiting)
        return found

    def stand(
        self,
        slot: str,
        frames: tuple[bytes, ...],
        now: float,
        *,
        period_s: float = math.inf,
        until: float = math.inf,
        urgent: bool = False,
    ) -> None:
        """Let ``frames`` stand in ``slot``: sent as soon as may be, then every ``period_s`` until ``until``.

        What stood there is forgotten, sent or not; of two groups of the same length the newer goes on where
        the older was, so that every place of the group has its turn. An urgent group goes before all others, whole and
        in its order, and once whatever replaces it; with ``until`` not after ``now`` it goes just once.
        """
        old = self._standing.get(slot)
        new = self._standing[slot] = _Standing(frames, now, period_s, until)
        if urgent:
            if not self._hurries(frames):
                self._urgent.extend(frames)
            new.due = now + period_s
            if new.over:
                del self._standing[slot]
        elif old is not None and len(old.frames) == len(frames):
            new.position = old.position

    def clear(self, slot: str) -> None:
        """Forget what stands in ``slot``."""
        self._standing.pop(slot, None)

    def unqueue(self, frame: bytes) -> None:
        """Forget a frame that was to be sent once, as far as it still waits."""
        while frame in self._queue:
            self._queue.remove(frame)

    def stands(self, slot: str) -> bool:
        """Tell whether anything stands in ``slot``."""
        return slot in self._standing

    def take(self, now: float) -> bytes | None:
        """Take the frame to write now, None when there is none or the gap has not passed."""
        if now < self._free_at:
            return None
        if self._exempt:
            frame: bytes | None = self._exempt.popleft()
        elif now < self._quiet_until:
            return None
        else:
            frame = self._urgent.popleft() if self._urgent else self._next(now)
        if frame is not None:
            self._free_at = now + self.gap_s
        return frame

    def written(self, now: float) -> None:
        """Take note that the frame taken last was written only now: the gap begins here."""
        self._free_at = max(self._free_at, now + self.gap_s)

    def _next(self, now: float) -> bytes | None:
        slot = self._due_slot(now)
        if slot is None:
            self._turn_of_queue = False
            return self._queue.popleft() if self._queue else None
        standing = self._standing[slot]
        frame = standing.step(now)
        if standing.over:
            del self._standing[slot]
        self._turn_of_queue = True
        return frame

    def deadline(self) -> float | None:
        """Tell when :meth:`take` will have something, None when nothing waits or stands."""
        if self.idle:
            return None
        if self._exempt:
            return self._free_at
        free_at = max(self._free_at, self._quiet_until)
        if self._urgent or self._queue:
            return free_at
        return max(free_at, min(standing.due for standing in self._standing.values()))

    def _hurries(self, group: tuple[bytes, ...]) -> bool:
        """Tell whether an urgent group still waits, whole and in its order."""
        if len(group) == 1:
            return group[0] in self._urgent
        urgent = tuple(self._urgent)
        return any(urgent[start : start + len(group)] == group for start in range(len(urgent) - len(group) + 1))

    def _due_slot(self, now: float) -> str | None:
        """Pick a due slot; slots take turns with the queue."""
        if not self._standing:
            return None
        if len(self._standing) == 1 and not self._queue:  # of a robot that is shown to many, nearly always
            slot, standing = next(iter(self._standing.items()))
            return slot if standing.due <= now else None
        due = [slot for slot, standing in self._standing.items() if standing.due <= now]
        if not due or (self._queue and self._turn_of_queue):
            return None
        return due[0] if len(due) == 1 else min(due, key=lambda slot: self._standing[slot].due)
