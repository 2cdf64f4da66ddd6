"""What every judge records: violations, events and the cause of its death. Sans-IO; knows no protocol.

A judge is a simulated peer as fragile as the legacy ones: it records each violation of what the page of its protocol
demands, and dies of what kills or cripples the legacy programs. Section names in its docstrings are those of that
page, or of the page that they name. Judges share their scaffold (this module, ``fragile``, ``hq_program``, ``sockets``
and ``timing``), and no code with the gateway that they judge, so that an error there cannot hide here.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar, Generic, NoReturn, TypeVar

M = TypeVar("M")


class Ended(Exception):
    """Raised to end a judge's tasks: it died, or has nothing left to do. Without a text the end is no event."""


class Judge:
    """The records of one judge."""

    KEEP: ClassVar[int] = 10_000
    """Most entries of each list."""

    def __init__(self) -> None:
        self.note: Callable[[str], object] | None = None
        """Called with each violation."""
        self.violations: list[str] = []
        self.events: list[str] = []
        self.received: deque[Any] = self._rows()
        """A row for each message, valid or not: monotonic seconds first, then what the protocol adds."""
        self.alive = True
        self.death = ""
        """The violation that killed it."""

    def _rows(self) -> deque[Any]:
        """Make a list that keeps its newest entries."""
        return deque(maxlen=self.KEEP)

    def _violate(self, text: str) -> None:
        """Record a violation of the protocol page; beyond ``KEEP`` entries only notify."""
        if len(self.violations) < self.KEEP:
            self.violations.append(text)
        if self.note is not None:
            self.note(text)

    def _event(self, text: str) -> None:
        """Record an event that is no violation; dropped beyond ``KEEP`` entries."""
        if len(self.events) < self.KEEP:
            self.events.append(text)

    def _die(self, text: str) -> NoReturn:
        """Record a violation that kills a legacy program; raise Ended."""
        self.alive, self.death = False, text
        self._violate(text)
        raise Ended(f"died: {text}")

    def _report(self, problem: str, raw: str, *, deadly: bool = False) -> bool:
        """Record what is wrong with a message, if anything, and return whether there is. Raise Ended if it is fatal."""
        if deadly:
            self._die(f"{problem}: {raw}")
        if problem:
            self._violate(f"{problem}: {raw}")
        return bool(problem)


class Chances(dict[str, random.Random]):
    """A stream of random numbers for each random choice of a peer, by name: they do not influence each other."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self._seed = seed

    def __missing__(self, name: str) -> random.Random:
        return self.setdefault(name, random.Random(f"{self._seed} {name}"))


class MessageReader(Generic[M]):
    """Cuts the stream of a peer into messages of the judge; a protocol says how long a message is and what it means."""

    def __init__(self) -> None:
        self.rest = b""
        """The part of a message at the end of what was read."""
        self.dead = False
        """True once nothing more can be read."""

    def take(self, data: bytes) -> list[M]:
        """Read the messages that end in ``data``."""
        messages: list[M] = []
        self.rest += data
        while self.rest and not self.dead:
            if problem := self._lost(self.rest):
                messages.append(self._lose(problem, after=len(messages)))
            elif len(self.rest) < (size := self._size(self.rest)):
                break
            else:
                raw, self.rest = self.rest[:size], self.rest[size:]
                messages.append(self._read(raw))
        return messages

    def _lost(self, data: bytes) -> str:
        """Return why the length of the message at the start of ``data`` is unknowable, empty if it is not."""
        raise NotImplementedError

    def _lose(self, problem: str, after: int) -> M:
        """Return a message for what cannot be framed, ``after`` others in this read; set ``dead`` or clear ``rest``."""
        raise NotImplementedError

    def _size(self, data: bytes) -> int:
        """Return the bytes of the message, or as many as are needed to know."""
        raise NotImplementedError

    def _read(self, raw: bytes) -> M:
        raise NotImplementedError


def show(data: bytes, limit: int = 60) -> str:
    """Format the first ``limit`` bytes in hex."""
    return shorten(data[:limit].hex(" "), data, limit)


def shorten(shown: str, data: bytes, limit: int) -> str:
    """Complete ``shown``, which is how the first ``limit`` bytes of ``data`` are written."""
    rest = f"... ({len(data)} bytes)" if len(data) > limit else ""
    return (shown or "(no bytes)") + rest
