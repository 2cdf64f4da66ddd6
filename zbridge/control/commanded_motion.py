"""What one robot was commanded to do, until when, and whether neutral must come before motion. Sans-IO."""

from __future__ import annotations

import math

from zbridge.control.events import AuthorityInput as Input
from zbridge.errors import NeutralFirst


class CommandedMotion:
    """The motion of one robot. deadman_s: seconds after which motion ends that is not repeated; of the holder."""

    def __init__(self, deadman_s: float) -> None:
        self.deadman_s = deadman_s
        self.stop_at = math.inf
        """When the deadman ends motion that is not repeated."""
        self.parts: set[str] = set()
        """The parts of the robot whose last command was motion."""
        self.autonomous = False
        """Whether the mode is autonomous; a stop and neutral end it."""
        self.on_its_own = False
        """Whether the robot may have moved by itself since its last stop: without a deadman, but every stop ends it."""
        self.needs_neutral: str | None = None
        """Why neutral must come before motion; None: it need not."""
        self.moved: set[str] = set()
        """The parts that moved when neutral was required, and whose neutral has not come yet."""

    def __repr__(self) -> str:
        return f"<CommandedMotion {sorted(self.parts)}, needs neutral: {self.needs_neutral}>"

    @property
    def moving(self) -> bool:
        """Whether the robot was sent motion, or ordered to move by itself, and has not been stopped since."""
        return bool(self.parts) or self.on_its_own

    @property
    def driven(self) -> bool:
        """Whether a program drives the robot or set its mode to autonomous; if not, the robot must be stopped."""
        return bool(self.parts) or self.autonomous

    def check_motion(self) -> None:
        """Raise Refused if the holder must send neutral before the robot moves."""
        if self.needs_neutral is not None:
            raise NeutralFirst(f"{self.needs_neutral}: send a neutral drive first")

    def applied(self, part: str, given_at: float, *, moving: bool, stale: bool, whole: bool) -> Input | None:
        """Record a command that was carried out; return the input that follows from it, see :meth:`Authority.applied`.

        None: the state of the authority stays.
        """
        parts = self.parts
        if moving and part in parts:  # repeated motion is no input: it only postpones the deadman
            self.stop_at = given_at + self.deadman_s
            return None
        if not moving and not parts and self.needs_neutral is None:  # nor is repeated neutral
            self.autonomous = False
            return None
        if not moving and not stale and self.moved:
            self.moved = set() if whole else self.moved - {part}
            if self.moved:  # a part that moved had no neutral yet: its stick may still be deflected
                return None
        (parts.add if moving else parts.discard)(part)
        if moving:
            return _MOTION
        if parts:  # motion of another part continues, and so does its deadman
            return None
        return _STALE_NEUTRAL if stale else _NEUTRAL

    def mode_chosen(self, *, autonomous: bool) -> None:
        """Record that the robot was sent the holder's choice of its mode."""
        self.autonomous = autonomous
        self.on_its_own = self.on_its_own or autonomous

    def sent_opaque(self) -> None:
        """Record that the robot was sent a raw message of the holder's: the robot may move because of it."""
        self.on_its_own = True

    def start(self, given_at: float) -> None:
        """Start the deadman."""
        self.stop_at = given_at + self.deadman_s

    def rest(self) -> None:
        """Stop the deadman; neutral also takes the robot out of its mode."""
        self.autonomous = False
        self.stop_at = math.inf

    def require_neutral(self, reason: str) -> None:
        """Record that the robot is stopped, and require neutral before motion."""
        self.moved |= self.parts
        self._still()
        self.needs_neutral = reason

    def end(self) -> None:
        """Record that the robot is stopped, and that nobody drives it."""
        self._still()
        self.allow()

    def allow(self) -> None:
        """Require no neutral before motion."""
        self.needs_neutral = None
        self.moved.clear()

    def _still(self) -> None:
        self.parts.clear()
        self.on_its_own = self.autonomous = False
        self.stop_at = math.inf


_MOTION, _NEUTRAL, _STALE_NEUTRAL = Input.MOTION, Input.NEUTRAL, Input.STALE_NEUTRAL
"""Looking up a member of an enum costs more than a command may."""
