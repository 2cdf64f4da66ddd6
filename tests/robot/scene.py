"""The device side with a TCP/UDP robot: a fake bus, a fake link, a clock that jumps, bytes from the protocol page.

A scene may be written down as a script, which :meth:`Rig.play` acts out line by line::

    left 0.1 > left                 the driver commands motion to the left, 0.1 s pass: the packet of the motion left
    with deadman_s=0.6              the first line may say how the device or the scene differs
    lost 1 established >            the connection is lost, the robot returns: nothing left
    other:takeover 2 > stop x9-10   another program takes over, 2 s pass: 9 or 10 stops left, and nothing else
    neutral 3*turn >> turn          the last packet that left is the turn
    control held other              what ``control`` shows: the state and the holder
    refused driver drive: busy x3   what ``control`` shows: who (- for nobody), command, a part of the reason, count

The commands are those of :data:`COMMANDS`, the other acts those of :meth:`Rig._acts`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import struct
from collections.abc import AsyncIterator, Callable
from typing import Any

import msgpack

from gateways.tcpudp.options import TcpUdpOptions
from gateways.tcpudp.translate import TcpUdpRobot
from tests.clock import JumpingLoop
from tests.fake_bus import FakeBus, FakeQuery, meet
from tests.fake_link import FakeLink
from tests.proofs import Holder, numbered, packed
from zbridge.bus import Handle, IncomingQuery, PriorityClass, Sample
from zbridge.bus.interface import Sort
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.context import ProtocolFaults, RobotContext
from zbridge.control.faults import OpenFaults
from zbridge.control.latch import Latches
from zbridge.errors import LinkError
from zbridge.fleet import topics
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.session_table import SessionTable
from zbridge.robot.connection import LinkSettings
from zbridge.robot.device import ControlParts, RobotDevice
from zbridge.robot.observer import Observer
from zbridge.transport.conversation import Conversation

ADDRESS = Address("robot.test", 11001)
LISTED = b"\x0b\x00\x00\x001.1,1.2,1.3"
# client id 2; cam, joystick, chat, lidar, lidar sim, map yes, UDP no; map size 30, interval 10
SETTINGS = bytes.fromhex("21000000 01 02 02") + LISTED + bytes.fromhex("00010101010101 1e000000 0a000000")
PLAIN_SETTINGS = bytes.fromhex("21000000 01 02 02") + LISTED + bytes.fromhex("00000000000000 00000000 00000000")
START_UDP = bytes.fromhex("02000000 01 04")  # unasked: the robot takes nothing for two seconds
STOP = bytes.fromhex("02000000 02 0d")
NEUTRAL: dict[str, Any] = {}
TWO_METRES = struct.pack("<360f", *([2.0] * 360))
SCAN = {"angle_min": 0.0, "angle_increment": 0.017453292519943295, "range_min": 0.1, "range_max": 9.0}

COMMANDS: dict[str, tuple[str, dict[str, Any], bytes]] = {
    "left": ("drive", {"left": 1.0}, bytes.fromhex("0e000000 02 0b 000080bf 00000000 0000803f")),
    "turn": ("drive", {"turn": 0.5}, bytes.fromhex("06000000 02 0c 000000bf")),
    "neutral": ("drive", NEUTRAL, b""),  # a stop
    "stop": ("stop", {}, STOP),
    "none": ("mode", {"mode": "none"}, bytes.fromhex("06000000 02 0a 01000000")),
    "manual": ("mode", {"mode": "manual"}, bytes.fromhex("06000000 02 0a 02000000")),
    "autonomous": ("mode", {"mode": "autonomous"}, bytes.fromhex("06000000 02 0a 03000000")),
    "text": ("text", {"text": "hi"}, bytes.fromhex("08000000 02 01 02000000 6869")),
    "lidar": ("lidar", {"on": True}, bytes.fromhex("06000000 02 32 01000000")),
    "raw": ("raw/tcpudp", {"id": 21, "body": b"\x01"}, bytes.fromhex("03000000 02 15 01")),
    "scan": ("scan", {**SCAN, "ranges": TWO_METRES}, bytes.fromhex("a6050000 02 3d 68010000" + "00004843" * 360)),
    "motor": ("motor/left", {"value": 1.0}, b""),  # this robot has none
    "dance": ("dance", {}, b""),
    "too_fast": ("drive", {"left": 9.0}, b""),
    **{
        f"ahead{part}": ("drive", {"forward": part}, bytes.fromhex("0e000000 02 0b 00000000 0000803f") + packet)
        for part in (0.1, 0.25, 0.35, 0.45, 0.55, 0.6, 1.0)
        for packet in [struct.pack("<f", part)]
    },
}  # fmt: skip
"""For every word of a script: the command, what it says, and the packet that the robot is sent."""
WORDS = {packet: word for word, (_, _, packet) in COMMANDS.items() if packet}
FOREVER_S = 1e6
"""A lease that no test outlives."""
_LISTS = ("refusals", "latches", "stops")
NEED_A_LEASE = {"drive", "motor", "mode", "raw"}


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
    """Lets a test put a question whose answer comes later, and keeps the priorities that were asked for."""

    def __init__(self) -> None:
        super().__init__("1")
        self.answers: dict[str, Callable[[IncomingQuery], None]] = {}
        self.priorities: dict[str, PriorityClass | Sort] = {}

    def answer(
        self,
        key: str,
        handler: Callable[[IncomingQuery], None],
        *,
        priority: PriorityClass | Sort = PriorityClass.OTHER,
    ) -> Handle:
        self.answers[key] = handler
        self.priorities[key] = priority
        return super().answer(key, handler, priority=priority)

    def subscribe(
        self,
        key_expr: str,
        handler: Callable[[Sample], None],
        *,
        priority: PriorityClass | Sort = PriorityClass.OTHER,
        history: bool = False,
    ) -> Handle:
        self.priorities[key_expr] = priority
        return super().subscribe(key_expr, handler, priority=priority, history=history)


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

    def command(self, name: str, fields: dict[str, Any] | bytes = NEUTRAL) -> None:
        """Command the robot, with the lease where there is one and the command needs it."""
        payload = fields if isinstance(fields, bytes) else packed(fields)
        needed = name.split("/", maxsplit=1)[0] in NEED_A_LEASE
        self.put(name, payload, self.held.attachment(name, payload) if needed and self.held is not None else None)

    def put(self, name: str, fields: dict[str, Any] | bytes, attachment: bytes | None) -> None:
        """Command the robot with this attachment."""
        payload = fields if isinstance(fields, bytes) else packed(fields)
        self._bus.publisher(f"fleet/r1/@cmd/{name}", topics.CMD_MODE).put(payload, attachment)


class Rig:
    """A device with everything around it played by the test; ``driver`` is the program that commands it."""

    def __init__(
        self,
        *,
        lease_s: float = FOREVER_S,
        deadman_s: float = 2.0,
        bus: OpenBus | None = None,
        latches: Latches | None = None,
        observer: Observer | None = None,
        **more: Any,
    ) -> None:
        self.loop = asyncio.get_running_loop()
        self.bus = bus or OpenBus()
        self.hq = self.bus.join("2")
        self.metrics = Metrics()
        self.manager = SessionTable()
        self.links: list[TimedLink] = []
        self.conversations: list[Conversation] = []
        self.unreachable: str | None = None
        self.settings = SETTINGS
        self.audit_lines: list[str] = []
        self.device = RobotDevice(
            RobotContext(
                TcpUdpRobot(TcpUdpOptions()),
                KeySpace("fleet", "r1"),
                self.bus,
                self.metrics,
                OpenFaults(),
                ProtocolFaults("r1"),
                clock=self.loop.time,
                clock_ns=lambda: 1234,
                **{clock: more.pop(clock) for clock in ("raw_ms", "suspended_s") if clock in more},
            ),
            "tcpudp",
            LinkSettings(
                addresses=(ADDRESS,),
                sessions=self.manager,
                connect=self._connect,
                **({"attach": more.pop("attach")} if "attach" in more else {}),
            ),
            ControlParts(
                authority=Authority(lease_s, deadman_s, numbered(), latches=latches),
                audit=Audit("r1", self.audit_lines.append),
                **{"idle_stop_s": 0.0, **more},
            ),
            observer,
        )
        self.driver, self.other = Program(self, "driver"), Program(self, "other")
        self.hold = self.driver.acquire
        self.command = self.driver.command
        self.read_to = 0

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

    async def establish(self, settings: bytes | None = None) -> None:
        """Finish the handshake and let the stop that greets the robot, and the gap, pass."""
        await self.settle()
        self.sends(settings or self.settings)
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
        self.read_to = len(self.link.written)

    def written(self) -> list[bytes]:
        """What was written since this was asked last."""
        start, self.read_to = self.read_to, len(self.link.written)
        return self.link.written[start:]

    @property
    def control(self) -> dict[str, Any]:
        """What ``control`` shows, without the refusals and what is said of stops."""
        return {name: value for name, value in self.last("control").items() if name not in _LISTS}

    async def refused(self) -> list[tuple[str | None, str, str, int]]:
        """What ``control`` shows: who, command, reason, count."""
        await asyncio.sleep(0.06)
        shown = self.last("control")["refusals"]
        return [(entry["who"], entry["command"], entry["reason"], entry["count"]) for entry in shown]

    async def refusals(self) -> list[tuple[str, str, int]]:
        """The same without who."""
        return [entry[1:] for entry in await self.refused()]

    @property
    def audited(self) -> list[dict[str, Any]]:
        """The audit log without the times."""
        lines = [json.loads(line) for line in self.audit_lines]
        return [{name: value for name, value in line.items() if name not in ("time", "robot")} for line in lines]

    # Scripts

    async def play(self, script: str) -> None:
        """Act out a script; see above."""
        for line in filter(None, map(str.strip, script.splitlines())):
            what, _, expected = line.partition(" ")
            if what == "control":
                assert f"{self.control['state']} {self.control['holder'] or ''}".strip() == expected, line
            elif what == "refused":
                self._compare_refusals(await self.refused(), expected)
            elif what != "with":
                acts, looks, expected = line.partition(">")
                for act in acts.split():
                    await self._act(act)
                if looks:
                    self._compare(self.written(), expected, line)

    async def _act(self, act: str) -> None:
        times, _, act = act.rpartition("*")
        who, _, what = act.rpartition(":")
        program: Program = getattr(self, who or "driver")
        for _ in range(int(times or 1)):
            if what in COMMANDS:
                program.command(*COMMANDS[what][:2])
            elif what[0].isdigit():
                await asyncio.sleep(float(what))
            elif what == "established":
                await self.establish()
            else:
                self._acts(program)[what]()

    def _acts(self, program: Program) -> dict[str, Callable[[], object]]:
        return {
            "acquire": program.acquire,
            "outrank": lambda: program.acquire(priority=1),
            "takeover": lambda: program.acquire("takeover"),
            "renew": program.renew,
            "release": program.release,
            "lost": self.goes,
            "unreachable": lambda: setattr(self, "unreachable", "no route"),
            "reachable": lambda: setattr(self, "unreachable", None),
            "announces_nothing": lambda: setattr(self, "settings", PLAIN_SETTINGS),
            "asks_for_datagrams": lambda: self.sends(START_UDP),
            "frozen": lambda: self.freeze(5.0),
            "bus_lost": lambda: self.bus.connection(False),
            "bus_back": lambda: self.bus.connection(True),
            "link_full": lambda: setattr(self.link, "ready", False),
            "link_free": lambda: (setattr(self.link, "ready", True), self.conversations[-1].writable()),
        }

    @staticmethod
    def _compare(written: list[bytes], expected: str, line: str) -> None:
        left = [WORDS.get(frame, frame.hex()) for frame in written]
        words, _, times = expected.removeprefix(">").partition(" x")
        one = words.split()
        if times:
            least, _, most = times.partition("-")
            count = len(left) // len(one)
            assert left == one * count, line
            assert int(least) <= count <= int(most or least), (line, count)
        else:
            assert (left[-len(one) :] if expected.startswith(">") else left) == one, line

    @staticmethod
    def _compare_refusals(shown: list[tuple[str | None, str, str, int]], expected: str) -> None:
        entries = expected.split(" | ") if expected else []
        assert len(shown) == len(entries), shown
        for (who, command, reason, count), entry in zip(shown, entries, strict=True):
            names, _, rest = entry.partition(": ")
            part, _, times = re.fullmatch(r"(.*?)( x(\d+))?", rest).groups()  # type: ignore[union-attr]
            assert (f"{who or '-'} {command}", count) == (names, int(times or 1)), shown
            assert part in reason, shown


@contextlib.asynccontextmanager
async def serving(*, unreachable: str | None = None, hold: bool = True, **more: Any) -> AsyncIterator[Rig]:
    """Run a device; unless told otherwise, a program holds the lease."""
    rig = Rig(**more)
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
async def established(**more: Any) -> AsyncIterator[Rig]:
    async with serving(**more) as rig:
        await rig.establish()
        yield rig
