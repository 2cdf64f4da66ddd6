"""Whose mode a rover is in: ours, or that of its RC pilot, its mission, or another ground station. Sans-IO.

Source: "The gateway as HQ" of the protocol page. Theory of operation. The rover shows its mode in each HEARTBEAT, and a
new one at once. The machine is :data:`TABLE`; :meth:`Helm._meaning` says what a HEARTBEAT means in each state:

    OTHERS     somebody else's mode, or not known whose; the first motion asks for ours
    ASKED      our driving mode was asked for, for :data:`ASK_S` at most
    DRIVING    our driving mode is shown, and the rover is armed
    STOPPING   HOLD was asked for
    HELD       the HOLD that we asked for is shown

In ASKED, DRIVING and STOPPING the rover may move by our order: stops that nobody ordered act there, and there only.
Whatever ends ASKED or DRIVING against the driver refuses motion until a neutral came. It leads to a stop, unless the
rover shows a mode that somebody else set.

HEARTBEATs and requests are late, and may be lost. So what is shown within :data:`FLIGHT_S` of a request that followed
another one at once may be older, and our driving mode that is shown some time after we asked is ours (``_ours_until``).
"""

from __future__ import annotations

import math
from enum import Enum, StrEnum
from typing import Any, ClassVar, TypeAlias

from gateways.mavlink.numbers import RoverMode
from gateways.mavlink.rover.advice import NOT_HELD
from zbridge.protocol import Kept, NotReady

ASK_S = 2.0
"""Seconds within which the rover must do what it was asked for (four requests), and then show it."""
STOP_S = 1.0
"""Seconds for which HOLD is asked for."""
FLIGHT_S = 1.0
"""Seconds from a request to the first HEARTBEAT that surely is not older."""
OURS_S = {RoverMode.GUIDED: 5.0, RoverMode.MANUAL: 2.0}
"""Seconds for which our driving mode, if shown, is still that of our request; MANUAL is also the mode of RC pilots."""


class HelmState(StrEnum):
    """See above."""

    OTHERS = "others"
    ASKED = "asked"
    DRIVING = "driving"
    STOPPING = "stopping"
    HELD = "held"


class HelmInput(Enum):
    """What the driver wants, or the rover shows.

    ASTRAY: nobody drives it, and its mode is ours, or may become so. TAKEN: its mode is, or remains, somebody else's.
    """

    MOTION = "motion"
    NEUTRAL = "neutral"
    REST = "rest"
    STOP = "stop"
    DRIVEN = "driven"
    HOLDING = "holding"
    ASTRAY = "astray"
    TAKEN = "taken"


class HelmAction(Enum):
    """What the session must do.

    ASK: for our mode, then SEND. SEND: motion. STOP: neutral and HOLD. LEAVE: send nothing more, and give sticks back.
    ABANDON: the same, but neutral where only our mode obeys it.
    """

    NOTHING = "nothing"
    ASK = "ask"
    SEND = "send"
    STOP = "stop"
    LEAVE = "leave"
    ABANDON = "abandon"


HelmRow: TypeAlias = dict[HelmInput, tuple[HelmAction, HelmState]]
_STOPS = HelmAction.STOP, HelmState.STOPPING
_WHILE_OURS: HelmRow = {
    HelmInput.MOTION: (HelmAction.SEND, HelmState.DRIVING),
    HelmInput.NEUTRAL: (HelmAction.SEND, HelmState.DRIVING),
    HelmInput.REST: _STOPS,
    HelmInput.STOP: _STOPS,
    HelmInput.ASTRAY: _STOPS,
    HelmInput.TAKEN: (HelmAction.LEAVE, HelmState.OTHERS),
}
_WHILE_NOT: HelmRow = {
    HelmInput.MOTION: (HelmAction.ASK, HelmState.ASKED),
    HelmInput.STOP: _STOPS,
    HelmInput.ASTRAY: _STOPS,
}
TABLE: dict[HelmState, HelmRow] = {
    HelmState.OTHERS: _WHILE_NOT,
    HelmState.ASKED: _WHILE_OURS
    | {
        HelmInput.MOTION: (HelmAction.SEND, HelmState.ASKED),
        HelmInput.NEUTRAL: _STOPS,
        HelmInput.DRIVEN: (HelmAction.SEND, HelmState.DRIVING),
        HelmInput.TAKEN: (HelmAction.ABANDON, HelmState.OTHERS),  # our request may be on its way
    },
    HelmState.DRIVING: _WHILE_OURS,
    HelmState.STOPPING: {
        HelmInput.MOTION: (HelmAction.ASK, HelmState.ASKED),
        HelmInput.REST: _STOPS,
        HelmInput.STOP: _STOPS,
        HelmInput.HOLDING: (HelmAction.LEAVE, HelmState.HELD),
        HelmInput.TAKEN: (HelmAction.LEAVE, HelmState.OTHERS),
    },
    HelmState.HELD: _WHILE_NOT | {HelmInput.TAKEN: (HelmAction.LEAVE, HelmState.OTHERS)},
}
"""``{state: {input: (action, next state)}}``; a missing pair changes nothing."""


