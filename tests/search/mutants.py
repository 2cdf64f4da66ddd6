"""Broken variants of the machines: a search that misses one lacks a rule."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import msgspec

from tests.search.bounds import LISTENER
from tests.search.moves import Bounds
from tests.search.search import Finding, search
from zbridge.control.admission import SAME_STOP_S, CommandFilter
from zbridge.control.authority_machine import AuthorityMachine
from zbridge.control.commanded_motion import CommandedMotion
from zbridge.control.events import AuthorityState
from zbridge.control.holders import CommandAge, Holders
from zbridge.lease.lease_client import LeaseClient

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


def _with_action(owner: Any, broken: Callable[..., Any], state_after: Any = None) -> Callable[[], Any]:
    """Replace the action of this name wherever the table has it, and if given, the state after it."""

    def make() -> Any:
        table = {
            state: {
                key: (broken, state_after or after) if action.__name__ == broken.__name__ else (action, after)
                for key, (action, after) in row.items()
            }
            for state, row in owner.TABLE.items()
        }
        return patch.object(owner, "TABLE", table)

    return make


def _move(self: AuthorityMachine, cause: Any) -> None:
    self.motion.stop_at = math.inf


def _end(self: AuthorityMachine, cause: Any) -> None:
    _END(self, cause)  # and what it says of stops is left out:
    self.events = [msgspec.structs.replace(each, stops=False) for each in self.events]


def _refuse_latched(self: AuthorityMachine, cause: Any) -> Any:
    return AuthorityMachine._grant(self, cause)


def _notify(self: LeaseClient, cause: Any) -> None:
    self._events.append(cause.event)


def _never_stale(self: CommandAge, late_s: float) -> bool:
    return False


def _ended_leases_count(self: Any, lease: bytes) -> Any:
    holder = self._ended.get(lease)
    if holder is not None:
        holder.ended = None
        return holder
    return _KNOWN(self, lease)


_END, _KNOWN = AuthorityMachine._end, Holders._known


def _stop_folded_at_once(self: CommandFilter, payload: bytes) -> Any:
    return None if self._clock() - self._stopped_at < SAME_STOP_S else _STOP(self, payload)


_STOP = CommandFilter._stop
MUTANTS: tuple[Broken, ...] = (
    ("a latched robot is given away", _with_action(AuthorityMachine, _refuse_latched, AuthorityState.HELD)),
    ("no deadman", _with_action(AuthorityMachine, _move)),
    ("neutral is not required", _method(CommandedMotion, "check_motion", lambda self: None)),
    ("an ended lease stops nothing", _with_action(AuthorityMachine, _end)),
    ("stale motion is obeyed", _method(CommandAge, "is_stale", _never_stale)),
    ("an expiry is not noticed", _without_table_entry(AuthorityMachine, "held", "lease expired")),
    ("a stop in motion ends no lease", _without_table_entry(AuthorityMachine, "moving", "stop")),
    ("commands of ended leases are obeyed", _method(Holders, "_known", _ended_leases_count)),
    ("a client learns nothing of news", _without_table_entry(LeaseClient, "held", "doubt")),
    ("a client keeps a lease that ended", _with_action(LeaseClient, _notify)),
    ("a returned lease is never asked for again", _without_table_entry(LeaseClient, "wanted", "returned")),
    ("a question without an answer is never over", _without_table_entry(LeaseClient, "asking", "denied")),
    (
        "a stop is folded though somebody moves the robot",
        _method(CommandFilter, "_stop", _stop_folded_at_once),
    ),
)


WORLD = Bounds("mutants", (LISTENER,), ("motion", "neutral"), channel=1, loses=False, beats=False, states=2000,
               faults=frozenset({"stop", "link", "robot latch"}))  # fmt: skip
"""Much may happen here, so that a violation is few moves away; the search ends with it, or with so many states."""
RUNS_OUT = "the search is not complete"


def caught_by(broken: Callable[[], Any], bounds: Bounds = WORLD) -> str | None:
    """Return the rule that a broken variant violates; None where the search finds none."""
    with broken():
        try:
            search(bounds)
        except Finding as finding:
            return None if RUNS_OUT in str(finding) else str(finding).partition("\n")[0]
    return None
