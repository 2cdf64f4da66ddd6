"""The device side with a TCP/UDP robot: a fake bus, a fake link, a clock that jumps, bytes from the protocol page."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import math
import re
import struct
from collections.abc import AsyncIterator, Callable
from typing import Any

import msgpack
import pytest
import zenoh

from gateways.tcpudp.translate import Options, TcpUdpRobot
from tests.clock import JumpingLoop, scene_of
from tests.proofs import Holder, lease, numbered, packed, shown
from zbridge.bus import Handle, IncomingQuery, Lane, Sample
from zbridge.bus.fake import FakeBus, FakeQuery, meet
from zbridge.bus.interface import Sort
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.motion_limits import MotionLimits
from zbridge.control.standstill import STOP_REPEAT_S
from zbridge.errors import LinkError, Malformed, NotReady, TooFast, Unsupported
from zbridge.fleet import topics
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.session_table import SessionTable
from zbridge.robot.device import HEARTBEAT_S, Device
from zbridge.robot.telemetry import ATTEND_EVERY
from zbridge.transport.conversation import Conversation
from zbridge.transport.fake import FakeLink

pytestmark = pytest.mark.jumping

ADDRESS = Address("robot.test", 11001)
LISTED = b"\x0b\x00\x00\x001.1,1.2,1.3"
# client id 2; cam, joystick, chat, lidar, lidar sim, map yes, UDP no; map size 30, interval 10
SETTINGS = bytes.fromhex("21000000 01 02 02") + LISTED + bytes.fromhex("00010101010101 1e000000 0a000000")
PLAIN_SETTINGS = bytes.fromhex("21000000 01 02 02") + LISTED + bytes.fromhex("00000000000000 00000000 00000000")
# flags of our answer: nothing but LidarSim
ANSWER = bytes.fromhex("18000000 02 03") + LISTED + bytes.fromhex("00000000000100")
STOP = bytes.fromhex("02000000 02 0d")
MOVE_LEFT = bytes.fromhex("0e000000 02 0b 000080bf 00000000 0000803f")
TURN_LEFT = bytes.fromhex("06000000 02 0c 000000bf")
POSITION = bytes.fromhex("0e000000 01 37 00001643 000048c2 0000b442")
MAP = bytes.fromhex("0f000000 01 35 09000000 000102 020200 010001")
BYE = bytes.fromhex("09000000 01 01 03000000 627965")

AUTONOMOUS = bytes.fromhex("06000000 02 0a 03000000")
MODE_NONE = bytes.fromhex("06000000 02 0a 01000000")

DRIVE_LEFT = {"left": 1.0}
NEUTRAL: dict[str, Any] = {}
FOREVER_S = 1e6
"""A lease that no test outlives."""
NEED_A_LEASE = {"drive", "motor", "mode", "raw"}
DENIED = {"ok": False, "lease": None, "token": None, "expires_in_s": None, "holder": None, "reason": None, "code": None}
STRANGE = lease(99)
"""A lease that was never given."""


class TimedLink(FakeLink):
    """Keeps the time of every write."""

    def __init__(self, loop: asyncio.AbstractEventLoop, peer: str) -> None:
        super().__init__(peer)
        self.times: list[float] = []
        self._loop = loop

    def write(self, data: bytes) -> None:
        super().write(data)
        self.times.append(self._loop.time())


class OpenBus(FakeBus):
    """Lets a test put a question whose answer comes later, and keeps the lanes that were asked for."""

    def __init__(self) -> None:
        super().__init__("1")
        self.answers: dict[str, Callable[[IncomingQuery], None]] = {}
        self.lanes: dict[str, Lane | Sort] = {}

    def answer(self, key: str, handler: Callable[[IncomingQuery], None], *, lane: Lane | Sort = Lane.OTHER) -> Handle:
        self.answers[key] = handler
        self.lanes[key] = lane
        return super().answer(key, handler, lane=lane)

    def subscribe(
        self, key_expr: str, handler: Callable[[Sample], None], *, lane: Lane | Sort = Lane.OTHER, history: bool = False
    ) -> Handle:
        self.lanes[key_expr] = lane
        return super().subscribe(key_expr, handler, lane=lane, history=history)


def payload_of(fields: dict[str, Any] | bytes) -> bytes:
    return fields if isinstance(fields, bytes) else packed(fields)


class Program:
    """A program on the bus that drives, and its lease."""

    def __init__(self, rig: Rig, who: str) -> None:
        self.who = who
        self.held: Holder | None = None
        self._rig = rig
        self._bus = rig.bus.join(who)

    def ask(self, name: str, payload: bytes) -> dict[str, Any]:
        """Ask something about the lease."""
        (reply,) = self._rig.ask(f"control/{name}", payload).replies
        assert reply.error is None
        answer: dict[str, Any] = msgpack.unpackb(reply.payload)
        return answer

    def acquire(self, how: str = "acquire", **wishes: Any) -> dict[str, Any]:
        """Ask for the lease, and keep it."""
        answer = self.ask(f"{how}/{topics.escape(self.who)}", packed({"who": self.who, **wishes}))
        if answer["ok"]:
            self.held = Holder.of(answer)
        return answer

    def renew(self) -> dict[str, Any]:
        assert self.held is not None
        return self.ask("renew", self.held.question("renew"))

    def release(self) -> dict[str, Any]:
        assert self.held is not None
        return self.ask("release", self.held.question("release"))

    def attachment(self, name: str, fields: dict[str, Any] | bytes) -> bytes | None:
        """What goes with the next command of a holder."""
        return self.held.attachment(name, payload_of(fields)) if self.held is not None else None

    def command(self, name: str, fields: dict[str, Any] | bytes = NEUTRAL) -> None:
        """Command the robot, with the lease where the command needs it."""
        self.put(name, fields, self.attachment(name, fields) if name.split("/")[0] in NEED_A_LEASE else None)

    def put(self, name: str, fields: dict[str, Any] | bytes, attachment: bytes | None) -> None:
        """Command the robot with this attachment."""
        payload = payload_of(fields)
        self._bus.publisher(f"fleet/r1/@cmd/{name}", topics.CMD_MODE).put(payload, attachment)


class Rig:
    """A device with everything around it played by the test; ``driver`` is the program that commands it."""

    def __init__(
        self,
        options: Options | None = None,
        *,
        lease_s: float = FOREVER_S,
        deadman_s: float = 2.0,
        limits: MotionLimits | None = None,
        idle_stop_s: float = 0.0,
        bus: OpenBus | None = None,
    ) -> None:
        self.loop = asyncio.get_running_loop()
        self.bus = bus or OpenBus()
        self.hq = self.bus.join("2")
        self.metrics = Metrics()
        self.manager = SessionTable()
        self.links: list[TimedLink] = []
        self.conversations: list[Conversation] = []
        self.unreachable: str | None = None
        self.audit_lines: list[str] = []
        self.device = Device(
            TcpUdpRobot(options or Options()),
            (ADDRESS,),
            protocol="tcpudp",
            keys=KeySpace("fleet", "r1"),
            bus=self.bus,
            authority=Authority(lease_s, deadman_s, numbered()),
            manager=self.manager,
            metrics=self.metrics,
            audit=Audit("r1", self.audit_lines.append),
            limits=limits,
            idle_stop_s=idle_stop_s,
            connect=self._connect,
            clock_ns=lambda: 1234,
        )
        self.driver = Program(self, "driver")
        self.hold = self.driver.acquire
        self.command = self.driver.command
        self._read = 0

    async def _connect(self, address: Address, conversation: Conversation) -> None:
        assert address == ADDRESS
        if self.unreachable:
            raise LinkError(self.unreachable)
        link = TimedLink(self.loop, str(address))
        self.links.append(link)
        self.conversations.append(conversation)
        conversation.attached(link)

    @property
    def link(self) -> TimedLink:
        return self.links[-1]

    async def settle(self) -> None:
        """Let what is ready run, without time passing."""
        for _ in range(10):
            await asyncio.sleep(0)

    async def establish(self, settings: bytes = SETTINGS) -> None:
        """Finish the handshake and let the stop that greets the robot, and the gap, pass."""
        await self.settle()
        self.sends(settings)
        await asyncio.sleep(1.15)
        self.forget_written()

    def sends(self, data: bytes) -> None:
        """Play the robot sending ``data``."""
        self.conversations[-1].received(data)

    def goes(self, reason: str = "closed by peer") -> None:
        """Play the loss of the connection."""
        self.conversations[-1].lost(reason)

    def freeze(self, seconds: float) -> None:
        """Let time pass in which the gateway does nothing, as if its process stood still."""
        assert isinstance(self.loop, JumpingLoop)
        self.loop._jumping.now += seconds

    def ask(self, name: str, payload: bytes = b"", *, asked: str | None = None) -> FakeQuery:
        """Play a program on the bus that asks the robot; ``asked``: by another key expression."""
        question = FakeQuery(f"fleet/r1/@rpc/{name}", payload, asked=asked)
        next(answer for key, answer in self.bus.answers.items() if meet(key, question.key))(question)
        return question

    def values(self, path: str) -> list[dict[str, Any]]:
        return [msgpack.unpackb(payload) for payload in self.bus.values(f"fleet/r1/{path}")]

    def last(self, path: str) -> dict[str, Any]:
        return self.values(path)[-1]

    def forget_written(self) -> None:
        self._read = len(self.link.written)

    def written(self) -> list[bytes]:
        """What was written since this was asked last."""
        start, self._read = self._read, len(self.link.written)
        return self.link.written[start:]

    @property
    def control(self) -> dict[str, Any]:
        """What ``control`` shows, without the refusals."""
        return {name: value for name, value in self.last("control").items() if name != "refusals"}

    async def refusals(self) -> list[tuple[str, str, int]]:
        """What ``control`` shows: command, reason, count."""
        return [(command, reason, count) for _, command, reason, count in await self.refused()]

    async def refused(self) -> list[tuple[str | None, str, str, int]]:
        """What ``control`` shows: who, command, reason, count."""
        await asyncio.sleep(0.06)
        shown = self.last("control")["refusals"]
        return [(entry["who"], entry["command"], entry["reason"], entry["count"]) for entry in shown]

    @property
    def audited(self) -> list[dict[str, Any]]:
        """The audit log without the times."""
        lines = [json.loads(line) for line in self.audit_lines]
        return [{name: value for name, value in line.items() if name not in ("time", "robot")} for line in lines]

    def counted(self, what: str) -> int:
        """How often the right to drive changed in this way."""
        return self.metrics.count("control", what=what).value


def handlers(rig: Rig, key: str) -> list[Callable[[Sample], None]]:
    """Give who subscribed to what this key expression meets, by Zenoh's own rules."""
    expression = zenoh.KeyExpr(key)
    return [
        take for subscribed, take in rig.bus._shared.subscribers if zenoh.KeyExpr(subscribed).intersects(expression)
    ]


@contextlib.asynccontextmanager
async def serving(
    options: Options | None = None, *, unreachable: str | None = None, hold: bool = True, **more: Any
) -> AsyncIterator[Rig]:
    """Run a device; unless told otherwise, a program holds the lease."""
    rig = Rig(options, **more)
    rig.unreachable = unreachable
    task = asyncio.create_task(rig.device.run())
    try:
        await rig.settle()
        if hold:
            assert rig.hold()["ok"]
        yield rig
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@contextlib.asynccontextmanager
async def established(options: Options | None = None, **more: Any) -> AsyncIterator[Rig]:
    async with serving(options, **more) as rig:
        await rig.establish()
        yield rig


