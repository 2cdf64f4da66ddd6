"""The intent of an old HQ program, which knows no lease: when to acquire the robot for it and when to release. Sans-IO.

Theory of operation. Such a program repeats what its stick says. The machine is :attr:`Intent.TABLE`,
``{state: {input: (action, next state)}}``; ``docs/control.md`` shows the same table, and a test compares both. Six
states: the program is idle, or the lease is being asked for, or held; and in each it may owe neutral. A program owes
neutral after it connected, and after a stop, a refusal or an expiry: before it says neutral once, none of its motion
is carried out, so that a stick that was left pushed moves no robot.

The listener's operator calls :meth:`motion`, :meth:`neutral` and :meth:`choose` for what the program says and must
carry out the :class:`Action` they return. It calls :meth:`granted`, :meth:`lost`, :meth:`released` and :meth:`refused`
for what became of the lease and of motion. Motion that is not repeated within ``deadman_s`` has ended; the robot's
gateway has stopped the robot by then. The control mode stands: it is kept when the lease is not.

After a silence of the program longer than ``deadman_s``, what comes may have waited in the network: an old neutral, and
an old push behind it. So a neutral then counts only once :data:`RESTS_S` pass without motion. Until then it is passed
on, as neutral of a part is, and what is owed stays owed.
Source: the design's "Old HQ programs".
"""

from __future__ import annotations

import math
from enum import Enum, StrEnum
from typing import ClassVar

from zbridge.errors import Code, LeaseLost, NeutralFirst

LEASE_S = 3.0
"""Seconds of neutral or silence after which a robot is released, until a lease says otherwise."""
EARLY_S = 0.3
"""Seconds by which a robot is released before its lease expires: an expiry would count as a loss."""
TOGETHER_S = 0.1
"""A mode and motion sent this close together, by stream and by datagram, may arrive in either order; seconds."""
RESTS_S = 0.3
"""Seconds without motion after which a neutral counts that came after a silence: what waited comes at once."""
_MODE_NONE = "control mode is none"


class Action(Enum):
    """What the caller must do with what a program said. REFUSE is raised as NeutralFirst, not returned."""

    NOTHING = "nothing"
    ACQUIRE = "acquire"
    WAIT = "wait"
    SEND = "send"
    RELEASE = "release"
    REFUSE = "refuse"


class State(StrEnum):
    """What a program has, and whether it owes neutral."""

    IDLE = "idle"
    ASKING = "asking"
    HOLDING = "holding"
    IDLE_OWES = "idle owing neutral"
    ASKING_OWES = "asking owing neutral"
    HOLDING_OWES = "holding owing neutral"


class Input(StrEnum):
    """What a program said, or what became of its lease or motion."""

    MOTION = "motion"
    NEUTRAL = "neutral"
    PART_NEUTRAL = "neutral of a part"
    AUTONOMOUS = "mode autonomous"
    MANUAL = "mode manual"
    NONE = "mode none"
    LATE_MODE = "mode just after motion"
    GRANTED = "granted"
    LOST = "lost"
    RELEASED = "released"
    REFUSED = "refused"
    DEADMAN = "deadman"


Row = dict[Input, tuple[Action, State]]


