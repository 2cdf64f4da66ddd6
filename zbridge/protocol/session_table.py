"""The sessions of one process, the ids of a robot's clients, and the delays between connection attempts. Sans-IO."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Collection, Iterator
from typing import Any, ClassVar

import msgspec

from zbridge.fleet.processes import SessionEntry
from zbridge.protocol.kept import Kept
from zbridge.protocol.session import Role, Session
from zbridge.protocol.traffic import Traffic

REMEMBERED = 32
"""Ended sessions that the table shows."""


class Backoff:
    """Delays between attempts, seconds: doubling from ``first_s`` to ``most_s``, each with 25 % jitter either way.

    chance: 0 to 1.
    """

    def __init__(self, first_s: float = 0.5, most_s: float = 10.0, chance: Callable[[], float] = random.random) -> None:
        self._first_s = first_s
        self._most_s = most_s
        self._next_s = first_s
        self._chance = chance

    def __repr__(self) -> str:
        return f"<Backoff next {self._next_s:g} s>"

    def delay_s(self) -> float:
        """Return the next delay, seconds."""
        delay_s, self._next_s = self._next_s, min(self._most_s, 2 * self._next_s)
        return delay_s * (0.75 + 0.5 * self._chance())

    def reset(self) -> None:
        """Start again from ``first_s``: an attempt succeeded."""
        self._next_s = self._first_s


class ClientIds(Kept):
    """The ids that a robot gives its clients: the lowest free one; a released id is not given again for ``quiet_s``."""

    kept: ClassVar[dict[str, Any]] = {"_free_at": dict[int, float]}

    def __init__(self, ids: range, quiet_s: float) -> None:
        self._quiet_s = quiet_s
        self._free_at = dict.fromkeys(ids, -math.inf)

    def __repr__(self) -> str:
        taken = sum(free_at == math.inf for free_at in self._free_at.values())
        return f"<ClientIds {taken} of {len(self._free_at)} taken>"

    def take(self, now: float) -> int | None:
        """Return the lowest id that is free now; None: all are taken."""
        for client_id, free_at in self._free_at.items():
            if free_at <= now:
                self._free_at[client_id] = math.inf
                return client_id
        return None

    def keep(self, client_ids: Collection[int], now: float) -> None:
        """Release all ids but these: their clients are gone."""
        for client_id, free_at in self._free_at.items():
            if free_at == math.inf and client_id not in client_ids:
                self.release(client_id, now)

    def release(self, client_id: int, now: float, *, rests: bool = True) -> None:
        """Release an id. ``rests`` False: the client never used it, so it is free at once."""
        self._free_at[client_id] = now + self._quiet_s if rests else -math.inf


class SessionTable:
    """The sessions of one process, of every protocol and both roles."""

    def __init__(self) -> None:
        self._live: dict[Session[Any], Traffic] = {}
        """What each had carried when it was added: another process may have begun it, and has counted that."""
        self._ended: list[SessionEntry] = []
        self._past: dict[Role, Traffic] = {role: Traffic() for role in Role}
        """What sessions carried that have ended."""

    def __repr__(self) -> str:
        return f"<SessionTable {len(self._live)} live, {len(self._ended)} ended>"

    def add(self, session: Session[Any]) -> None:
        """Add a new session to the table."""
        self._live[session] = msgspec.structs.replace(session.traffic)

    def remove(self, session: Session[Any]) -> None:
        """Move an ended session to the :data:`REMEMBERED` ones; idempotent."""
        before = self._live.pop(session, None)
        if before is not None:
            self._ended = [*self._ended, session.snapshot()][-REMEMBERED:]
            _add(self._past[session.role], session.traffic, before)

    def __iter__(self) -> Iterator[Session[Any]]:
        """Go through the live ones."""
        return iter(self._live)

    def carried(self, role: Role) -> Traffic:
        """Sum what all sessions of one role have carried in this process, also those that have ended."""
        total = msgspec.structs.replace(self._past[role])
        for session, before in self._live.items():
            if session.role is role:
                _add(total, session.traffic, before)
        return total

    def snapshots(self) -> tuple[SessionEntry, ...]:
        """Show every session, the live ones first."""
        return (*(session.snapshot() for session in self._live), *self._ended)


def _add(total: Traffic, now: Traffic, before: Traffic) -> None:
    for field in Traffic.__struct_fields__:
        setattr(total, field, getattr(total, field) + getattr(now, field) - getattr(before, field))
