"""What a session still has to write: one frame at a time, with a gap between two writes. Sans-IO.

Theory of operation
-------------------
A session puts frames in. The driver gets one with ``take(now)``, writes it, reports the write with ``written(now)`` and
returns at ``deadline()``. Fragile peers treat one read as one packet, so ``take`` returns None for ``gap_s`` after a
write.

Four places for frames. ``take`` serves them in this order:

    exempt   queue of the handshake (``put_exempt``). The only one that is served during a silence (``quiet``).
    urgent   queue of the stop (``set`` with ``urgent``). Each group leaves whole and in order, whatever replaces
             its slot meanwhile. The same group is not queued twice.
    slots    one named group of frames each (``set``): the newest motion, the newest scan. A new group replaces the one
             before it, sent or not. Sent when due; with a period, again after each period, until ``until``.
    queue    frames that are sent once (``put``).

Fairness: the slot that has been due longest goes first; slots and queue take turns frame by frame, so that neither
a stream of motion nor a full queue starves the other. A group that replaces one of the same length continues at the
position of the old one, and is sent whole from there, unless it is the same: if a group of motors is replaced faster
than it is written, each motor is still served.

Polls and the slot :data:`KEEP_ALIVE` are sent while the outbox is muted, too: they keep the connection alive. Nothing
but :meth:`Outbox.clear` empties them.

Bounds: queue and exempt refuse a frame beyond ``limit``; urgent keeps the newest ``URGENT`` frames; a slot holds one
group, and a protocol names a fixed number of slots.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, ClassVar

import msgspec

from zbridge.errors import Code, NotReady
from zbridge.protocol.kept import FRAMES, Form, Kept, Spare

URGENT = 256
"""Frames of stops that may wait: one for each motor that a robot can have."""
KEEP_ALIVE = "keep alive"
"""The slot of what the robot's watchdog needs."""
LIMIT = 64
"""Frames that may wait; one more is refused."""


class _Group(msgspec.Struct):
    """The frames of one slot: sent ``spacing_s`` apart, then again every ``period_s`` until ``until``."""

    frames: tuple[bytes, ...]
    due: float
    period_s: float
    until: float
    spacing_s: float = 0.0
    position: int = 0
    sent: int = 0
    """Frames of this round that have left."""
    lasting: bool = False

    def step(self, now: float) -> bytes:
        """Return the next frame of the group."""
        frame = self.frames[self.position]
        self.position, self.sent = (self.position + 1) % len(self.frames), self.sent + 1
        if self.sent == len(self.frames):
            self.position = self.sent = 0
            self.due = now + self.period_s
        elif self.spacing_s:
            self.due = now + self.spacing_s
        return frame

    @property
    def over(self) -> bool:
        """Whether the group is sent whole and not due again."""
        return self.sent == 0 and (self.due > self.until or self.due == math.inf)


