"""How often one ground station is told what. Sans-IO.

Source: "The gateway as vehicle" of the protocol page.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

from gateways.mavlink.messages import MavlinkMessage, telemetry
from zbridge.protocol import Kept

FASTEST_S = 0.05
"""Least seconds between two messages of an id, whatever is asked for."""
ALL_S = 0.25
"""Least seconds between two where all are asked for at once."""
_FAST, _SLOW = (0.25, 1.0)


def _ids(*messages: type[MavlinkMessage]) -> tuple[int, ...]:
    return tuple(message.spec.id for message in messages)


TIMED = _ids(telemetry.SysStatus, telemetry.GpsRawInt, telemetry.HomePosition, telemetry.ExtendedSysState)
"""What is repeated though nothing of the robot is new."""
_POSITION = _ids(telemetry.LocalPositionNed, telemetry.GlobalPositionInt)
_EXTENDED_STATUS = _ids(telemetry.SysStatus, telemetry.GpsRawInt)
_ATTITUDE, _HUD = _ids(telemetry.Attitude), _ids(telemetry.VfrHud)
_EXTRA = _ids(telemetry.BatteryStatus, telemetry.ObstacleDistance)
GROUPS = {2: _EXTENDED_STATUS, 6: _POSITION, 10: _ATTITUDE, 11: _HUD, 12: _EXTRA}
"""The ids of a stream of REQUEST_DATA_STREAM; 0 is all of them."""
_ALL = tuple(message_id for ids in GROUPS.values() for message_id in ids)
_UNASKED = dict.fromkeys(_POSITION + _ATTITUDE + _HUD, _FAST) | dict.fromkeys(_ids(telemetry.BatteryStatus), _SLOW)
_UNASKED |= dict.fromkeys(_EXTENDED_STATUS, _SLOW)
STREAMED = frozenset(_ALL + TIMED)


class Streams(Kept):
    """The streams of one client: those that no program asks for and all need, and what it asked for."""

    kept: ClassVar[dict[str, Any]] = {"_periods": dict[int, float]}

    def __init__(self) -> None:
        self._periods = dict(_UNASKED)
        self._due: dict[int, float] = {}

    def __repr__(self) -> str:
        return f"<Streams {sorted(self._periods)}>"

    def set(self, message_id: int, period_s: float) -> None:
        """Send a message every ``period_s``; 0: as often as unasked; below 0: never."""
        if period_s > 0:
            self._periods[message_id] = max(FASTEST_S, period_s)
        elif period_s == 0 and message_id in _UNASKED:
            self._periods[message_id] = _UNASKED[message_id]
        else:
            self._periods.pop(message_id, None)
        self._due.pop(message_id, None)

    def set_group(self, group: int, rate_hz: int, *, on: bool) -> None:
        """Set the streams of a REQUEST_DATA_STREAM; an unknown group changes nothing."""
        least_s = ALL_S if group == 0 else FASTEST_S
        for message_id in _ALL if group == 0 else GROUPS.get(group, ()):
            self.set(message_id, max(least_s, 1 / rate_hz) if on and rate_hz else -1.0)

    def period_s(self, message_id: int) -> float:
        """Return the seconds between two messages of an id; ``inf``: it is not sent."""
        return self._periods.get(message_id, math.inf)

    def take(self, message_id: int, now: float) -> bool:
        """Return whether a message is due, and take that for sent."""
        period_s, due = self.period_s(message_id), self._due.get(message_id, -math.inf)
        if period_s == math.inf or now < due:
            return False
        self._due[message_id] = max(due, now - period_s) + period_s
        return True

    @property
    def due(self) -> float:
        """When something of :data:`TIMED` is next due; ``inf``: never."""
        return min((self._due.get(each, 0.0) for each in TIMED if each in self._periods), default=math.inf)
