"""What pages are told of the fleet: all of it once, then what has changed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from zbridge.client.fleet_model import FleetModel
from zbridge.fleet.printable import shown
from zbridge.views.rows import RobotRow, RowState, read_rows

Row = dict[str, Any]
_encode = msgspec.json.Encoder().encode
_TEXT = 200
"""Most characters of a robot's name or text in a row."""


class FleetFeed:
    """The rows of all robots, as pages have them. clock: seconds since the epoch."""

    def __init__(self, model: FleetModel, clock: Callable[[], float] = time.time) -> None:
        self.rows: dict[str, Row] = {}
        self._model = model
        self._clock = clock

    def __repr__(self) -> str:
        return f"<FleetFeed {len(self.rows)} rows>"

    def alive(self) -> list[str]:
        """Return the robots that have a gateway now."""
        return [name for name, entry in self._model.robots.items() if entry.alive]

    def is_alive(self, robot: str) -> bool:
        """Return whether a robot has a gateway now."""
        entry = self._model.robots.get(robot)
        return entry is not None and entry.alive

    def accepts(self, robot: str) -> tuple[str, ...]:
        """Return the commands that a robot accepts now."""
        entry = self._model.robots.get(robot)
        return entry.status.commands if entry is not None and entry.status is not None else ()

    def latched(self) -> list[str]:
        """Return the robots that are latched now."""
        self._model.take()
        return [name for name, entry in self._model.robots.items() if entry.stopped_by]

    def forget(self, robot: str) -> None:
        """Forget a robot, until it is on the bus again."""
        self._model.robots.pop(robot, None)

    def refresh(self, roster: Iterable[str], *, connected: bool) -> bytes | None:
        """Read the model; return what has changed since the last call as JSON, None if nothing has."""
        self._model.take()
        now, rows = self._clock() - self._model.clock(), dict[str, Row]()
        for row in read_rows(self._model, connected=connected):
            rows[row.name] = self._fields(row, now)
        for name in roster:
            if name not in rows:
                rows[name] = _missing(name, connected=connected)
        before, self.rows = self.rows, rows
        changed = [row for name, row in rows.items() if before.get(name) != row]
        gone = [name for name in before if name not in rows]
        return _encode({"rows": changed, "gone": gone}) if changed or gone else None

    def snapshot(self, **more: Any) -> bytes:
        """Return all rows, and whatever else a page needs to begin, as JSON."""
        return _encode({"full": True, "rows": list(self.rows.values()), **more})

    def _fields(self, row: RobotRow, epoch: float) -> Row:
        """Make a row. epoch: when the model's clock was 0, seconds."""
        entry = self._model.robots[row.name]
        status, control, stats = entry.status, entry.control, entry.stats
        seen = entry.published_at
        away = row.state in (RowState.NO_GATEWAY, RowState.SILENT, RowState.UNKNOWN)
        return {
            "name": row.name,
            "state": row.state.word,
            "severity": row.state.severity,
            "reason": row.reason,
            "driver": row.driver,
            "latched": [shown(latch.described, _TEXT) for latch in control.latches] if control is not None else [],
            "protocol": shown(status.protocol or "", _TEXT) if status is not None else "",
            "version": shown(status.version or "", _TEXT) if status is not None else "",
            "commands": list(status.commands[:32]) if status is not None and not away else [],
            "rate": round(row.rate, 1) if row.rate is not None else None,
            "refused": row.refused,
            "gaps": row.gaps,
            "host": row.host,
            "gateway": shown(stats.process.version, _TEXT) if stats is not None else "",
            "seen": round(epoch + seen) if away and seen is not None else None,
        }


def _missing(name: str, *, connected: bool) -> Row:
    """Make the row of a robot that only the roster knows."""
    state = RowState.NO_GATEWAY if connected else RowState.UNKNOWN
    reason = "not on the bus since the console was started"
    empty = dict.fromkeys(("driver", "protocol", "version", "host", "gateway"), "")
    unknown = dict.fromkeys(("rate", "refused", "gaps", "seen"))
    known = {"name": name, "state": state.word, "severity": state.severity, "reason": reason}
    return {**known, "latched": [], "commands": [], **empty, **unknown}
