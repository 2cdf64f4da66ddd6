"""``--json``: one object a line, with a word for programs and a reason for people."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.client import World
from tests.fake_bus import FakeBus
from zbridge.bus import Bus, BusSettings
from zbridge.cli import gateway_commands
from zbridge.cli.probe import probe
from zbridge.errors import NotReady
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import LinkStatus, Status
from zbridge.protocol.plugin import find_protocol

pytestmark = pytest.mark.jumping
NOWHERE = BusSettings(connect=("tcp/127.0.0.1:1",), multicast=False)
AT = "tcp://127.0.0.1:1"


def on(monkeypatch: pytest.MonkeyPatch, bus: FakeBus) -> None:
    async def open_bus(*_: object, **__: object) -> Bus:
        return bus.join("program")

    monkeypatch.setattr("zbridge.client.open_bus", open_bus)


def printed(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    out, err = capsys.readouterr()
    assert err == ""
    return [json.loads(line) for line in out.splitlines()]


async def test_stops_and_releases_are_reported_for_each_robot(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    world = World("r1", "r2")
    on(monkeypatch, world.bus)
    world.gateways["r2"].publish(topics.STATUS, Status("offline", reason="no route to host"))
    assert not await gateway_commands.stop(NOWHERE, "fleet", None, latch=False, reason=None, as_json=True)
    why = "r2: stop accepted, but the robot is offline: no route to host"
    assert printed(capsys) == [
        {"robot": "r1", "ok": True, "outcome": "stopped", "reason": None},
        {"robot": "r2", "ok": False, "outcome": "offline", "reason": why},
    ]
    assert await gateway_commands.stop(NOWHERE, "fleet", "r1", latch=True, reason="wet floor", as_json=True)
    assert printed(capsys) == [{"robot": "r1", "ok": True, "outcome": "latched", "reason": None}]
    assert await gateway_commands.unlatch(NOWHERE, "fleet", "r1", as_json=True)
    (line,) = printed(capsys)
    assert (line["outcome"], [latch["reason"] for latch in line["released"]]) == ("unlatched", ["wet floor"])
    assert not await gateway_commands.unlatch(NOWHERE, "fleet", "r9", as_json=True)
    (line,) = printed(capsys)
    assert (line["ok"], line["outcome"]) == (False, "did not confirm")


async def test_restarts_are_reported_for_each_robot(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bus = FakeBus()
    on(monkeypatch, bus)
    for robot in ("r1", "r2"):
        bus.announce(f"fleet/{robot}/@alive/gateway")
    bus.answer("fleet/r1/@rpc/restart/*", lambda query: query.answer(b""))
    bus.answer("fleet/r2/@rpc/restart/*", lambda query: query.refuse(NotReady("the successor ended: exit code 2")))
    assert not await gateway_commands.restart(NOWHERE, "fleet", None, who="ann", as_json=True)
    assert printed(capsys) == [
        {"robot": "r1", "ok": True, "outcome": "restarted", "reason": None},
        {"robot": "r2", "ok": False, "outcome": "refused", "reason": "r2: the successor ended: exit code 2"},
    ]


async def test_probe_says_which_robot_it_is_and_why_nothing_is_known(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bus, protocol = FakeBus(), find_protocol("tcpudp")
    on(monkeypatch, bus)
    address = protocol.device_address(AT)
    assert await probe(NOWHERE, protocol, address, realm="fleet", sure=True, as_json=True) == 1
    out, err = capsys.readouterr()
    assert json.loads(out) == {"address": AT, "robot": None, "reason": err.removeprefix(f"{AT}: ").strip()}
    links = (LinkStatus("robot", "established", AT),)
    status = payloads.encode(Status("established", protocol="tcpudp", version="1.3", links=links))
    bus.publisher("fleet/r1/status", topics.STATUS).put(status)
    assert await probe(NOWHERE, protocol, address, realm="fleet", sure=False, as_json=True) == 0
    (line,) = printed(capsys)
    assert (line["address"], line["robot"], line["version"]) == (AT, "r1", "1.3")
