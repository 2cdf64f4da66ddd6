"""One line of the report of the conformance kit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from zbridge.errors import describe

GUIDE = "docs/how-to/add-a-protocol.md"
_SHOWN = 3


class SimulatorFault(Exception):
    """The simulated robot raised an exception, or ended; the text is complete."""


class CheckFinding(msgspec.Struct, frozen=True):
    """Whether one claim holds. ``problem`` None: it does. ``note``: a remark for the reader.

    unchecked: why the claim could not be checked; it then neither holds nor fails. guide: the paragraph of the guide
    that explains the claim, as ``5. Commands: Stops``.
    """

    claim: str
    problem: str | None = None
    note: str = ""
    unchecked: str | None = None
    guide: str = ""

    @classmethod
    def of(cls, claim: str, problems: list[str], note: str = "", guide: str = "") -> CheckFinding:
        """Make the finding of a claim that was tested in many ways; it shows the first problems."""
        if not problems:
            return cls(claim, None, note, guide=guide)
        more = f" (and {len(problems) - _SHOWN} more)" if len(problems) > _SHOWN else ""
        return cls(claim, "; ".join(problems[:_SHOWN]) + more, note, guide=guide)

    @classmethod
    def not_checked(cls, claim: str, why: str, guide: str = "") -> CheckFinding:
        """Make the finding of a claim that could not be checked."""
        return cls(claim, unchecked=why, guide=guide)

    @classmethod
    def tried(
        cls, claim: str, find: Callable[[], str | list[str] | CheckFinding | None], expected: str = "", guide: str = ""
    ) -> CheckFinding:
        """Make the finding of a check that returns a problem, several, or none, or raises an exception.

        expected: what should have happened instead.
        """
        try:
            found = find()
        except Exception as error:  # whatever the protocol's own code raises is a finding
            return cls(claim, raised(error, expected), guide=guide)
        if isinstance(found, CheckFinding):
            return msgspec.structs.replace(found, guide=found.guide or guide)
        return cls.of(claim, found, guide=guide) if isinstance(found, list) else cls(claim, found, guide=guide)

    def __str__(self) -> str:
        note = f" ({self.note})" if self.note else ""
        if self.unchecked is not None:
            return f"?     {self.claim}{note}\n      not checked: {self.unchecked}"
        if self.problem is None:
            return f"ok    {self.claim}{note}"
        guide = f"\n      see {self.guide!r} in {GUIDE}" if self.guide else ""
        return f"FAIL  {self.claim}{note}\n      {self.problem}{guide}"


def brief(message: Any) -> str:
    """Show a message without the fields that have their defaults: ``Drive(forward=0.5)``."""
    fields = {field.name: field.default for field in msgspec.structs.fields(message)}
    given = {name: getattr(message, name) for name, default in fields.items() if getattr(message, name) != default}
    return f"{type(message).__name__}({', '.join(f'{name}={value!r}' for name, value in given.items())})"


def raised(error: BaseException, expected: str = "") -> str:
    """Return what the protocol's own code raised, in which class and line, and what was expected instead."""
    if isinstance(error, SimulatorFault):
        return str(error)
    return f"{describe(error)}; expected {expected}" if expected else describe(error)
