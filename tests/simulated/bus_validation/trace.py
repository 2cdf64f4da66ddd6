"""A trace as data: who takes part, what is done when, and what is read off what was observed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

Finding = float | int | str | bool | None
"""Times in seconds (float) are compared with a range, numbers too; texts and truth values with a set."""


class Step(NamedTuple):
    """Something that is done. at: seconds from the start. who: an agent, a router or a road (``A-router1``)."""

    at: float
    who: str
    what: str
    arguments: tuple[Any, ...] = ()


class Entry(NamedTuple):
    """An observation. at: seconds from the start of the trace."""

    at: float
    who: str
    what: str
    fields: tuple[Any, ...]


class Log(list[Entry]):
    """What was observed."""

    def of(self, who: str, what: str, *fields: Any) -> list[Entry]:
        """Return what an agent observed; fields: what it begins with."""
        return [each for each in self if (each.who, each.what) == (who, what) and each.fields[: len(fields)] == fields]

    def first(self, who: str, what: str, *fields: Any, since: float = 0.0) -> float | None:
        """Return when an agent first observed this, in seconds after ``since``; None: never."""
        return next((each.at - since for each in self.of(who, what, *fields) if each.at >= since), None)

    def numbers(self, who: str, key: str, tag: str) -> list[int]:
        """Return the numbers of the samples that an agent received on a key."""
        return [each.fields[2] for each in self.of(who, "got", key, tag)]


@dataclass(frozen=True)
class Trace:
    """A trace. agents: by name, their router. routers: the second one connects to the first."""

    name: str
    agents: dict[str, str]
    steps: tuple[Step, ...]
    lasts_s: float
    read: Callable[[Log], dict[str, Finding]]
    quick: bool = False
    """Whether the tests play it, too."""

    @property
    def routers(self) -> tuple[str, ...]:
        """The routers that take part."""
        return tuple(sorted({"router1", *self.agents.values()}))

    def steps_of(self, what: str) -> list[Step]:
        """Return the steps of one kind."""
        return [step for step in self.steps if step.what == what]
