"""The details of one robot."""

from __future__ import annotations

import pytest

from tests.fake_bus import FakeBus
from tests.views.top import EVIL, EVIL_SHOWN, entry_of, opened, put, row_of, serve, stats
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Latch, LinkStatus, Refusal, Status
from zbridge.fleet.processes import DiskSpace, ListenerStats, ProcessStats, SessionEntry, Sessions
from zbridge.views.top.details import Tables, detail_lines, duration

pytestmark = pytest.mark.jumping
LISTENER = ListenerStats("r1", "alf", "tcp://0.0.0.0:11002", 2)
TABLES = {
    ("r1", "gateway"): Sessions(
        (
            SessionEntry(
                "robot", "10.0.0.7:11001", "hq", "established", None, "1.3",
                counters={"frames_in": 7, "frames_out": 5, "malformed": 1, "dropped": 2}, left_out={"mode": 4},
            ),
        )
    ),
    ("r1", "hq.hub"): Sessions(
        (),
        process=ProcessStats("hub", 8, "0.1.0"),
        listeners=(ListenerStats("hub", "wc2ec", "tcp://0.0.0.0:11003", 1, listening=False),),
    ),
}  # fmt: skip


def lines(control: Control, status: Status | None = None, tables: Tables | None = TABLES) -> list[str]:
    bus = FakeBus()
    model, _ = opened(bus)
    serve(bus, "r1", stats(listeners=(LISTENER,), disks=(DiskSpace("audit", "/var/log/r1", 12_300_000_000),)), control)
    if status is not None:
        put(bus, "r1", topics.STATUS, status)
    return [line.text for line in detail_lines(entry_of(model, "r1"), row_of(model, "r1"), tables)]


async def test_all_that_is_known_of_a_robot_is_listed() -> None:
    refusals = (
        Refusal(who="ann", command="drive", code="held", reason="held by bob", count=4),
        Refusal(who=None, command="drive", code="stale", reason="too old", count=1, by="hq.hub"),
    )
    latches = (Latch(b"1" * 16, "bob", "wet floor", fleet=True),)
    links = (LinkStatus("tcp", "established", "tcp://10.0.0.7:11001", shared=True),)
    control = Control("latched", latches=latches, refusals=refusals)
    found = lines(control, Status("established", protocol="tcpudp", version="1.3", features=("udp",), links=links))
    for expected in (
        "r1: LATCHED: latched by bob (wet floor)",
        "tcpudp, version 1.3, features udp",
        "driver: nobody; control is latched",
        "  host hub, pid 7, zbridge 0.1.0, up 0 s",
        "  2.0 % of a core, 40 MB (90 MB resident), event loop 0.0 ms late",
        "  since its start: 2 gaps, 3 commands refused, 0 messages dropped",
        "  disk for audit: 12.3 GB free at /var/log/r1",
        "  scan 10.5/s",
        "  latched by bob (wet floor), with the whole fleet",
        "  tcp: established, tcp://10.0.0.7:11001, an address that other robots share",
        "  gateway: robot 10.0.0.7:11001: established, 1.3 by tcp, 7 in, 5 out, 3 lost, left out mode 4",
        "  gateway: r1, alf at tcp://0.0.0.0:11002, listening, 2 clients",
        "  hq.hub: hub, wc2ec at tcp://0.0.0.0:11003, NOT listening, 1 clients",
    ):
        assert expected in found
    assert found[-2:] == ["  1 x drive of somebody: stale: too old, by hq.hub", "  4 x drive of ann: held: held by bob"]


async def test_a_driver_is_shown_with_its_lease() -> None:
    found = lines(Control("held", holder="ann", priority=5, expires_in_s=2.25))
    assert "driver: ann (priority 5), its lease ends in 2.2 s; control is held" in found


async def test_what_is_not_known_yet_is_said() -> None:
    assert "  (asking)" in lines(Control("free"), tables=None)
    found = lines(Control("free"), tables={})
    assert {"sessions: none", "latched stops: none", "links: none", "refusals, the newest first: none"} <= set(found)


async def test_text_of_peers_is_escaped_in_every_line() -> None:
    refusal = Refusal(who=EVIL, command=EVIL, code=EVIL, reason=EVIL, count=1, by=EVIL)
    control = Control("held", holder=EVIL, refusals=(refusal,), latches=(Latch(b"1" * 16, EVIL, EVIL),))
    link = LinkStatus(EVIL, EVIL, EVIL, EVIL)
    status = Status("offline", EVIL, EVIL, EVIL, EVIL, (EVIL,), (link,), EVIL)
    session = SessionEntry(EVIL, EVIL, EVIL, EVIL, EVIL, EVIL, left_out={EVIL: 1})
    found = lines(control, status, {("r1", EVIL): Sessions((session,), listeners=(LISTENER,))})
    assert all(line.isprintable() for line in found)
    assert sum(EVIL_SHOWN in line for line in found) >= 6


@pytest.mark.parametrize(
    ("seconds", "written"), [(5.4, "5 s"), (125, "2 min 5 s"), (11_520, "3 h 12 min"), (100_000, "1 d 3 h")]
)
def test_a_time_is_written_in_its_two_largest_units(seconds: float, written: str) -> None:
    assert duration(seconds) == written
