"""What Prometheus reads of one gateway: every event of a drive is counted under a word that the code knows."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from tests.e2e.conftest import Bench, until
from tests.e2e.rigs.robots import Robot, position
from tests.ports import free_port
from tests.scraped import samples, scrape, value
from zbridge.control.events import StopCause
from zbridge.control.faults import FaultCode
from zbridge.errors import Code
from zbridge.metrics import FAMILIES

WHO = "evil-driver"
CLOSED = {
    "realm": {"fleet"},
    "robot": {"r1"},
    "direction": {"in", "out"},
    "role": {"hq", "robot"},
    "code": {*Code, *FaultCode},
    "cause": set(StopCause),
    "change": {"acquired", "taken_over", "released", "ended", "latched", "unlatched"},
    "outcome": {"established", "failed", "lost", "accepted", "turned_away"},
    "queue": {"bus_in", "bus_out_states", "bus_out_streams", "robot_out", "hq_out", "replies"},
    "kind": {"pose", "status", "control", "drive", "stop", "unknown", "text", "map", "scan", "mode", "lidar", "raw"},
    "link": {"robot"},
    "protocol": {"tcpudp"},
}


@pytest.fixture
def robot(bench: Bench) -> Robot:
    made = Robot()
    bench.stack.callback(made.close)
    return made


def test_a_drive_its_end_and_every_refusal_are_counted(bench: Bench, robot: Robot) -> None:
    port, fleet = free_port(), bench.fleet
    gateway = bench.serve(robot.port, f'[metrics]\nlisten = "127.0.0.1:{port}"\n')

    def counted(name: str, **labels: str) -> Callable[[], float]:
        def read() -> float:
            try:
                return value(scrape(port), f"zbridge_{name}", **labels)
            except KeyError:
                return 0

        return read

    fleet.put("r1/@cmd/drive", forward=0.5)  # without a lease
    until(counted("refused_total", code="no_lease"), what="the refusal")
    fleet.put("r1/@cmd/no_such_command", b"")
    until(counted("refused_total", code="unsupported"), what="another one")
    fleet.hold("r1", WHO, deadman_s=0.2)
    for _ in range(50):
        robot.send(position(1.0, 2.0, 90.0))
        fleet.put("r1/@cmd/drive", forward=0.5)
        time.sleep(0.01)
    assert counted("lease_held")() == counted("robot_driven")() == 1
    until(counted("stops_total", cause="deadman"), what="the deadman")
    fleet.put("r1/@cmd/stop")
    until(counted("stops_total", cause="command"), what="a stop")
    until(lambda: counted("bus_messages_total", direction="out", kind="pose")() == 50, what="the positions")
    assert counted("bus_messages_total", direction="in", kind="drive")() == 51
    assert counted("bus_messages_total", direction="in", kind="unknown")() == 1
    poses = fleet.seen["fleet/r1/pose"]
    assert counted("bus_bytes_total", direction="out", kind="pose")() > 50 * len(poses[0])
    assert counted("link_bytes_total", role="hq", direction="in")() == 33 + 4 + 50 * 18
    assert 3 <= counted("socket_to_bus_seconds_count")() <= 51
    assert counted("bus_to_socket_seconds_count")() >= 52
    assert 0 < counted("bus_to_socket_seconds_sum")() < 5.0
    assert counted("lease_changes_total", change="acquired")() == 1
    assert counted("robot_connections_total", outcome="established")() == 1
    assert counted("event_loop_lateness_seconds_count")() >= 1
    robot.close()
    until(counted("stops_total", cause="robot_lost"), what="the loss")
    until(counted("robot_connections_total", outcome="failed"), what="an attempt")
    assert_closed(scrape(port))
    assert WHO not in scrape(port)
    assert "no_such_command" not in scrape(port)
    gateway.end()


def assert_closed(text: str) -> None:
    """Every label but versions and states has a value that the code knows; every metric is in the table."""
    known = {family.full_name: set(family.labels) for family in FAMILIES.values()}
    for name, labels in samples(text):
        base = next(each for each in (name, name.rpartition("_")[0]) if each in known)
        given = dict(labels)
        assert set(given) - {"realm", "robot", "le"} == known[base], name
        for label, values in CLOSED.items():
            assert given.get(label, next(iter(values))) in values, (name, given)
