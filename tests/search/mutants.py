"""Broken variants of the machines: a search that misses one lacks a rule."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

from tests.search.bounds import QUICK
from tests.search.moves import Bounds
from tests.search.search import Finding, search
import msgspec

from zbridge.control import gate, proof
from zbridge.control.authority import Authority
from zbridge.control.command_age import CommandAge
from zbridge.control.lease_client import LeaseClient
from zbridge.control.lease_events import LeaseEvent

Broken = tuple[str, Callable[[], Any]]
"""What is broken, and a patch that breaks it."""


def _method(owner: type, name: str, broken: Callable[..., Any]) -> Callable[[], Any]:
    return lambda: patch.object(owner, name, broken)


def _without_table_entry(owner: Any, state: str, said: str) -> Callable[[], Any]:
    def make() -> Any:
        table = {
            each: {key: entry for key, entry in row.items() if (each.value, key.value) != (state, said)}
            for each, row in owner.TABLE.items()
        }
        return patch.object(owner, "TABLE", table)

    return make


def _move_without_deadman(self: Authority, given_at: float) -> None:
    self._stop_at = math.inf


def _end_without_stop(self: Authority, reason: str, kind: Any, who: str | None = None) -> None:
    _END(self, reason, kind, who)
    self._events = [msgspec.structs.replace(each, stops=False) for each in self._events]


def _tell_nothing(self: LeaseClient, now: float, event: LeaseEvent) -> None:
    self._events.append(event)


def _never_stale(self: CommandAge, late_s: float) -> bool:
    return False


def _ended_leases_count(self: Any, lease: bytes) -> Any:
    holder = self._ended.get(lease)
    if holder is not None:
        holder.ended = None
        return holder
    return _KNOWN(self, lease)


_END, _KNOWN = Authority._end, proof.Holders._known
MUTANTS: tuple[Broken, ...] = (
    ("no answer to an acquire while latched", _without_table_entry(Authority, "latched", "acquire")),
    ("no deadman", _method(Authority, "_move", _move_without_deadman)),
    ("neutral is not required", _method(Authority, "require_motion", lambda self: None)),
    ("an ended lease stops nothing", _method(Authority, "_end", _end_without_stop)),
    ("stale motion is obeyed", _method(CommandAge, "is_stale", _never_stale)),
    ("an expiry is not noticed", _without_table_entry(Authority, "held", "lease expired")),
    ("a stop in motion ends no lease", _without_table_entry(Authority, "moving", "stop")),
    ("commands of ended leases are obeyed", _method(proof.Holders, "_known", _ended_leases_count)),
    ("a client learns nothing of news", _without_table_entry(LeaseClient, "held", "doubt")),
    ("a client keeps a lease that ended", _method(LeaseClient, "_tell", _tell_nothing)),
    ("a returned lease is never asked for again", _without_table_entry(LeaseClient, "wanted", "returned")),
    ("a question without an answer is never over", _without_table_entry(LeaseClient, "asking", "denied")),
    ("a stop is folded while somebody holds the robot", lambda: patch.object(gate, "SAME_STOP_S", 1e9)),
)


def caught_by(broken: Callable[[], Any], worlds: tuple[Bounds, ...] = QUICK) -> str | None:
    """Return the first world in which a search finds a broken variant, and the rule; None where none does."""
    with broken():
        for bounds in worlds:
            try:
                search(bounds)
            except Finding as finding:
                return str(finding).partition("\n")[0]
    return None
