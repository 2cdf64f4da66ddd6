"""One row for each robot of the fleet model, for ``zbridge top`` and the console. Text of peers is safe to print."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from enum import Enum
from typing import Any

import msgspec

from zbridge.client.fleet_model import SILENT_S, FleetModel, RobotEntry
from zbridge.fleet.printable import shown
from zbridge.fleet.processes import ProcessStats

_CELL = 200
"""Most characters of a cell."""
_SHOWN = ("latched", "robot_lost")
"""Faults that other columns show."""
_SHARED = "*"
"""Follows the processor and memory of a process that serves several robots."""


class RowState(Enum):
    """What a robot's row says of it, the worst first: the word, and the mark before the robot's name.

    Words in capitals are of the gateway, or of a latched stop; the others are the states of the robot's links.
    """

    NO_GATEWAY = ("NO GATEWAY", "X")
    SILENT = ("SILENT", "?")
    OFFLINE = ("offline", "!")
    STALLED = ("stalled", "!")
    CLOSING = ("closing", "!")
    CONNECTING = ("connecting", "!")
    HANDSHAKING = ("handshaking", "!")
    UNKNOWN = ("unknown", "?")
    LATCHED = ("LATCHED", "L")
    ESTABLISHED = ("established", " ")

    @property
    def word(self) -> str:
        """What the column says."""
        return self.value[0]

    @property
    def mark(self) -> str:
        """One character, shown also where no room is left for the column."""
        return self.value[1]

    @property
    def severity(self) -> int:
        """The place among all states, 0 for the worst."""
        return _SEVERITY[self]


class RobotRow(msgspec.Struct, frozen=True):
    """One robot. None and "": not known.

    rate: messages a second. refused: commands, since the gateway started. cpu: processors in use. memory_bytes:
    proportional if known, else resident. shared: whether the gateway's process serves other robots too.
    """

    name: str
    state: RowState
    driver: str = ""
    reason: str = ""
    rate: float | None = None
    refused: int | None = None
    gaps: int | None = None
    cpu: float | None = None
    memory_bytes: int | None = None
    shared: bool = False
    host: str = ""
    protocol: str = ""

    @property
    def cpu_text(self) -> str:
        """Per cent of a core."""
        return f"{100 * self.cpu:.1f}{_SHARED * self.shared}" if self.cpu is not None else ""

    @property
    def memory_text(self) -> str:
        """Megabytes."""
        return f"{self.memory_bytes / 1e6:.0f}M{_SHARED * self.shared}" if self.memory_bytes is not None else ""

    def contains(self, words: Iterable[str]) -> bool:
        """Return whether each of these words, in lower case, stands somewhere in the row."""
        texts = (self.name, self.state.word, self.driver, self.reason, self.host, self.protocol)
        text = "\n".join(texts).lower()
        return all(word in text for word in words)


def read_rows(model: FleetModel, *, connected: bool = True) -> list[RobotRow]:
    """Return the rows of all robots. connected: whether this program is on the bus; else no state is known."""
    settling = model.clock() - model.opened_at < SILENT_S
    return [_read_row(entry, _state(entry, model, connected, settling)) for entry in model.robots.values()]


def _state(entry: RobotEntry, model: FleetModel, connected: bool, settling: bool) -> RowState:
    """Return the state of a robot. settling: tokens and messages may still be on their way to us."""
    status = entry.status
    if not connected or (settling and not entry.alive):
        return RowState.UNKNOWN
    if not entry.alive:
        return RowState.NO_GATEWAY
    if model.silent(entry):
        return RowState.SILENT
    if status is None:
        return RowState.UNKNOWN
    if status.state != "established":
        return RowState[status.state.upper()]
    if status.stalled is True:
        return RowState.STALLED
    return RowState.LATCHED if entry.control is not None and entry.control.latches else RowState.ESTABLISHED


def _read_row(entry: RobotEntry, state: RowState) -> RobotRow:
    """Return the row of a robot; what a gateway does and uses that is gone or silent is not known."""
    status, stats = entry.status, entry.stats
    present = state not in (RowState.NO_GATEWAY, RowState.SILENT, RowState.UNKNOWN)
    process = stats.process if stats is not None and present else None
    return RobotRow(
        name=entry.name,
        state=state,
        driver=driver_text(entry) if state is not RowState.NO_GATEWAY else "",
        reason=_reason(entry, state),
        rate=sum(stats.rates.values()) if stats is not None and present else None,
        refused=stats.refused if stats is not None else entry.refused if entry.control is not None else None,
        gaps=stats.gaps if stats is not None else None,
        cpu=process.cpu if process is not None else None,
        memory_bytes=memory_bytes(process) if process is not None else None,
        shared=process is not None and process.robots > 1,
        host=shown(_host(entry), _CELL),
        protocol=shown(f"{status.protocol or ''} {status.version or ''}".strip(), _CELL) if status is not None else "",
    )


def driver_text(entry: RobotEntry) -> str:
    """Return who drives; else LATCHED or stopped if that is so, else ""."""
    control = entry.control
    if control is None:
        return ""
    if control.latches or control.state == "latched":
        return "LATCHED"
    return shown(entry.driver, _CELL) or ("stopped" if control.state == "stopped" else "")


def _reason(entry: RobotEntry, state: RowState) -> str:
    own = {
        RowState.NO_GATEWAY: "no gateway serves it",
        RowState.SILENT: f"its gateway has published nothing for {SILENT_S:g} s",
        RowState.STALLED: "its link acknowledges nothing",
        RowState.UNKNOWN: "" if entry.status is not None else "the gateway has published no status yet",
    }.get(state, "")
    reported = entry.status.reason or "" if entry.status is not None and state is not RowState.NO_GATEWAY else ""
    faults = entry.status.faults if entry.status is not None and state is not RowState.NO_GATEWAY else ()
    more = (f"{each.code}: {each.text}" for each in faults if each.code not in _SHOWN and each.text not in reported)
    return shown("; ".join(filter(None, (own, entry.stopped_by, reported, *more))), _CELL)


def _host(entry: RobotEntry) -> str:
    reported = entry.status.host if entry.status is not None else None
    return reported or (entry.stats.process.host if entry.stats is not None else "")


def memory_bytes(process: ProcessStats) -> int:
    """Return what a process occupies: pages that it shares counted in part, if the platform says so."""
    return process.proportional_bytes if process.proportional_bytes is not None else process.resident_bytes


def count_states(rows: Iterable[RobotRow]) -> str:
    """Count robots by state, the worst first: ``200 robots: 1 SILENT, 2 offline, 197 established``."""
    counts = Counter(row.state for row in rows)
    listed = ", ".join(f"{counts[state]} {state.word}" for state in RowState if counts[state])
    robots = "1 robot" if counts.total() == 1 else f"{counts.total()} robots"
    return f"{robots}: {listed}" if listed else robots


def as_fields(row: RobotRow, entry: RobotEntry) -> dict[str, Any]:
    """Return a robot as a JSON object: its row, its status, and its gateway's figures. None: not known."""
    status, control, stats = entry.status, entry.control, entry.stats
    return {
        "robot": entry.name,
        "alive": entry.alive,
        "silent": row.state is RowState.SILENT,
        "state": status.state if status is not None else None,
        "stalled": status is not None and status.stalled is True,
        "reason": row.reason or None,
        "control": control.state if control is not None else None,
        "driver": entry.driver or None,
        "latches": [latch.described for latch in control.latches] if control is not None else [],
        "faults": msgspec.to_builtins(status.faults) if status is not None else [],
        "refusals": msgspec.to_builtins(control.refusals) if control is not None else [],
        "protocol": status.protocol if status is not None else None,
        "version": status.version if status is not None else None,
        "rates": stats.rates if stats is not None else {},
        "gaps": row.gaps,
        "refused": row.refused,
        "dropped": stats.dropped if stats is not None else None,
        "cpu": row.cpu,
        "memory_bytes": row.memory_bytes,
        "host": _host(entry) or None,
        "process": msgspec.to_builtins(stats.process) if stats is not None else None,
    }


_SEVERITY = {state: place for place, state in enumerate(RowState)}
