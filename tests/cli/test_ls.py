"""``zbridge ls``: what gateways say of themselves, one line for each robot."""

from __future__ import annotations

import json

import pytest

from tests.fake_bus import FakeBus
from zbridge.bus import Bus, BusSettings
from zbridge.cli.bus import list_robots
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, Latch, Status
from zbridge.fleet.processes import ProcessStats, Stats
from zbridge.fleet.topics import KeySpace, Topic

pytestmark = pytest.mark.jumping
NOWHERE = BusSettings(connect=("tcp/127.0.0.1:1",), multicast=False)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> FakeBus:
    """Three gateways: of a robot that ann drives, of one that bob has latched, and one that says nothing yet."""
    bus = FakeBus("robot")

    async def open_bus(*_: object, **__: object) -> Bus:
        return bus.join("program")

    def put(robot: str, topic: Topic, message: FleetMessage) -> None:
        bus.publisher(KeySpace("fleet", robot).key(topic.path), topic).put(payloads.encode(message))

    monkeypatch.setattr("zbridge.client.open_bus", open_bus)
    for robot in ("r3", "r1", "r2"):
        bus.announce(f"fleet/{robot}/@alive/gateway")
    put("r1", topics.STATUS, Status("established", host="hub", protocol="tcpudp", version="1.3"))
    put("r1", topics.CONTROL, Control("held", holder="ann"))
    put("r1", topics.STATS, Stats(ProcessStats("hub", 7, "0.1.0"), {"pose": 20.0}))
    put("r2", topics.STATUS, Status("offline", reason="no route to host"))
    put("r2", topics.CONTROL, Control("latched", latches=(Latch(b"1" * 16, "bob", "wet floor"),)))
    return bus


async def test_each_robot_is_listed_with_its_driver_or_who_latched_it(
    bus: FakeBus, capsys: pytest.CaptureFixture[str]
) -> None:
    await list_robots(NOWHERE, "fleet", as_json=False)
    titles, *rows = capsys.readouterr().out.splitlines()
    assert titles.split() == ["robot", "state", "driver", "host", "protocol", "version", "features", "reason"]
    assert rows[0].split() == ["r1", "established", "ann", "hub", "tcpudp", "1.3"]
    assert rows[1].split() == [
        *("r2", "offline", "latched", "by", "bob"),
        *("(wet", "floor)", "no", "route", "to", "host"),
    ]
    assert rows[2].split() == ["r3", "?", "the", "gateway", "has", "published", "no", "status", "yet"]


async def test_json_has_the_fields_of_status_and_what_the_gateway_says_besides(
    bus: FakeBus, capsys: pytest.CaptureFixture[str]
) -> None:
    await list_robots(NOWHERE, "fleet", as_json=True)
    r1, r2, r3 = map(json.loads, capsys.readouterr().out.splitlines())
    assert (r1["robot"], r1["state"], r1["protocol"], r1["driver"]) == ("r1", "established", "tcpudp", "ann")
    assert (r1["control"]["holder"], r1["stats"]["rates"], r1["stats"]["process"]["pid"]) == ("ann", {"pose": 20.0}, 7)
    assert (r2["driver"], r2["control"]["latches"][0]["id"], r2["stats"]) == (None, 16 * "31", None)
    assert r3 == {"robot": "r3", "state": None, "driver": None, "control": None, "stats": None}
