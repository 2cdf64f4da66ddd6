"""What pages are told of the fleet: all once, then only what changed; hostile names and texts as text."""

from __future__ import annotations

import json
from typing import Any

from tests.fake_bus import FakeBus
from tests.views.top import EVIL, opened, publish, put, serve
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Latch, Status
from zbridge.views.console.feed import FleetFeed


def told(feed: FleetFeed, *roster: str, connected: bool = True) -> dict[str, Any]:
    """Refresh; give the changed rows by name, and ``gone`` if anybody is."""
    message = json.loads(feed.refresh(roster, connected=connected) or b'{"rows": [], "gone": []}')
    return {row["name"]: row for row in message["rows"]} | ({"gone": message["gone"]} if message["gone"] else {})


def fed() -> tuple[FakeBus, FleetFeed, Any]:
    bus = FakeBus()
    model, clock = opened(bus)
    return bus, FleetFeed(model, lambda: 1_000_000.0 + clock.now), clock


def test_a_robot_is_told_whole_once_and_then_when_it_changes() -> None:
    bus, feed, _ = fed()
    serve(bus, "r1")
    row = told(feed)["r1"]
    assert (row["state"], row["protocol"], row["version"], row["rate"], row["refused"]) == (
        "established",
        "tcpudp",
        "1.3",
        30.5,
        3,
    )
    assert row["seen"] is None
    assert told(feed) == {}
    publish(bus, "r1", control=Control("held", holder="ann"))
    assert told(feed)["r1"]["driver"] == "ann"


def test_a_gateway_that_is_silent_is_told_with_when_it_was_last_seen() -> None:
    bus, feed, clock = fed()
    serve(bus, "r1")
    told(feed)
    began = clock.now
    clock.now += 10.0
    row = told(feed)["r1"]
    assert (row["state"], row["seen"], row["rate"]) == ("SILENT", round(1_000_000 + began), None)


def test_a_robot_of_the_roster_is_missing_and_gone_once_it_is_forgotten() -> None:
    _, feed, _ = fed()
    row = told(feed, "r9")["r9"]
    assert (row["state"], row["commands"]) == ("NO GATEWAY", [])
    assert told(feed) == {"gone": ["r9"]}


def test_nothing_is_known_of_robots_while_the_bus_is_lost() -> None:
    bus, feed, _ = fed()
    serve(bus, "r1")
    told(feed, "r9")
    assert {name: row["state"] for name, row in told(feed, "r9", connected=False).items()} == {
        "r1": "unknown",
        "r9": "unknown",
    }


def test_what_robots_take_and_why_they_are_latched_is_told() -> None:
    bus, feed, _ = fed()
    serve(bus, "r1", control=Control("latched", latches=(Latch(bytes(16), "ann", "wet floor"),)))
    put(bus, "r1", topics.STATUS, Status("established", commands=("stop", "drive")))
    row = told(feed)["r1"]
    assert (row["commands"], row["latched"]) == (["stop", "drive"], ["latched by ann (wet floor)"])


def test_hostile_texts_are_told_as_text_and_cut() -> None:
    bus, feed, _ = fed()
    serve(bus, "r1")
    put(bus, "r1", topics.STATUS, Status("established", reason=EVIL, protocol="\u202e" * 10_000, version="x" * 10_000))
    row = told(feed)["r1"]
    assert "\x1b" not in json.dumps(row, ensure_ascii=False)
    assert max(len(value) for value in row.values() if isinstance(value, str)) <= 200


def test_a_snapshot_has_all_rows_and_what_else_a_page_begins_with() -> None:
    bus, feed, _ = fed()
    serve(bus, "r1")
    told(feed, "r9")
    snapshot = json.loads(feed.snapshot(realm="fleet"))
    assert (snapshot["full"], snapshot["realm"], [row["name"] for row in snapshot["rows"]]) == (
        True,
        "fleet",
        ["r1", "r9"],
    )
