"""Keeps a robot at rest that nobody drives: sends its stop, quickly for a second, and then again and again.

A robot program or a link that stalled may have lost all of the first ones (design, "Who may drive").
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from zbridge.conditions import Conditions
from zbridge.errors import Refused
from zbridge.protocol.plugin import Robot
from zbridge.protocol.session import State

STOP_REPEAT_S = 1.0
"""Seconds for which a stop is repeated quickly."""
IDLE_STOP_S = 1.0
"""Seconds between two stops after that, unless the configuration says otherwise."""
_CONDITION = "stop"


class Standstill:
    """Sends stops to one robot. ``pump`` writes what its sessions have to write.

    idle_stop_s: seconds between two stops while nobody drives; 0: only when motion ends.
    ``driven``: whether somebody drives the robot now, or it was told to move by itself.
    ``clock``: seconds on the event loop's time line.
    """

    def __init__(
        self,
        robot: Robot,
        conditions: Conditions,
        *,
        idle_stop_s: float,
        driven: Callable[[], bool],
        pump: Callable[[], None],
        clock: Callable[[], float],
    ) -> None:
        self._robot = robot
        self._conditions = conditions
        self._idle_stop_s = idle_stop_s
        self._driven = driven
        self._pump = pump
        self._clock = clock
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
        """Watch from now on that a robot that nobody drives is sent its stop."""
        if self._idle_stop_s:
            self._timer = self._loop.call_later(self._idle_stop_s, self._on_time)

    def close(self) -> None:
        """Send nothing more."""
        if self._timer is not None:
            self._timer.cancel()

    def neutral(self, now: float) -> None:
        """Take note that neutral is being repeated from now on."""
        self._repeated_until = now + STOP_REPEAT_S

    def stop(self) -> None:
        """Send the robot its stop at once and for a second; raise Refused where it cannot be sent."""
        now = self._clock()
        self._send(now, now + STOP_REPEAT_S)
        self._repeated_until = now + STOP_REPEAT_S

    def _send(self, now: float, until: float) -> None:
        try:
            self._robot.stop(now, until)
        except Refused as refusal:
            self._conditions.set(_CONDITION, f"cannot be stopped: {refusal}")
            raise
        self._conditions.set(_CONDITION, None)
        self._pump()

    def _on_time(self) -> None:
        self.begin()
        session, now = self._robot.driving, self._clock()
        if session is None or session.state is not State.ESTABLISHED:
            self._conditions.set(_CONDITION, None)
        elif not self._driven() and now >= self._repeated_until:
            try:
                self._send(now, now)
            except Refused:
                return  # status says so
