"""Executes the table of a handshake: ``{step: {event: (action, next step)}}``; chooses the version. Sans-IO.

A session contributes the table, the time that each step may last, and the actions, which are its own methods. It fires
an event for each message of the handshake and calls :meth:`Handshake.expire` at :attr:`Handshake.deadline`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping
from typing import Any, ClassVar, Generic, TypeVar

from zbridge.errors import ProtocolError
from zbridge.protocol.kept import Budget, Exported, Kept

Step = TypeVar("Step", bound=Hashable)
Event = TypeVar("Event", bound=Hashable)
Action = Callable[[Any, float], object]
"""``action(session, now)``; called when the next step has been taken."""


class Handshake(Kept, Generic[Step, Event]):
    """One run through a table. ``within_s``: seconds that a step may last; a step that is not in it may last forever.

    ``timeout``: the event of a step that has lasted too long.
    """

    kept: ClassVar[dict[str, Any]] = {"deadline": float}

    def __init__(
        self,
        session: object,
        table: Mapping[Step, Mapping[Event, tuple[Action, Step]]],
        first: Step,
        *,
        timeout: Event,
        within_s: Mapping[Step, float],
    ) -> None:
        self.step = first
        self.deadline = math.inf
        """When the step has lasted too long."""
        self._session, self._table = session, table
        self._timeout, self._within_s = timeout, within_s

    def __repr__(self) -> str:
        return f"<Handshake {self.step}>"

    def export(self, budget: Budget | None = None) -> Exported:
        """Export the step, and how long it may last."""
        return super().export(budget) | {"step": getattr(self.step, "name", self.step)}

    def restore(self, state: Exported) -> None:
        """Continue from a step; raise ProtocolError if the table has none of that name."""
        super().restore(state)
        steps = {getattr(step, "name", step): step for step in self._table}
        if state.get("step") not in steps:
            raise ProtocolError(f"no step {state.get('step')!r} in this handshake")
        self.step = steps[state["step"]]

    def fire(self, event: Event, now: float) -> bool:
        """Take the next step, then act; False, and nothing happens, if the event is not due in this step."""
        row = self._table[self.step].get(event)
        if row is None:
            return False
        action, self.step = row
        self.deadline = now + self._within_s.get(self.step, math.inf)
        action(self._session, now)
        return True

    def expire(self, now: float) -> None:
        """Fire the timeout if the step has lasted too long. Call at :attr:`deadline`, or later."""
        if now >= self.deadline:
            self.deadline = math.inf
            self.fire(self._timeout, now)


_VERSION = re.compile(r"\d{1,9}(\.\d{1,9})*")


def parse_versions(listed: str) -> tuple[str, ...]:
    """Read a comma-separated version list; ignore entries that are not dotted numbers."""
    entries = (entry.strip() for entry in listed.split(","))
    return tuple(entry for entry in entries if _VERSION.fullmatch(entry))


def agree(ours: Iterable[str], theirs: Iterable[str]) -> str | None:
    """Choose the highest common version, compared number by number; None: there is none."""
    common = set(ours) & set(theirs)
    return max(common, key=_numbers, default=None)


def newest(listed: Iterable[str], known: Collection[str]) -> str | None:
    """Choose the newest known version that is not newer than the newest listed; None: there is none."""
    limit = max(map(_numbers, listed), default=None)
    fitting = [version for version in known if limit is not None and _numbers(version) <= limit]
    return max(fitting, key=_numbers, default=None)


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))
