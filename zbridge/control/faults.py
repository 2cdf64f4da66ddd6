"""Faults in the code of one robot's protocol: what it raises and must not, as refusals. Sans-IO."""

from __future__ import annotations

import logging

from zbridge.errors import FAULT, Unsupported, describe

log = logging.getLogger("zbridge.robot.commands")

LOGGED = 16
"""Faults that are logged, each once."""


class Faults:
    """The faults of one robot's protocol. robot: its name, for the log."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._logged: set[str] = set()

    def __repr__(self) -> str:
        return f"<Faults {sorted(self._logged)}>"

    def refusal(self, what: str, error: Exception) -> Unsupported:
        """Return the refusal of what ran into a fault, and note the fault."""
        self.note(what, error)
        return Unsupported(f"{FAULT}{describe(error)}")

    def note(self, what: str, error: Exception) -> None:
        """Log a fault with its traceback, each once."""
        fault = describe(error)
        if fault not in self._logged and len(self._logged) < LOGGED:
            self._logged.add(fault)
            log.error("%s: %s: %s%s", self._robot, what, FAULT, fault, exc_info=error)
