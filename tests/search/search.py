"""Breadth-first search over all states of a bounded world, and what must come of each of them in the end."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

from tests.search.moves import Bounds, moves
from tests.search.rules import Account, Violation, judge
from tests.search.world import World
from zbridge.control.authority_machine import AuthorityMachine
from zbridge.lease.lease_client import LeaseClient

STEPS = 12
"""Steps of time within which a program that wants the lease has it, and one that lost it knows."""


@dataclass
class Found:
    """What a search came to. cells: how often each cell of a table was executed."""

    bounds: Bounds
    states: int = 0
    moves: int = 0
    complete: bool = False
    kinds: Counter[str] = field(default_factory=Counter)
    """Moves by kind."""
    cells: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    longest: int = 0
    """Steps of time until the slowest program had its lease."""


class Finding(AssertionError):
    """A rule was violated; the text has the moves that lead there."""


class _Row(dict[Any, Any]):
    """A row of a table that counts what is looked up in it."""

    def __init__(self, table: str, state: str, row: Any, cells: Counter[tuple[str, str, str]]) -> None:
        super().__init__(row)
        self._named, self._cells = (table, state), cells

    def get(self, key: Any, default: Any = None) -> Any:
        found = super().get(key, default)
        if found is not None:
            self._cells[*self._named, key.value] += 1
        return found

    def __getitem__(self, key: Any) -> Any:
        self._cells[*self._named, key.value] += 1
        return super().__getitem__(key)


def search(bounds: Bounds, *, liveness: bool = True) -> Found:
    """Visit every state; raise Finding at the first that breaks a rule."""
    found = Found(bounds)
    tables = {
        kind: {state: _Row(kind.__name__, state.value, row, found.cells) for state, row in kind.TABLE.items()}
        for kind in (AuthorityMachine, LeaseClient)
    }
    with contextlib.ExitStack() as stack:
        for kind, table in tables.items():
            stack.enter_context(patch.object(kind, "TABLE", table))
        _Search(found).run(liveness=liveness)
    return found


class _Search:
    def __init__(self, found: Found) -> None:
        self._found = found
        self._bounds = found.bounds
        self._came: dict[Any, tuple[Any, str]] = {}
        """For each state the one before, and the move that led here."""
        self._calm: dict[tuple[int, Any], int] = {}
        """Steps from each state of a fair course to its end."""

    def run(self, *, liveness: bool) -> None:
        """Visit all states, level by level."""
        found, bounds = self._found, self._bounds
        world, account = World(bounds.programs, bounds.channel, bounds.delay, overtaken=bounds.overtaken), Account()
        first = _named(world, account)
        self._came[first] = (None, "")
        level = [(first, world, account)]
        while level:
            following = []
            for name, world, account in level:
                if liveness:
                    self._lives(name, world)
                for move, after, next_account in self._after(name, world, account):
                    key = _named(after, next_account)
                    if key not in self._came:
                        self._came[key] = (name, move)
                        following.append((key, after, next_account))
                if len(self._came) > bounds.states:
                    raise Finding(f"{bounds.name}: more than {bounds.states} states: the search is not complete")
            level = following
        found.states, found.complete = len(self._came), True

    def _after(self, name: Any, world: World, account: Account) -> Iterator[tuple[str, World, Account]]:
        for move, act in moves(world, self._bounds):
            after = world.copy()
            World.moves = after
            try:
                act(after)
                after.forget()
                if not self._bounds.hears:
                    after.news = [None for _ in after.news]
                next_account = judge(world, account, after, move)
            except Violation as error:
                raise Finding(self._told(name, move, error)) from error
            except Exception as error:
                raise Finding(self._told(name, move, error)) from error
            self._found.moves += 1
            self._found.kinds[move] += 1
            yield move, after, next_account

    def _lives(self, name: Any, world: World) -> None:
        """Let the network work: whoever wants the lease gets it, and whoever lost it learns that."""
        for wanted in (None, *range(len(world.holders))):
            try:
                self._found.longest = max(self._found.longest, self._fair(wanted, world))
            except Violation as error:
                raise Finding(self._told(name, "then the network works", error)) from error

    def _fair(self, wanted: int | None, world: World) -> int:
        """Return the steps of time until all is well; raise Violation where it never is. wanted: wants the lease."""
        if _well(wanted, world):
            return 0
        world = world.copy()
        World.moves = world
        world.ready = True
        if world.hand:
            world.record()
        if wanted is not None:
            for latch in tuple(world.authority.latches._in_force):
                world.authority.unlatch(latch, "eve", fleet=latch == b"F" * 16)
            world.settle()
        passed: list[Any] = []
        for steps in range(STEPS + 1):
            key = (wanted, world.key())
            known = self._calm.get(key)
            if known is not None or _well(wanted, world):
                total = steps + (known or 0)
                if total > STEPS:
                    break
                for index, each in enumerate(passed):
                    self._calm[each] = total - index
                self._calm[key] = known or 0
                return total
            passed.append(key)
            world = _next(wanted, world)
        what = "who lost the lease never learns it" if wanted is None else f"{wanted} wants the lease and never gets it"
        raise Violation(f"{what}: {world.authority!r}, {[holder.client for holder in world.holders]}")

    def _told(self, name: Any, move: str, error: Exception) -> str:
        way = [move]
        while name is not None:
            name, before = self._came[name]
            way.append(before)
        shown = "\n  ".join(filter(None, reversed(way)))
        return f"{self._bounds.name}: {type(error).__name__}: {error}\n  {shown}"


def _named(world: World, account: Account) -> Any:
    return world.key(), account.named(world)


def _next(wanted: int | None, world: World) -> World:
    """Let everything arrive, and a step of time pass."""
    world = world.copy()
    World.moves = world
    world.channel = 100
    for number, holder in enumerate(world.holders):
        if wanted == number:
            if holder.client.state.value in ("free", "dropped", "returning"):
                holder.want()
        elif wanted is not None:
            holder.drop()
    _arrive(world)
    world.beat()
    _arrive(world)
    world.step()
    return world


def _arrive(world: World) -> None:
    for _ in range(100):
        if world.net:
            world.deliver(world.net[0])
        elif any(news is not None for news in world.news):
            for number in range(len(world.holders)):
                world.hear(number)
        else:
            return
    raise Violation("the network does not come to rest")


def _well(wanted: int | None, world: World) -> bool:
    verifier = world.authority.verifier
    held = [
        verifier is not None and holder.client._signer is not None and holder.client._signer.lease == verifier.lease
        for holder in world.holders
    ]
    if wanted is not None:
        return held[wanted]
    return all(mine or not holder.held for mine, holder in zip(held, world.holders, strict=True))
