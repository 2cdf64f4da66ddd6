"""What an examination reports: findings by layer, the worst one, and the exit code. Sans-IO."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum, StrEnum

import msgspec


class Verdict(IntEnum):
    """How bad a finding is. SKIPPED: not checked, because something before it failed."""

    OK = 0
    NOTE = 1
    SKIPPED = 2
    WARNING = 3
    ERROR = 4


class Layer(StrEnum):
    """What is examined, in the order from a program to its robot."""

    CONFIGURATION = "configuration"
    NAMES = "names"
    CERTIFICATE = "certificate"
    ADDRESS = "address"
    BUS = "bus"
    ROLE = "role"
    GATEWAY = "gateway"
    ROBOT = "robot"
    DRIVING = "driving"
    LISTENERS = "listeners"
    CLOCKS = "clocks"
    DISK = "disk"
    PROCESS = "process"
    SUPERVISOR = "supervisor"


PAST = "refused_"
"""The codes of what was refused since the gateway started begin with this; it need not matter now."""
_FIRST = (Layer.ROLE, Layer.DRIVING, Layer.ROBOT, Layer.GATEWAY, Layer.LISTENERS)
"""The layers whose notes answer what people ask most: why may I not drive."""


class Finding(msgspec.Struct, frozen=True):
    """One result. code: for programs; text, remedy: for people. robot: None if it concerns all."""

    layer: Layer
    verdict: Verdict
    code: str
    text: str
    remedy: str | None = None
    robot: str | None = None

    @property
    def failed(self) -> bool:
        """Whether what depends on this cannot be checked."""
        return self.verdict is Verdict.ERROR


def ok(layer: Layer, text: str, code: str = "ok") -> Finding:
    """Make a finding without trouble."""
    return Finding(layer, Verdict.OK, code, text)


def note(layer: Layer, code: str, text: str, remedy: str | None = None) -> Finding:
    """Make a finding that is worth knowing, and no trouble by itself."""
    return Finding(layer, Verdict.NOTE, code, text, remedy)


def warning(layer: Layer, code: str, text: str, remedy: str | None = None) -> Finding:
    """Make a finding of something that works, but not as it should, or not for long."""
    return Finding(layer, Verdict.WARNING, code, text, remedy)


def error(layer: Layer, code: str, text: str, remedy: str | None = None) -> Finding:
    """Make a finding of something that does not work."""
    return Finding(layer, Verdict.ERROR, code, text, remedy)


def worst(findings: Iterable[Finding]) -> Finding | None:
    """Return the first of the worst findings: the layer where the path ends; None if there is no trouble."""
    found = [each for each in findings if each.verdict in (Verdict.WARNING, Verdict.ERROR)]
    return max(found, key=lambda each: each.verdict, default=None)  # the first of several


def conclusion(findings: Iterable[Finding]) -> str:
    """Return the last line: the layer that fails and what to do, or that nothing is wrong."""
    findings = list(findings)
    trouble = worst(findings)
    if trouble is not None:
        more = sum(each.verdict in (Verdict.WARNING, Verdict.ERROR) for each in findings) - 1
        return _line(trouble) + (f" ({more} more finding{'s' if more > 1 else ''} above)" if more else "")
    robots = len({each.robot for each in findings if each.robot is not None})
    well = f"no failure found in {robots} robots" if robots > 1 else "no failure found"
    notes = [each for each in findings if each.verdict is Verdict.NOTE and not each.code.startswith(PAST)]
    most = min(notes, key=lambda each: _FIRST.index(each.layer) if each.layer in _FIRST else len(_FIRST), default=None)
    return f"{well}, but: {_line(most)}" if most is not None else well


def _line(finding: Finding) -> str:
    whose = f"{finding.robot}: " if finding.robot else ""
    return f"{whose}{finding.layer}: {finding.text}" + (f" -> {finding.remedy}" if finding.remedy else "")


def exit_code(findings: Iterable[Finding], fail_on: Verdict) -> int:
    """Return 1 if there is a finding of this verdict or a worse one, else 0."""
    return int(any(each.verdict >= fail_on for each in findings))