class Outbox(Kept):
    """Frames on their way out. ``gap_s``: least time between two writes, seconds."""

    kept: ClassVar[dict[str, Any]] = {
        "_queue": Spare(FRAMES),
        "_urgent": Spare(FRAMES),
        "_exempt": Spare(FRAMES),
        "_slots": Spare(Form(lambda slots: _write_slots(slots), lambda raw: _read_slots(raw))),
        "_free_at": float,
        "_turn_of_queue": bool,
        "_quiet_until": float,
    }

    def __init__(self, gap_s: float, limit: int = LIMIT) -> None:
        self.gap_s = gap_s
        self._limit = limit
        self._queue: deque[bytes] = deque()
        self._urgent: deque[bytes] = deque(maxlen=URGENT)
        self._slots: dict[str, _Group] = {}
        self._free_at = -math.inf
        self._turn_of_queue = False
        self._exempt: deque[bytes] = deque()
        self._quiet_until = -math.inf
        self._muted = False

    def __repr__(self) -> str:
        return f"<Outbox {len(self._queue)} waiting, slots {sorted(self._slots)}>"

    def __len__(self) -> int:
        return len(self._exempt) + len(self._urgent) + len(self._queue)

    @property
    def hurried(self) -> bool:
        """Whether frames of a stop, or of a handshake, still wait."""
        return bool(self._urgent or self._exempt)

    @property
    def muted(self) -> bool:
        """Whether only what keeps the connection alive is written."""
        return self._muted

    def waits(self, now: float) -> bool:
        """Return whether a frame waits: for its turn, an answer, the gap. Repetitions that are not due do not wait."""
        return bool(self) or any(group.due <= now + self.gap_s for group in self._slots.values())

    def put(self, frame: bytes) -> None:
        """Queue a frame that is sent once; raise Refused when ``limit`` frames wait."""
        if self._muted:
            return
        if len(self._queue) >= self._limit:
            raise NotReady(f"{self._limit} packets wait for the robot", Code.BUSY)
        self._queue.append(frame)

    def quiet(self, until: float) -> None:
        """Begin a silence: before ``until`` only exempt frames leave."""
        self._quiet_until = until

    def mute(self, muted: bool) -> None:
        """Drop all frames but exempt ones, polls and the keep-alive, waiting or new, until ``mute(False)``."""
        self._muted = muted
        if muted:
            for place in (self._queue, self._urgent):
                place.clear()
            self._clear_slots()

    def put_exempt(self, frame: bytes) -> None:
        """Queue a frame that leaves first, and during a silence; raise Refused when ``limit`` of them wait."""
        if len(self._exempt) >= self._limit:
            raise NotReady(f"{self._limit} packets of the handshake wait", Code.BUSY)
        self._exempt.append(frame)

    def withdraw(self, frame: bytes) -> bool:
        """Remove an exempt frame (this object); False if it has left."""
        waiting = [kept for kept in self._exempt if kept is not frame]
        found = len(waiting) < len(self._exempt)
        self._exempt = deque(waiting)
        return found

    def found(self, frame: bytes | None) -> bytes | None:
        """Return the exempt frame that equals ``frame``, after both were restored; ``frame`` itself if it has left."""
        return next((kept for kept in self._exempt if kept == frame), frame)

    def set(
        self,
        slot: str,
        frames: tuple[bytes, ...],
        now: float,
        *,
        period_s: float = math.inf,
        until: float = math.inf,
        spacing_s: float = 0.0,
        urgent: bool = False,
        lasting: bool = False,
    ) -> None:
        """Put a group of frames into ``slot``, in place of the one there.

        The group is due at ``now``, then every ``period_s`` until ``until``; without a period it is sent once.
        ``spacing_s``: between two of its frames, where it is not urgent; else the gap of the outbox.
        ``urgent``: queue it before all slots, to leave whole; the slot holds its repetitions, none if ``until`` is not
        after ``now``. ``lasting``: it moves no robot, and is kept where the outbox is muted or forgets, as polls are.
        """
        lasting = lasting or slot == KEEP_ALIVE
        if self._muted and not lasting:
            return
        old = self._slots.get(slot)
        new = self._slots[slot] = _Group(frames, now, period_s, until, spacing_s, lasting=lasting)
        if urgent:
            if not self._hurries(frames):
                self._urgent.extend(frames)
            new.due = now + period_s
            if new.over:
                del self._slots[slot]
        elif old is not None:
            if len(old.frames) == len(frames):
                new.position = old.position
                new.sent = old.sent if old.frames == frames else 0
            if old.due <= now or old.sent:  # it keeps its turn, and the spacing
                new.due = old.due

    def prolong(self, slot: str, frames: tuple[bytes, ...], *, period_s: float, until: float) -> bool:
        """Repeat what ``slot`` holds until then, on its existing schedule; False if it holds other frames.

        So repeated frames leave evenly spaced: a peer that reads seldom joins frames that arrive closer together.
        """
        group = self._slots.get(slot)
        if group is None or group.frames != frames or group.due > until:
            return False
        group.period_s, group.until = period_s, max(group.until, until)
        return True

    def forget(self) -> None:
        """Drop every waiting frame, and every repetition."""
        for place in (self._queue, self._urgent, self._exempt):
            place.clear()
        self._clear_slots()

    def _clear_slots(self) -> None:
        self._slots = {slot: group for slot, group in self._slots.items() if group.lasting}

    def clear(self, slot: str) -> None:
        """Empty ``slot``."""
        self._slots.pop(slot, None)

    def unqueue(self, frame: bytes) -> None:
        """Remove a frame from the queue, as often as it is there."""
        while frame in self._queue:
            self._queue.remove(frame)

    def is_set(self, slot: str) -> bool:
        """Return whether ``slot`` holds a group."""
        return slot in self._slots

    def take(self, now: float) -> bytes | None:
        """Take the frame to write now; None: there is none, or the gap has not passed."""
        if now < self._free_at:
            return None
        if self._exempt:
            frame: bytes | None = self._exempt.popleft()
        elif now < self._quiet_until:
            return None
        elif self._urgent:
            frame = self._urgent.popleft()
        elif (slot := self._due_slot(now)) is None:
            self._turn_of_queue = False
            frame = self._queue.popleft() if self._queue else None
        else:
            self._turn_of_queue = True
            group = self._slots[slot]
            frame = group.step(now)
            if group.over:
                del self._slots[slot]
        if frame is not None:
            self._free_at = now + self.gap_s
        return frame

    def written(self, now: float) -> None:
        """Start the gap now: the frame taken last is written."""
        self._free_at = max(self._free_at, now + self.gap_s)

    def deadline(self) -> float | None:
        """Return the time at which :meth:`take` has a frame; None: all queues and slots are empty."""
        if self._exempt:
            return self._free_at
        free_at = max(self._free_at, self._quiet_until)
        if self._urgent or self._queue:
            return free_at
        if not self._slots:
            return None
        return max(free_at, min(group.due for group in self._slots.values()))

    def _hurries(self, group: tuple[bytes, ...]) -> bool:
        """Return whether a group still waits among the urgent frames, whole and in its order."""
        urgent = tuple(self._urgent)
        return any(urgent[start : start + len(group)] == group for start in range(len(urgent) - len(group) + 1))

    def _due_slot(self, now: float) -> str | None:
        """Choose the slot that has been due longest; None: none is due, or it is the queue's turn."""
        if not self._slots:
            return None
        if len(self._slots) == 1 and not self._queue:  # nearly always, for HQ programs
            slot, group = next(iter(self._slots.items()))
            return slot if group.due <= now else None
        due = [slot for slot, group in self._slots.items() if group.due <= now]
        if not due or (self._queue and self._turn_of_queue):
            return None
        return due[0] if len(due) == 1 else min(due, key=lambda slot: self._slots[slot].due)


def _write_slots(slots: dict[str, _Group]) -> list[Any]:
    """Write the groups; what 0.2 did not know stands last."""
    return [
        [slot, FRAMES.write(group.frames), group.position, group.due, group.period_s, group.until, group.spacing_s]
        + [group.sent, group.lasting]
        for slot, group in slots.items()
    ]


def _read_slots(raw: list[Any]) -> dict[str, _Group]:
    """Read the groups, also as 0.2 wrote them."""
    slots = {}
    for slot, frames, position, due, period_s, until, spacing_s, *more in raw:
        sent, lasting = more or (position, False)
        slots[slot] = _Group(FRAMES.read(frames), due, period_s, until, spacing_s, position, sent, lasting)
    return slots
