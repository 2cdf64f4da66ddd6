"""State machines, drawn from the tables that the code executes.

Inputs that lead from one state to the same next state share an arrow. Inputs that leave the state as it is are left
out. An input that leads from all states of a group to the same state is drawn once, from the group's frame.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from enum import Enum
from typing import Any, NamedTuple

from docs.diagrams.dot import Graph
from docs.diagrams.svg import Kind
from gateways.tcpudp.session import hq_role, robot_role
from zbridge.control.authority_machine import AuthorityMachine
from zbridge.lease.lease_client import LeaseClient
from zbridge.lease.stick import Stick
from zbridge.protocol.session_states import TRANSITIONS
from zbridge.robot.ownership import Ownership

Table = Mapping[Any, Mapping[Any, Any]]
"""``{state: {input: (action, next state)}}``, or ``{state: {input: next state}}``."""
Arrows = dict[tuple[Any, Any], list[Any]]
"""The inputs that lead from one state to another."""


class Machine(NamedTuple):
    """A table, and how it is drawn.

    what: whose states they are. groups: the states in a frame, by its label. layout: for dot. tail: the state of a
    group that ranks in place of its frame. below: the frame with its label at the bottom. level: the states between
    which an arrow does not affect the ranks.
    """

    table: Table
    what: str
    groups: Mapping[str, tuple[str, ...]] = {}
    layout: str = "nodesep=0.35, ranksep=0.45"
    tail: int = 0
    below: str = ""
    level: tuple[tuple[str, str], ...] = ()


_USABLE, _STICK = ("held", "checking", "doubted"), ("idle", "asking", "holding")
MACHINES = {
    "authority": Machine(
        AuthorityMachine.TABLE,
        "a robot's lease, at its gateway",
        {"no lease": ("free", "stopped"), "a program has the lease": ("held", "moving", "needs neutral")},
        tail=-1,
        below="no lease",
        level=(("free", "stopped"), ("latched", "stopped")),
    ),
    "lease-client": Machine(LeaseClient.TABLE, "a lease, in a program", {"commands may be sent": _USABLE}),
    "stick": Machine(
        Stick.TABLE,
        "a stick and its lease",
        {"motion counts": _STICK, "motion is refused": tuple(f"{state} needing neutral" for state in _STICK)},
        below="motion is refused",
    ),
    "ownership": Machine(Ownership.TABLE, "a gateway that serves a robot, or wants to"),
    "session": Machine(
        TRANSITIONS,
        "a session with a robot or an HQ program",
        {"not closing yet": ("connecting", "handshaking", "established")},
        "rankdir=LR, nodesep=0.3, ranksep=0.3",
        tail=-1,
    ),
    "handshake-robot": Machine(hq_role.TABLE, "the TCP/UDP handshake with a robot (numbers are packet ids)"),
    "handshake-hq": Machine(robot_role.TABLE, "the TCP/UDP handshake with an HQ program (numbers are packet ids)"),
}
"""The machines, by the names of their diagrams."""
KINDS: dict[str, Kind] = {
    **dict.fromkeys(("needs neutral", "needing neutral"), "program"),
    **dict.fromkeys(("held", "checking", "doubted", "holding", "owning", "established"), "gateway"),
    **dict.fromkeys(("stopped", "latched"), "stop"),
    "moving": "robot",
}
"""The kind of a state by how its words begin or end: the lease, the robot or the session is there; and so on."""


def draw(machine: Machine) -> Graph:
    """Draw one machine."""
    what, states = machine.what, list(machine.table)
    graph = Graph(f"States of {what}", f"The states of {what}, and what leads from one to another.", machine.layout)
    arrows = transitions(machine.table)
    for state in states:
        graph.node(state.name, state_lines(state), kind_of(state.value), first=state is states[0])
    for label, values in machine.groups.items():
        members = [state for state in states if state.value in values]
        graph.cluster(label, [state.name for state in members], below=label == machine.below)
        for after, inputs in _shared(arrows, members).items():
            graph.edge(members[machine.tail].name, after.name, _lines(inputs), label)
    for (state, after), inputs in arrows.items():
        if inputs:
            graph.edge(state.name, after.name, _lines(inputs), orders=(state.value, after.value) not in machine.level)
    return graph


def transitions(table: Table) -> Arrows:
    """Return the inputs that lead from each state to another one."""
    found: Arrows = {}
    for state, row in table.items():
        for given, entry in row.items():
            after = entry[1] if isinstance(entry, tuple) else entry
            if after not in (None, state):
                found.setdefault((state, after), []).append(given)
    return found


def state_lines(state: Enum) -> list[str]:
    """Return what a state is labelled with: its words, below the name of a step of a handshake."""
    named = isinstance(state, hq_role.HqStep | robot_role.RobotStep)
    return [*([state.name] if named else []), *textwrap.wrap(state.value, 26)]


def kind_of(words: str) -> Kind:
    """Return the kind of a state."""
    return next((kind for word, kind in KINDS.items() if words.startswith(word) or words.endswith(word)), "plain")


def _shared(arrows: Arrows, members: list[Any]) -> dict[Any, list[Any]]:
    """Take the inputs out that lead from every member of a group to the same state outside it."""
    shared = {}
    for after in dict.fromkeys(after for state, after in arrows if state in members and after not in members):
        rows = [arrows.get((member, after), []) for member in members]
        if common := [given for given in rows[0] if all(given in row for row in rows)]:
            shared[after] = common
        for row in rows:
            row[:] = [given for given in row if given not in common]
    return shared


def _lines(inputs: list[Any]) -> list[str]:
    return [line for given in inputs for line in textwrap.wrap(given.value, 34)]