class Intent:
    """The intent of one program.

    deadman_s: silence after which its motion has ended, seconds.
    """

    def __init__(self, deadman_s: float) -> None:
        self.mode = "manual"
        """The control mode; a protocol whose programs must choose one first begins with ``choose("none")``."""
        self.held_back: str | None = "connected"
        """Why the program owes neutral; None while it does not."""
        self.lease_s = LEASE_S
        self.deadman_s = deadman_s
        self._state = State.IDLE_OWES
        self._moving = False
        self._moved_at = -math.inf
        self._used_at = -math.inf
        self._heard_at = -math.inf
        self._waited = False
        """Whether what comes may have waited in the network: there was a silence, and no neutral counted since."""
        self._rests_at = math.inf
        """When the neutral counts that came last after a silence, unless motion comes before."""
        self._modeless_at = -math.inf

    def __repr__(self) -> str:
        return f"<Intent {self.mode} {'held' if self.held else 'asking' if self.asking else 'idle'} {self.held_back}>"

    @property
    def held(self) -> bool:
        """Whether the lease is held."""
        return self._state in _HOLDING

    @property
    def asking(self) -> bool:
        """Whether the lease was asked for and the answer is awaited."""
        return self._state in _ASKING

    @property
    def may_steer(self) -> bool:
        """Whether wheels may be set: the lease is held and no neutral is owed."""
        return self._state in _HOLDING and self.held_back is None

    # What the program says

    def heard(self, now: float) -> None:
        """Record that the program sent anything at all. To be called before what it says is taken."""
        if -math.inf < self._heard_at < now - self.deadman_s:
            self._waited, self._rests_at = True, math.inf
        self._heard_at = now

    def motion(self, now: float, *, lasts: bool = True) -> Action:
        """Take motion; raise Refused if the program may not move the robot now.

        lasts: whether the program repeats this motion within the deadman.
        """
        self.expire(now)
        self._rests_at = math.inf
        if self.mode == "none" and self.held_back is None:
            self.refused(_MODE_NONE)
            self._modeless_at = now
            raise LeaseLost(_MODE_NONE, Code.NO_LEASE)
        action = self._handle(_MOTION)
        self._used_at = now
        if lasts:
            self._moved_at, self._moving = now, True
        return action

    def neutral(self, now: float, *, whole: bool = True) -> Action:
        """Take neutral. whole=False: of one part while the program still moves another, so that no motion has ended.

        Programs say neutral all the time while nobody touches the stick: it is no stop for a robot that drives itself.
        """
        self.expire(now)
        if not whole:
            return self._handle(Input.PART_NEUTRAL)
        if self.mode == "autonomous" and self.held_back is None and not self._moving:
            return Action.NOTHING
        self._moving = False
        if self._waited:
            self._rests_at = min(self._rests_at, now + RESTS_S)
            return self._handle(Input.PART_NEUTRAL)
        self.held_back = None
        return self._handle(_NEUTRAL)

    def choose(self, mode: str, now: float) -> Action:
        """Take a control mode; ``autonomous`` counts as motion, ``none`` releases the robot."""
        self.expire(now)
        if mode == "autonomous":
            self._rests_at = math.inf
        if mode != "none" and self.held_back == _MODE_NONE and now - self._modeless_at < TOGETHER_S:
            self.held_back = None  # the motion was sent after this, and arrived first
            self._handle(Input.LATE_MODE)
        former, self.mode = self.mode, mode  # it stands even if it is refused: programs say it once
        action = self._handle(_CHOSEN[mode])
        if "autonomous" in (mode, former):  # a robot that moved by itself was in use until now
            self._used_at = now
        self._moving = self._moving and mode != "none"
        return action

    # What becomes of the lease and of motion

    def granted(self, lease_s: float) -> None:
        """Record that the lease was granted. lease_s: its length, seconds."""
        self.lease_s = lease_s
        self._handle(Input.GRANTED)

    def lost(self, why: str) -> None:
        """Record that the lease was refused or has ended; the program owes neutral."""
        self._hold_back(why)
        self._handle(Input.LOST)

    def released(self) -> None:
        """Record that the robot was given back."""
        self._moving = False
        self._handle(Input.RELEASED)

    def refused(self, why: str) -> None:
        """Record that motion was not carried out; the program owes neutral."""
        self._hold_back(why)
        self._handle(Input.REFUSED)

    def restore(self, mode: str, why: str) -> None:
        """Go on, owing neutral, with the mode that the program chose in another process."""
        self.mode, self.held_back = mode, why

    # Time

    def expire(self, now: float) -> None:
        """End motion that was not repeated in time: the robot's gateway has stopped it.

        Let a neutral count that came after a silence and was not followed by motion.
        """
        if now >= self._rests_at:
            self._waited, self._rests_at = False, math.inf
            self.held_back = None
            self._handle(_NEUTRAL)
        if self._moving and now - self._moved_at >= self.deadman_s:
            self._hold_back("deadman")
            self._handle(Input.DEADMAN)

    def wants_release(self, now: float) -> bool:
        """Return whether the robot has been unused for so long that it must be released.

        A robot that moves by itself is in use as long as the program sends anything at all.
        """
        used_at = max(self._used_at, self._heard_at) if self.mode == "autonomous" else self._used_at
        return self.held and now - used_at >= self.lease_s - min(EARLY_S, self.lease_s / 4)

    def _hold_back(self, why: str) -> None:
        """Demand a neutral that is said from now on."""
        self.held_back, self._moving, self._rests_at = why, False, math.inf

    def _handle(self, said: Input) -> Action:
        """Carry out the table; raise NeutralFirst if its action is to refuse. A missing pair changes nothing."""
        entry = self.TABLE[self._state].get(said)
        if entry is None:
            return _NOTHING
        action, self._state = entry
        if action is _REFUSE:
            raise NeutralFirst(f"{self.held_back}: release the stick first")
        return action

    TABLE: ClassVar[dict[State, Row]] = {
        State.IDLE: {
            Input.MOTION: (Action.ACQUIRE, State.ASKING),
            Input.AUTONOMOUS: (Action.ACQUIRE, State.ASKING),
            Input.LOST: (Action.NOTHING, State.IDLE_OWES),
            Input.REFUSED: (Action.NOTHING, State.IDLE_OWES),
            Input.DEADMAN: (Action.NOTHING, State.IDLE_OWES),
        },
        State.ASKING: {
            Input.MOTION: (Action.WAIT, State.ASKING),
            Input.NEUTRAL: (Action.WAIT, State.ASKING),
            Input.PART_NEUTRAL: (Action.WAIT, State.ASKING),
            Input.AUTONOMOUS: (Action.WAIT, State.ASKING),
            Input.MANUAL: (Action.WAIT, State.ASKING),
            Input.NONE: (Action.RELEASE, State.ASKING),
            Input.GRANTED: (Action.NOTHING, State.HOLDING),
            Input.LOST: (Action.NOTHING, State.IDLE_OWES),
            Input.RELEASED: (Action.NOTHING, State.IDLE),
            Input.REFUSED: (Action.NOTHING, State.ASKING_OWES),
            Input.DEADMAN: (Action.NOTHING, State.ASKING_OWES),
        },
        State.HOLDING: {
            Input.MOTION: (Action.SEND, State.HOLDING),
            Input.NEUTRAL: (Action.SEND, State.HOLDING),
            Input.PART_NEUTRAL: (Action.SEND, State.HOLDING),
            Input.AUTONOMOUS: (Action.SEND, State.HOLDING),
            Input.MANUAL: (Action.SEND, State.HOLDING),
            Input.NONE: (Action.RELEASE, State.HOLDING),
            Input.LOST: (Action.NOTHING, State.IDLE_OWES),
            Input.RELEASED: (Action.NOTHING, State.IDLE),
            Input.REFUSED: (Action.NOTHING, State.HOLDING_OWES),
            Input.DEADMAN: (Action.NOTHING, State.HOLDING_OWES),
        },
        State.IDLE_OWES: {
            Input.MOTION: (Action.REFUSE, State.IDLE_OWES),
            Input.NEUTRAL: (Action.NOTHING, State.IDLE),
            Input.AUTONOMOUS: (Action.REFUSE, State.IDLE_OWES),
            Input.LATE_MODE: (Action.NOTHING, State.IDLE),
        },
        State.ASKING_OWES: {
            Input.MOTION: (Action.REFUSE, State.ASKING_OWES),
            Input.NEUTRAL: (Action.WAIT, State.ASKING),
            Input.PART_NEUTRAL: (Action.WAIT, State.ASKING_OWES),
            Input.AUTONOMOUS: (Action.REFUSE, State.ASKING_OWES),
            Input.MANUAL: (Action.WAIT, State.ASKING_OWES),
            Input.NONE: (Action.RELEASE, State.ASKING_OWES),
            Input.LATE_MODE: (Action.NOTHING, State.ASKING),
            Input.GRANTED: (Action.NOTHING, State.HOLDING_OWES),
            Input.LOST: (Action.NOTHING, State.IDLE_OWES),
            Input.RELEASED: (Action.NOTHING, State.IDLE_OWES),
        },
        State.HOLDING_OWES: {
            Input.MOTION: (Action.REFUSE, State.HOLDING_OWES),
            Input.NEUTRAL: (Action.SEND, State.HOLDING),
            Input.PART_NEUTRAL: (Action.SEND, State.HOLDING_OWES),
            Input.AUTONOMOUS: (Action.REFUSE, State.HOLDING_OWES),
            Input.MANUAL: (Action.SEND, State.HOLDING_OWES),
            Input.NONE: (Action.RELEASE, State.HOLDING_OWES),
            Input.LATE_MODE: (Action.NOTHING, State.HOLDING),
            Input.LOST: (Action.NOTHING, State.IDLE_OWES),
            Input.RELEASED: (Action.NOTHING, State.IDLE_OWES),
        },
    }


_HOLDING = frozenset({State.HOLDING, State.HOLDING_OWES})
_ASKING = frozenset({State.ASKING, State.ASKING_OWES})
# Looking up a member of an enum costs more than the rest of a command:
_MOTION, _NEUTRAL = Input.MOTION, Input.NEUTRAL
_NOTHING, _REFUSE = Action.NOTHING, Action.REFUSE
_CHOSEN = {"none": Input.NONE, "manual": Input.MANUAL, "autonomous": Input.AUTONOMOUS}
