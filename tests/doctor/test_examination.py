"""Doctor on a bus of its own: what is broken is found, what depends on it is skipped, and nothing is driven."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from tests.fake_bus import FakeBus
from tests.ports import free_port
from zbridge.app.config import load
from zbridge.bus import BusSettings
from zbridge.doctor import bus as on_bus
from zbridge.doctor import examination as examining
from zbridge.doctor.examination import Examination, Options, examine_bus
from zbridge.doctor.findings import Finding, Layer, Verdict
from zbridge.doctor.gateway_file import examine_file
from zbridge.errors import BusError, BusRefused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, LinkStatus, Status
from zbridge.fleet.processes import ListenerStats, ProcessStats, SessionEntry, Sessions, Stats
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.host.addresses import AddressLock, forms_of

jumping = pytest.mark.jumping
LINK = LinkStatus("robot", "established", "tcp://10.0.0.7:11001")
GOOD = Status("established", protocol="tcpudp", version="1.3", links=(LINK,), host="hub")
PROCESS = ProcessStats("hub", 7, "0.1.0", uptime_s=4000.0, resident_bytes=60_000_000, files=30, most_files=1024)
DESK = ListenerStats("desk", "tcpudp", "tcp://127.0.0.1:11002")
SETTINGS = BusSettings(connect=("tcp/127.0.0.1:7447",))


class Robot:
    """A robot's gateway: it has a token, and publishes once a second."""

    def __init__(self, bus: FakeBus, name: str = "r1") -> None:
        self.bus, self.keys = bus, KeySpace("fleet", name)
        self.token = bus.announce(self.keys.alive("gateway"))
        self.status: FleetMessage = GOOD
        self.control: FleetMessage = Control("free")
        self.stats: FleetMessage = Stats(PROCESS, {"pose": 20.0})
        self.ended: tuple[SessionEntry, ...] = ()
        self.stamp_ns: int | None = None
        bus.answer(self.keys.key(topics.RPC_SESSIONS("gateway").path), self._answer)
        self.publish()

    def publish(self) -> None:
        for topic, message in (
            (topics.STATUS, self.status),
            (topics.CONTROL, self.control),
            (topics.STATS, self.stats),
        ):
            self.put(topic, message)

    def put(self, topic: Topic, message: FleetMessage) -> None:
        self.bus.publisher(self.keys.key(topic.path), topic).put(payloads.encode(message))

    def _answer(self, query) -> None:  # type: ignore[no-untyped-def]
        table = Sessions(self.ended) if self.stamp_ns is None else Sessions(self.ended, stamp_ns=self.stamp_ns)
        query.answer(payloads.encode(table))


async def examined(
    robot: Robot | None, name: str | None = "r1", beats: bool = True, **options: object
) -> list[Finding]:
    """Examine a robot whose gateway publishes once more meanwhile."""
    examination = Examination()
    if robot is not None and beats:
        asyncio.get_running_loop().call_later(0.5, robot.publish)
    await examine_bus(examination, SETTINGS, "fleet", name, Options())
    return examination.findings


def trouble(findings: list[Finding]) -> dict[Layer, str]:
    return {each.layer: each.code for each in findings if each.verdict in (Verdict.WARNING, Verdict.ERROR)}


def skipped(findings: list[Finding]) -> set[Layer]:
    return {each.layer for each in findings if each.verdict is Verdict.SKIPPED}


@jumping
async def test_a_healthy_robot_has_a_finding_for_each_layer_and_no_trouble(bus: FakeBus) -> None:
    findings = await examined(Robot(bus))
    assert trouble(findings) == {}
    assert skipped(findings) == set()
    layers = {each.layer for each in findings}
    assert layers >= {
        Layer.CERTIFICATE,
        Layer.BUS,
        Layer.ROLE,
        Layer.GATEWAY,
        Layer.ROBOT,
        Layer.DRIVING,
        Layer.PROCESS,
    }
    assert {each.robot for each in findings} == {"r1"}


@jumping
async def test_nothing_is_put_and_no_stream_subscribed_to(bus: FakeBus) -> None:
    robot = Robot(bus)
    subscribed: list[str] = []
    subscribe = FakeBus.subscribe

    def noting(self: FakeBus, key_expr: str, *args: object, **options: object) -> object:
        subscribed.append(key_expr)
        return subscribe(self, key_expr, *args, **options)  # type: ignore[arg-type]

    FakeBus.subscribe = noting  # type: ignore[assignment, method-assign]
    try:
        await examined(robot)
    finally:
        FakeBus.subscribe = subscribe  # type: ignore[method-assign]
    assert set(subscribed) == {"fleet/*/status", "fleet/*/control", "fleet/*/@gateway/stats"}
    assert not [sample.key for sample in bus.network.history if "@cmd" in sample.key]


@jumping
async def test_a_gateway_that_hangs_is_told_from_one_that_is_gone_and_from_none(bus: FakeBus) -> None:
    robot = Robot(bus)
    findings = await examined(robot, beats=False)
    assert trouble(findings) == {Layer.GATEWAY: "gateway_silent"}
    assert skipped(findings) == {Layer.ROBOT, Layer.DRIVING, Layer.PROCESS}
    robot.token.close()
    assert trouble(await examined(robot, beats=False)) == {Layer.GATEWAY: "gateway_left"}
    assert trouble(await examined(None, "r7")) == {Layer.GATEWAY: "no_gateway"}


