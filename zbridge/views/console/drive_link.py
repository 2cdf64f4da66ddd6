"""How fresh a browser's commands are, and when it must send neutral before motion. Sans-IO; time is an argument.

Theory of operation. The server sends numbered ticks, and each command names the newest tick that the page had received
when it was given. The age of that tick bounds the age of the command, whichever direction of the connection stalled,
and whoever was frozen meanwhile: buffers of the kernel deliver a burst after a stall, and its commands name old ticks.
At most :data:`UNANSWERED` ticks are under way, so a stall does not collect them either.

The link judges commands (:meth:`DriveLink.take`) and says what is due (:meth:`DriveLink.expire`, at
:meth:`DriveLink.deadline` or later). The caller owns the stick and the lease: it must require neutral of the stick as
the verdict says, and report with :meth:`DriveLink.sent` what the robot was sent.

Guarantees. A command is accepted once, in order, and only if it was given at most :data:`FRESH_S` ago. Motion ends
:data:`BRIDGE_S` after the last accepted command. After a dropped command, a silence of :data:`GAP_S`, and a change of
the page's ``epoch`` (its focus, its gamepads) the verdict requires neutral.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Annotated, Literal

import msgspec

from zbridge.fleet.messages import Finite, Fraction

TICK_S = 0.05
"""Seconds between two ticks; a page repeats its command as often."""
FRESH_S = 0.3
"""Oldest tick, seconds, that a command may name."""
BRIDGE_S = 0.2
"""Silence in seconds after which a moving robot is sent neutral."""
GAP_S = 0.5
"""Silence in seconds after which neutral must come before motion."""
SILENT_S = 2.0
"""A page that sends nothing for so long loses control."""
UNANSWERED = 8
"""Most ticks that no command has named yet."""
_Count = Annotated[int, msgspec.Meta(ge=0, lt=2**53)]


class MotorCommand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One motor: rad/s, or metres for a linear one, which stays where it is when it is no longer commanded."""

    name: Annotated[str, msgspec.Meta(max_length=100)]
    value: Finite
    linear: bool = False


class PageCommand(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="drive"):
    """What a page commands, 20 times a second and at each change. seq: rises. tick: the newest that it received.

    epoch: rises when the page regains the focus or a usable connection, or its gamepads change; why: which of them it
    was last. Fractions of full scale, ``turn`` counter-clockwise. motor: moves one motor instead.
    """

    seq: _Count
    tick: _Count
    epoch: _Count = 0
    why: Literal["", "focus", "gamepad", "link"] = ""
    forward: Fraction = 0.0
    left: Fraction = 0.0
    turn: Fraction = 0.0
    motor: MotorCommand | None = None

    @property
    def moving(self) -> bool:
        """Whether this is motion, not neutral."""
        return bool(self.forward or self.left or self.turn or (self.motor is not None and self.motor.value))


class Drop(Enum):
    """Why a command is dropped."""

    STALE = "stale"
    REPEATED = "repeated"
    UNKNOWN_TICK = "unknown_tick"


class PageVerdict(msgspec.Struct, frozen=True):
    """What is to be done with a command. drop: None if it is accepted. centre: why neutral must come before motion."""

    drop: Drop | None = None
    centre: str | None = None


class Due(Enum):
    """What is due because a page is silent."""

    NEUTRAL = "neutral"
    SILENT = "silent"


_WHY = {
    "focus": "the page was out of focus",
    "gamepad": "the gamepads have changed",
    "link": "the connection to this page was slow",
}


class DriveLink:
    """The connection of one page that drives, from ``now`` on."""

    def __init__(self, now: float) -> None:
        self.acknowledged: tuple[int, float] | None = None
        """The last accepted command, and when it came: the page computes the round trip of it."""
        self._sent_at: dict[int, float] = {}
        """When recent ticks were sent: those that are fresh, and the newest ones."""
        self._tick = 0
        self._answered = 0
        self._seq = -1
        self._epoch: int | None = None
        self._heard_at = self._accepted_at = now
        self.moving = False
        """Whether the robot may move now."""

    def __repr__(self) -> str:
        return f"<DriveLink at tick {self._tick}, command {self._seq}>"

    def tick(self, now: float) -> int | None:
        """Return the number of the tick to send now; None if too many are unanswered."""
        if self._tick - self._answered >= UNANSWERED:
            return None
        self._tick += 1
        self._sent_at[self._tick] = now
        while len(self._sent_at) > UNANSWERED + FRESH_S / TICK_S:
            del self._sent_at[next(iter(self._sent_at))]
        return self._tick

    def heard(self, now: float) -> None:
        """Record that the page sent anything."""
        self._heard_at = now

    def take(self, command: PageCommand, now: float) -> PageVerdict:
        """Judge a command."""
        if command.seq <= self._seq:
            return PageVerdict(Drop.REPEATED)
        self._seq = command.seq
        if command.tick > self._tick:
            return PageVerdict(Drop.UNKNOWN_TICK, "the page named a tick that was never sent")
        self._answered = max(self._answered, command.tick)
        sent_at = self._sent_at.get(command.tick, -math.inf)
        if now - sent_at > FRESH_S:
            return PageVerdict(Drop.STALE, "the connection to this page stalled")
        centre = None
        if now - self._accepted_at > GAP_S:
            centre = f"the page sent nothing for {GAP_S:g} s"
        if self._epoch is not None and command.epoch != self._epoch:
            centre = _WHY.get(command.why, "the page was changed")
        self._epoch, self._accepted_at = command.epoch, now
        self.acknowledged = (command.seq, now)
        return PageVerdict(centre=centre)

    def sent(self, *, moving: bool) -> None:
        """Record whether the robot may move now: it was sent motion, or moves by itself."""
        self.moving = moving

    def deadline(self) -> float:
        """Return when :meth:`expire` is due next."""
        silent_at = self._heard_at + SILENT_S
        return min(silent_at, self._accepted_at + BRIDGE_S) if self.moving else silent_at

    def expire(self, now: float) -> Due | None:
        """Return what is due: neutral after motion that was not repeated, or the end of a silent page's control."""
        if now >= self._heard_at + SILENT_S:
            return Due.SILENT
        if self.moving and now >= self._accepted_at + BRIDGE_S:
            return Due.NEUTRAL
        return None
