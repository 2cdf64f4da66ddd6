"""Each documented failure, broken on a bus of its own, and doctor's verdict: the table of ``doctor.md``."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import pytest

from tests.certificates import Authority
from tests.doctor.test_examination import GOOD, PROCESS, SETTINGS, Robot
from tests.fake_bus import FakeBus
from tests.ports import free_port
from zbridge.app.config import plan
from zbridge.bus import BusSettings
from zbridge.bus.tls.files import folder_settings
from zbridge.doctor import bus as on_bus
from zbridge.doctor import examination as examining
from zbridge.doctor import here
from zbridge.doctor.bus import examine_role
from zbridge.doctor.examination import Examination, Options, examine_bus
from zbridge.doctor.findings import Verdict
from zbridge.errors import BusError, Code
from zbridge.fleet.messages import Control, Refusal
from zbridge.fleet.processes import DiskSpace, SessionEntry, Stats

pytestmark = pytest.mark.jumping
PAGE = (
    (Path(__file__).parents[2] / "docs" / "reference" / "doctor.md").read_text().partition("## Documented failures")[2]
)
ROWS = re.findall(r"^\| ([^|]+) \| [^|]+ \| (?:anywhere|host|silence) \|$", PAGE, re.MULTILINE)


def refused(code: str) -> Control:
    return Control("free", refusals=(Refusal(who="ann", command="drive", code=code, reason="the reason", count=1),))


def status(**fields: object) -> Callable[[Robot], None]:
    def act(robot: Robot) -> None:
        robot.status = msgspec.structs.replace(GOOD, **fields)

    return act


def control(shown: Control) -> Callable[[Robot], None]:
    def act(robot: Robot) -> None:
        robot.control = shown

    return act


def stats(process: dict[str, object] | None = None, **fields: object) -> Callable[[Robot], None]:
    def act(robot: Robot) -> None:
        told = Stats(msgspec.structs.replace(PROCESS, **(process or {})), {"pose": 20.0})
        robot.stats = msgspec.structs.replace(told, **fields)

    return act


def silent(robot: Robot) -> None:
    robot.publish = lambda: None  # type: ignore[method-assign]


def gone(robot: Robot) -> None:
    silent(robot)
    robot.token.close()


def wrong_clock(robot: Robot) -> None:
    robot.stamp_ns = time.time_ns() - 3600 * 10**9


def used_up(robot: Robot) -> None:
    robot.status = msgspec.structs.replace(GOOD, state="handshaking")
    reason = "connected, but no settings within 5 s: its one connection may be used up, restart the robot program"
    robot.ended = (SessionEntry("robot", "tcp://a:1", "hq", "closed", reason),)


RIVAL = "another gateway serves this robot too: 1a2b3c"
BROKEN: dict[str, tuple[Callable[[Robot], None], set[str]]] = {
    "the client is killed": (control(Control("free")), set()),
    "the client is frozen": (control(Control("held", holder="ann", expires_in_s=2.0)), {"held"}),
    "somebody takes over": (control(refused("lease_ended")), {"refused_lease_ended"}),
    "the gateway is ended": (gone, {"gateway_left"}),
    "the gateway is killed, with a ": (stats({"uptime_s": 2.0}), {"restarted"}),
    "the gateway is killed, without a": (gone, {"gateway_left"}),
    "the gateway is frozen": (silent, {"gateway_silent"}),
    "the wall clock jumps": (wrong_clock, {"clock"}),
    "a second connection": (used_up, {"used_up"}),
    "an HQ program is frozen": (control(refused("neutral_first")), {"refused_neutral_first"}),
    "the robot's program stalls": (stats(rates={}), {"robot_quiet"}),
    "the robot's link is down": (status(stalled=True), {"link_stalled"}),
    "the network between gateway and robot": (status(state="connecting"), {"robot_connecting"}),
    "a second gateway claims": (status(reason=RIVAL), {"condition"}),
    "a forged claim": (status(reason=RIVAL), {"condition"}),
    "the machine of the gateway is suspended": (silent, {"gateway_silent"}),
    "the audit log cannot": (stats(disks=(DiskSpace("audit", "/var/log/r1", 0),)), {"disk_full"}),
}
OTHERWISE = ("the bus is cut", "the listener is killed", "rules of Zenoh's own router", "a command is refused")
"""Broken by tests of their own, below."""


async def verdict(robot: Robot | None) -> set[str]:
    """Examine a robot whose gateway may publish once more; give the codes of what is not well."""
    examination = Examination()
    if robot is not None:
        asyncio.get_running_loop().call_later(0.5, lambda: robot.publish())
    await examine_bus(examination, SETTINGS, "fleet", "r1", Options())
    found = {each.code for each in examination.findings if each.verdict not in (Verdict.OK, Verdict.SKIPPED)}
    return found - {"no_router"}  # a fake bus has none


def test_each_row_of_the_page_is_broken_here() -> None:
    rows = ROWS[1:] if ROWS[0] == "failure" else ROWS
    begun = (*BROKEN, *OTHERWISE)
    assert [row for row in rows if sum(map(row.startswith, begun)) != 1] == []
    assert [begin for begin in begun if not any(row.startswith(begin) for row in rows)] == []


@pytest.mark.parametrize("failure", BROKEN)
async def test_a_documented_failure_has_its_verdict(bus: FakeBus, failure: str) -> None:
    robot = Robot(bus)
    breaks, codes = BROKEN[failure]
    breaks(robot)
    robot.publish()
    assert await verdict(robot) == codes


@pytest.mark.parametrize("code", Code)
async def test_a_command_that_is_refused_is_shown_with_its_code(bus: FakeBus, code: Code) -> None:
    robot = Robot(bus)
    robot.control = refused(code)
    robot.publish()
    assert await verdict(robot) == {f"refused_{code}"}


async def test_a_bus_that_is_cut_is_seen_from_both_sides(bus: FakeBus, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot(bus)
    gone(robot)
    assert await verdict(robot) == {"gateway_left"}

    @asynccontextmanager
    async def cut_off(settings: BusSettings, realm: str) -> AsyncIterator[FakeBus]:
        raise BusError("tcp/127.0.0.1:7447 does not answer")
        yield

    async def not_full(settings: BusSettings) -> None:
        return None

    monkeypatch.setattr(on_bus, "joined", cut_off)
    monkeypatch.setattr(examining, "why_router_refuses", not_full)
    assert await verdict(None) == {"bus_unreachable"}


def test_a_listener_that_was_killed_has_its_port_closed() -> None:
    hq = [{"protocol": "tcpudp", "listen": f"tcp://127.0.0.1:{free_port()}"}]
    (finding,) = here.examine_ports(plan({"robot": {"name": "r1"}, "hq": hq}), runs=True)
    assert (finding.verdict, finding.code) == (Verdict.ERROR, "port_closed")


async def test_rules_of_another_router_look_like_silence_and_are_told_as_that(bus: FakeBus, tmp_path: Path) -> None:
    settings = folder_settings(Authority(tmp_path / "lab").issue("viewer.v1"), ("tls/127.0.0.1:1",))
    assert [each.code for each in await examine_role(bus, settings, "fleet", "r1")] == ["no_whoami"]