@jumping
async def test_why_the_last_connection_ended_is_read_from_the_session_table(bus: FakeBus) -> None:
    robot = Robot(bus)
    robot.status = Status("connecting", protocol="tcpudp", links=(LINK,))
    robot.ended = (SessionEntry("robot", "tcp://a:1", "hq", "closed", reason="no common version: the peer speaks '9'"),)
    findings = await examined(robot)
    assert trouble(findings) == {Layer.ROBOT: "wrong_version"}
    robot.ended = (SessionEntry("robot", "tcp://a:1", "hq", "closed", reason="tcp://a:1: Connection refused"),)
    (finding,) = [each for each in await examined(robot) if each.layer is Layer.ROBOT]
    assert finding.code == "robot_connecting"
    assert finding.text == "connecting: tcp://a:1: Connection refused (tcp://10.0.0.7:11001)"


@jumping
async def test_a_clock_that_is_an_hour_off_is_a_warning(bus: FakeBus) -> None:
    robot = Robot(bus)
    robot.stamp_ns = time.time_ns() + 3600 * 10**9
    assert trouble(await examined(robot)) == {Layer.CLOCKS: "clock"}


@jumping
async def test_listeners_in_a_process_of_their_own_are_examined_too(bus: FakeBus) -> None:
    robot = Robot(bus)
    table = payloads.encode(Sessions((), process=PROCESS, listeners=(DESK,)))
    bus.answer(robot.keys.key(topics.RPC_SESSIONS("hq.desk.1").path), lambda query: query.answer(table))
    findings = await examined(robot)
    assert [each.code for each in findings if each.layer is Layer.LISTENERS] == ["listener_loopback"]


@jumping
async def test_two_gateways_for_one_address_are_a_warning_at_both(bus: FakeBus) -> None:
    robots = [Robot(bus, name) for name in ("r1", "r2")]
    for robot in robots:
        robot.publish()
    findings = await examined(robots[0])
    assert trouble(findings) == {Layer.ROBOT: "same_address"}
    assert "tcp://10.0.0.7:11001 is the address of r2 too" in next(
        each.text for each in findings if each.code == "same_address"
    )


@jumping
async def test_the_whole_fleet_is_examined_and_each_finding_names_its_robot(bus: FakeBus) -> None:
    for name in ("r1", "r2"):
        Robot(bus, name).token.close()
    findings = await examined(None, None)
    assert {each.robot for each in findings if each.layer is Layer.GATEWAY} == {"r1", "r2"}
    assert (await examined(None, None))[0].robot is None


@jumping
async def test_a_bus_without_robots_says_so(bus: FakeBus) -> None:
    assert trouble(await examined(None, None)) == {Layer.GATEWAY: "no_robots"}


@pytest.mark.parametrize(
    ("fault", "code"),
    [(BusError("no route"), "bus_unreachable"), (BusRefused("hub refused viewer.ann: expired"), "bus_refused")],
)
@jumping
async def test_a_bus_that_cannot_be_joined_skips_what_depends_on_it(
    fault: BusError, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    @asynccontextmanager
    async def joined(settings: BusSettings, realm: str) -> AsyncIterator[FakeBus]:
        raise fault
        yield

    async def nothing(settings: BusSettings) -> None:
        return None

    monkeypatch.setattr(on_bus, "joined", joined)
    monkeypatch.setattr(examining, "why_router_refuses", nothing)
    findings = await examined(None)
    assert trouble(findings) == {Layer.BUS: code}
    assert skipped(findings) >= {Layer.ROLE, Layer.GATEWAY, Layer.ROBOT, Layer.DRIVING}


# Files, on the gateway's host


def written(folder: Path, text: str) -> Path:
    file = folder / "r1.toml"
    file.write_text(text)
    return file


async def examined_file(file: Path) -> list[Finding]:
    examination = Examination()
    await examine_file(examination, file, None, Options())
    return examination.findings


async def test_a_faulty_file_is_the_only_finding_and_everything_else_is_skipped(tmp_path: Path) -> None:
    findings = await examined_file(written(tmp_path, '[robot]\nname = "r1"\nnick = 1\n'))
    assert trouble(findings) == {Layer.CONFIGURATION: "configuration"}
    assert skipped(findings) == set(Layer) - {Layer.CONFIGURATION}


FILE = '[robot]\nname = "r1"\n[device]\nprotocol = "tcpudp"\nconnect = ["tcp://{at}"]\n'


async def test_names_that_nobody_has_and_ports_that_are_taken_are_found_on_the_host(
    bus: FakeBus, tmp_path: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        hq = f'[[hq]]\nprotocol = "tcpudp"\nlisten = "tcp://127.0.0.1:{port}"\n'
        findings = await examined_file(written(tmp_path, FILE.format(at="robot.invalid:1") + hq))
    assert trouble(findings) == {
        Layer.NAMES: "unknown_host",
        Layer.LISTENERS: "port_taken",
        Layer.GATEWAY: "no_gateway",
    }
    assert Layer.ADDRESS in skipped(findings)


async def test_the_address_of_another_robots_gateway_is_found_on_the_host(bus: FakeBus, tmp_path: Path) -> None:
    file = written(tmp_path, FILE.format(at=f"127.0.0.1:{free_port()}"))
    device = load(file).device
    assert device is not None
    lock = AddressLock("fleet", "r2")
    assert lock.take(forms_of(device)) is None
    try:
        assert trouble(await examined_file(file))[Layer.ADDRESS] == "address_taken"
    finally:
        lock.close()
    assert Layer.ADDRESS not in trouble(await examined_file(file))
