"""The intent of an old HQ program, which knows no lease: its stick, its control mode, and what may be old. Sans-IO.

Theory of operation. Such a program repeats what its stick says: :class:`zbridge.lease.stick.Stick` decides when to
acquire the robot for it, what may be sent, and when to release. A new program needs neutral. The lease outlasts the
deadman, for only neutral is missing then. The intent adds three things:

The control mode. Mode autonomous counts as motion, mode none releases the robot, and the mode stands: it is kept when
the lease is not.

Neutral of a part, while the program still moves another: it is passed on, and ends nothing.

What may have waited in the network. After a silence of the program longer than its deadman, an old neutral may come,
and an old push behind it. So a neutral then counts only once :data:`RESTS_S` pass without motion. Until then it is
passed on, as neutral of a part is, and neutral is still needed.
Source: "The stick of an HQ program" in ``state-tables.md``.
"""

from __future__ import annotations

import math

from zbridge.errors import Code, LeaseLost
from zbridge.lease.stick import Stick, StickAction, StickInput, StickRules

LEASE_S = 3.0
"""Seconds of neutral or silence after which a robot is released, until a lease says otherwise."""
EARLY_S = 0.3
"""Seconds by which a robot is released before its lease expires: an expiry would count as a loss."""
TOGETHER_S = 0.1
"""A mode and motion sent this close together, by stream and by datagram, may arrive in either order; seconds."""
RESTS_S = 0.3
"""Seconds without motion after which a neutral counts that came after a silence: what waited comes at once."""
_MODE_NONE = "control mode is none"


class Intent(Stick):
    """The intent of one program.

    deadman_s: silence after which its motion has ended, seconds.
    """

    def __init__(self, deadman_s: float) -> None:
        super().__init__(StickRules(deadman_s=deadman_s, idle_s=LEASE_S - EARLY_S), "connected")
        self.mode = "manual"
        """The control mode; a protocol whose programs must choose one first begins with ``choose("none")``."""
        self._waited = False
        """Whether what comes may have waited in the network: there was a silence, and no neutral counted since."""
        self._rests_at = math.inf
        """When the neutral counts that came last after a silence, unless motion comes before."""
        self._modeless_at = -math.inf

    @property
    def may_steer(self) -> bool:
        """Whether wheels may be set: the lease is held and no neutral is needed."""
        return self.held and self.needs_neutral is None

    # What the program says

    def heard(self, now: float) -> None:
        """Record that the program sent anything at all. To be called before what it says is taken."""
        if -math.inf < self.heard_at < now - self.deadman_s:
            self._waited, self._rests_at = True, math.inf
        self.heard_at = now

    def motion(self, now: float, *, lasts: bool = True) -> StickAction:
        """Take motion; raise Refused if the program may not move the robot now.

        lasts: whether the program repeats this motion within the deadman.
        """
        self.expire(now)
        self._rests_at = math.inf
        if self.mode == "none" and self.needs_neutral is None:
            self.refused(_MODE_NONE)
            self._modeless_at = now
            raise LeaseLost(_MODE_NONE, Code.NO_LEASE)
        return self._on_motion(now, lasts)

    def neutral(self, now: float, *, whole: bool = True) -> StickAction:
        """Take neutral. whole=False: of one part while the program still moves another, so that no motion has ended.

        Programs say neutral all the time while nobody touches the stick: it is no stop for a robot that drives itself.
        """
        self.expire(now)
        if not whole:
            return self._handle(StickInput.HARMLESS)
        if self.mode == "autonomous" and self.needs_neutral is None and not self._moving:
            return StickAction.NOTHING
        if self._waited:
            self._moving = False
            self._rests_at = min(self._rests_at, now + RESTS_S)
            return self._handle(StickInput.HARMLESS)
        return self._on_neutral(now)

    def choose(self, mode: str, now: float) -> StickAction:
        """Take a control mode; ``autonomous`` counts as motion, ``none`` releases the robot."""
        self.expire(now)
        if mode == "autonomous":
            self._rests_at = math.inf
        if mode != "none" and self.needs_neutral == _MODE_NONE and now - self._modeless_at < TOGETHER_S:
            self.clear()  # the motion was sent after this, and arrived first
        former, self.mode = self.mode, mode  # it stands even if it is refused: programs say it once
        action = self._handle(_CHOSEN[mode])
        if "autonomous" in (mode, former):  # a robot that moved by itself was in use until now
            self._used_at = now
        self._moving = self._moving and mode != "none"
        return action

    # What becomes of the lease

    def granted(self, lease_s: float | None = None) -> None:
        """Record that the lease was granted. lease_s: its length, seconds; None: as long as the one before."""
        if lease_s:
            self.idle_s = lease_s - min(EARLY_S, lease_s / 4)
        super().granted()

    def restore(self, mode: str, why: str, heard_at: float) -> None:
        """Continue, needing neutral, with the mode that the program chose in another process.

        heard_at: when that process last received from the program. What came later waited in the kernel.
        """
        self.mode, self.needs_neutral, self.heard_at = mode, why, heard_at

    # Time

    def expire(self, now: float) -> bool:
        """End motion that was not repeated in time: the robot's gateway has stopped it.

        Let a neutral count that came after a silence and was not followed by motion.
        """
        if now >= self._rests_at:
            self._waited, self._rests_at = False, math.inf
            self.clear()
        return super().expire(now)

    def _last_used(self) -> float:
        """Return when the robot was last used: one that moves by itself is in use while anything is heard."""
        return max(self._used_at, self.heard_at) if self.mode == "autonomous" else self._used_at

    def _require_neutral(self, why: str) -> None:
        """Demand a neutral that is said from now on."""
        super()._require_neutral(why)
        self._rests_at = math.inf


_CHOSEN = {"none": StickInput.DROP, "manual": StickInput.HARMLESS, "autonomous": StickInput.MOTION}
