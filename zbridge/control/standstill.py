"""Keeps a robot stopped while nobody drives: repeats its stop quickly for a second, then every ``idle_stop_s``.

A stalled robot program or link may have lost all of the first stops ("Stops" in ``lease.md``).
"""

from __future__ import annotations

import asyncio
import math

from zbridge.control.authority import Authority
from zbridge.control.context import RobotContext
from zbridge.control.faults import FaultCode
from zbridge.control.settings import LEAST_IDLE_STOP_S
from zbridge.errors import Refused
from zbridge.protocol.session import State

STOP_REPEAT_S = 1.0
"""Seconds for which a stop is repeated quickly."""
IDLE_STOP_S = 1.0
"""Seconds between two stops after that, unless the configuration says otherwise."""


class Standstill:
    """Sends stops to one robot.

    authority: knows whether somebody drives the robot now, or ordered it to move by itself.
    idle_stop_s: seconds between two stops while nobody drives, fewer where the protocol says so; 0: only when motion
    ends, and while a latched stop is in force.
    """

    def __init__(self, context: RobotContext, authority: Authority, idle_stop_s: float = IDLE_STOP_S) -> None:
        self._context = context
        self._clock = context.clock
        self._authority = authority
        self._idle_stop_s = idle_stop_s
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._repeated_until = -math.inf

    def __repr__(self) -> str:
        return f"<Standstill every {self._idle_stop_s:g} s, {self.stopping_s:.1f} s of quick stops left>"

    @property
    def stopping_s(self) -> float:
        """Seconds for which a stop or a neutral is still being repeated quickly."""
        return max(0.0, self._repeated_until - self._clock())

    def begin(self) -> None:
        """Send stops from now on whenever nobody drives."""
        self._timer = self._loop.call_later(self._period_s(), self._on_time)

    def close(self) -> None:
        """Send nothing more."""
        if self._timer is not None:
            self._timer.cancel()

    def neutral(self, now: float) -> None:
        """Note that the session repeats neutral from now on: no stop is needed meanwhile."""
        self._repeated_until = now + STOP_REPEAT_S

    def stop(self, *, ordered: bool) -> None:
        """Send the robot its stop at once and for a second; raise Refused if it cannot be sent.

        ordered: somebody wants it stopped now, or a latch is in force; else as :meth:`RobotSide.rest` says.
        """
        now = self._clock()
        self._send(now, now + STOP_REPEAT_S, ordered=ordered or bool(self._authority.latches))
        self._repeated_until = now + STOP_REPEAT_S

    def _period_s(self) -> float:
        """Return the seconds between two stops while nobody drives."""
        wanted_s = self._idle_stop_s or IDLE_STOP_S
        try:
            return max(LEAST_IDLE_STOP_S, min(wanted_s, self._context.robot.idle_stop_s))
        except Exception as error:
            self._context.faults.note("idle_stop_s", error)
            return wanted_s

    def _send(self, now: float, until: float, *, ordered: bool) -> None:
        try:
            self._write(now, until, ordered)
        except Refused as refusal:
            self._context.open_faults.set(FaultCode.CANNOT_STOP, f"cannot be stopped: {refusal}")
            raise
        self._context.open_faults.set(FaultCode.CANNOT_STOP, None)
        self._context.pump()

    def _write(self, now: float, until: float, ordered: bool) -> None:
        robot = self._context.robot
        try:
            (robot.stop if ordered else robot.rest)(now, until)
        except Refused:
            raise
        except Exception as error:
            raise self._context.faults.refusal("stop", error) from error

    def _on_time(self) -> None:
        self.begin()
        session, now = self._context.robot.driving, self._clock()
        if session is None or session.state is not State.ESTABLISHED:
            self._context.open_faults.set(FaultCode.CANNOT_STOP, None)
        elif (
            (self._idle_stop_s or self._authority.latches)
            and not self._authority.motion.driven
            and now >= self._repeated_until
        ):
            try:
                self._send(now, now, ordered=bool(self._authority.latches))
            except Refused:
                return  # the condition says so on status
