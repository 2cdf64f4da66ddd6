"""Conformance of a handover: another process that takes a connection over continues as the one before would."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial
from typing import Any

from zbridge.protocol.plugin import Protocol
from zbridge.simulation.checks.examples import numbers
from zbridge.simulation.checks.finding import CheckFinding
from zbridge.simulation.checks.rehearsal import Rehearsal, Transcript, named, robot_of

CLAIM = "another process that takes the connection over continues as this one would"
GUIDE = "4. A robot that sends by itself: Restarts"
AFTER_S = 1.0


def check_handover(protocol: Protocol, received: list[bytes]) -> CheckFinding:
    """Compare a session that is handed over with one that is not. received: the robot's frames of a whole drive."""
    if not robot_of(protocol).hands_over:
        kind = type(robot_of(protocol)).__qualname__
        why = f"{kind}.hands_over is False: a restart of the gateway drops the connection"
        return CheckFinding.not_checked(CLAIM, why, GUIDE)
    find = partial(_differences, protocol, Transcript(received))
    return CheckFinding.tried(CLAIM, find, "the state of both objects, restored", GUIDE)


def _differences(protocol: Protocol, recording: Transcript) -> list[str]:
    half = len(recording.received) // 2
    stayed, handed_over = Rehearsal(protocol, recording), Rehearsal(protocol, recording)
    for each in (stayed, handed_over):
        each.play(recording.received[:half])
    handed_over.hand_over()
    shown, written = zip(*(_rest(each, recording.received[half:]) for each in (stayed, handed_over)), strict=True)
    problems = [f"{name} shows {new}, not {old}" for name, old, new in _unlike(*shown)]
    problems += [
        f"{_named(protocol, new)} is written, not {_named(protocol, old)}"
        for _, old, new in _unlike(*map(_pairs, written))
    ]
    return problems


def _rest(rehearsal: Rehearsal, frames: list[bytes]) -> tuple[list[tuple[str, Any]], list[bytes]]:
    """Play the rest; return the numbers that were shown, and the frames that were written."""
    rehearsal.shown.clear()
    written = rehearsal.play(frames)
    written += rehearsal.run(AFTER_S)
    return [(name, round(value, 6)) for name, value in numbers(rehearsal.shown)], written


def _pairs(written: list[bytes]) -> list[tuple[str, Any]]:
    return [("frame", frame) for frame in written]


def _unlike(one: list[tuple[str, Any]], other: list[tuple[str, Any]]) -> Iterator[tuple[str, Any, Any]]:
    """Yield the first difference of each name."""
    seen: set[str] = set()
    for (name, old), (other_name, new) in itertools.zip_longest(one, other, fillvalue=("nothing", None)):
        known = name if name != "nothing" else other_name
        same = (name, str(old)) == (other_name, str(new))  # a NaN equals itself here
        if not same and known not in seen:
            seen.add(known)
            yield known, old, new


def _named(protocol: Protocol, frame: bytes | None) -> str:
    return named(protocol, frame) if frame is not None else "nothing"
