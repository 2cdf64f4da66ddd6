"""Which rows of the tables of ``state-tables.md``, ``refusals.md`` and ``failures.md`` a run reached, and how often.

The tables of the machines are what the code executes: each is replaced by one that counts its inputs. The other rows
are counted by what the checker saw.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from typing import Any
from unittest.mock import patch

from zbridge.control.authority_machine import AuthorityMachine
from zbridge.errors import Code
from zbridge.hq.intent import Intent
from zbridge.lease.lease_client import LeaseClient
from zbridge.robot.ownership import Ownership

MACHINES: tuple[Any, ...] = (AuthorityMachine, LeaseClient, Intent, Ownership)
EVENTS = {
    "the client is killed": "client: kill",
    "the client is frozen": "client: pause",
    "the client is cut off": "client: cut",
    "the client ends without release": "client: end",
    "somebody takes over": "lease ended: superseded",
    "somebody stops": "lease ended: stop",
    "the bus is cut": "lease ended: bus lost",
    "the router is restarted": "fault router",
    "the gateway is ended": "gateway: end",
    "the gateway is killed": "gateway: kill",
    "the gateway resumes after it was frozen": "gateway: pause",
    "the machine of the gateway is suspended": "fault suspend",
    "the wall clock jumps": "fault jump",
    "the program is frozen": "HQ program: pause",
    "the program is unplugged": "HQ program: cut",
    "the program closes": "HQ program: leave",
    "the listener is killed": "listener: kill",
    "the listener is frozen": "listener: pause",
    "the listener is ended": "listener: end",
    "somebody on the bus repeats what was overheard": "fault forge",
    "the robot's program stalls": "robot: pause",
    "the robot's link is cut": "robot: cut",
    "the robot's link is stalled": "a link was stalled",
    "a gateway starts, and another one claims the robot": "Ownership: another gateway, or no bus",
    "two serve one robot, and meet": "Ownership: a better claim, while connected",
    "the other one leaves a moving robot": "a gateway left a moving robot to another one",
    "the owner is gone, and the other one serves the robot": "a gateway was left alone",
}
"""The rows of ``failures.md`` that the simulation has, and what counts them."""


class _Row(dict[Any, Any]):
    """A row of a table that counts what is looked up in it."""

    def __init__(self, machine: str, row: Any, counts: Counter[str]) -> None:
        super().__init__(row)
        self._machine, self._counts = machine, counts

    def get(self, key: Any, default: Any = None) -> Any:
        found = super().get(key, default)
        if found is not None:
            self._counts[f"{self._machine}: {key.value}"] += 1
        return found

    def __getitem__(self, key: Any) -> Any:
        self._counts[f"{self._machine}: {key.value}"] += 1
        return super().__getitem__(key)


@contextlib.contextmanager
def counted(counts: Counter[str]) -> Iterator[None]:
    """Count the inputs of all machines meanwhile."""
    with contextlib.ExitStack() as stack:
        for machine in MACHINES:
            table = {state: _Row(machine.__name__, row, counts) for state, row in machine.TABLE.items()}
            stack.enter_context(patch.object(machine, "TABLE", table))
        yield


def table(counts: Counter[str]) -> list[tuple[str, str, int]]:
    """Give each row: its table, what it is, and how often it was reached."""
    rows = []
    for machine in MACHINES:
        inputs = {said.value: None for row in machine.TABLE.values() for said in row}
        rows += [(machine.__name__, said, counts[f"{machine.__name__}: {said}"]) for said in inputs]
    rows += [("refused", code.value, counts[f"refused {code.value}"]) for code in Code]
    return rows + [("what happens", name, counts[key]) for name, key in EVENTS.items()]
