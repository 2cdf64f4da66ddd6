"""Whose mode a rover is in: ours, or that of its RC pilot, its mission, or another ground station. Sans-IO.

Source: "The gateway as HQ" of the protocol page. Theory of operation. The rover shows its mode in each HEARTBEAT, and a
new one at once. What is shown without having been asked for was set by somebody else, and is left to them:

    OTHERS     somebody else's mode, or not known whose; the first motion asks for ours
    ASKED      our driving mode was asked for: motion is sent behind the request, for :data:`ASK_S` at most
    DRIVING    our driving mode is shown, and the rover is armed
    STOPPING   HOLD was asked for
    HELD       the HOLD that we asked for is shown
    LOST       somebody took the rover while we drove it, or refused it: no motion until a neutral came

ASKED, DRIVING, STOPPING and HELD are *ours*: stops that nobody ordered act there only.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Any, ClassVar

from gateways.mavlink.numbers import RoverMode
from gateways.mavlink.rover.advice import NOT_HELD
from zbridge.protocol import Kept, NotReady

ASK_S = 2.0
"""Seconds within which the rover must show the mode that it was asked for: four requests."""
STOP_S = 1.0
"""Seconds for which HOLD is asked for."""


class HelmState(Enum):
    """See above."""

    OTHERS = "others"
    ASKED = "asked"
    DRIVING = "driving"
    STOPPING = "stopping"
    HELD = "held"
    LOST = "lost"


class Helm(Kept):
    """The mode of one rover. driving: our driving mode. arms: the first motion arms it."""

    kept: ClassVar[dict[str, Any]] = {
        "state": HelmState,
        "mode": int | None,
        "armed": bool,
        "warning": str | None,
        "_why": str,
        "_said": str,
        "_since": float,
        "_shown_at": float,
        "_acknowledged": bool,
        "_judged": bool,
        "_yields": bool,
    }

    def __init__(self, driving: RoverMode, *, arms: bool) -> None:
        self.driving, self.arms = driving, arms
        self.state = HelmState.OTHERS
        self.mode: int | None = None
        """As the rover showed it last."""
        self.armed = False
        self.warning: str | None = None
        """A stop that the rover did not confirm."""
        self._why = self._said = ""
        self._since = self._shown_at = -math.inf
        self._acknowledged = self._judged = self._yields = False

    def __repr__(self) -> str:
        return f"<Helm {self.state.value}, mode {self.mode_name}, {'armed' if self.armed else 'disarmed'}>"

    @property
    def ours(self) -> bool:
        """Whether the rover is in a mode that we set, or will be."""
        return self.state not in (HelmState.OTHERS, HelmState.LOST)

    @property
    def mode_name(self) -> str:
        """The mode that is shown, for people."""
        return name_of_mode(self.mode)

    @property
    def due(self) -> float:
        """When :meth:`expire` is next due; ``inf``: never."""
        if self.state is HelmState.ASKED:
            return self._since + ASK_S
        return self._since + STOP_S if self.state is HelmState.STOPPING and not self._judged else math.inf

    # What we do

    def engage(self, now: float) -> bool:
        """Allow motion; return whether the mode must be asked for. Raise NotReady."""
        if self.state is HelmState.LOST:
            raise NotReady(f"{self._why}: {self._said}" if self._said else self._why)
        if self.state in (HelmState.ASKED, HelmState.DRIVING):
            return False
        if not self.armed and not self.arms:
            raise NotReady("disarmed")
        self.state, self._since, self._said = HelmState.ASKED, now, ""
        return True

    def release(self) -> bool:
        """Note a neutral; return whether it is sent: a rover in somebody else's mode gets none."""
        if self.state is HelmState.LOST:
            self.state = HelmState.OTHERS
        return self.state in (HelmState.ASKED, HelmState.DRIVING)

    def stop(self, now: float, *, ordered: bool) -> None:
        """Note that HOLD is asked for. ordered: by a person, so also against a pilot who takes the rover meanwhile."""
        self.state, self._since = HelmState.STOPPING, now
        self._acknowledged = self._judged = False
        self._yields = not ordered and self.mode == self.driving

    # What the rover says

    def show(self, mode: int, *, armed: bool, now: float) -> None:
        """Note what a HEARTBEAT shows."""
        self.mode, self.armed, self._shown_at = mode, armed, now
        state = self.state
        if state is HelmState.ASKED and mode == self.driving and armed:
            self.state, self.warning = HelmState.DRIVING, None
        elif state is HelmState.DRIVING and (mode != self.driving or not armed):
            self._lose(f"mode {self.mode_name}" if mode != self.driving else "disarmed")
        elif state is HelmState.HELD and mode != RoverMode.HOLD:
            self.state = HelmState.OTHERS
        elif state is HelmState.STOPPING and self._acknowledged and mode == RoverMode.HOLD:
            self.state, self.warning = HelmState.HELD, None
        elif state is HelmState.STOPPING and self._yields and mode not in (self.driving, RoverMode.HOLD):
            self.state = HelmState.OTHERS
        elif state is HelmState.STOPPING and now >= self._since + STOP_S:
            self._judge()

    def answer(self, what: str, *, accepted: bool) -> None:
        """Note the answer to a request for a mode, or to arm (``what``, for people).

        A HEARTBEAT that shows HOLD confirms a stop only behind an answer: one before it may be older than our request.
        """
        if self.state is HelmState.ASKED and not accepted:
            self._lose(f"{what} refused")
        elif self.state is HelmState.STOPPING:
            self._acknowledged = self._acknowledged or accepted

    def say(self, text: str) -> None:
        """Note a warning of the rover: it may be why it refuses."""
        if self.state in (HelmState.ASKED, HelmState.LOST):
            self._said = text

    def expire(self, now: float) -> None:
        """Judge requests that were not carried out in time."""
        if now < self.due:
            return
        if self.state is HelmState.ASKED:
            self._lose(f"mode {self.mode_name}" if self.mode != self.driving else "disarmed")
        else:
            self._judged = True
            if self._shown_at > self._since:  # else the next HEARTBEAT tells
                self._judge()

    def _judge(self) -> None:
        self._judged = True
        if self.mode == RoverMode.HOLD:
            self.state, self.warning = HelmState.HELD, None
            return
        self.warning = f"{NOT_HELD}: mode {self.mode_name}"
        if self.mode != self.driving:
            self.state = HelmState.OTHERS

    def _lose(self, why: str) -> None:
        self.state, self._why = HelmState.LOST, why


def name_of_mode(mode: int | None) -> str:
    """Return the name of a mode of ArduRover, or its number."""
    if mode is None:
        return "unknown"
    return RoverMode(mode).name if mode in set(RoverMode) else str(mode)
