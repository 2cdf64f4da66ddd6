"""Names of states: see :mod:`tests.search.world`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tests.search.world import Command, Query, Reply, TokenGone, World
from zbridge.errors import Code
from zbridge.fleet.messages import Control


class _Order:
    """Names values by their order: equal worlds differ in them, and machines only compare them."""

    def __init__(self, values: Iterable[Any]) -> None:
        self._ranks = {value: rank for rank, value in enumerate(sorted(set(values)))}

    def __getitem__(self, value: Any) -> int:
        return self._ranks.get(value, -1)


class _Numbers:
    """The numbers in use of each lease, of commands and of questions."""

    def __init__(self, found: Iterable[tuple[bytes, str, int]]) -> None:
        self._orders: dict[tuple[bytes, str], list[int]] = {}
        for lease, kind, number in found:
            self._orders.setdefault((lease, kind), []).append(number)
        self._ranks = {which: _Order(numbers) for which, numbers in self._orders.items()}

    def rank(self, lease: bytes, kind: str, number: int) -> int:
        order = self._ranks.get((lease, kind))
        return order[number] if order is not None else -1


def name(world: World) -> Any:
    """Name a state."""
    return _Namer(world).name()


class _Namer:
    def __init__(self, world: World) -> None:
        self.world = world
        self.leases = self._leases()
        self.numbers = _Numbers(self._numbers())
        self.counts = {number: self._refusals(number) for number in range(len(world.holders))}
        self.tokens = self._tokens()

    def name(self) -> Any:
        world = self.world
        return (
            self._authority(),
            self._filters(),
            tuple(self._program(number) for number in range(len(world.holders))),
            tuple(sorted(map(self._message, world.net))),
            tuple((priority.value, command.program, command.what, self._shown(command),
                   self._age(command.given_ms)) for priority, command in world.inbox),
            tuple((command.program, command.what, self._shown(command), self._since(sender.given_at), sender.stale)
                  for command, sender in world.hand),
            (tuple(sorted(world.robot.parts)), world.robot.autonomous, world.ready,
             self._since(world.robot.moved_at) if world.robot.moving else 0),
        )  # fmt: skip

    # What is in use

    def _leases(self) -> _Order:
        world = self.world
        used = world.leases_in_use() | set(world.authority.holders._ended)
        if world.authority.verifier is not None:
            used.add(world.authority.verifier.lease)
        return _Order(used)

    def _numbers(self) -> Iterable[tuple[bytes, str, int]]:
        world = self.world
        for holder in world.holders:
            signer = holder.client._signer
            if signer is not None:
                yield signer.lease, "commands", signer._commands
                yield signer.lease, "questions", signer._questions
        for command in (*(each for _, each in world.inbox), *(each for each, _ in world.hand)):
            yield command.lease, "commands", command.seq
        for message in world.net:
            if isinstance(message, Command):
                yield message.lease, "commands", message.seq
            elif isinstance(message, Query) and message.lease is not None:
                yield message.lease, "questions", message.seq
        for each in self._known():
            for kind, number in each.numbers.items():
                yield each.verifier.lease, kind, number
        for kind, prover in self._provers():
            yield prover._newest[0], kind, prover._newest[1]

    def _known(self) -> list[Any]:
        holders = self.world.authority.holders
        return [*([holders.current] if holders.current is not None else []), *holders._ended.values()]

    def _provers(self) -> list[tuple[str, Any]]:
        world = self.world
        return [
            ("commands", world.admission._prover),
            *(("questions", each) for each in world.filters.values()),
        ]

    def _refusals(self, number: int) -> tuple[Any, ...]:
        """Name what a program is told of its ended leases, and what it knows of that."""
        world = self.world
        who = world.programs[number].name
        authority = {
            (reason, command): count
            for (whose, command, code, reason, by), count in world.authority._refusals._counts.items()
            if code == Code.LEASE_ENDED and whose == who
        }
        news = self._news_counts(world.news[number], who)
        known = {
            (reason, command): count
            for (whose, command, code, reason), count in world.holders[number].client.news._counts.items()
            if code == Code.LEASE_ENDED and whose == who
        }
        named = []
        for key in {*authority, *news, *known}:
            said, knows = authority.get(key, 0), known.get(key, 0)
            heard = news.get(key, 0) if world.news[number] is not None else said
            if not said == heard == knows:  # else it is as if there were none
                order = _Order((said, heard, knows))
                named.append((order[said], order[heard], order[knows]))
        return tuple(sorted(named))

    @staticmethod
    def _news_counts(control: Control | None, who: str) -> dict[tuple[str, str], int]:
        if control is None:
            return {}
        return {
            (refusal.reason, refusal.command): refusal.count
            for refusal in control.refusals
            if refusal.who == who and refusal.code == Code.LEASE_ENDED
        }

    def _tokens(self) -> _Order:
        world = self.world
        tokens = [holder.client.request.alive or "" for holder in world.holders]
        tokens += [each.alive or "" for each in self._known()]
        tokens += [message.alive for message in world.net if isinstance(message, TokenGone)]
        tokens += [message.alive for message in world.net if isinstance(message, Query)]
        return _Order(tokens)

    # Names of the parts

    def _ago(self, at: float) -> int:
        """Name a time by what is left of it, in hundredths of a second; all that is past is alike."""
        if at in (float("inf"), float("-inf")):
            return 10**6 if at > 0 else 0
        return max(0, round((at - self.world.now) * 100))

    def _since(self, at: float) -> int:
        return min(10**4, round((self.world.now - at) * 100))

    def _age(self, given_ms: float) -> int:
        return min(300, round(self.world.now * 100 - given_ms / 10))

    def _shown(self, command: Command) -> tuple[int, int]:
        return self.leases[command.lease], self.numbers.rank(command.lease, "commands", command.seq)

    def _authority(self) -> Any:
        authority, motion = self.world.authority, self.world.authority.motion
        return (
            authority.machine.state.value, motion.on_its_own, motion.autonomous,
            tuple(sorted(motion.parts)), tuple(sorted(motion.moved)),
            self._ago(motion.stop_at), motion.needs_neutral or "", tuple(map(self._lease, self._known())),
            tuple(authority.latches._in_force), tuple(sorted(authority.latches._released)),
            tuple(sorted(authority.latches._released_fleet)), _stops(tuple(authority.latches._stops)),
        )  # fmt: skip

    def _lease(self, holder: Any) -> Any:
        lease = holder.verifier.lease
        current = self.world.authority.holders.current is holder
        return (
            self.leases[lease], holder.who, current and self._ago(holder.expires_at),
            current and self.tokens[holder.alive or ""], holder.ended or "",
            current and not holder.numbers and self._age(holder.asked_ms),
            tuple((kind, self.numbers.rank(lease, kind, holder.numbers.get(kind, -1)))
                  for kind in ("commands", "questions")),
            round(holder.age._baseline_ms / 100) if current and holder.age._baseline_ms is not None else -1,
        )  # fmt: skip

    def _filters(self) -> Any:
        current = self.world.authority.verifier
        named = []
        for kind, prover in self._provers():
            lease, number = prover._newest
            mine = current is not None and lease == current.lease
            named.append(self.numbers.rank(lease, kind, number) if mine else -1)
        fold = self.world.now - self.world.admission._stopped_at < 0.05
        return (*named, fold)

    def _program(self, number: int) -> Any:
        world, holder = self.world, self.world.holders[number]
        client = holder.client
        signer, waiting = client._signer, client._waiting
        waits = (
            None if waiting is None
            else (waiting.key, self._ago(waiting.asked_at + waiting.timeout_s), self._since(waiting.asked_at))
        )  # fmt: skip
        news = world.news[number]
        return (
            client.state.value,
            signer and (self.leases[signer.lease], self.numbers.rank(signer.lease, "commands", signer._commands),
                        self.numbers.rank(signer.lease, "questions", signer._questions), self._ago(client._expires_at)),
            self._ago(client._due_at) if client.deadline() is not None else 0,
            self._ago(client._wait_until) if client.state.value in _WAITING else 0,
            waits, self.tokens[client.request.alive or ""], holder._token is not None,
            news and (self.leases[news.lease] if news.lease else -1, news.holder == client.request.who),
            self.counts[number],
        )  # fmt: skip

    def _message(self, message: Any) -> Any:
        if isinstance(message, TokenGone):
            return ("token", self.tokens[message.alive])
        waits = self.world.holders[message.program].client._waiting
        if isinstance(message, Command):
            return ("command", message.program, message.what, *self._shown(message),
                    self._age(message.given_ms))  # fmt: skip
        mine = message.question is waits
        if isinstance(message, Reply):
            rank = self.leases[message.lease] if message.lease is not None else -1
            return ("reply", message.program, message.question.key, mine, *message.said, rank,
                    self._age(message.given_ms))  # fmt: skip
        rank, number = 0, 0
        if message.lease is not None:
            rank, number = self.leases[message.lease], self.numbers.rank(message.lease, "questions", message.seq)
        return ("query", message.program, message.question.key, mine, rank, number, self.tokens[message.alive],
                self._age(message.given_ms))  # fmt: skip


_WAITING = ("asking", "paused", "dropped", "recalled", "returning", "wanted", "free")


def _stops(ids: tuple[bytes, ...]) -> tuple[bytes, ...]:
    """Name the ids of the last stops: how often one alone was told does not matter."""
    return ids if len(set(ids)) > 1 else ids[:1]
