"""What is wrong with a robot, its links, its control and its cmd_vel, as ROS's diagnostics. Sans-IO."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from zbridge.fleet.messages import Control, Status

OK, WARN, ERROR, STALE = range(4)
"""diagnostic_msgs/DiagnosticStatus."""
_LONGEST = 200
"""Characters of a text that strangers may have written."""
MOST_VALUES = 32
"""Values of one entry."""
_UNUSABLE: Mapping[str, int] = {"established": OK, "connecting": WARN, "handshaking": WARN, "closing": WARN}


class Diagnostic(msgspec.Struct, frozen=True):
    """One status. values: pairs of key and value."""

    level: int
    name: str
    message: str
    values: Sequence[tuple[str, str]] = ()


def entries_of(robot: str, status: Status | None, control: Control | None) -> list[Diagnostic]:
    """Return the entries of a robot's state, links, faults, control and refusals, as its gateway reports them."""
    state = [_state(robot, status), _links(robot, status), _faults(robot, status)]
    return [*state, _control(robot, control), _refusals(robot, control)]


def _state(robot: str, status: Status | None) -> Diagnostic:
    name = f"{robot}: state"
    if status is None:
        return Diagnostic(STALE, name, "no gateway reports")
    facts = (("protocol", status.protocol), ("dialect", status.dialect), ("version", status.version))
    values = [(key, value) for key, value in facts if value]
    if status.features:
        values.append(("features", ", ".join(status.features)))
    text = status.state + (f": {status.reason}" if status.reason else "")
    return Diagnostic(_UNUSABLE.get(status.state, ERROR), name, cut(text), values)


def _faults(robot: str, status: Status | None) -> Diagnostic:
    name, faults = f"{robot}: faults", status.faults if status is not None else ()
    if not faults:
        return Diagnostic(STALE if status is None else OK, name, "no gateway reports" if status is None else "none")
    values = [(fault.code, cut(f"{fault.text} ({fault.count})")) for fault in faults[:MOST_VALUES]]
    return Diagnostic(WARN, name, cut(", ".join(fault.code for fault in faults)), values)


def _links(robot: str, status: Status | None) -> Diagnostic:
    links = status.links if status is not None else ()
    down = [link for link in links if link.state != "established"]
    values = [(f"{link.name} {link.peer}", cut(f"{link.state} {link.reason or ''}".strip())) for link in links]
    text = f"{len(links) - len(down)} of {len(links)} links established"
    return Diagnostic(WARN if down else OK if links else STALE, f"{robot}: links", text, values[:MOST_VALUES])


def _control(robot: str, control: Control | None) -> Diagnostic:
    name = f"{robot}: control"
    if control is None:
        return Diagnostic(STALE, name, "no gateway reports")
    values = [("holder", cut(control.holder))] if control.holder else []
    values += [(f"latch {latch.id.hex()[:8]}", cut(latch.described)) for latch in control.latches]
    text = f"held by {control.holder}" if control.holder else control.state
    if control.latches:
        text = control.latches[-1].described
    return Diagnostic(OK if control.state in ("free", "held") else WARN, name, cut(text), values[:MOST_VALUES])


def _refusals(robot: str, control: Control | None) -> Diagnostic:
    refusals = control.refusals if control is not None else ()
    values = [
        (cut(f"{refusal.command} of {refusal.who or 'somebody'}"), cut(f"{refusal.reason} ({refusal.count})"))
        for refusal in refusals
    ]
    text = f"{sum(refusal.count for refusal in refusals)} commands refused lately"
    return Diagnostic(WARN if refusals else OK, f"{robot}: refusals", text, values[:MOST_VALUES])


def cut(text: str) -> str:
    """Shorten a text that strangers may have written, and keep what is printable of it."""
    return "".join(letter if letter.isprintable() else "?" for letter in text[:_LONGEST])
