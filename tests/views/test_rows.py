"""What ``zbridge top`` says of a robot: which states it tells apart, and what it does not print."""

from __future__ import annotations

import json

import pytest

from tests.fake_bus import FakeBus
from tests.views.top import ESTABLISHED, EVIL, EVIL_SHOWN, entry_of, opened, publish, put, row_of, serve, stats
from zbridge.client.fleet_model import SILENT_S
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Fault, Latch, Refusal, Status
from zbridge.fleet.printable import as_json
from zbridge.fleet.processes import ProcessStats, Stats
from zbridge.views.rows import RobotRow, RowState, as_fields, count_states

pytestmark = pytest.mark.jumping
LATCHED = Control("latched", latches=(Latch(b"1" * 16, "bob", "wet floor"),))


async def test_a_healthy_robot_shows_what_its_gateway_published() -> None:
    bus = FakeBus()
    model, _ = opened(bus)
    serve(bus, "r1", control=Control("held", holder="ann"))
    assert row_of(model, "r1") == RobotRow(
        "r1", RowState.ESTABLISHED, "ann", "", 30.5, 3, 2, 0.02, 40_000_000, False, "hub", "tcpudp 1.3"
    )


async def test_a_gateway_that_is_gone_one_that_hangs_and_a_latched_robot_are_told_apart_by_words_and_marks() -> None:
    bus = FakeBus()
    model, clock = opened(bus)
    for name in ("gone", "hangs", "latched", "well"):
        publish(bus, name)
    tokens = [bus.announce(f"fleet/{name}/@alive/gateway") for name in ("gone", "hangs", "latched", "well")]
    tokens[0].close()
    clock.now += SILENT_S
    publish(bus, "latched", control=LATCHED)
    publish(bus, "well")
    found = {name: row_of(model, name) for name in model.robots}
    assert {name: (row.state.word, row.state.mark) for name, row in found.items()} == {
        "gone": ("NO GATEWAY", "X"),
        "hangs": ("SILENT", "?"),
        "latched": ("LATCHED", "L"),
        "well": ("established", " "),
    }
    assert found["gone"].reason == "no gateway serves it"
    assert found["hangs"].reason == "its gateway has published nothing for 3 s"
    assert (found["latched"].driver, found["latched"].reason) == ("LATCHED", "latched by bob (wet floor)")
    assert [(found[name].rate, found[name].cpu) for name in ("gone", "hangs")] == [(None, None)] * 2


@pytest.mark.parametrize(
    ("status", "word", "reason"),
    [
        (Status("offline", reason="connection refused"), "offline", "connection refused"),
        (Status("handshaking"), "handshaking", ""),
        (Status("established", stalled=True), "stalled", "its link acknowledges nothing"),
    ],
)
async def test_a_link_that_does_not_work_is_the_state_also_of_a_latched_robot(
    status: Status, word: str, reason: str
) -> None:
    bus = FakeBus()
    model, _ = opened(bus)
    serve(bus, "r1", control=LATCHED)
    put(bus, "r1", topics.STATUS, status)
    row = row_of(model, "r1")
    assert (row.state.word, row.state.mark, row.driver) == (word, "!", "LATCHED")
    assert set(row.reason.split("; ")) - {""} == {"latched by bob (wet floor)", reason} - {""}


async def test_open_faults_are_told_once_unless_another_column_tells_them() -> None:
    bus = FakeBus()
    model, _ = opened(bus)
    serve(bus, "r1", control=LATCHED)
    faults = (
        Fault("deadman", "no command for 0.5 s (ann)", 1, 2),
        Fault("latched", "latched by bob (wet floor)", 1),
        Fault("audit_log", "the audit log is not written", 1),
    )
    put(bus, "r1", topics.STATUS, Status("established", reason="the audit log is not written", faults=faults))
    row = row_of(model, "r1")
    told = "latched by bob (wet floor); the audit log is not written; deadman: no command for 0.5 s (ann)"
    assert row.reason == told
    shown = as_fields(row, model.robots["r1"])["faults"]
    assert [(fault["code"], fault["count"]) for fault in shown] == [("deadman", 2), ("latched", 1), ("audit_log", 1)]


