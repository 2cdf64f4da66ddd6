"""The last line of doctor, and its exit code."""

from __future__ import annotations

import pytest

from zbridge.doctor.findings import Finding, Layer, Verdict, conclusion, error, exit_code, note, warning

FULL = warning(Layer.DISK, "disk_low", "little left", "make room")
LOST = error(Layer.ROBOT, "robot_offline", "offline", "switch it on")
VIEWER = note(Layer.ROLE, "x", "only a viewer", "ask for more")
SKIPPED = Finding(Layer.CLOCKS, Verdict.SKIPPED, "skipped", "not checked: bus failed")


@pytest.mark.parametrize(
    ("findings", "line"),
    [
        ([], "no failure found"),
        ([note(Layer.PROCESS, "y", "new"), VIEWER], "no failure found, but: role: only a viewer -> ask for more"),
        ([note(Layer.DRIVING, "refused_held", "once")], "no failure found"),
        ([FULL], "disk: little left -> make room"),
        ([FULL, LOST, SKIPPED], "robot: offline -> switch it on (1 more finding above)"),
        (
            [LOST, error(Layer.PROCESS, "descriptors", "none left")],
            "robot: offline -> switch it on (1 more finding above)",
        ),
    ],
)
def test_the_last_line_names_the_first_of_the_worst_layers_and_what_to_do(findings: list[Finding], line: str) -> None:
    assert conclusion(findings) == line


def test_the_exit_code_follows_the_verdict_that_was_asked_for() -> None:
    assert [exit_code([FULL], each) for each in (Verdict.WARNING, Verdict.ERROR)] == [1, 0]
    assert [exit_code([LOST], each) for each in (Verdict.WARNING, Verdict.ERROR)] == [1, 1]
    assert [exit_code([SKIPPED, note(Layer.ROLE, "x", "y")], each) for each in (Verdict.WARNING, Verdict.ERROR)] == [
        0,
        0,
    ]
