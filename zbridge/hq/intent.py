"""What an old HQ program means, which knows of no lease: when it acquires the robot, and gives it back. Sans-IO.

Such a program says what its stick says, again and again. After it connected, and after a stop, a refusal or an
expiry, nothing moves before it has once said neutral: a stick that was left pushed moves no robot.
Source: the design's "Old HQ programs".
"""

from __future__ import annotations

import math
from enum import Enum

from zbridge.errors import Code, LeaseLost, NeutralFirst

LEASE_S = 3.0
"""Seconds of neutral or silence after which a robot is given back, until a lease says otherwise."""
EARLY_S = 0.3
"""Seconds by which a robot is given back before its lease expires: an expiry would count as a loss."""
TOGETHER_S = 0.1
"""Seconds within which a mode and motion were sent one after the other, by stream and by datagram, in whatever order
they came."""
_MODE_NONE = "control mode is none"


class Action(Enum):
    """What is to be done with what a program said."""

    NOTHING = "nothing"
    ACQUIRE = "acquire"
    WAIT = "wait"
    SEND = "send"
    RELEASE = "release"


class Intent:
    """One program. deadman_s: silence after which its motion has ended. modes: it must say first that it will drive."""

    def __init__(self, deadman_s: float, *, modes: bool = False) -> None:
        self.mode = "none" if modes else "manual"
        self.held = False
        """Whether it holds the robot."""
        self.asking = False
        """Whether it was asked for the robot, and there is no answer yet."""
        self.held_back: str | None = "connected"
        """Why neutral must come before motion; None where it need not."""
        self.lease_s = LEASE_S
        self.deadman_s = deadman_s
        self._moving = False
        self._moved_at = -math.inf
        self._used_at = -math.inf
        self._heard_at = -math.inf
        self._modeless_at = -math.inf

    def __repr__(self) -> str:
        return f"<Intent {self.mode} {'held' if self.held else 'asking' if self.asking else 'idle'} {self.held_back}>"

    @property
    def may_steer(self) -> bool:
        """Whether wheels may be set: the robot is held, and nothing need be said first."""
        return self.held and self.held_back is None

    # What the program says

    def heard(self, now: float) -> None:
        """Take note that anything at all came."""
        self._heard_at = now

    def motion(self, now: float, *, lasts: bool = True) -> Action:
        """Take motion; raise Refused where the program may not move the robot now.

        Motion that ``lasts`` is to be said again within the deadman.
        """
        self.expire(now)
        if self.held_back is not None:
            raise NeutralFirst(f"{self.held_back}: let go of the stick first")
        if self.mode == "none":
            self.held_back, self._modeless_at = _MODE_NONE, now
            raise LeaseLost(_MODE_NONE, Code.NO_LEASE)
        self._used_at = now
        if lasts:
            self._moved_at, self._moving = now, True
        return self._act()

    def neutral(self, now: float, *, whole: bool = True) -> Action:
        """Take neutral; of a part only, where the program still says motion of another: that ends nothing.

        Programs say neutral all the time while nobody touches the stick: it is no stop for a robot that drives itself.
        """
        self.expire(now)
        if self.mode == "autonomous" and whole and self.held_back is None and not self._moving:
            return Action.NOTHING
        if whole:
            self.held_back, self._moving = None, False
        return Action.SEND if self.held else Action.WAIT if self.asking else Action.NOTHING

    def choose(self, mode: str, now: float) -> Action:
        """Take a control mode, which stands; autonomous is motion, none gives the robot back."""
        self.expire(now)
        if mode != "none" and self.held_back == _MODE_NONE and now - self._modeless_at < TOGETHER_S:
            self.held_back = None  # the motion was sent after this, and came first
        if mode == "autonomous" and self.held_back is not None:
            self.mode = mode  # it stands all the same: programs say it once
            raise NeutralFirst(f"{self.held_back}: let go of the stick first")
        if "autonomous" in (mode, self.mode):  # a robot that moved by itself was in use until now
            self._used_at = now
        self.mode = mode
        if mode == "none":
            self._moving = False
            return Action.RELEASE if self.held or self.asking else Action.NOTHING
        if mode == "autonomous":
            return self._act()
        return Action.SEND if self.held else Action.WAIT if self.asking else Action.NOTHING

    def _act(self) -> Action:
        if self.held:
            return Action.SEND
        if self.asking:
            return Action.WAIT
        self.asking = True
        return Action.ACQUIRE

    # What becomes of the lease

    def granted(self, lease_s: float) -> None:
        """Take note that the robot is ours."""
        self.asking, self.held, self.lease_s = False, True, lease_s

    def lost(self, why: str) -> None:
        """Take note that it is not, or not any more."""
        self.asking = self.held = self._moving = False
        self.held_back = why

    def released(self) -> None:
        """Take note that it was given back."""
        self.asking = self.held = self._moving = False

    def refused(self, why: str) -> None:
        """Take note that motion was not carried out, and neutral must come."""
        self.held_back, self._moving = why, False

    # Time

    def expire(self, now: float) -> None:
        """Let motion end that was not said again in time: the robot's gateway has stopped it."""
        if self._moving and now - self._moved_at >= self.deadman_s:
            self.refused("deadman")

    def wants_release(self, now: float) -> bool:
        """Tell whether the robot has not been used for so long that it is to be given back.

        A robot that moves by itself is used as long as anything at all is heard.
        """
        used_at = max(self._used_at, self._heard_at) if self.mode == "autonomous" else self._used_at
        return self.held and now - used_at >= self.lease_s - min(EARLY_S, self.lease_s / 4)