async def test_while_tokens_may_still_be_on_their_way_and_without_the_bus_no_state_is_known() -> None:
    bus = FakeBus()
    model, clock = opened(bus)
    publish(bus, "r1")
    assert row_of(model, "r1").state is RowState.NO_GATEWAY
    model.opened_at = clock.now
    assert row_of(model, "r1").state is RowState.UNKNOWN
    bus.announce("fleet/r1/@alive/gateway")
    assert row_of(model, "r1").state is RowState.ESTABLISHED
    without = row_of(model, "r1", connected=False)
    assert (without.state, without.rate, without.cpu) == (RowState.UNKNOWN, None, None)


async def test_memory_is_proportional_if_the_platform_says_so_and_marked_where_robots_share_the_process() -> None:
    bus = FakeBus()
    model, _ = opened(bus)
    serve(bus, "r1")
    serve(bus, "r2", stats(memory_mb=None))
    serve(bus, "r3", Stats(ProcessStats("hub", 7, "0.1.0", robots=12, cpu=0.5, resident_bytes=60_000_000)))
    texts = [(row_of(model, name).memory_text, row_of(model, name).cpu_text) for name in ("r1", "r2", "r3")]
    assert texts == [("40M", "2.0"), ("90M", "2.0"), ("60M*", "50.0*")]


async def test_a_robot_that_published_a_token_only_has_a_row() -> None:
    bus = FakeBus()
    model, clock = opened(bus)
    bus.announce("fleet/r1/@alive/gateway")
    model.opened_at = clock.now
    row = row_of(model, "r1")
    assert (row.state, row.reason) == (RowState.UNKNOWN, "the gateway has published no status yet")
    assert (row.refused, row.gaps, row.rate, row.cpu_text, row.memory_text) == (None, None, None, "", "")


async def test_what_peers_chose_reaches_no_terminal_as_a_command_and_a_long_name_stays_whole() -> None:
    bus = FakeBus()
    model, _ = opened(bus)
    name = "r" * 500
    serve(bus, name, control=Control("held", holder=EVIL))
    put(bus, name, topics.STATUS, Status("connecting", reason=EVIL, host=EVIL, protocol=EVIL))
    row = row_of(model, name)
    assert (row.driver, row.reason, row.host, row.protocol) == (EVIL_SHOWN,) * 4


async def test_a_robot_is_one_object_of_json() -> None:
    bus = FakeBus()
    model, _ = opened(bus)
    refused = Refusal(who="ann", command="drive", code="held", reason="held by bob", count=4)
    control = Control("latched", latches=LATCHED.latches, refusals=(refused,))
    serve(bus, "r1", control=control)
    line = as_json(as_fields(row_of(model, "r1"), entry_of(model, "r1")))
    fields = json.loads(line)
    assert "\n" not in line
    assert (fields["robot"], fields["alive"], fields["silent"], fields["state"]) == ("r1", True, False, "established")
    assert (fields["latches"], fields["rates"]) == (["latched by bob (wet floor)"], {"pose": 20.0, "scan": 10.5})
    assert fields["refusals"][0]["code"] == "held"
    assert (fields["gaps"], fields["refused"], fields["cpu"], fields["memory_bytes"]) == (2, 3, 0.02, 40_000_000)
    assert (fields["protocol"], fields["version"], fields["process"]["pid"]) == ("tcpudp", "1.3", 7)


async def test_robots_are_counted_by_state_the_worst_first() -> None:
    states = [RowState.ESTABLISHED] * 3 + [RowState.SILENT, RowState.OFFLINE]
    rows = [RobotRow(f"r{number}", state) for number, state in enumerate(states)]
    assert count_states(rows) == "5 robots: 1 SILENT, 1 offline, 3 established"
    assert (count_states(rows[:1]), count_states([])) == ("1 robot: 1 established", "0 robots")


def test_every_state_of_a_robot_has_a_row_state() -> None:
    from typing import get_args

    from zbridge.fleet.messages import RobotState

    assert {RowState[state.upper()].word for state in get_args(RobotState)} == set(get_args(RobotState))
    assert ESTABLISHED.state == "established"