rig = scene_of(established)


# Handshake and status


async def test_the_robot_speaks_first_and_nothing_is_written_before() -> None:
    async with serving() as rig:
        await asyncio.sleep(1.0)
        assert rig.link.written == []
        assert rig.last("status")["state"] == "handshaking"


async def test_the_settings_are_answered_and_the_status_shows_what_was_agreed() -> None:
    async with serving() as rig:
        rig.sends(SETTINGS)
        assert rig.link.written == [ANSWER]
        status = rig.last("status")
        assert status["state"] == "established"
        assert status["reason"] is None
        assert status["protocol"] == "tcpudp"
        assert status["version"] == "1.3"
        assert status["features"] == ["cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map"]
        assert status["stamp_ns"] == 1234
        assert status["links"] == [
            {"name": "robot", "state": "established", "peer": "tcp://robot.test:11001", "reason": None}
        ]


async def test_the_settings_may_come_byte_by_byte() -> None:
    async with serving() as rig:
        for byte in SETTINGS:
            assert rig.link.written == []
            rig.sends(bytes([byte]))
        assert rig.link.written == [ANSWER]


async def test_the_status_goes_through_every_state_in_order() -> None:
    async with serving() as rig:
        await rig.establish()
        assert [status["state"] for status in rig.values("status")][:4] == [
            "offline",
            "connecting",
            "handshaking",
            "established",
        ]
        assert rig.values("status")[0]["reason"] == "not yet connected"


async def test_status_and_control_are_repeated_every_second(rig: Rig) -> None:
    status, control = len(rig.values("status")), len(rig.values("control"))
    await asyncio.sleep(3 * HEARTBEAT_S)
    assert len(rig.values("status")) == status + 3
    assert len(rig.values("control")) == control + 3


async def test_a_silent_robot_is_left_with_the_reason_that_its_connection_may_be_used_up() -> None:
    async with serving() as rig:
        await asyncio.sleep(5.1)
        offline = [status for status in rig.values("status") if status["state"] == "offline"]
        assert "one connection may be used up" in offline[-1]["reason"]
        assert rig.links[0].closed


async def test_an_unreachable_robot_shows_as_offline_with_the_reason_and_is_tried_again() -> None:
    async with serving(unreachable="tcp://robot.test:11001: Connection refused") as rig:
        assert rig.last("status")["state"] == "offline"
        assert rig.last("status")["reason"] == "tcp://robot.test:11001: Connection refused"
        rig.unreachable = None
        await asyncio.sleep(1.0)
        await rig.establish()
        assert rig.last("status")["state"] == "established"


async def test_attempts_to_reach_a_robot_come_ever_more_rarely() -> None:
    async with serving(unreachable="no route") as rig:
        await asyncio.sleep(60.0)
        attempts = [status for status in rig.values("status") if status["state"] == "connecting"]
        assert 7 <= len(attempts) <= 14


async def test_a_robot_without_a_common_version_is_told_so_and_left() -> None:
    async with serving() as rig:
        rig.sends(
            bytes.fromhex("19000000 01 02 02 03000000") + b"9.9" + bytes.fromhex("00010101010101 1e000000 0a000000")
        )
        status = rig.last("status")
        assert status["state"] == "offline"
        assert status["reason"].startswith("no common version: the peer speaks '9.9'")
        (told,) = rig.link.written
        text = status["reason"].encode()
        assert told == (6 + len(text)).to_bytes(4, "little") + b"\x02\x01" + len(text).to_bytes(4, "little") + text
        await rig.settle()
        assert rig.link.closed


async def test_a_broken_stream_ends_the_session_and_says_why(rig: Rig) -> None:
    rig.sends(bytes.fromhex("00000000 01 37"))
    await rig.settle()
    assert rig.last("status")["state"] == "offline"
    assert "broken stream" in rig.last("status")["reason"]
    assert rig.links[0].closed


async def test_a_malformed_packet_costs_nothing_but_itself(rig: Rig) -> None:
    rig.sends(bytes.fromhex("03000000 01 37 00") + POSITION)
    assert rig.last("status")["state"] == "established"
    assert len(rig.values("pose")) == 1
    assert rig.conversations[0].session.traffic.malformed == 1


async def test_the_session_table_shows_the_live_session_and_remembers_the_lost_one(rig: Rig) -> None:
    (shown,) = rig.manager.snapshots()
    assert (shown.name, shown.peer, shown.state) == ("robot", "tcp://robot.test:11001", "established")
    rig.goes()
    await rig.settle()
    assert [shown.reason for shown in rig.manager.snapshots()] == ["closed by peer"]


# Telemetry: bytes of the protocol page, fields of the fleet messages


@pytest.mark.parametrize(
    ("packet", "path", "fields"),
    [
        (BYE, "text", {"text": "bye", "kind": "debug", "sender": None}),
        ("06000000 01 33 01000000", "lidar", {"on": True}),
        ("06000000 01 33 02000000", "lidar", {"on": False}),
        ("06000000 01 1f 01000000", "camera", {"on": True}),
        ("06000000 01 1f 02000000", "camera", {"on": False}),
        ("05000000 01 28 aabbcc", "raw/tcpudp", {"id": 40, "body": b"\xaa\xbb\xcc"}),
        ("03000000 01 46 07", "raw/tcpudp", {"id": 70, "body": b"\x07"}),
        ("02000000 01 c8", "raw/tcpudp", {"id": 200, "body": b""}),
        ("02000000 01 3c", "text", {"text": "simulated lidar data", "kind": "request", "sender": None}),
    ],
)
async def test_a_packet_is_published_on_its_key(rig: Rig, packet, path, fields) -> None:
    rig.sends(bytes.fromhex(packet) if isinstance(packet, str) else packet)
    assert rig.last(path) == {**fields, "stamp_ns": 1234}


async def test_a_position_is_published_in_metres_and_radians(rig: Rig) -> None:
    rig.sends(POSITION)  # 150 cm, -50 cm, 90 degrees
    pose = rig.last("pose")
    assert pose["x"] == pytest.approx(1.5)
    assert pose["y"] == pytest.approx(-0.5)
    assert pose["heading"] == pytest.approx(math.pi)
    assert pose["stamp_ns"] == 1234


async def test_a_map_is_published_with_rows_of_y(rig: Rig) -> None:
    rig.sends(MAP)  # x 0: 0 1 2, x 1: 2 2 0, x 2: 1 0 1
    shown = rig.last("map")
    assert (shown["rows"], shown["columns"]) == (3, 3)
    assert shown["cells"] == bytes([0, 2, 1, 1, 2, 0, 2, 0, 1])
    assert shown["cell"] == pytest.approx(0.1)
    assert shown["origin"] == pytest.approx([-0.15, -0.15])


@pytest.mark.parametrize("packet", ["06000000 01 35 00000000", "02000000 01 35"])
async def test_a_robot_that_has_no_map_yet_shows_an_empty_one(rig: Rig, packet: str) -> None:
    rig.sends(bytes.fromhex(packet) + POSITION)
    assert rig.last("status")["state"] == "established"
    shown = rig.last("map")
    assert (shown["rows"], shown["columns"], shown["cells"]) == (0, 0, b"")
    assert len(rig.values("pose")) == 1


async def test_a_position_that_comes_as_packet_53_is_a_pose(rig: Rig) -> None:
    rig.sends(bytes.fromhex("0e000000 01 35 00001643 000048c2 0000b442"))
    assert (rig.last("pose")["x"], rig.last("pose")["y"]) == pytest.approx((1.5, -0.5))


async def test_what_came_before_a_broken_packet_is_published_before_the_robot_is_offline(rig: Rig) -> None:
    seen: list[str] = []
    rig.hq.subscribe("fleet/r1/pose", lambda sample: seen.append("pose"))
    rig.hq.subscribe("fleet/r1/status", lambda sample: seen.append(msgpack.unpackb(sample.payload)["state"]))
    rig.sends(POSITION + bytes(6))
    await rig.settle()
    assert seen == ["pose", "offline"]


async def test_a_latecomer_gets_the_last_map_and_status(rig: Rig) -> None:
    rig.sends(MAP)
    seen: list[str] = []
    rig.bus.join("3").subscribe("fleet/r1/*", lambda sample: seen.append(sample.key), history=True)
    assert sorted(seen) == ["fleet/r1/control", "fleet/r1/map", "fleet/r1/status"]


async def test_stream_messages_of_one_read_are_all_published_in_order_and_counted(rig: Rig) -> None:
    before = rig.metrics.total("published")
    rig.sends(POSITION + BYE + POSITION)
    assert len(rig.values("pose")) == 2
    assert len(rig.values("text")) == 1
    assert rig.metrics.total("published") == before + 3


@pytest.mark.parametrize("packet", [bytes.fromhex("06000000 01 33 01000000"), MAP, BYE, POSITION])
async def test_states_and_maps_count_as_published_like_everything_else(rig: Rig, packet: bytes) -> None:
    before = rig.metrics.total("published")
    rig.sends(packet)
    assert rig.metrics.total("published") == before + 1


async def test_a_packet_without_meaning_is_counted_and_not_published(rig: Rig) -> None:
    rig.sends(bytes.fromhex("0b000000 01 35 05000000 0000000000") + bytes.fromhex("06000000 01 33 07000000"))
    assert rig.values("map") == []
    assert rig.values("lidar") == []
    assert rig.metrics.total("untranslatable") == 2
    rig.sends(POSITION)
    assert len(rig.values("pose")) == 1


# Commands


@pytest.mark.parametrize(
    ("name", "fields", "packet"),
    [
        ("drive", {"left": 1.0}, MOVE_LEFT),
        ("drive", {"forward": 0.6, "left": 0.8}, "0e000000 02 0b cdcc4cbf 9a99193f 0000803f"),
        ("drive", {"turn": 0.5}, TURN_LEFT),
        ("drive", {}, STOP),
        ("stop", {}, STOP),
        ("mode", {"mode": "none"}, "06000000 02 0a 01000000"),
        ("mode", {"mode": "manual"}, "06000000 02 0a 02000000"),
        ("mode", {"mode": "autonomous"}, "06000000 02 0a 03000000"),
        ("lidar", {"on": True}, "06000000 02 32 01000000"),
        ("lidar", {"on": False}, "06000000 02 32 02000000"),
        ("text", {"text": "hi"}, "08000000 02 01 02000000 6869"),
        ("raw/tcpudp", {"id": 40, "body": b"\x01\x02"}, "04000000 02 28 0102"),
        ("raw/tcpudp", {"id": 21, "body": b"\x01"}, "03000000 02 15 01"),
    ],
)
async def test_a_command_becomes_its_packet(rig: Rig, name: str, fields: dict[str, Any], packet: str | bytes) -> None:
    rig.command(name, fields)
    assert rig.written() == [bytes.fromhex(packet) if isinstance(packet, str) else packet]
    assert rig.metrics.total("commands") == 1
    assert rig.metrics.total("refused") == 0


