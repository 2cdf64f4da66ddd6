"""What a check of the conformance kit says: one claim, and why it does not hold where it does not."""

from __future__ import annotations

import msgspec

from zbridge.errors import describe


class Finding(msgspec.Struct, frozen=True):
    """One line of the report. ``problem`` None: the claim holds. ``note``: what a reader should know of it."""

    claim: str
    problem: str | None = None
    note: str = ""

    @classmethod
    def of(cls, claim: str, problems: list[str], note: str = "") -> Finding:
        """Make the finding of a claim that was tried in many ways: the first problems are shown."""
        if not problems:
            return cls(claim, None, note)
        more = f" (and {len(problems) - _SHOWN} more)" if len(problems) > _SHOWN else ""
        return cls(claim, "; ".join(problems[:_SHOWN]) + more, note)

    @classmethod
    def broken(cls, claim: str, error: BaseException, expected: str = "") -> Finding:
        """Make the finding of a claim whose check ended with an exception; ``expected``: what should have come."""
        return cls(claim, raised(error, expected))

    def __str__(self) -> str:
        note = f" ({self.note})" if self.note else ""
        return (
            f"ok    {self.claim}{note}" if self.problem is None else f"FAIL  {self.claim}{note}\n      {self.problem}"
        )


def raised(error: BaseException, expected: str) -> str:
    """Say what the protocol's own code raised, in which class and line, and what was expected instead."""
    return f"{describe(error)}; expected {expected}" if expected else describe(error)


_SHOWN = 3
