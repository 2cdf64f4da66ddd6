"""Prints the findings of an examination, for people or as JSON."""

from __future__ import annotations

import msgspec
from rich.text import Text

from zbridge.cli.terminal import console
from zbridge.doctor.findings import Finding, Verdict
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown

_STYLES = dict(zip(Verdict, ("green", "", "dim", "yellow", "red"), strict=True))
_VERDICT, _LAYER = 8, 14
"""Characters of the columns."""


class Printer:
    """Prints each finding when it is found. verbose: what is well, too. several: name the robots."""

    def __init__(self, *, as_json: bool, verbose: bool, several: bool) -> None:
        self._as_json = as_json
        self._verbose = verbose
        self._several = several
        self._skipped: list[Finding] = []

    def show(self, finding: Finding) -> None:
        """Print a finding."""
        if self._as_json:
            fields = msgspec.to_builtins(finding) | {"verdict": finding.verdict.name.lower()}
            console.print(to_json(fields))
            return
        if self._skipped and (finding.text, finding.robot) != (self._skipped[0].text, self._skipped[0].robot):
            self._show_skipped()
        if finding.verdict is Verdict.SKIPPED:
            self._skipped.append(finding)
        elif finding.verdict is not Verdict.OK or self._verbose:
            self._show(finding)

    def _show_skipped(self) -> None:
        """Print what was skipped for one reason in one line."""
        skipped, self._skipped = self._skipped, []
        layers = ", ".join(each.layer for each in skipped)
        self._show(msgspec.structs.replace(skipped[0], text=f"{layers}: {skipped[0].text}"), layer="")

    def _show(self, finding: Finding, layer: str | None = None) -> None:
        whose = f"{finding.robot}: " if self._several and finding.robot else ""
        line = Text(finding.verdict.name.lower().ljust(_VERDICT), _STYLES[finding.verdict])
        line.append((finding.layer if layer is None else layer).ljust(_LAYER), "")
        line.append(shown(f"{whose}{finding.text}"), "")
        console.print(line)
        if finding.remedy and finding.verdict is not Verdict.OK:
            console.print(Text(" " * (_VERDICT + _LAYER) + shown(f"-> {finding.remedy}"), ""))

    def conclude(self, text: str) -> None:
        """Print the last line."""
        if self._skipped:
            self._show_skipped()
        console.print(shown(text))
