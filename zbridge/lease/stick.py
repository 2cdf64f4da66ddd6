"""A stick: turns its positions into lease, neutral, drives and stops. Sans-IO.

Theory of operation. Somebody repeats what the stick of an HQ program, a ROS publisher, a Foxglove viewer or a keyboard
says. The machine is :attr:`Stick.TABLE`, ``{state: {input: (action, next state)}}``; ``state-tables.md`` shows the
same table, and a test compares both. Six states: idle, or the lease is being asked for, or held; and each of these may
need neutral. A stick that needs neutral moves nothing before it was centred once: a stick that was left deflected must
not start a robot that was stopped or lost.

The caller tells :meth:`Stick.heard`, then :meth:`Stick.motion` or :meth:`Stick.neutral`, and must carry out the
:class:`StickAction` they return. It calls :meth:`Stick.granted`, :meth:`Stick.lost`, :meth:`Stick.released` and
:meth:`Stick.refused` for what became of the lease and of motion; and, at :meth:`Stick.deadline` or earlier,
:meth:`Stick.expire` and :meth:`Stick.wants_release`.

Guarantees. ACQUIRE is returned at most once before the lease is granted, lost or released. SEND is returned only while
the lease is held. Motion is sent, or waits, only if no neutral is needed.

:class:`StickRules` has what differs between sticks on purpose. Two drivers carry the actions out: the listener's
operator (:mod:`zbridge.hq.operator`), and :class:`zbridge.client.pilot.Pilot` for all other sticks.
"""

from __future__ import annotations

import math
from enum import Enum, StrEnum
from typing import ClassVar, TypeAlias

import msgspec

from zbridge.errors import NeutralFirst


class StickAction(Enum):
    """What the caller must do. REFUSE is raised as NeutralFirst, not returned."""

    NOTHING = "nothing"
    ACQUIRE = "acquire"
    WAIT = "wait"
    SEND = "send"
    RELEASE = "release"
    REFUSE = "refuse"


class StickState(StrEnum):
    """What the stick's user has, and whether neutral is needed."""

    IDLE = "idle"
    ASKING = "asking"
    HOLDING = "holding"
    IDLE_NEEDS_NEUTRAL = "idle needing neutral"
    ASKING_NEEDS_NEUTRAL = "asking needing neutral"
    HOLDING_NEEDS_NEUTRAL = "holding needing neutral"


class StickInput(StrEnum):
    """What the stick says, or what became of its lease or motion."""

    MOTION = "motion"
    NEUTRAL = "neutral"
    HARMLESS = "harmless"
    WANT = "want"
    DROP = "drop"
    GRANTED = "granted"
    LOST = "lost"
    RELEASED = "released"
    NEUTRAL_REQUIRED = "neutral required"
    CLEARED = "cleared"


StickRow: TypeAlias = dict[StickInput, tuple[StickAction, StickState | None]]


class StickRules(msgspec.Struct, frozen=True):
    """What differs between sticks. Times in seconds; infinite: never.

    deadman_s: motion that is not repeated for so long has ended, and neutral is needed. keeps: whether the lease
    outlasts that, and a refusal. idle_s: without motion for so long the lease is released. neutral_counts: whether
    neutral puts that off, too. quiet_s: silence that is as good as neutral. lapsed: why neutral is needed after the
    deadman. advice: what a refusal tells the user after the reason.
    """

    deadman_s: float = math.inf
    keeps: bool = True
    idle_s: float = math.inf
    neutral_counts: bool = False
    quiet_s: float = math.inf
    lapsed: str = "deadman"
    advice: str = ": centre the joystick first"