class Helm(Kept):
    """The mode of one rover. driving: our driving mode. arms: the first motion arms it."""

    kept: ClassVar[dict[str, Any]] = {
        "vehicle": int,
        "state": HelmState,
        "mode": int | None,
        "armed": bool,
        "overrides": bool,
        "_why": str,
        "_said": str,
        "_listens": bool,
        "_ordered": bool,
        "_unconfirmed": int | None,
        "_explained": tuple[int, ...],
        "_since": float,
        "_shown_at": float,
        "_counts_from": float,
        "_ours_until": float,
    }

    def __init__(self, driving: RoverMode, *, arms: bool) -> None:
        self.driving, self.arms = driving, arms
        self.vehicle = 0
        """The system whose mode this is; 0: none was found yet."""
        self.state = HelmState.OTHERS
        self.mode: int | None = None
        """As the rover showed it last."""
        self.armed = False
        self.overrides = False
        """Whether a stick of ours may hold the RC receiver's off."""
        self._why = self._said = ""
        """Why motion is refused until a neutral came, and what the rover said of it."""
        self._listens = self._ordered = False
        self._unconfirmed: int | None = None
        """The mode that was shown instead of HOLD after a stop."""
        self._explained: tuple[int, ...] = ()
        """Modes besides ours that a rover may still show though nobody took it."""
        self._since = self._shown_at = self._counts_from = self._ours_until = -math.inf

    def __repr__(self) -> str:
        return f"<Helm {self.state}, mode {self.mode_name}, {'armed' if self.armed else 'disarmed'}>"

    @property
    def ours(self) -> bool:
        """Whether the rover may move by our order."""
        return self.state not in (HelmState.OTHERS, HelmState.HELD)

    @property
    def mode_name(self) -> str:
        """The mode that is shown, for people."""
        return name_of_mode(self.mode)

    @property
    def hindrance(self) -> str | None:
        """Why motion is refused now; None: it is not."""
        if self._why:
            return f"{self._why}: {self._said}" if self._said else self._why
        drivable = self.armed or self.arms or self.state in (HelmState.ASKED, HelmState.DRIVING)
        return None if drivable else "disarmed"

    @property
    def warning(self) -> str | None:
        """A stop that the rover did not confirm."""
        unconfirmed = self._unconfirmed
        return f"{NOT_HELD}: mode {name_of_mode(unconfirmed)}" if unconfirmed is not None else None

    @property
    def due(self) -> float:
        """When :meth:`expire` is next due; ``inf``: never."""
        return self._since + ASK_S if self.state is HelmState.ASKED else math.inf

    # What we do

    def move(self, now: float) -> HelmAction:
        """Allow motion; raise NotReady."""
        if (why := self.hindrance) is not None:
            raise NotReady(why)
        return self._handle(HelmInput.MOTION, now)

    def wait(self, now: float) -> None:
        """Note that the rover has done what it was asked for: it has time again to show it, and for what comes next."""
        self._since, self._ours_until = now, now + OURS_S[self.driving]

    def neutral(self, now: float) -> HelmAction:
        """Note a neutral: motion is allowed again. A driver who lets go before the rover was ours wants it no more."""
        self._why = ""
        return self._handle(HelmInput.NEUTRAL, now)

    def stop(self, now: float, *, ordered: bool) -> HelmAction:
        """Stop it. ordered: by a person, so also against a pilot who has the rover, or takes it meanwhile."""
        return self._handle(HelmInput.STOP if ordered else HelmInput.REST, now)

    # What the rover says

    def found(self, vehicle: int) -> None:
        """Begin with a new connection: nothing is in flight there. Another vehicle has nothing of the one before."""
        if vehicle != self.vehicle:
            Helm.__init__(self, self.driving, arms=self.arms)
        self.vehicle, self._unconfirmed, self._explained, self._counts_from = vehicle, None, (), -math.inf

    def show(self, mode: int, *, armed: bool, now: float) -> HelmAction:
        """Note what a HEARTBEAT shows."""
        self.mode, self.armed, self._shown_at = mode, armed, now
        self._listens = False
        if mode != self._unconfirmed:
            self._unconfirmed = None
        late = self.state is HelmState.STOPPING and now >= self._since + STOP_S
        if late and (mode == self.driving or (self._ordered and mode != RoverMode.HOLD)):
            self._unconfirmed = mode
        happened = self._meaning(now, late=late)
        reason = "disarmed" if mode == self.driving else f"mode {self.mode_name}"
        return self._handle(happened, now, reason) if happened is not None else HelmAction.NOTHING

    def answer(self, what: str, now: float, *, accepted: bool) -> HelmAction:
        """Note the answer to a request for a mode, or to arm (``what``, for people)."""
        if self.state is not HelmState.ASKED or accepted:
            return HelmAction.NOTHING
        happened = HelmInput.ASTRAY if self.mode == self.driving else HelmInput.TAKEN
        return self._handle(happened, now, f"{what} refused")

    def say(self, text: str) -> None:
        """Note a warning of the rover: it may be why it refuses, or just refused."""
        if self.state is HelmState.ASKED or self._listens:
            self._said = text

    def expire(self, now: float) -> HelmAction:
        """Give up a request that was not carried out in time. Without a HEARTBEAT behind it, it may have been."""
        if now < self.due:
            return HelmAction.NOTHING
        if self.mode == self.driving and not self.armed:
            return self._handle(HelmInput.ASTRAY, now, "disarmed")
        if self.mode == self.driving or self._shown_at < self._since + FLIGHT_S:
            return self._handle(HelmInput.ASTRAY, now, f"mode {self.driving.name} was not shown")
        return self._handle(HelmInput.TAKEN, now, f"mode {self.mode_name}")

    def _meaning(self, now: float, *, late: bool) -> HelmInput | None:
        """Return what the mode that was just shown means. late: a stop should be over."""
        mode, state = self.mode, self.state
        ours, counts, recent = mode == self.driving, self.counts(now), now < self._ours_until
        meaning: HelmInput | None = None
        if state is HelmState.ASKED:
            if ours and self.armed and counts:
                meaning = HelmInput.DRIVEN
            elif not ours and mode not in self._explained:
                meaning = HelmInput.TAKEN
        elif state is HelmState.DRIVING:
            if not ours and not (recent and mode == RoverMode.HOLD):  # our own HOLD may be late
                meaning = HelmInput.TAKEN
            elif not ours or not self.armed:
                meaning = HelmInput.ASTRAY
        elif state is HelmState.STOPPING:
            if mode == RoverMode.HOLD:
                meaning = HelmInput.HOLDING if counts else None
            elif not ours and (late or (not self._ordered and (counts or mode not in self._explained))):
                meaning = HelmInput.TAKEN
        elif ours and recent:
            meaning = HelmInput.ASTRAY
        elif mode != RoverMode.HOLD:
            meaning = HelmInput.TAKEN
        return meaning

    def counts(self, now: float) -> bool:
        """Return whether what is heard now is behind our newest request."""
        return now >= self._counts_from

    # The machine

    def _handle(self, happened: HelmInput, now: float, reason: str = "") -> HelmAction:
        """Carry out the table. reason: why motion is refused from now on, if we drove or asked."""
        before, entry = self.state, TABLE[self.state].get(happened)
        if entry is None:
            return HelmAction.NOTHING
        action, self.state = entry
        moved = before in (HelmState.ASKED, HelmState.DRIVING)
        if moved and reason and self.state is not HelmState.DRIVING:
            self._why, self._listens = reason, True
        if action is HelmAction.ASK:
            stopping = before is HelmState.STOPPING
            shown = self._explained if stopping else (self.mode or 0,)
            held = (int(RoverMode.HOLD),) if stopping or now < self._ours_until else ()  # our HOLD may be shown late
            self._explained = tuple({*shown, *held})
            self._said = ""
            self._begin(now, in_flight=stopping)
        elif action is HelmAction.STOP:
            if before is not HelmState.STOPPING:
                self._ordered = False
                self._explained = self._explained if before is HelmState.ASKED else ()
                in_flight = before is HelmState.ASKED and self.driving is RoverMode.GUIDED  # MANUAL alone moves nothing
                self._begin(now, in_flight=in_flight)
            self._ordered = self._ordered or happened is HelmInput.STOP
        asked = HelmState.ASKED in (before, self.state)
        if action in (HelmAction.ASK, HelmAction.STOP) and (asked or (moved and self.driving is RoverMode.GUIDED)):
            self._ours_until = now + OURS_S[self.driving]
        return action

    def _begin(self, now: float, *, in_flight: bool) -> None:
        """Note when something was asked for. in_flight: what was asked for before may not have been shown yet."""
        self._since, self._counts_from = now, now + (FLIGHT_S if in_flight else 0.0)


def name_of_mode(mode: int | None) -> str:
    """Return the name of a mode of ArduRover, or its number."""
    if mode is None:
        return "unknown"
    return RoverMode(mode).name if mode in set(RoverMode) else str(mode)
