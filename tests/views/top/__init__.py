"""Robots for the tests of ``zbridge top``, on a fake bus."""

from __future__ import annotations

from typing import Any

from tests.fake_bus import FakeBus
from zbridge.client.fleet_model import SILENT_S, FleetModel, RobotEntry
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, Status
from zbridge.fleet.processes import ProcessStats, Stats
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.views.rows import RobotRow, RowState, read_rows

ESTABLISHED = Status("established", protocol="tcpudp", version="1.3", host="hub")
EVIL = "\x1b[31m[bold]evil[/bold]\nline"
EVIL_SHOWN = r"\x1b[31m[bold]evil[/bold]\nline"


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def put(bus: FakeBus, robot: str, topic: Topic, message: FleetMessage) -> None:
    bus.publisher(KeySpace("fleet", robot).key(topic.path), topic).put(payloads.encode(message))


def stats(cpu: float = 0.02, memory_mb: int | None = 40, **fields: Any) -> Stats:
    proportional = memory_mb * 1_000_000 if memory_mb is not None else None
    process = ProcessStats("hub", 7, "0.1.0", cpu=cpu, resident_bytes=90_000_000, proportional_bytes=proportional)
    return Stats(process, **{"rates": {"pose": 20.0, "scan": 10.5}, "gaps": 2, "refused": 3, **fields})


def serve(bus: FakeBus, robot: str, said: Stats | None = None, control: Control | None = None) -> None:
    """Publish what a healthy gateway does."""
    bus.announce(f"fleet/{robot}/@alive/gateway")
    publish(bus, robot, said, control)


def publish(bus: FakeBus, robot: str, said: Stats | None = None, control: Control | None = None) -> None:
    put(bus, robot, topics.STATUS, ESTABLISHED)
    put(bus, robot, topics.CONTROL, control or Control("free"))
    put(bus, robot, topics.STATS, said or stats())


def opened(bus: FakeBus) -> tuple[FleetModel, Clock]:
    """Open a model that has listened for long enough to know who is silent."""
    clock = Clock()
    model = FleetModel(bus.join("watcher"), "fleet", clock=clock)
    model.open()
    clock.now += SILENT_S
    return model, clock


def row_of(model: FleetModel, robot: str, *, connected: bool = True) -> RobotRow:
    return next(row for row in read_rows(model, connected=connected) if row.name == robot)


def entry_of(model: FleetModel, robot: str) -> RobotEntry:
    return model.robots[robot]


def rows(count: int, **fields: Any) -> list[RobotRow]:
    """Make rows of robots that are all well."""
    return [
        RobotRow(
            **{"name": f"r{number}", "state": RowState.ESTABLISHED, "host": "hub", "protocol": "tcpudp 1.3", **fields}
        )
        for number in range(count)
    ]