class Stick:
    """The stick of one user for one robot. needs_neutral: why neutral is needed from the beginning; None: it is not."""

    def __init__(self, rules: StickRules, needs_neutral: str | None = None) -> None:
        self.rules = rules
        self.needs_neutral = needs_neutral
        """Why neutral is needed; None while it is not."""
        self.deadman_s = rules.deadman_s
        self.idle_s = rules.idle_s
        self.in_use = False
        """Whether the lease is kept however long the stick rests."""
        self.heard_at = -math.inf
        self._state = StickState.IDLE if needs_neutral is None else StickState.IDLE_NEEDS_NEUTRAL
        self._moving = False
        self._moved_at = -math.inf
        self._used_at = -math.inf

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._state}{f', {self.needs_neutral}' if self.needs_neutral else ''}>"

    @property
    def held(self) -> bool:
        """Whether the lease is held."""
        return self._state in _HOLDING

    @property
    def active(self) -> bool:
        """Whether the lease is held or asked for."""
        return self._state not in _IDLE

    # What the stick says

    def heard(self, now: float) -> None:
        """Record that the user sent anything at all. To be called before what it says is taken."""
        if self.rules.quiet_s < math.inf and now - self.heard_at >= self.rules.quiet_s:
            self.clear()
        self.heard_at = now

    def motion(self, now: float, *, lasts: bool = True) -> StickAction:
        """Take motion; raise NeutralFirst if neutral is needed. lasts: whether the user repeats this motion."""
        self.expire(now)
        return self._on_motion(now, lasts)

    def neutral(self, now: float) -> StickAction:
        """Take zero motion: nothing moves any more, and no neutral is needed."""
        self.expire(now)
        return self._on_neutral(now)

    def want(self, now: float) -> StickAction:
        """Get the lease without motion."""
        self._used_at = now
        return self._handle(StickInput.WANT)

    # What becomes of the lease and of motion

    def granted(self) -> None:
        """Record that the lease was granted."""
        self._handle(StickInput.GRANTED)

    def lost(self, why: str) -> None:
        """Record that the lease was refused or has ended; neutral is needed."""
        self._require_neutral(why)
        self._handle(StickInput.LOST)

    def released(self) -> None:
        """Record that the lease was released."""
        self._moving = False
        self._handle(StickInput.RELEASED)

    def refused(self, why: str) -> None:
        """Record that motion was not, or must not be, carried out; neutral is needed."""
        self._require_neutral(why)
        self._handle(StickInput.NEUTRAL_REQUIRED)

    def clear(self) -> None:
        """Record that neutral is not needed any more, though it was not said."""
        self.needs_neutral = None
        self._handle(StickInput.CLEARED)

    # Time

    def deadline(self) -> float:
        """Return when :meth:`expire` or :meth:`wants_release` is next due; infinite: not before something happens."""
        lapses_at = self._moved_at + self.deadman_s if self._moving else math.inf
        return min(lapses_at, self._last_used() + self.idle_s) if self.held and not self.in_use else lapses_at

    def expire(self, now: float) -> bool:
        """End motion that was not repeated in time. Return whether the lease must be released therefore."""
        if self._moving and now >= self._moved_at + self.deadman_s:
            self.refused(self.rules.lapsed)
            return self.active and not self.rules.keeps
        return False

    def wants_release(self, now: float) -> bool:
        """Return whether the lease is held, but was unused for so long that it must be released."""
        return self.held and not self.in_use and now >= self._last_used() + self.idle_s

    # The machine

    def _on_motion(self, now: float, lasts: bool) -> StickAction:
        action = self._handle(_MOTION)
        self._used_at = now
        if lasts:
            self._moved_at, self._moving = now, True
        return action

    def _on_neutral(self, now: float) -> StickAction:
        self._moving, self.needs_neutral = False, None
        if self.rules.neutral_counts:
            self._used_at = now
        return self._handle(_NEUTRAL)

    def _last_used(self) -> float:
        return self._used_at

    def _require_neutral(self, why: str) -> None:
        """Demand a neutral that is said from now on."""
        self.needs_neutral, self._moving = why, False

    def _handle(self, said: StickInput) -> StickAction:
        """Carry out the table; raise NeutralFirst if its action is to refuse. A missing pair changes nothing."""
        entry = self.TABLE[self._state].get(said)
        if entry is None:
            return _NOTHING
        action, after = entry
        if action is _REFUSE:
            raise NeutralFirst(f"{self.needs_neutral}{self.rules.advice}")
        if after is not None:
            self._state = after
        return action

    _WHILE_ASKING: ClassVar[StickRow] = {
        StickInput.NEUTRAL: (StickAction.WAIT, StickState.ASKING),
        StickInput.HARMLESS: (StickAction.WAIT, None),
        StickInput.DROP: (StickAction.RELEASE, None),
        StickInput.LOST: (StickAction.NOTHING, StickState.IDLE_NEEDS_NEUTRAL),
    }
    _WHILE_HOLDING: ClassVar[StickRow] = {
        StickInput.NEUTRAL: (StickAction.SEND, StickState.HOLDING),
        StickInput.HARMLESS: (StickAction.SEND, None),
        StickInput.DROP: (StickAction.RELEASE, None),
        StickInput.LOST: (StickAction.NOTHING, StickState.IDLE_NEEDS_NEUTRAL),
    }
    TABLE: ClassVar[dict[StickState, StickRow]] = {
        StickState.IDLE: {
            StickInput.MOTION: (StickAction.ACQUIRE, StickState.ASKING),
            StickInput.WANT: (StickAction.ACQUIRE, StickState.ASKING),
            StickInput.LOST: (StickAction.NOTHING, StickState.IDLE_NEEDS_NEUTRAL),
            StickInput.NEUTRAL_REQUIRED: (StickAction.NOTHING, StickState.IDLE_NEEDS_NEUTRAL),
        },
        StickState.ASKING: _WHILE_ASKING
        | {
            StickInput.MOTION: (StickAction.WAIT, None),
            StickInput.GRANTED: (StickAction.NOTHING, StickState.HOLDING),
            StickInput.RELEASED: (StickAction.NOTHING, StickState.IDLE),
            StickInput.NEUTRAL_REQUIRED: (StickAction.NOTHING, StickState.ASKING_NEEDS_NEUTRAL),
        },
        StickState.HOLDING: _WHILE_HOLDING
        | {
            StickInput.MOTION: (StickAction.SEND, None),
            StickInput.RELEASED: (StickAction.NOTHING, StickState.IDLE),
            StickInput.NEUTRAL_REQUIRED: (StickAction.NOTHING, StickState.HOLDING_NEEDS_NEUTRAL),
        },
        StickState.IDLE_NEEDS_NEUTRAL: {
            StickInput.MOTION: (StickAction.REFUSE, None),
            StickInput.NEUTRAL: (StickAction.NOTHING, StickState.IDLE),
            StickInput.WANT: (StickAction.ACQUIRE, StickState.ASKING_NEEDS_NEUTRAL),
            StickInput.CLEARED: (StickAction.NOTHING, StickState.IDLE),
        },
        StickState.ASKING_NEEDS_NEUTRAL: _WHILE_ASKING
        | {
            StickInput.MOTION: (StickAction.REFUSE, None),
            StickInput.GRANTED: (StickAction.NOTHING, StickState.HOLDING_NEEDS_NEUTRAL),
            StickInput.RELEASED: (StickAction.NOTHING, StickState.IDLE_NEEDS_NEUTRAL),
            StickInput.CLEARED: (StickAction.NOTHING, StickState.ASKING),
        },
        StickState.HOLDING_NEEDS_NEUTRAL: _WHILE_HOLDING
        | {
            StickInput.MOTION: (StickAction.REFUSE, None),
            StickInput.RELEASED: (StickAction.NOTHING, StickState.IDLE_NEEDS_NEUTRAL),
            StickInput.CLEARED: (StickAction.NOTHING, StickState.HOLDING),
        },
    }


_IDLE = frozenset({StickState.IDLE, StickState.IDLE_NEEDS_NEUTRAL})
_HOLDING = frozenset({StickState.HOLDING, StickState.HOLDING_NEEDS_NEUTRAL})
# Looking up a member of an enum costs more than the rest of a command:
_MOTION, _NEUTRAL = StickInput.MOTION, StickInput.NEUTRAL
_NOTHING, _REFUSE = StickAction.NOTHING, StickAction.REFUSE