async def test_a_drive_is_repeated_while_the_robot_moves(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(1.1)
    assert rig.written() == [MOVE_LEFT] * 5


async def test_a_newer_drive_replaces_the_one_that_waits_for_the_gap(rig: Rig) -> None:
    rig.command("text", {"text": "hi"})
    rig.command("drive", DRIVE_LEFT)
    rig.command("drive", {"turn": 0.5})
    await asyncio.sleep(0.05)
    assert rig.written()[1:] == [TURN_LEFT]


@pytest.mark.scene(Options(gap_s=0.02))
async def test_the_gap_is_kept_between_any_two_packets(rig: Rig) -> None:
    for _ in range(20):
        rig.command("text", {"text": "hi"})
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.command("stop")
    await asyncio.sleep(2.0)
    times = rig.link.times
    assert len(times) > 30
    assert min(later - earlier for earlier, later in itertools.pairwise(times)) >= 0.02 - 1e-9


async def test_a_stop_goes_before_everything_that_waits(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    for _ in range(30):
        rig.command("text", {"text": "hi"})
    rig.forget_written()
    rig.command("stop")
    await asyncio.sleep(0.0101)
    assert rig.written() == [STOP]


@pytest.mark.parametrize("payload", [b"", b"stop", b"\x01", b"\xc1", b"\x90", msgpack.packb({"stamp_ns": "now"})])
async def test_a_stop_stops_the_robot_whatever_its_payload(rig: Rig, payload: bytes) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    rig.command("stop", payload)
    assert rig.written() == [STOP]
    assert rig.last("control")["state"] == "stopped"
    assert rig.metrics.total("refused") == 0


async def test_a_stop_leaves_before_neutral_and_motion_of_the_next_holder_that_follow_at_once(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    rig.forget_written()
    rig.command("stop")
    rig.hold()
    rig.command("drive", NEUTRAL)
    rig.command("drive", {"turn": 0.5})
    await asyncio.sleep(0.05)
    assert rig.written() == [STOP, TURN_LEFT]


async def test_a_stop_goes_to_a_robot_that_takes_nothing_as_soon_as_it_takes_something(rig: Rig) -> None:
    rig.link.ready = False
    for _ in range(80):
        rig.command("lidar", {"on": True})
    rig.command("stop")
    rig.link.ready = True
    rig.conversations[-1].writable()
    assert rig.written() == [STOP]


async def test_a_stop_for_a_robot_that_cannot_be_stopped_is_refused_and_motion_is_stopped_all_the_same() -> None:
    async with serving() as rig:
        await rig.establish(PLAIN_SETTINGS)
        rig.command("stop")
        assert rig.last("control")["state"] == "stopped"
        ((command, reason, _),) = await rig.refusals()
        assert (command, "joystick" in reason) == ("stop", True)
        assert rig.written() == []


async def test_a_stop_is_repeated_for_a_second_and_then_nothing_more_is_sent(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    start = rig.loop.time()
    rig.command("stop")
    await asyncio.sleep(5.0)
    stops = rig.written()
    assert set(stops) == {STOP}
    assert 10 <= len(stops) <= 11
    times = rig.link.times[-len(stops) :]
    assert times[0] == start
    assert STOP_REPEAT_S - 0.11 <= times[-1] - start <= STOP_REPEAT_S + 1e-6


async def test_a_stop_shows_on_control_at_once(rig: Rig) -> None:
    rig.command("stop")
    assert rig.last("control")["state"] == "stopped"


async def test_nobody_drives_after_a_stop_before_acquiring_anew(rig: Rig) -> None:
    rig.command("stop")
    await asyncio.sleep(2.0)
    rig.forget_written()
    for fields in (DRIVE_LEFT, NEUTRAL, DRIVE_LEFT):
        rig.command("drive", fields)
        await asyncio.sleep(0.1)
    assert rig.written() == []
    assert await rig.refused() == [("driver", "drive", "the lease has ended (stop)", 3)]
    assert rig.driver.renew() == {**DENIED, "reason": "the lease has ended (stop)", "code": "lease_ended"}
    rig.hold()
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == [MOVE_LEFT], "whoever acquires needs no neutral"


async def test_a_refused_drive_does_not_end_the_stop_that_is_repeated(rig: Rig) -> None:
    rig.command("stop")
    for _ in range(10):
        rig.command("drive", DRIVE_LEFT)
        await asyncio.sleep(0.05)
    assert set(rig.written()) == {STOP}


@pytest.mark.scene(deadman_s=0.6)
async def test_silence_while_moving_stops_the_robot_after_the_deadman_time(rig: Rig) -> None:
    start = rig.loop.time()
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.59)
    assert set(rig.written()) == {MOVE_LEFT}
    await asyncio.sleep(3.0)
    stops = rig.written()
    assert set(stops) == {STOP}
    assert 10 <= len(stops) <= 11
    assert rig.link.times[-len(stops)] == pytest.approx(start + 0.6)
    assert rig.link.times[-1] - rig.link.times[-len(stops)] >= STOP_REPEAT_S - 0.11
    assert rig.control["holder"] == "driver", "the lease stays until it expires"


@pytest.mark.scene(deadman_s=0.6)
async def test_nothing_but_the_holders_fresh_commands_keeps_the_robot_moving(rig: Rig) -> None:
    other = Program(rig, "other")
    seen = rig.driver.attachment("drive", DRIVE_LEFT)
    rig.driver.put("drive", DRIVE_LEFT, seen)
    for _ in range(4):
        await asyncio.sleep(0.145)
        rig.command("text", {"text": "hi"})
        rig.command("dance")
        rig.driver.put("drive", DRIVE_LEFT, seen)
        rig.driver.put("drive", DRIVE_LEFT, None)
        rig.driver.renew()
        rig.ask("pose")
        other.command("drive", DRIVE_LEFT)
        other.acquire()
    assert STOP not in rig.written()
    await asyncio.sleep(0.03)
    assert STOP in rig.written()


@pytest.mark.scene(deadman_s=0.2)
async def test_motion_after_the_deadman_needs_neutral(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(3.0)
    rig.forget_written()
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == []
    ((_, reason, _),) = await rig.refusals()
    assert "deadman" in reason
    rig.command("drive", NEUTRAL)
    await asyncio.sleep(0.1)
    rig.command("drive", DRIVE_LEFT)
    assert rig.written()[-1] == MOVE_LEFT


async def test_the_loss_of_the_bus_stops_a_moving_robot_and_ends_the_lease(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    rig.bus.connection(False)
    assert rig.written() == [STOP]
    await asyncio.sleep(2.0)
    assert len(rig.written()) >= 9
    rig.bus.connection(True)
    for fields in (NEUTRAL, DRIVE_LEFT):
        rig.command("drive", fields)
    assert rig.written() == []
    assert await rig.refused() == [("driver", "drive", "the lease has ended (bus lost)", 2)]
    rig.hold()
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == [MOVE_LEFT]


async def test_the_loss_of_the_bus_ends_the_lease_of_a_standing_robot_and_sends_it_nothing(rig: Rig) -> None:
    rig.bus.connection(False)
    await asyncio.sleep(1.0)
    assert rig.written() == []
    assert (rig.control["state"], rig.control["holder"]) == ("stopped", None)
    rig.bus.connection(True)
    assert rig.driver.renew()["reason"] == "the lease has ended (bus lost)"


@pytest.mark.scene(hold=False)
async def test_the_loss_of_the_bus_is_nothing_to_a_robot_nobody_holds(rig: Rig) -> None:
    rig.bus.connection(False)
    await asyncio.sleep(1.0)
    assert rig.control["state"] == "free"
    assert rig.audit_lines == []


# The lease


OF_THE_HOLDER = [
    ("drive", DRIVE_LEFT),
    ("drive", NEUTRAL),
    ("mode", {"mode": "manual"}),
    ("raw/tcpudp", {"id": 40, "body": b"hi"}),
    ("motor/left", {"value": 1.0}),
]


@pytest.mark.scene(hold=False, lease_s=3.0)
async def test_whoever_acquires_a_free_robot_is_given_its_lease_and_shown_as_the_holder(rig: Rig) -> None:
    free = {"state": "free", "holder": None, "lease": None, "priority": None, "expires_in_s": None}
    assert rig.control == free
    granted = {"ok": True, "lease": bytes([1]) * 8, "token": bytes([1]) * 32, "expires_in_s": 3.0}
    assert rig.hold(priority=4) == {**granted, "holder": "driver", "reason": None, "code": None}
    held = {"state": "held", "holder": "driver", "lease": bytes([1]) * 8, "priority": 4, "expires_in_s": 3.0}
    assert rig.control == held
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == [MOVE_LEFT]
    assert (rig.counted("acquired"), rig.metrics.total("refused")) == (1, 0)


@pytest.mark.scene(lease_s=5.0)
async def test_control_counts_the_time_that_is_left_down_and_never_shows_the_token(rig: Rig) -> None:
    rig.hold("takeover")
    assert rig.driver.held is not None
    start = rig.loop.time()
    await asyncio.sleep(3 * HEARTBEAT_S)
    left = rig.control["expires_in_s"]
    assert 5.0 - 3 * HEARTBEAT_S <= left < 5.0 - 2 * HEARTBEAT_S + 1e-6
    assert rig.loop.time() == pytest.approx(start + 3.0)
    token = rig.driver.held.token
    rig.command("drive", DRIVE_LEFT)
    rig.command("stop")
    assert not any(token in payload for payload in rig.bus.values("fleet/r1/*"))
    assert not any(token in (sample.attachment or b"") for sample in rig.bus._shared.history)
    assert len(rig.bus.values("fleet/*/@cmd/**")) == 2, "commands were looked at as well"


@pytest.mark.parametrize(("name", "fields"), OF_THE_HOLDER)
@pytest.mark.scene(hold=False)
async def test_without_the_lease_nothing_that_may_move_the_robot_is_carried_out(rig: Rig, name, fields) -> None:
    rig.command(name, fields)
    assert rig.written() == []
    assert rig.metrics.total("refused") == 1
    assert await rig.refused() == [(None, name, "no lease: acquire first", 1)]
    assert rig.counted("stopped") == 0


@pytest.mark.parametrize(("name", "fields"), OF_THE_HOLDER)
async def test_of_two_programs_only_the_holders_commands_are_carried_out(rig: Rig, name, fields) -> None:
    other = Program(rig, "other")
    assert other.acquire("takeover")["ok"]
    assert rig.hold("takeover")["ok"]
    rig.command("drive", {"turn": 0.5})
    await asyncio.sleep(0.05)
    assert rig.written() == [TURN_LEFT]
    for _ in range(3):
        other.command(name, fields)
    assert rig.written() == []
    assert await rig.refused() == [("other", name, "the lease has ended (taken over by driver)", 3)]
    assert rig.metrics.total("refused") == 3
    assert rig.control["holder"] == "driver"
    rig.command("drive", {"turn": 0.5})
    assert rig.written() == [TURN_LEFT], "the holder drives on"


async def test_a_guessed_lease_is_nobodys_and_a_guessed_token_of_the_right_one_neither(rig: Rig) -> None:
    forger = Program(rig, "forger")
    for held in (STRANGE, Holder(bytes([1]) * 8, bytes(32)), Holder(bytes([1]) * 8, bytes([1]) * 31)):
        held.seq = 1_000
        forger.put("drive", DRIVE_LEFT, held.attachment("drive", packed(DRIVE_LEFT)))
    assert rig.written() == []
    assert await rig.refused() == [(None, "drive", "held by driver (priority 0)", 1), (None, "drive", "wrong proof", 2)]
    assert [entry["code"] for entry in rig.last("control")["refusals"]] == ["held", "malformed"]
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == [MOVE_LEFT], "their numbers are not the holder's"


async def test_what_was_overheard_is_good_for_no_other_command_and_no_other_payload(rig: Rig) -> None:
    seen = rig.driver.attachment("motor/left", {"value": 0.5})
    for name, fields in (("motor/right", {"value": 0.5}), ("motor/left", {"value": 0.6}), ("mode", {"value": 0.5})):
        rig.driver.put(name, fields, seen)
    assert [(command, reason) for command, reason, _ in await rig.refusals()] == [
        ("motor/right", "wrong proof"),
        ("motor/left", "wrong proof"),
        ("mode", "wrong proof"),
    ]
    assert rig.metrics.total("refused") == 3


@pytest.mark.parametrize(
    "key",
    [
        "fleet/*/@cmd/drive",
        "fleet/r1/@cmd/*",
        "fleet/**/@cmd/drive",
        "*/r1/@cmd/drive",
        "fleet/r1/@cmd/**",
        "fleet/r1/@cmd/motor/*",
        "fleet/*/@cmd/light",
    ],
)
async def test_a_command_whose_key_has_wildcards_is_refused_whoever_proves_it(rig: Rig, key: str) -> None:
    held = rig.driver.held
    assert held is not None
    payload = packed(DRIVE_LEFT)
    attachment = shown(held.lease, held.token, key, 1, payload)
    rig.hq.publisher(key, topics.CMD_DRIVE).put(payload, attachment)
    assert MOVE_LEFT not in rig.written()
    assert await rig.refused() == [(None, key.rpartition("@cmd/")[2], "its key has wildcards", 1)]
    assert rig.last("control")["refusals"][0]["code"] == "malformed"


@pytest.mark.parametrize("key", ["fleet/*/@cmd/stop", "fleet/**/@cmd/stop", "*/*/@cmd/stop", "fleet/r$*/@cmd/stop"])
@pytest.mark.scene(deadman_s=60.0)
async def test_a_stop_alone_may_have_wildcards(rig: Rig, key: str) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    for handler in handlers(rig, key):
        handler(Sample(key, b""))
    assert rig.written() == [STOP]
    assert rig.control["state"] == "stopped"
    assert await rig.refused() == []


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("text", {"text": "hi"}),
        ("lidar", {"on": True}),
        ("scan", {"angle_min": 0.0, "angle_increment": 1.0, "range_min": 0.1, "range_max": 9.0, "ranges": bytes(8)}),
        ("stop", {}),
    ],
)
@pytest.mark.parametrize("hold", [False, True])
async def test_what_moves_nothing_needs_no_lease(name: str, fields: dict[str, Any], hold: bool) -> None:
    async with established(hold=hold) as rig:
        Program(rig, "other").command(name, fields)
        assert len(rig.written()) == 1
        assert rig.metrics.total("refused") == 0


@pytest.mark.scene(hold=False)
async def test_a_light_that_the_robot_has_not_is_refused_for_that_and_not_for_want_of_a_lease(rig: Rig) -> None:
    rig.command("light", {"on": True})
    assert await rig.refusals() == [("light", "a TCP/UDP robot has no such command", 1)]


@pytest.mark.scene(lease_s=3.0)
async def test_a_robot_that_is_held_is_not_given_to_another_of_the_same_priority(rig: Rig) -> None:
    other = Program(rig, "other")
    assert other.acquire() == {
        **DENIED,
        "expires_in_s": pytest.approx(3.0 - 1.15),
        "holder": "driver",
        "reason": "held by driver (priority 0)",
        "code": "held",
    }
    assert await rig.refused() == [("other", "acquire", "held by driver (priority 0)", 1)]
    assert rig.metrics.total("refused") == 1
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == [MOVE_LEFT]


@pytest.mark.parametrize(("how", "priority"), [("takeover", 0), ("takeover", -5), ("acquire", 1)])
@pytest.mark.scene(deadman_s=60.0)
async def test_the_stop_of_a_moving_robot_that_changes_hands_goes_before_the_new_holders_motion(
    rig: Rig, how: str, priority: int
) -> None:
    other = Program(rig, "other")
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    assert other.acquire(how, priority=priority)["ok"]
    other.command("drive", {"turn": 0.5})
    assert rig.written() == [STOP]
    await asyncio.sleep(2.0)
    assert set(rig.written()) == {TURN_LEFT}
    rig.command("drive", DRIVE_LEFT)
    assert await rig.refused() == [("driver", "drive", "the lease has ended (taken over by other)", 1)]
    assert (rig.control["holder"], rig.control["priority"]) == ("other", priority)
    assert rig.counted("taken over" if how == "takeover" else "acquired") == (1 if how == "takeover" else 2)


async def test_a_standing_robot_that_changes_hands_is_sent_nothing(rig: Rig) -> None:
    Program(rig, "other").acquire("takeover")
    await asyncio.sleep(1.0)
    assert rig.written() == []


@pytest.mark.scene(deadman_s=60.0)
async def test_a_moving_robot_that_is_released_is_stopped_for_a_second_and_free(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    assert rig.driver.release() == {**DENIED, "ok": True}
    assert rig.written() == [STOP]
    assert rig.control["state"] == "free"
    await asyncio.sleep(2.0)
    stops = rig.written()
    assert set(stops) == {STOP}
    assert 9 <= len(stops) <= 10
    rig.command("drive", DRIVE_LEFT)
    assert await rig.refused() == [("driver", "drive", "the lease has ended (released)", 1)]
    assert Program(rig, "other").acquire()["ok"]


async def test_a_standing_robot_that_is_released_is_sent_nothing(rig: Rig) -> None:
    rig.driver.release()
    await asyncio.sleep(1.0)
    assert rig.written() == []
    assert rig.control["state"] == "free"


async def test_a_lease_that_has_ended_or_never_was_is_neither_renewed_nor_released(rig: Rig) -> None:
    rig.driver.release()
    ended = {**DENIED, "reason": "the lease has ended (released)", "code": "lease_ended"}
    assert (rig.driver.renew(), rig.driver.release()) == (ended, ended)
    never = {**DENIED, "reason": "no lease: acquire first", "code": "no_lease"}
    assert rig.driver.ask("renew", STRANGE.question("renew")) == never
    other = Program(rig, "other")
    other.acquire()
    for name in ("renew", "release"):
        denied = other.ask(name, STRANGE.question(name))
        assert (denied["ok"], denied["token"], denied["holder"]) == (False, None, "other")
        assert (denied["reason"], denied["code"]) == ("held by other (priority 0)", "held")
    assert rig.control["holder"] == "other"
    assert await rig.refused() == [
        ("driver", "renew", "the lease has ended (released)", 1),
        ("driver", "release", "the lease has ended (released)", 1),
        (None, "renew", "no lease: acquire first", 1),
        (None, "renew", "held by other (priority 0)", 1),
        (None, "release", "held by other (priority 0)", 1),
    ]


async def test_a_question_about_the_lease_that_was_overheard_is_good_for_nothing(rig: Rig) -> None:
    held = rig.driver.held
    assert held is not None
    overheard = held.question("renew")
    assert rig.driver.ask("release", overheard)["code"] == "malformed", "of another key"
    assert rig.driver.ask("renew", overheard)["ok"]
    assert rig.driver.ask("renew", overheard)["code"] == "out_of_order"
    rig.driver.put("drive", b"", overheard)
    assert rig.control["holder"] == "driver"
    assert await rig.refused() == [
        (None, "release", "wrong proof", 1),
        (None, "renew", "repeated or out of order", 1),
        (None, "drive", "wrong proof", 1),
    ]
    assert rig.driver.release()["ok"]


@pytest.mark.parametrize("name", ["acquire", "takeover"])
@pytest.mark.parametrize(
    ("who", "at", "ok"),
    [
        ("op1", "op1", True),
        ("op1.laptop", "op1", True),
        ("me@here", "me%40here", True),
        ("op2", "op1", False),
        ("op12", "op1", False),
        ("op1", "op1.laptop", False),
        ("op1", "%6Fp1", False),
    ],
)
@pytest.mark.scene(hold=False)
async def test_a_program_asks_in_its_own_name_only(rig: Rig, name: str, who: str, at: str, ok: bool) -> None:
    (reply,) = rig.ask(f"control/{name}/{at}", packed({"who": who})).replies
    if ok:
        assert rig.control["holder"] == who
        return
    assert isinstance(reply.error, Malformed)
    asked_as = "op1" if at == "%6Fp1" else at
    reason = f"who = {who!r}: expected {asked_as!r}, or that and '.suffix'"
    assert str(reply.error) == reason
    assert await rig.refused() == [(None, name, reason, 1)]
    assert rig.control["state"] == "free"


@pytest.mark.parametrize(
    ("name", "asked"),
    [
        ("acquire/*", "fleet/r1/@rpc/control/acquire/*"),
        ("acquire/other", "fleet/*/@rpc/control/acquire/other"),
        ("takeover/*", "fleet/*/@rpc/control/takeover/*"),
        ("renew", "fleet/*/@rpc/control/renew"),
        ("release", "fleet/r1/@rpc/control/*"),
    ],
)
async def test_a_question_about_the_lease_whose_key_has_wildcards_is_refused(rig: Rig, name: str, asked: str) -> None:
    held = rig.driver.held
    assert held is not None
    payload = shown(held.lease, held.token, asked, 9) if name in ("renew", "release") else packed({"who": "other"})
    (reply,) = rig.ask(f"control/{name}", payload, asked=asked).replies
    assert isinstance(reply.error, Malformed)
    assert await rig.refused() == [(None, name.partition("/")[0], "its key has wildcards", 1)]
    assert rig.control["holder"] == "driver"


@pytest.mark.parametrize("name", ["acquire/ann", "takeover/ann", "renew", "release"])
@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x90", b"\x81", packed({"who": 5, "lease": 5})])
@pytest.mark.scene(hold=False)
async def test_a_malformed_question_about_the_lease_is_refused_with_what_was_expected(rig: Rig, name, payload) -> None:
    (reply,) = rig.ask(f"control/{name}", payload).replies
    assert isinstance(reply.error, Malformed)
    reason = str(reply.error)
    if name in ("renew", "release"):
        assert reason == "malformed authorization: expected {lease, seq, proof}"
    else:
        assert re.match("Acquire: .....", reason), "the message that was expected"
    assert await rig.refused() == [(None, name.partition("/")[0], reason, 1)]
    assert rig.control["state"] == "free"


@pytest.mark.scene(hold=False, lease_s=3.0, deadman_s=0.5)
async def test_wishes_are_capped_by_the_robots_own(rig: Rig) -> None:
    assert rig.hold(lease_s=100.0, deadman_s=100.0)["expires_in_s"] == 3.0
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.55)
    assert rig.written()[-1] == STOP
    assert rig.hold("takeover", lease_s=1.0, deadman_s=0.1)["expires_in_s"] == 1.0
    await asyncio.sleep(0.01)
    rig.command("drive", DRIVE_LEFT)
    rig.forget_written()
    await asyncio.sleep(0.15)
    assert STOP in rig.written()
    await asyncio.sleep(1.0)
    assert rig.control["state"] == "stopped"


# The end of a lease


@pytest.mark.parametrize(
    ("name", "fields", "sent", "stop"),
    [
        ("drive", DRIVE_LEFT, MOVE_LEFT, [STOP]),
        ("mode", {"mode": "autonomous"}, AUTONOMOUS, [MODE_NONE, STOP]),
        ("raw/tcpudp", {"id": 21, "body": b"\x01"}, bytes.fromhex("03000000 02 15 01"), [STOP]),
    ],
)
@pytest.mark.scene(lease_s=1.0, deadman_s=5.0, hold=False)
async def test_a_lease_that_expires_stops_a_robot_that_moves_or_may(rig: Rig, name, fields, sent, stop) -> None:
    rig.hold()
    await asyncio.sleep(0.5)
    start = rig.loop.time()
    rig.command(name, fields)
    await asyncio.sleep(0.99)
    assert set(rig.written()) == {sent}
    await asyncio.sleep(3.0)
    stops = rig.written()
    assert stops == stop * (len(stops) // len(stop))
    assert 10 <= len(stops) // len(stop) <= 11
    assert rig.link.times[-len(stops)] == pytest.approx(start + 1.0)
    assert rig.control["state"] == "stopped"
    assert {rig.control[name] for name in ("holder", "lease", "priority", "expires_in_s")} == {None}
    for again in (NEUTRAL, DRIVE_LEFT):
        rig.command("drive", again)
    assert rig.written() == []
    assert await rig.refused() == [("driver", "drive", "the lease has ended (lease expired)", 2)]
    rig.hold()
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == [MOVE_LEFT]


@pytest.mark.parametrize("mode", ["none", "manual"])
@pytest.mark.scene(lease_s=1.0, hold=False)
async def test_a_lease_that_expires_ends_and_sends_a_standing_robot_nothing(rig: Rig, mode: str) -> None:
    rig.hold()
    rig.command("mode", {"mode": mode})
    rig.forget_written()
    await asyncio.sleep(3.0)
    assert rig.written() == []
    assert rig.control["state"] == "stopped"
    assert rig.counted("ended") == 1


@pytest.mark.scene(lease_s=1.0, deadman_s=0.3, hold=False)
async def test_renewing_keeps_a_robot_going_that_moves_on_its_own(rig: Rig) -> None:
    rig.hold()
    rig.command("mode", {"mode": "autonomous"})
    for _ in range(10):
        await asyncio.sleep(0.9)
        assert rig.driver.renew() == {**DENIED, "ok": True, "expires_in_s": 1.0, "holder": "driver"}
    assert rig.written() == [AUTONOMOUS]


@pytest.mark.scene(deadman_s=60.0, hold=False)
async def test_a_holder_whose_liveliness_token_goes_is_lost_and_the_robot_stopped_in_the_same_moment(rig: Rig) -> None:
    token = rig.hq.announce("fleet/r1/@alive/operator.7")
    rig.hold(alive="operator.7")
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    token.close()
    assert rig.written() == [STOP]
    assert rig.control["state"] == "stopped"
    for fields in (NEUTRAL, DRIVE_LEFT):
        rig.command("drive", fields)
    assert await rig.refused() == [("driver", "drive", "the lease has ended (holder lost)", 2)]
    await asyncio.sleep(2.0)
    assert set(rig.written()) == {STOP}
    rig.hold()
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == [MOVE_LEFT]


@pytest.mark.scene(deadman_s=60.0, hold=False)
async def test_the_liveliness_token_of_anybody_else_is_nothing_to_the_holder(rig: Rig) -> None:
    own = rig.hq.announce("fleet/r1/@alive/operator.7")
    others = [
        rig.hq.announce(key)
        for key in ("fleet/r1/@alive/operator.8", "fleet/r2/@alive/operator.7", "fleet/r1/@alive/gateway")
    ]
    rig.hold(alive="operator.7")
    rig.command("drive", DRIVE_LEFT)
    for token in others:
        token.close()
    await asyncio.sleep(0.1)
    assert set(rig.written()) == {MOVE_LEFT}
    rig.driver.release()
    Program(rig, "other").acquire()
    own.close()
    assert rig.control["holder"] == "other", "the token of a lease that has ended"


@pytest.mark.scene(hold=False)
async def test_a_holder_without_a_liveliness_token_is_not_refused(rig: Rig) -> None:
    assert rig.hold(alive="operator.7")["ok"]
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == [MOVE_LEFT]


async def test_a_lease_outlives_the_loss_of_the_robot(rig: Rig) -> None:
    rig.goes()
    await asyncio.sleep(1.0)
    assert rig.driver.renew()["ok"]
    assert Program(rig, "other").acquire()["reason"] == "held by driver (priority 0)"
    await rig.establish()
    rig.command("drive", DRIVE_LEFT)
    assert [reason for _, reason, _ in await rig.refusals()] == [
        "held by driver (priority 0)",
        "robot lost: send a neutral drive first",
    ]
    rig.command("drive", NEUTRAL)
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.05)
    assert rig.written()[-1] == MOVE_LEFT


@pytest.mark.scene(deadman_s=60.0)
async def test_a_robot_that_is_busy_is_stopped_and_the_lease_stays_but_needs_neutral(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    rig.sends(bytes.fromhex("02000000 01 04"))  # serverStartUDP, unasked: it takes nothing for two seconds
    assert rig.last("status")["reason"] == "handshaking"
    assert [line["reason"] for line in rig.audited if line["event"] == "stopped"] == ["handshaking"]
    rig.command("drive", DRIVE_LEFT)
    rig.command("drive", NEUTRAL)
    assert await rig.refused() == [("driver", "drive", "handshaking", 2)]
    await asyncio.sleep(2.5)
    report, *rest = rig.written()
    assert report == bytes.fromhex("03000000 02 07 00"), "all that such a robot may be sent at first"
    assert set(rest) == {STOP}
    rig.command("drive", DRIVE_LEFT)
    assert (await rig.refused())[-1] == ("driver", "drive", "no longer busy: send a neutral drive first", 1)
    assert rig.control["holder"] == "driver"
    rig.command("drive", NEUTRAL)
    await asyncio.sleep(0.1)
    rig.command("drive", DRIVE_LEFT)
    assert rig.written()[-1] == MOVE_LEFT


@pytest.mark.scene(lease_s=2.0, hold=False)
async def test_a_lease_that_expires_while_the_robot_is_away_has_ended_when_it_returns(rig: Rig) -> None:
    rig.hold()
    rig.command("drive", DRIVE_LEFT)
    rig.goes()
    rig.unreachable = "no route"
    await asyncio.sleep(3.0)
    rig.unreachable = None
    await asyncio.sleep(3.0)
    await rig.establish()
    assert rig.control["state"] == "stopped"
    assert rig.metrics.total("refused") == 0, "a stop for a robot that is away is none that failed"
    rig.command("drive", NEUTRAL)
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == []


# A gateway that stood still itself


@pytest.mark.scene(deadman_s=0.6)
async def test_motion_that_comes_after_the_deadman_time_is_refused_although_the_gateway_was_frozen_meanwhile(
    rig: Rig,
) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    rig.freeze(5.0)
    rig.command("drive", {"turn": 0.5})
    assert rig.written() == [STOP]
    assert await rig.refusals() == [("drive", "deadman: send a neutral drive first", 1)]
    await asyncio.sleep(2.0)
    assert set(rig.written()) == {STOP}
    rig.command("drive", NEUTRAL)
    await asyncio.sleep(0.1)
    rig.command("drive", {"turn": 0.5})
    assert rig.written()[-1] == TURN_LEFT
    assert rig.counted("stopped") == 1


@pytest.mark.parametrize("attachment", [None, b"\xc1", STRANGE.attachment("drive", packed(NEUTRAL))])
@pytest.mark.scene(deadman_s=0.6)
async def test_a_late_command_of_anybody_lets_the_deadman_act(rig: Rig, attachment: bytes | None) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    rig.freeze(5.0)
    rig.driver.put("drive", NEUTRAL, attachment)
    assert rig.written() == [STOP]


@pytest.mark.scene(deadman_s=0.6)
async def test_a_late_neutral_is_taken_behind_the_stop_that_was_due(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    rig.freeze(5.0)
    rig.command("drive", NEUTRAL)
    rig.command("drive", {"turn": 0.5})
    await asyncio.sleep(0.05)
    assert rig.written() == [STOP, TURN_LEFT]
    assert [line["reason"] for line in rig.audited if line["event"] == "stopped"] == ["deadman"]


@pytest.mark.parametrize("how", ["drive", "renew", "release"])
@pytest.mark.scene(lease_s=3.0, hold=False)
async def test_what_the_holder_does_after_its_lease_expired_comes_too_late(rig: Rig, how: str) -> None:
    rig.hold()
    rig.command("mode", {"mode": "autonomous"})
    await asyncio.sleep(0.1)
    rig.forget_written()
    rig.freeze(5.0)
    if how == "drive":
        rig.command("drive", DRIVE_LEFT)
        await asyncio.sleep(0.01)
        assert rig.written() == [MODE_NONE, STOP]
        ((_, reason, _),) = await rig.refusals()
    else:
        reason = getattr(rig.driver, how)()["reason"]
        await asyncio.sleep(0.01)
        assert rig.written() == [MODE_NONE, STOP]
    assert reason == "the lease has ended (lease expired)"
    assert rig.control["state"] == "stopped"
    assert rig.counted("ended") == 1


@pytest.mark.scene(deadman_s=0.6)
async def test_a_gateway_that_wakes_from_being_frozen_sends_the_stop_before_any_repetition(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    rig.freeze(5.0)
    await asyncio.sleep(0.5)
    assert set(rig.written()) == {STOP}


@pytest.mark.parametrize(("name", "fields"), [("drive", {"left": 9.0}), ("motor/x", {"value": 1.0})])
@pytest.mark.scene(deadman_s=0.6)
async def test_refused_commands_of_the_holder_do_not_keep_the_robot_moving(rig: Rig, name, fields) -> None:
    rig.command("drive", DRIVE_LEFT)
    for _ in range(4):
        await asyncio.sleep(0.2)
        rig.command(name, fields)
    assert rig.written()[-1] == STOP
    assert rig.counted("stopped") == 1


@pytest.mark.scene(limits=MotionLimits(slew_per_s=1.0))
async def test_the_limits_begin_anew_after_a_stop_whatever_comes_first(rig: Rig) -> None:
    for _ in range(5):
        rig.command("drive", {"forward": 1.0})
        await asyncio.sleep(0.25)
    rig.driver.put("stop", NEUTRAL, None)
    await asyncio.sleep(2.0)
    rig.hold()
    rig.command("mode", {"mode": "autonomous"})
    await asyncio.sleep(0.1)
    rig.forget_written()
    rig.command("drive", {"forward": 1.0})
    await asyncio.sleep(0.05)
    assert rig.written()[-1] == forward_drive(0.25)


async def test_commands_are_served_in_the_midst_of_a_large_read(rig: Rig) -> None:
    attended: list[int] = []
    rig.bus.attend = lambda: attended.append(len(rig.values("pose")))  # type: ignore[method-assign]
    rig.sends(POSITION * (3 * ATTEND_EVERY))
    assert len(attended) == 3
    assert len(rig.values("pose")) == 3 * ATTEND_EVERY


@pytest.mark.parametrize("first", ["mode", "raw/tcpudp"])
@pytest.mark.parametrize("mode", ["manual", "none"])
async def test_a_release_stops_a_robot_that_was_let_move_by_itself_whatever_its_mode_is_now(rig, first, mode) -> None:
    rig.command(first, {"mode": "autonomous", "id": 40, "body": b"x"})
    rig.command("mode", {"mode": mode})
    await asyncio.sleep(0.1)
    rig.forget_written()
    rig.driver.release()
    assert STOP in rig.written()


# Limits on motion


def forward_drive(speed: float) -> bytes:
    return bytes.fromhex("0e000000 02 0b 00000000 0000803f") + struct.pack("<f", speed)


@pytest.mark.scene(limits=MotionLimits(slew_per_s=1.0))
async def test_a_robot_is_not_sent_faster_changes_than_its_owner_allows(rig: Rig) -> None:
    for _ in range(5):
        rig.command("drive", {"forward": 0.6})
        await asyncio.sleep(0.1)
    speeds = [round(struct.unpack("<f", data[-4:])[0], 3) for data in rig.written() if data[5] == 11]
    assert list(dict.fromkeys(speeds)) == [0.25, 0.35, 0.45, 0.55, 0.6]
    assert rig.metrics.total("drives_slowed") == 4
    rig.command("drive", {"forward": 0.1})
    assert rig.written() == [forward_drive(0.1)], "slowing down is never slowed"
    assert rig.metrics.total("drives_slowed") == 4


@pytest.mark.scene(limits=MotionLimits(slew_per_s=1.0), deadman_s=0.3)
async def test_after_a_stop_a_robot_starts_from_standing_again(rig: Rig) -> None:
    for _ in range(8):
        rig.command("drive", {"forward": 1.0})
        await asyncio.sleep(0.1)
    await asyncio.sleep(2.0)
    rig.hold("takeover")
    rig.forget_written()
    rig.command("drive", {"forward": 1.0})
    assert rig.written() == [forward_drive(0.25)]


@pytest.mark.scene(limits=MotionLimits(rate_hz=10.0))
async def test_drives_that_come_too_fast_are_refused_and_neutral_never_is(rig: Rig) -> None:
    for _ in range(5):
        rig.command("drive", DRIVE_LEFT)
    rig.command("drive", NEUTRAL)
    await asyncio.sleep(0.05)
    assert rig.written() == [MOVE_LEFT, STOP]
    assert await rig.refused() == [("driver", "drive", "more than 10 commands a second", 3)]
    await asyncio.sleep(0.1)
    rig.command("drive", DRIVE_LEFT)
    assert rig.written()[-1] == MOVE_LEFT


# What is written down, counted, and put in which lane


@pytest.mark.scene(hold=False, deadman_s=0.5)
async def test_the_audit_log_tells_who_drove_what_was_refused_and_what_stopped_the_robot(rig: Rig) -> None:
    other = Program(rig, "other")
    rig.hold(priority=2)
    other.acquire()
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(1.0)
    rig.command("drive", NEUTRAL)
    rig.command("drive", DRIVE_LEFT)
    other.acquire("takeover")
    other.release()
    rig.hold()
    other.command("stop")
    assert rig.audited == [
        {"event": "acquired", "who": "driver", "priority": 2},
        {"event": "refused", "who": "other", "command": "acquire", "reason": "held by driver (priority 2)"},
        {"event": "stopped", "who": "driver", "reason": "deadman", "stops": True},
        {"event": "ended", "who": "driver", "reason": "taken over by other", "stops": True},
        {"event": "taken over", "who": "other", "priority": 0},
        {"event": "released", "who": "other", "reason": "released"},
        {"event": "acquired", "who": "driver", "priority": 0},
        {"event": "stopped", "who": "driver", "reason": "stop", "stops": True},
    ]
    assert {json.loads(line)["robot"] for line in rig.audit_lines} == {"r1"}
    counted = {labels[0][1]: value for name, labels, value in rig.metrics if name == "control"}
    assert counted == {"acquired": 2, "stopped": 2, "ended": 1, "taken over": 1, "released": 1}
    assert rig.metrics.total("refused") == 1


@pytest.mark.scene(hold=False)
async def test_a_robot_that_was_lost_or_stopped_by_nobody_is_written_down_too(rig: Rig) -> None:
    rig.command("stop")
    rig.goes()
    assert [(line["event"], line["reason"]) for line in rig.audited] == [("stopped", "stop"), ("stopped", "robot lost")]


async def test_the_holders_commands_wait_for_nobody_elses_and_a_stop_for_nothing(rig: Rig) -> None:
    lane = rig.bus.lanes["fleet/r1/@cmd/**"]
    assert not isinstance(lane, Lane)
    held, drive = rig.driver.held, packed(DRIVE_LEFT)
    assert held is not None

    def lane_of(attachment: bytes | None, payload: bytes = drive, key: str = "fleet/r1/@cmd/drive") -> Lane | None:
        return lane(key, attachment, len(payload) + len(attachment or b""), lambda: payload)

    assert lane_of(None, key="fleet/r1/@cmd/stop") is lane_of(None, key="fleet/*/@cmd/stop") is Lane.STOP

    first, late = held.attachment("drive", drive), held.attachment("drive", drive)
    for other in (None, b"", b"\xc1", STRANGE.attachment("drive", drive)):
        assert lane_of(other) is Lane.OTHER
    near = Holder(held.lease, bytes(32), first=2**40)
    assert lane_of(near.attachment("drive", drive)) is Lane.OTHER, "who knows the id alone"
    assert lane_of(first, packed(NEUTRAL)) is lane_of(first, key="fleet/r1/@cmd/mode") is Lane.OTHER
    assert lane_of(first) is Lane.COMMAND, "whatever numbers others came with"
    assert lane_of(first) is Lane.OTHER, "what was overheard fills no lane of the holder's"
    assert lane_of(late) is Lane.COMMAND
    newest = held.attachment("drive", drive)
    Program(rig, "other").acquire("takeover")
    assert lane_of(newest) is Lane.OTHER
    rig.command("stop")
    assert lane_of(newest) is Lane.OTHER
    assert lane_of(b"") is Lane.OTHER


@pytest.mark.parametrize("name", ["renew", "release"])
async def test_the_holders_questions_wait_for_nobody_elses(rig: Rig, name: str) -> None:
    key = f"fleet/r1/@rpc/control/{name}"
    lane, commands, held = rig.bus.lanes[key], rig.bus.lanes["fleet/r1/@cmd/**"], rig.driver.held
    assert not isinstance(lane, Lane)
    assert not isinstance(commands, Lane)
    assert held is not None
    held.seq = 1_000  # its commands have numbers of their own
    assert commands("fleet/r1/@cmd/drive", held.attachment("drive", b""), 60, bytes) is Lane.COMMAND
    question = held.question(name)
    assert lane(f"fleet/r2/@rpc/control/{name}", question, 60, bytes) is Lane.OTHER
    assert lane(key, question, 60, bytes) is Lane.COMMAND
    assert lane(key, question, 60, bytes) is Lane.OTHER
    for asker in ("acquire", "takeover"):
        asking = rig.bus.lanes[f"fleet/r1/@rpc/control/{asker}/*"]
        assert not isinstance(asking, Lane)
        assert asking(f"fleet/r1/@rpc/control/{asker}/me", packed({"who": "me"}), 10, bytes) is Lane.OTHER


# Floods


async def test_what_the_gates_keep_back_is_shown_once_a_second_and_counted_like_any_refusal(rig: Rig) -> None:
    commands, acquires = rig.bus.lanes["fleet/r1/@cmd/**"], rig.bus.lanes["fleet/r1/@rpc/control/acquire/*"]
    assert not isinstance(commands, Lane)
    assert not isinstance(acquires, Lane)
    before = rig.metrics.total("refused")
    passed = [commands("fleet/r1/@cmd/drive", None, 10, bytes) for _ in range(1000)].count(Lane.OTHER)
    asked = [acquires("fleet/r1/@rpc/control/acquire/n", b"", 0, bytes) for _ in range(1000)].count(Lane.OTHER)
    await asyncio.sleep(1.1)
    kept_back = [entry for entry in rig.last("control")["refusals"] if entry["command"] in ("commands", "acquire")]
    assert [(entry["who"], entry["command"], entry["code"], entry["count"]) for entry in kept_back] == [
        (None, "commands", "no_lease", 1000 - passed),
        (None, "acquire", "rate", 1000 - asked),
    ]
    assert rig.metrics.total("refused") - before == 2000 - passed - asked
    await asyncio.sleep(1.1)
    assert rig.metrics.total("refused") - before == 2000 - passed - asked


async def test_more_than_five_takeovers_a_second_are_refused_and_the_last_one_keeps_the_robot(rig: Rig) -> None:
    taken = [rig.ask("control/takeover/n", packed({"who": f"n.{number}"})).replies[0] for number in range(8)]
    assert [reply.error is None for reply in taken] == [True] * 5 + [False] * 3
    assert {str(reply.error) for reply in taken[5:]} == {"more than 5 takeovers a second"}
    assert isinstance(taken[-1].error, TooFast)
    assert rig.control["holder"] == "n.4"
    assert (None, "takeover", "more than 5 takeovers a second", 3) in await rig.refused()
    await asyncio.sleep(0.25)
    assert rig.ask("control/takeover/n", packed({"who": "n"})).replies[0].error is None


async def test_a_stop_right_after_a_stop_is_not_carried_out_again(rig: Rig) -> None:
    gate = rig.bus.lanes["fleet/r1/@cmd/**"]
    assert not isinstance(gate, Lane)
    assert gate("fleet/r1/@cmd/stop", None, 0, bytes) is Lane.STOP
    rig.command("stop")
    assert gate("fleet/r1/@cmd/stop", None, 0, bytes) is None
    await asyncio.sleep(0.06)
    assert gate("fleet/r1/@cmd/stop", None, 0, bytes) is Lane.STOP
    rig.command("stop")
    rig.driver.acquire()
    assert gate("fleet/r1/@cmd/stop", None, 0, bytes) is Lane.STOP, "a new holder is stopped at once"
    await asyncio.sleep(1.0)
    assert rig.metrics.total("stops_folded") == 1


# Refusals


def telling(*refusals: dict[str, Any]) -> bytes:
    """What a listener tells: refusals of a program of its own, with what is said otherwise."""
    whole = {"who": "hq.desk.3", "command": "drive", "code": "neutral_first", "reason": "let go first", "count": 1}
    return packed({"refusals": [{**whole, **refusal} for refusal in refusals]})


async def test_what_a_listener_refused_its_programs_is_shown_with_who_command_code_reason_and_by_whom(rig: Rig) -> None:
    (reply,) = rig.ask("control/refused/hq.desk", telling({"count": 7}, {"who": "hq.desk.4"})).replies
    assert (reply.error, msgpack.unpackb(reply.payload)) == (None, {})
    rig.ask("control/refused/hq.desk", telling({"count": 5}))
    await asyncio.sleep(0.06)
    told = {"command": "drive", "code": "neutral_first", "reason": "let go first", "by": "hq.desk"}
    assert rig.last("control")["refusals"] == [
        {"who": "hq.desk.4", "count": 1, **told},
        {"who": "hq.desk.3", "count": 12, **told},
    ]
    assert rig.control["holder"] == "driver", "and nothing else comes of it"
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == [MOVE_LEFT]


@pytest.mark.parametrize(
    ("at", "refusal"),
    [
        ("driver", {"who": "driver"}),
        ("hq", {"who": "hq.desk.3"}),
        ("hq.desk", {"who": "driver"}),
        ("hq.desk", {"who": "hq.desk2.3"}),
        ("hq.desk", {"who": "hq.other.3"}),
        ("hq.desk", {"who": None}),
        ("hq.desk", {"who": ""}),
    ],
)
async def test_nobody_tells_of_refusals_in_anybody_elses_name(rig: Rig, at: str, refusal: dict[str, Any]) -> None:
    (reply,) = rig.ask(f"control/refused/{at}", telling({}, refusal)).replies
    assert isinstance(reply.error, Malformed)
    ((who, command, _, _),) = await rig.refused()
    assert (who, command) == (None, "refused"), "neither that one nor what came with it"


@pytest.mark.parametrize(
    "payload",
    [b"\xc1", packed({}), packed({"refusals": 5}), packed({"refusals": [{"who": "hq.desk.3"}]}), telling(*17 * [{}])],
)
async def test_a_telling_that_cannot_be_read_or_is_too_long_is_refused(rig: Rig, payload: bytes) -> None:
    (reply,) = rig.ask("control/refused/hq.desk", payload).replies
    assert isinstance(reply.error, Malformed)


async def test_tellings_are_bounded_and_so_is_what_they_say(rig: Rig) -> None:
    rig.ask("control/refused/hq.desk", telling({"reason": "r" * 10_000, "command": "c" * 10_000, "count": 2**60}))
    rig.ask("control/refused/hq.desk", telling({"code": "of tomorrow", "count": -5}))
    await asyncio.sleep(0.06)
    long, unknown = rig.last("control")["refusals"]
    assert (len(long["reason"]), len(long["command"]), long["count"]) == (200, 64, 1_000_000)
    assert (unknown["code"], unknown["count"]) == ("unsupported", 1)
    for number in range(200):
        last = rig.ask("control/refused/hq.desk", telling({"reason": f"reason {number}"}))
    assert isinstance(last.replies[0].error, TooFast)
    await asyncio.sleep(0.06)
    shown_now = rig.last("control")["refusals"]
    assert len(shown_now) == 16
    assert len([entry for entry in shown_now if entry["code"] == "rate"]) == 1
    await asyncio.sleep(1.0)
    (reply,) = rig.ask("control/refused/hq.desk", telling({})).replies
    assert reply.error is None


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\xc1", "Drive: MessagePack"),
        (b"\x81", "Drive: "),
        (b"\x01", "got `int`"),
        (msgpack.packb({"forward": 1.5}), "forward"),
        (msgpack.packb({"forward": "fast"}), "forward"),
        (msgpack.packb({"forward": math.nan}), "forward"),
        (msgpack.packb({"forward": None}), "forward"),
    ],
)
async def test_a_malformed_payload_is_refused_counted_and_shown(rig: Rig, payload: bytes, reason: str) -> None:
    rig.command("drive", payload)
    assert rig.written() == []
    assert rig.metrics.total("refused") == 1
    ((command, shown, count),) = await rig.refusals()
    assert command == "drive"
    assert shown.startswith("Drive: "), "the message that was expected"
    assert reason in shown
    assert count == 1


@pytest.mark.parametrize("name", ["dance", "drive/fast", "motor/left", "light", "raw/other", "sensor/x"])
async def test_an_unknown_command_is_refused(rig: Rig, name: str) -> None:
    rig.command(name, {"on": True, "value": 1.0, "id": 1})
    assert rig.written() == []
    ((command, reason, _),) = await rig.refusals()
    assert command == name
    assert "no such command" in reason


@pytest.mark.parametrize(
    ("name", "fields", "reason"),
    [
        ("camera", {"on": True}, "camera"),
        ("text", {"text": "hi", "kind": "chat"}, "raw"),
        ("text", {"text": ""}, "empty text"),
        ("raw/tcpudp", {"id": 200}, "may crash"),
        ("raw/tcpudp", {"id": 11}, "not raw"),
        ("text", {"text": "x" * 5000}, "4096"),
        ("text", {"text": "Grüße"}, "text"),
    ],
)
async def test_what_the_robot_cannot_do_is_refused_with_the_reason(rig: Rig, name, fields, reason) -> None:
    rig.command(name, fields)
    await asyncio.sleep(0.1)
    assert rig.written() == []
    ((_, shown, _),) = await rig.refusals()
    assert reason in shown


async def test_refusals_are_gathered_before_control_shows_them(rig: Rig) -> None:
    before = len(rig.values("control"))
    for _ in range(100):
        rig.command("dance")
    assert len(rig.values("control")) == before
    assert await rig.refusals() == [("dance", "no such command", 100)]
    assert len(rig.values("control")) == before + 1
    assert rig.metrics.total("refused") == 100


async def test_the_part_of_a_drive_that_is_left_out_is_reported(rig: Rig) -> None:
    rig.command("drive", {"left": 1.0, "turn": 0.5, "light": True})
    assert rig.written() == [MOVE_LEFT]
    ((command, reason, _),) = await rig.refusals()
    assert command == "drive"
    assert "turn" in reason


async def test_a_command_while_the_robot_is_offline_is_refused() -> None:
    async with serving(unreachable="no route") as rig:
        rig.command("lidar", {"on": True})
        assert await rig.refusals() == [("lidar", "offline", 1)]


async def test_a_command_during_the_handshake_is_refused() -> None:
    async with serving() as rig:
        rig.command("lidar", {"on": True})
        assert rig.link.written == []
        assert await rig.refusals() == [("lidar", "handshaking", 1)]


async def test_motion_refused_while_offline_needs_neutral_afterwards() -> None:
    async with serving() as rig:
        rig.command("drive", DRIVE_LEFT)
        await rig.establish()
        rig.command("drive", DRIVE_LEFT)
        assert rig.written() == []
        rig.command("drive", NEUTRAL)
        await asyncio.sleep(0.1)
        rig.command("drive", DRIVE_LEFT)
        assert rig.written() == [STOP, MOVE_LEFT]


async def test_neutral_refused_while_offline_does_not_make_motion_possible() -> None:
    async with serving() as rig:
        rig.command("drive", DRIVE_LEFT)
        rig.command("drive", NEUTRAL)
        await rig.establish()
        rig.command("drive", DRIVE_LEFT)
        assert rig.written() == []


async def test_a_stop_while_offline_is_taken_and_remembered() -> None:
    async with serving(unreachable="no route") as rig:
        rig.command("stop")
        assert rig.last("control")["state"] == "stopped"
        assert await rig.refusals() == []


async def test_a_robot_that_announces_nothing_is_sent_nothing_it_may_not_know() -> None:
    async with serving() as rig:
        await rig.establish(PLAIN_SETTINGS)
        rig.command("drive", DRIVE_LEFT)
        rig.command("mode", {"mode": "manual"})
        rig.command("lidar", {"on": True})
        rig.command("raw/tcpudp", {"id": 40, "body": b"hi"})
        await asyncio.sleep(1.0)
        assert rig.written() == []
        shown = await rig.refusals()
        assert [command for command, _, _ in shown] == ["drive", "mode", "lidar", "raw/tcpudp"]
        assert all("does not announce" in reason for _, reason, _ in shown)
        assert not rig.device._enforcer.authority.moving, "there is nothing to stop"


async def test_forced_features_are_used_although_the_robot_does_not_announce_them() -> None:
    async with serving(Options(force=("joystick",))) as rig:
        await rig.establish(PLAIN_SETTINGS)
        rig.command("drive", DRIVE_LEFT)
        assert rig.written() == [MOVE_LEFT]


async def test_a_robot_that_takes_nothing_is_not_flooded(rig: Rig) -> None:
    rig.link.ready = False
    for _ in range(100):
        rig.command("text", {"text": "hi"})
    assert rig.written() == []
    ((command, reason, count),) = await rig.refusals()
    assert command == "text"
    assert reason.startswith("64 packets wait")
    rig.link.ready = True
    rig.conversations[0].writable()
    await asyncio.sleep(2.0)
    assert len(rig.written()) == 100 - count


# Simulated lidar data


async def test_a_scan_is_sent_in_the_robots_unit_and_shown_on_the_bus(rig: Rig) -> None:
    ranges = struct.pack("<360f", *([2.0] * 360))
    fields = {"angle_min": 0.0, "angle_increment": math.radians(1), "range_min": 0.1, "range_max": 9.0}
    rig.command("scan", {**fields, "ranges": ranges})
    expected = bytes.fromhex("a6050000 02 3d 68010000") + bytes.fromhex("00004843") * 360  # 200 cm
    assert rig.written() == [expected]
    assert rig.last("scan")["ranges"] == ranges


async def test_a_scan_of_absurd_geometry_does_no_harm(rig: Rig) -> None:
    fields = {"angle_min": 0.0, "angle_increment": 1e-300, "range_min": 0.1, "range_max": 9.0}
    rig.command("scan", {**fields, "ranges": struct.pack("<10f", *([2.0] * 10))})
    one_degree = bytes.fromhex("00004843") + bytes(4 * 359)  # 200 cm straight ahead
    assert rig.written() == [bytes.fromhex("a6050000 02 3d 68010000") + one_degree]


# Loss and return of the robot


async def test_a_robot_lost_before_it_was_established_needs_no_neutral() -> None:
    async with serving() as rig:
        rig.goes("reset")
        assert rig.counted("stopped") == 0
        await asyncio.sleep(1.0)
        await rig.establish()
        rig.command("drive", DRIVE_LEFT)
        assert rig.written() == [MOVE_LEFT]


async def test_a_lost_robot_shows_as_offline_with_the_reason(rig: Rig) -> None:
    rig.goes("connection lost: reset")
    status = rig.last("status")
    assert (status["state"], status["reason"]) == ("offline", "connection lost: reset")
    assert status["version"] is None
    assert status["features"] == []


async def test_a_robot_that_returns_publishes_again(rig: Rig) -> None:
    rig.goes()
    await asyncio.sleep(1.0)
    assert len(rig.links) == 2
    await rig.establish()
    assert rig.last("status")["state"] == "established"
    rig.sends(POSITION)
    assert len(rig.values("pose")) == 1


@pytest.mark.scene(deadman_s=60.0)
async def test_a_robot_lost_while_moving_needs_neutral_when_it_returns_and_gets_no_old_motion(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.goes()
    assert rig.counted("stopped") == 1
    await asyncio.sleep(1.0)
    await rig.establish()
    await asyncio.sleep(1.0)
    assert rig.written() == []
    assert rig.control["holder"] == "driver", "the lease stays"
    rig.command("drive", DRIVE_LEFT)
    rig.command("mode", {"mode": "autonomous"})
    assert rig.written() == []
    assert "robot lost" in (await rig.refusals())[-1][1]
    rig.command("drive", NEUTRAL)
    await asyncio.sleep(0.1)
    rig.command("drive", DRIVE_LEFT)
    assert rig.written() == [STOP, MOVE_LEFT]


@pytest.mark.scene(deadman_s=0.5)
async def test_the_deadman_of_a_lost_robot_does_not_fire(rig: Rig) -> None:
    rig.command("drive", DRIVE_LEFT)
    rig.goes()
    rig.unreachable = "no route"
    await asyncio.sleep(2.0)
    rig.unreachable = None
    await asyncio.sleep(3.0)
    await rig.establish()
    rig.command("drive", DRIVE_LEFT)
    assert "robot lost" in (await rig.refusals())[-1][1]


async def test_the_robots_new_client_id_is_used_after_its_return(rig: Rig) -> None:
    rig.goes()
    await asyncio.sleep(1.0)
    await rig.establish(SETTINGS[:6] + b"\x07" + SETTINGS[7:])
    rig.command("stop")
    await asyncio.sleep(0.05)
    assert rig.written() == [bytes.fromhex("02000000 07 0d")]


# Raw frames


async def test_raw_frames_are_shown_only_to_those_who_listen() -> None:
    async with established() as rig:
        rig.sends(POSITION)
        assert rig.bus.values("fleet/r1/@wire/**") == []
    bus = OpenBus()
    seen: list[tuple[str, bytes]] = []
    bus.join("3").subscribe("fleet/r1/@wire/**", lambda sample: seen.append((sample.key, sample.payload)))
    async with serving(bus=bus) as rig:
        await rig.establish()
        rig.sends(POSITION + b"\x02\x00")
        assert seen[:2] == [("fleet/r1/@wire/robot/in", SETTINGS), ("fleet/r1/@wire/robot/out", ANSWER)]
        assert seen[-1] == ("fleet/r1/@wire/robot/in", POSITION)
        assert {frame for _, frame in seen[2:-1]} == {STOP}, "the stop that greets the robot"


# Questions


@pytest.mark.parametrize(
    ("name", "asked", "answer"), [("map", "02000000 02 34", MAP), ("pose", "02000000 02 36", POSITION)]
)
async def test_a_query_asks_the_robot_and_is_answered_with_what_it_sends(rig: Rig, name, asked, answer) -> None:
    question = rig.ask(name)
    assert rig.written() == [bytes.fromhex(asked)]
    assert question.replies == []
    rig.sends(answer)
    (reply,) = question.replies
    assert reply.error is None
    assert msgpack.unpackb(reply.payload) == rig.last(name)
    rig.sends(answer)
    assert len(question.replies) == 1


async def test_two_queries_at_once_ask_the_robot_once_and_are_both_answered(rig: Rig) -> None:
    questions = [rig.ask("pose"), rig.ask("pose")]
    await asyncio.sleep(0.1)
    assert len(rig.written()) == 1
    rig.sends(POSITION)
    assert [len(question.replies) for question in questions] == [1, 1]


async def test_a_position_does_not_answer_a_query_for_the_map(rig: Rig) -> None:
    question = rig.ask("map")
    rig.sends(POSITION)
    assert question.replies == []


async def test_a_query_the_robot_does_not_answer_is_refused_after_two_seconds(rig: Rig) -> None:
    question = rig.ask("map")
    await asyncio.sleep(1.99)
    assert question.replies == []
    await asyncio.sleep(0.02)
    (reply,) = question.replies
    assert isinstance(reply.error, NotReady)
    assert str(reply.error) == "the robot did not answer within 2 s"
    rig.forget_written()
    rig.ask("map")
    assert len(rig.written()) == 1, "the next query asks anew"


async def test_a_query_while_offline_is_refused_at_once() -> None:
    async with serving(unreachable="no route") as rig:
        (reply,) = await rig.hq.ask("fleet/r1/@rpc/map")
        assert isinstance(reply.error, NotReady)
        assert str(reply.error) == "offline"


async def test_a_query_the_robot_cannot_be_asked_is_refused_at_once() -> None:
    async with serving() as rig:
        await rig.establish(PLAIN_SETTINGS)
        (reply,) = rig.ask("map").replies
        assert isinstance(reply.error, Unsupported)
        assert "slam_map" in str(reply.error)
        assert rig.written() == []


async def test_queries_that_wait_are_refused_when_the_robot_is_lost(rig: Rig) -> None:
    question = rig.ask("map")
    rig.goes()
    (reply,) = question.replies
    assert str(reply.error) == "the robot was lost"
    await asyncio.sleep(3.0)
    assert len(question.replies) == 1


# Back pressure and leave-taking


async def test_a_bus_that_is_full_pauses_the_link_until_it_takes_more(rig: Rig) -> None:
    rig.bus.takes = False
    rig.sends(POSITION)
    assert rig.link.paused
    rig.bus.relieve()
    assert not rig.link.paused
    rig.sends(POSITION)
    assert not rig.link.paused


async def test_a_link_made_while_the_bus_is_full_is_read_until_the_bus_says_so_again(rig: Rig) -> None:
    rig.bus.takes = False
    rig.sends(POSITION)
    assert rig.link.paused
    rig.goes()
    await asyncio.sleep(1.0)
    await rig.establish()
    rig.sends(POSITION)
    assert rig.link.paused
    rig.bus.relieve()
    assert not rig.link.paused


async def test_a_second_cancellation_does_not_cut_the_leave_taking_short() -> None:
    rig = Rig(deadman_s=60.0)
    task = asyncio.create_task(rig.device.run())
    await rig.establish()
    rig.hold()
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    rig.forget_written()
    task.cancel()
    await asyncio.sleep(0.05)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await asyncio.sleep(2.0)
    assert rig.last("status")["reason"] == "gateway stopped"
    assert set(rig.written()) == {STOP}
    assert rig.link.closed


async def test_a_moving_robot_is_stopped_before_the_gateway_ends() -> None:
    async with established(deadman_s=60.0) as rig:
        rig.command("drive", DRIVE_LEFT)
        await asyncio.sleep(0.1)
        rig.forget_written()
        start = rig.loop.time()
    stops = rig.written()
    assert set(stops) == {STOP}
    assert len(stops) >= 10
    assert rig.loop.time() - start <= 1.7
    assert rig.link.closed
    assert (rig.last("status")["state"], rig.last("status")["reason"]) == ("offline", "gateway stopped")


async def test_a_gateway_that_ends_gives_no_lease_any_more_and_ends_the_one_of_a_moving_robot() -> None:
    rig = Rig(deadman_s=60.0)
    task = asyncio.create_task(rig.device.run())
    await rig.establish()
    rig.hold()
    rig.command("drive", DRIVE_LEFT)
    await asyncio.sleep(0.1)
    task.cancel()
    await rig.settle()
    rig.forget_written()
    for name in ("acquire/driver", "takeover/driver", "renew", "release"):
        (reply,) = rig.ask(f"control/{name}", packed({"who": "driver"})).replies
        assert reply.error is not None
        assert (str(reply.error), getattr(reply.error, "code", None)) == ("gateway stopped", "closing")
    rig.command("drive", NEUTRAL)
    rig.command("drive", {"turn": 0.5})
    assert rig.control["state"] == "stopped"
    assert rig.audited[-2:] == [
        {"event": "stopped", "who": "driver", "reason": "gateway stopped", "stops": True},
        {"event": "refused", "who": "driver", "command": "drive", "reason": "the lease has ended (gateway stopped)"},
    ]
    with pytest.raises(asyncio.CancelledError):
        await task
    assert set(rig.written()) == {STOP}


async def test_a_robot_in_autonomous_mode_is_stopped_before_the_gateway_ends() -> None:
    async with established() as rig:
        rig.command("mode", {"mode": "autonomous"})
        await asyncio.sleep(0.1)
        rig.forget_written()
    stops = rig.written()
    assert len(stops) >= 20
    assert stops == [MODE_NONE, STOP] * (len(stops) // 2)


async def test_a_neutral_shortly_before_the_gateway_ends_is_repeated_for_its_second() -> None:
    async with established() as rig:
        rig.command("drive", DRIVE_LEFT)
        await asyncio.sleep(0.1)
        rig.command("drive", NEUTRAL)
        start = rig.loop.time()
        rig.forget_written()
    assert set(rig.written()) == {STOP}
    assert 1.0 <= rig.loop.time() - start < 1.1


async def test_a_standing_robot_is_left_at_once() -> None:
    async with established() as rig:
        start = rig.loop.time()
    assert rig.written() == []
    assert rig.loop.time() - start < 0.1
    assert rig.link.closed
    assert rig.last("status")["reason"] == "gateway stopped"


async def test_a_gateway_that_ends_leaves_the_robots_keys_to_others_and_writes_no_loss_down() -> None:
    async with established() as rig:
        pass
    assert await rig.hq.ask("fleet/r1/@rpc/control/acquire/ann", packed({"who": "ann"})) == []
    before = len(rig.values("control"))
    rig.driver.put("stop", NEUTRAL, None)
    await rig.settle()
    assert len(rig.values("control")) == before
    assert [line for line in rig.audited if line["event"] == "stopped"] == []


async def test_a_device_prints_its_robot_and_state(rig: Rig) -> None:
    assert repr(rig.device) == "<Device r1 established>"


# Faults of the protocol's own code


def raise_key_error(*arguments: object) -> None:
    raise KeyError(1)


KEY_ERROR = r"a fault of the protocol: KeyError: 1 \(test_device.py:\d+\)"
NO_OUTCOME = r"a fault of the protocol: TypeError: Robot.command gave no Outcome \(commands.py:\d+\)"


@pytest.mark.parametrize(("name", "fields"), [("drive", DRIVE_LEFT), ("light", {"on": True})])
@pytest.mark.parametrize(("command", "said"), [(raise_key_error, KEY_ERROR), (lambda *arguments: None, NO_OUTCOME)])
async def test_a_fault_of_the_protocol_in_a_command_is_a_refusal_and_is_logged_once(
    rig: Rig,
    name: str,
    fields: dict[str, Any],
    command: Callable[..., None],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(TcpUdpRobot, "command", command)
    for _ in range(3):
        rig.command(name, fields)
    ((refused, reason, count),) = await rig.refusals()
    assert (refused, count) == (name, 3)
    assert re.fullmatch(said, reason)
    assert rig.last("control")["refusals"][0]["code"] == "unsupported"
    assert len([record for record in caplog.records if record.exc_info]) == 1


async def test_a_fault_of_the_protocol_in_a_stop_is_shown_on_status_and_control_and_is_logged_once(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(TcpUdpRobot, "stop", raise_key_error)
    for _ in range(2):
        rig.command("stop", {})
    ((refused, reason, count),) = await rig.refusals()
    assert (refused, count) == ("stop", 2)
    assert re.fullmatch(KEY_ERROR, reason)
    assert rig.last("status")["reason"] == f"cannot be stopped: {reason}"
    assert len([record for record in caplog.records if record.exc_info]) == 1


async def test_a_fault_of_the_protocol_in_a_question_is_its_answer(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TcpUdpRobot, "known", raise_key_error)
    (reply,) = await rig.hq.ask("fleet/r1/@rpc/map")
    assert re.fullmatch(KEY_ERROR, str(reply.error))


async def test_a_fault_of_the_translation_is_the_reason_of_the_end(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    def translator(self: TcpUdpRobot, kind: type) -> None:
        raise KeyError(1)

    monkeypatch.setattr(TcpUdpRobot, "translator", translator)
    rig.sends(POSITION)
    await rig.settle()
    assert rig.last("status")["state"] == "offline"
    assert rig.last("status")["reason"].startswith("a fault of the protocol: KeyError: 1 (test_device.py:")
