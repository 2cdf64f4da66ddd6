"""One listener with a toy protocol on a fake bus, its links played by hand, on a clock that jumps.

A frame is a length byte and so many bytes. A client says ``hi`` first; ``go`` and ``stand`` drive, ``map?`` asks.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import ipaddress
import logging
import math
import re
import weakref
from collections.abc import AsyncIterator, Callable
from typing import Any

import numpy as np
import pytest

from tests.clock import jumping
from tests.hq.test_operator import Gateway
from zbridge.address import Address
from zbridge.bus.fake import FakeBus
from zbridge.bus.interface import Answer, IncomingQuery
from zbridge.errors import BusError, EncodeError, NotReady, ProtocolError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Acquire,
    Drive,
    FleetMessage,
    Map,
    Pose,
    Query,
    Refusal,
    Refusals,
    Scan,
    Status,
    Stop,
    Switch,
    Text,
)
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.fleet.view import RobotView
from zbridge.hq import listener as listeners
from zbridge.hq.listener import STALL_S, SWEEP_S, TELL_S, Listener
from zbridge.hq.robot_subscription import RobotSubscription
from zbridge.hq.settings import HqSettings, ListenerPlan
from zbridge.metrics import Metrics
from zbridge.protocol.outbox import LIMIT
from zbridge.protocol.plugin import HqSide, Protocol, Send, Telemetry
from zbridge.protocol.session import Limits, Role, Session, State
from zbridge.protocol.session_table import SessionTable
from zbridge.transport.fake import FakeLink
from zbridge.transport.link import Receiver

KEYS = KeySpace("fleet", "r1")
STATUS = Status(state="established", protocol="toy")
MAP = Map(rows=2, columns=3, cell=0.1, origin=(0.0, 0.0), cells=np.zeros((2, 3), np.uint8))


def framed(body: bytes) -> bytes:
    return bytes([len(body)]) + body


def frame_end(data: bytes, start: int) -> int:
    if data[start] == 255:
        raise ProtocolError("length 255")
    return start + 1 + data[start]


class ToySession(Session[bytes]):
    role = Role.ROBOT
    frame_end = staticmethod(frame_end)
    scans = False
    said_at = half_at = 0.0

    def encode(self, message: bytes) -> bytes:
        return framed(message)

    def decode(self, frame: bytes) -> bytes:
        if frame[1:] == b"?":
            raise ProtocolError("what is ?")
        return frame[1:]

    def opened(self, now: float) -> None:
        self.send_first(b"who are you")

    def accept(self, message: bytes, now: float) -> bool:
        self.said_at = now
        if self.state is State.ESTABLISHED:
            return True
        if message != b"hi":
            raise ProtocolError("hi was expected")
        self.establish("2.0", ("wings",))
        return False


class ToySide(HqSide):
    name = "toy"
    deadman_s = 1.25
    numbers = range(2, 256)
    follows = ("pose", "text", "lidar")
    quiet_s = 0.0

    def __init__(self, options: Any, view: RobotView, metrics: Metrics) -> None:
        self.view = view
        self.encoded = 0
        self.made: list[ToySession] = []

    def session(self, number: int, bounds: Limits) -> ToySession:
        self.made = [session for session in self.made if not session.over]
        self.made.append(session := ToySession(bounds))
        return session

    def begin(self, session: ToySession, now: float) -> None:
        session.send(b"welcome")

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        if isinstance(message, Switch):
            raise EncodeError("no switch can be shown")
        if not isinstance(message, Pose | Text | Scan):
            return None
        self.encoded += 1
        if isinstance(message, Text):
            text = framed(message.text.encode())
            return lambda session, now: session.outbox.put(text)
        frame = framed(b"scan" if isinstance(message, Scan) else b"at %g" % message.x)

        def send(session: ToySession, now: float) -> None:
            if isinstance(message, Pose) or session.scans:
                session.outbox.set(topic.path, (frame,), now)

        return send

    def take(self, session: ToySession, message: bytes) -> tuple[Telemetry, ...]:
        if message in (b"scans on", b"scans off"):
            session.scans = message == b"scans on"
            return ()
        taken = _TAKEN.get(message)
        if taken is None:
            raise ProtocolError(f"what is {message!r}")
        return (taken,)

    def answer(self, session: ToySession, topic: Topic, message: FleetMessage | None, now: float) -> None:
        session.send(b"%s: %s" % (topic.path.encode(), type(message).__name__.encode()))

    def tell(self, session: ToySession, text: str, now: float) -> None:
        session.send(b"! " + text.encode())

    def wanted(self) -> tuple[Topic, ...]:
        return (topics.SCAN,) if any(session.scans for session in self.made if not session.over) else ()


_TAKEN: dict[bytes, Telemetry] = {
    b"go": (topics.CMD_DRIVE, Drive(forward=0.5)),
    b"stand": (topics.CMD_DRIVE, Drive()),
    b"stop": (topics.CMD_STOP, Stop()),
    b"map?": (topics.RPC_MAP, Query()),
    b"pose?": (topics.RPC_POSE, Query()),
}


class HandLink(FakeLink):
    """A link that ends as a real one does: its receiver is told soon after it was closed."""

    receiver: Receiver

    def close(self) -> None:
        if not self.closed:
            super().close()
            asyncio.get_running_loop().call_soon(self.receiver.lost, "closed by us")

    def abort(self) -> None:
        self.close()


class Program:
    """An HQ program at the other end of a link."""

    def __init__(self, receiver: Receiver, peer: str) -> None:
        self.receiver = receiver
        self.link = HandLink(peer)
        self.link.receiver = receiver
        receiver.attached(self.link)

    def say(self, *messages: bytes) -> None:
        self.receiver.received(b"".join(map(framed, messages)))

    def greeted(self) -> Program:
        """Shake hands, and forget what was heard."""
        self.say(b"hi")
        self.heard()
        return self

    def heard(self) -> list[bytes]:
        """What was heard since the last call."""
        written, self.link.written = self.link.written, []
        return [frame[1:] for frame in written]

    def leave(self) -> None:
        if not self.link.closed:
            self.link.closed = True
            self.receiver.lost("closed by peer")

    def take_nothing(self) -> None:
        self.link.ready = False

    def take_all(self) -> None:
        self.link.ready = True
        self.receiver.writable()


class Scene:
    """A listener that runs, and the robot's gateway beside it."""

    side_class = ToySide

    def __init__(self, *, allow: tuple[str, ...] = (), robot: bool = True, **settings: Any) -> None:
        self.loop = asyncio.get_running_loop()
        self.skipped_s = 0.0
        self.bus = FakeBus("hq")
        self.gateway = Gateway(self.bus.join("gw"), self)  # type: ignore[arg-type]
        self.status = self.gateway.bus.publisher(KEYS.key("status"), topics.STATUS)
        self.token = None
        if robot:
            self.come()
        self.metrics = Metrics()
        self.manager = SessionTable()
        self.audience = RobotSubscription(self.bus, KEYS, self.metrics)
        self.audience.open()
        protocol = Protocol(
            name="toy",
            summary="",
            options=HqSettings,
            links=1,
            robot=None,  # type: ignore[arg-type]
            simulate=None,  # type: ignore[arg-type]
            hq=self._side,
        )
        plan = ListenerPlan(
            protocol,
            None,
            Address("127.0.0.1", 0),
            HqSettings(protocol="toy", listen="tcp://127.0.0.1:0", **settings),
            tuple(map(ipaddress.ip_network, allow)),
        )
        self.accept: Callable[[], Receiver]
        self.listener = Listener(
            plan, "toy", self.audience, self.bus, KEYS, self.manager, self.metrics, lambda: self.now
        )
        self.hosts = 0

    def _side(self, options: Any, view: RobotView, metrics: Metrics) -> ToySide:
        self.side = self.side_class(options, view, metrics)
        return self.side

    @property
    def now(self) -> float:
        return self.loop.time() + self.skipped_s

    def come(self) -> None:
        """Let the robot be there."""
        self.status.put(payloads.encode(STATUS))
        self.token = self.gateway.bus.announce(KEYS.alive("gateway"))

    def go(self) -> None:
        """Let the robot's gateway be gone."""
        assert self.token is not None
        self.token.close()

    def say(self, topic: Topic, message: FleetMessage) -> None:
        self.gateway.bus.publisher(KEYS.key(topic.path), topic).put(payloads.encode(message))

    def report(self) -> None:
        self.gateway.control.put(payloads.encode(self.gateway.report()))

    def connect(self, host: str = "10.0.0.1") -> Program:
        self.hosts += 1
        return Program(self.accept(), f"tcp://{host}:{5000 + self.hosts}")

    def count(self, name: str) -> int:
        return self.metrics.total(name)

    def reason(self, name: str) -> str | None:
        """Why a session ended, or nothing while it lives."""
        return next(shown.reason for shown in self.manager.snapshots() if shown.name == name)


@pytest.fixture(autouse=True)
def by_hand(monkeypatch: pytest.MonkeyPatch) -> list[Scene]:
    """Let scenes accept links by hand."""
    scenes: list[Scene] = []

    @contextlib.asynccontextmanager
    async def listen(address: Address, receiver: Callable[[], Receiver], **kwargs: Any) -> AsyncIterator[Address]:
        scenes[-1].accept = receiver
        yield Address(address.host, 11002)

    monkeypatch.setattr(listeners, "listen", listen)
    _SCENES.append(scenes)
    return scenes


_SCENES: list[list[Scene]] = []


@contextlib.asynccontextmanager
async def serving(**settings: Any) -> AsyncIterator[Scene]:
    scene = Scene(**settings)
    _SCENES[-1].append(scene)
    task = scene.loop.create_task(scene.listener.run())
    await asyncio.wait_for(scene.listener.ready.wait(), 1.0)
    try:
        yield scene
        assert not task.done(), task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def soon() -> None:
    """Let what was begun be done."""
    await asyncio.sleep(0.001)


# Coming and going


@jumping
async def test_a_client_shakes_hands_and_is_shown_the_robot() -> None:
    async with serving() as scene:
        assert scene.listener.address == Address("127.0.0.1", 11002)
        program = scene.connect()
        assert program.heard() == [b"who are you"]
        scene.say(topics.POSE, Pose(x=1.0, y=0.0, heading=0.0))
        assert program.heard() == [], "nothing before the handshake"
        program.say(b"hi")
        assert program.heard() == [b"welcome"]
        scene.say(topics.POSE, Pose(x=2.0, y=0.0, heading=0.0))
        assert program.heard() == [b"at 2"]
        (entry,) = scene.manager.snapshots()
        assert (entry.name, entry.role, entry.state, entry.version) == ("toy.2", "robot", "established", "2.0")
        assert entry.peer == program.link.peer


@jumping
async def test_clients_get_the_lowest_numbers_that_are_free() -> None:
    async with serving() as scene:
        programs = [scene.connect() for _ in range(4)]
        assert sorted(scene.listener.clients) == [2, 3, 4, 5]
        programs[1].leave()
        await soon()
        scene.connect()
        assert sorted(scene.listener.clients) == [2, 3, 4, 5]
        assert scene.reason("toy.3") is None
        assert scene.count("hq_accepted") == 5


@jumping
async def test_254_clients_are_served_and_the_255th_is_turned_away() -> None:
    async with serving(accept_hz=1000) as scene:
        programs = [scene.connect().greeted() for _ in range(254)]
        assert sorted(scene.listener.clients) == list(range(2, 256))
        late = scene.connect()
        assert late.link.closed
        assert late.heard() == []
        late.say(b"hi", b"go")
        assert late.heard() == []
        assert (scene.count("hq_accepted"), scene.count("hq_turned_away")) == (254, 1)
        await soon()
        scene.say(topics.POSE, Pose(x=3.0, y=0.0, heading=0.0))
        assert all(program.heard() == [b"at 3"] for program in programs)
        assert scene.side.encoded == 1
        programs[76].leave()
        await soon()
        assert scene.connect().heard() == [b"who are you"]


@jumping
async def test_a_listener_may_be_told_to_serve_fewer() -> None:
    async with serving(clients=2) as scene:
        programs = [scene.connect() for _ in range(3)]
        assert [program.link.closed for program in programs] == [False, False, True]
        programs[0].leave()
        await soon()
        assert not scene.connect().link.closed


@jumping
async def test_more_than_so_many_connections_a_second_of_one_address_are_closed_at_once() -> None:
    async with serving(accept_hz=3.0) as scene:
        programs = [scene.connect() for _ in range(5)]
        assert [program.link.closed for program in programs] == [False, False, False, True, True]
        assert programs[4].heard() == []
        assert not scene.connect("10.0.0.2").link.closed, "another address"
        assert (scene.count("hq_accepted"), scene.count("hq_turned_away")) == (4, 2)
        for program in programs[:3]:
            program.leave()
        await soon()
        assert scene.connect().link.closed, "that they have left makes no room"
        await asyncio.sleep(1.0)
        assert not scene.connect().link.closed


@jumping
async def test_twenty_connections_a_second_are_let_in_unless_told_otherwise() -> None:
    async with serving() as scene:
        assert [scene.connect().link.closed for _ in range(25)] == [False] * 20 + [True] * 5


@pytest.mark.parametrize("accept_hz", [20.0, 1000.0])
@jumping
async def test_a_flood_of_connections_costs_a_few_lines_a_second(
    accept_hz: float, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        async with serving(accept_hz=accept_hz, clients=10_000) as scene:
            caplog.clear()
            for _ in range(800):
                program = scene.connect()
                program.leave()
                await asyncio.sleep(0.0025)
            scene.connect("10.0.0.9")
            await asyncio.sleep(2.0)
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) <= 20, lines
    came = sum(int(count) for line in lines for count in re.findall(r"(\d+) more connected", line))
    told = sum("10.0.0.1:" in line and "connected as client" in line for line in lines)
    assert came + told == scene.count("hq_accepted") - 1
    away = sum(int(count) for line in lines for count in re.findall(r"(\d+) more turned away", line))
    assert away + sum(" turned away (" in line for line in lines) == scene.count("hq_turned_away")
    assert any("tcp://10.0.0.9" in line and "connected as client" in line for line in lines), "others are told of"


@jumping
async def test_a_number_rests_after_its_client_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ToySide, "quiet_s", 2.0)
    async with serving() as scene:
        scene.connect().greeted().leave()
        await soon()
        scene.connect()
        assert sorted(scene.listener.clients) == [3]
        await asyncio.sleep(2.0)
        scene.connect()
        assert sorted(scene.listener.clients) == [2, 3]


@jumping
async def test_a_number_that_was_never_used_need_not_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ToySide, "quiet_s", 2.0)
    async with serving() as scene:
        scene.connect().leave()
        await soon()
        scene.connect()
        assert sorted(scene.listener.clients) == [2]


@jumping
async def test_numbers_that_rest_take_no_clients_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """``clients`` is the most at a time: a program that is restarted at once finds its place free."""
    monkeypatch.setattr(ToySide, "quiet_s", 2.0)
    async with serving(clients=1) as scene:
        scene.connect().leave()
        await soon()
        assert not scene.connect().link.closed
        assert scene.connect().link.closed


@jumping
async def test_many_clients_come_and_go_and_leave_nothing_behind() -> None:
    async with serving(accept_hz=1000) as scene:
        await soon()
        tasks, kept = len(asyncio.all_tasks()), scene.bus._shared
        subscribers, queryables = len(kept.subscribers), len(kept.queryables)
        sessions: list[weakref.ref[ToySession]] = []
        for cycle in range(500):
            programs = [scene.connect() for _ in range(4)]
            for program in programs[:3]:
                program.say(b"hi")
            sessions += [weakref.ref(session) for session in scene.side.made[-4:]]
            programs[0].say(b"stand", b"go", b"scans on")
            programs[1].say(b"map?", b"?")
            if cycle % 2:
                await soon()
            for program in programs:
                program.leave()
            await soon()
        await asyncio.sleep(5.0)
        assert scene.listener.clients == {}
        assert len(asyncio.all_tasks()) == tasks
        assert (len(kept.subscribers), len(kept.queryables)) == (subscribers, queryables)
        assert kept.tokens == [KEYS.alive("gateway")]
        assert repr(scene.manager) == "<SessionTable 0 live, 32 ended>"
        assert len(scene.listener._bridge._publishers) <= 2
        assert (scene.listener._active, scene.listener._asked) == (set(), {})
        assert "0 of 254 taken" in repr(scene.listener._ids)
        assert scene.gateway.report().state == "free"
        scene.side.made.clear()
        del programs, program
        gc.collect()
        assert sum(session() is not None for session in sessions) <= 1, "the last one is a variable of a loop"


@jumping
async def test_the_table_says_why_a_client_went() -> None:
    async with serving() as scene:
        scene.connect().leave()
        await soon()
        assert scene.reason("toy.2") == "closed by peer"


# Who may come


@pytest.mark.parametrize(
    ("host", "welcome"),
    [
        ("10.1.2.3", True),
        ("192.168.1.7", True),
        ("192.168.1.8", False),
        ("127.0.0.1", False),
        ("[fd00::1]", True),
        ("[fe80::1%eth0]", False),
        ("[::1]", False),
        ("[::ffff:10.1.2.3]", True),
        ("[::ffff:11.1.2.3]", False),
    ],
)
@jumping
async def test_only_allowed_networks_are_let_in(host: str, welcome: bool) -> None:
    async with serving(allow=("10.0.0.0/8", "192.168.1.7/32", "fd00::/8")) as scene:
        program = scene.connect(host)
        assert program.link.closed is not welcome
        assert scene.count("hq_turned_away") == (not welcome)
        assert len(scene.listener.clients) == welcome


@jumping
async def test_without_a_list_everybody_is_let_in() -> None:
    async with serving() as scene:
        assert not any(scene.connect(host).link.closed for host in ("10.1.2.3", "127.0.0.1", "[fe80::1%eth0]"))


@jumping
async def test_a_client_that_is_turned_away_uses_up_no_number() -> None:
    async with serving(allow=("10.0.0.0/8",)) as scene:
        for _ in range(300):
            scene.connect("11.0.0.1")
        await soon()
        scene.connect()
        assert sorted(scene.listener.clients) == [2]


# Limits


@jumping
async def test_a_client_that_does_not_shake_hands_is_closed() -> None:
    async with serving(handshake_s=1.5) as scene:
        silent, served = scene.connect(), scene.connect().greeted()
        await asyncio.sleep(1.4)
        assert not silent.link.closed
        await asyncio.sleep(0.2)
        assert silent.link.closed
        assert scene.reason("toy.2") == "no handshake within 1.5 s"
        assert not served.link.closed
        assert sorted(scene.listener.clients) == [3]


@jumping
async def test_a_client_that_is_silent_for_too_long_is_closed() -> None:
    async with serving(idle_s=3.0) as scene:
        silent, talking = scene.connect().greeted(), scene.connect().greeted()
        for _ in range(30):
            talking.say(b"stand")
            await asyncio.sleep(0.1)
            assert not silent.link.closed or scene.loop.time() > 1002.9
        await asyncio.sleep(0.7)
        assert silent.link.closed
        assert scene.reason("toy.2") == "silent for 3 s"
        assert not talking.link.closed


@jumping
async def test_a_client_may_be_silent_for_ever_where_no_limit_is_set() -> None:
    async with serving() as scene:
        silent = scene.connect().greeted()
        await asyncio.sleep(10_000)
        assert not silent.link.closed


@jumping
async def test_what_is_sent_to_a_client_is_no_sign_of_its_life() -> None:
    async with serving(idle_s=1.0) as scene:
        silent = scene.connect().greeted()
        for step in range(20):
            scene.say(topics.POSE, Pose(x=float(step), y=0.0, heading=0.0))
            await asyncio.sleep(0.1)
        assert silent.link.closed


@jumping
async def test_a_client_that_takes_nothing_is_cut_and_costs_the_others_nothing() -> None:
    async with serving() as scene:
        stalled, served = scene.connect().greeted(), scene.connect().greeted()
        await soon()
        stalled.take_nothing()
        start = scene.loop.time()
        while not stalled.link.closed:
            scene.say(topics.POSE, Pose(x=1.0, y=0.0, heading=0.0))
            assert served.heard() == [b"at 1"]
            await asyncio.sleep(0.02)
            assert scene.loop.time() - start < 2 * STALL_S
        assert STALL_S - SWEEP_S <= scene.loop.time() - start <= STALL_S + 2 * SWEEP_S
        assert scene.reason("toy.2") == f"took nothing for {STALL_S:g} s"
        assert stalled.heard() == []
        await soon()
        assert sorted(scene.listener.clients) == [3]


@jumping
async def test_a_client_that_stalls_now_and_then_stays() -> None:
    async with serving() as scene:
        program = scene.connect().greeted()
        for _ in range(20):
            program.take_nothing()
            await asyncio.sleep(STALL_S - 2 * SWEEP_S)
            program.take_all()
            await asyncio.sleep(STALL_S)
        assert not program.link.closed


@jumping
async def test_a_client_that_takes_a_byte_now_and_then_is_cut() -> None:
    async with serving() as scene:
        program = scene.connect().greeted()
        for _ in range(12):
            program.take_nothing()
            await asyncio.sleep(0.95)
            program.take_all()
            await asyncio.sleep(0.05)
        assert program.link.closed


@jumping
async def test_a_process_that_was_frozen_cuts_nobody_for_it() -> None:
    """The time while it did not run is no time in which a client took nothing, or was silent."""
    async with serving(idle_s=5.0) as scene:
        stalled, silent = scene.connect().greeted(), scene.connect().greeted()
        await soon()
        scene.skipped_s += 60.0
        for _ in range(20):
            await asyncio.sleep(0.1)
            silent.say(b"stand")
            stalled.say(b"stand")
            stalled.take_nothing()
        assert not stalled.link.closed, "it has taken nothing for two seconds"
        await asyncio.sleep(2.0)
        assert not silent.link.closed, "it has been silent for two seconds"


@jumping
async def test_a_client_that_floods_is_closed_and_the_others_are_served() -> None:
    async with serving(rate_hz=50.0) as scene:
        wild, served = scene.connect().greeted(), scene.connect().greeted()
        await soon()
        wild.say(*[b"stop"] * 100)
        await soon()
        assert wild.link.closed
        assert scene.reason("toy.2") == "flood: more than 50 messages a second"
        assert len(scene.bus.values("fleet/r1/@cmd/stop")) == 49, "what it had the right to"
        scene.say(topics.POSE, Pose(x=1.0, y=0.0, heading=0.0))
        assert served.heard() == [b"at 1"]


@jumping
async def test_rubbish_ends_its_own_session_only() -> None:
    async with serving() as scene:
        broken, served = scene.connect().greeted(), scene.connect().greeted()
        broken.receiver.received(framed(b"stop") + b"\xff rubbish")
        await soon()
        assert broken.link.closed
        assert scene.reason("toy.2") == "broken stream: length 255"
        assert len(scene.bus.values("fleet/r1/@cmd/stop")) == 1, "what came before it"
        served.say(b"stop")
        assert len(scene.bus.values("fleet/r1/@cmd/stop")) == 2


@jumping
async def test_messages_without_meaning_are_counted_and_the_next_ones_are_taken() -> None:
    async with serving() as scene:
        program = scene.connect().greeted()
        program.say(b"?", b"sing", b"stop")
        assert scene.count("hq_malformed") == 2
        assert scene.manager.snapshots()[0].counters["malformed"] == 2
        assert len(scene.bus.values("fleet/r1/@cmd/stop")) == 1
        assert scene.count("hq_commands") == 1


@jumping
async def test_a_full_queue_drops_for_its_client_alone() -> None:
    async with serving() as scene:
        slow, served = scene.connect().greeted(), scene.connect().greeted()
        await soon()
        slow.take_nothing()
        for number in range(LIMIT + 10):
            scene.say(topics.TEXT, Text(text=str(number)))
        assert len(served.heard()) == LIMIT + 10
        assert scene.count("hq_dropped") == 10
        counters = {shown.name: shown.counters["dropped"] for shown in scene.manager.snapshots()}
        assert counters == {"toy.2": 10, "toy.3": 0}
        slow.take_all()
        await soon()
        assert slow.heard() == [b"%d" % number for number in range(LIMIT)]


@jumping
async def test_of_a_stream_a_slow_client_gets_the_newest() -> None:
    async with serving() as scene:
        slow = scene.connect().greeted()
        await soon()
        slow.take_nothing()
        for number in range(100):
            scene.say(topics.POSE, Pose(x=float(number), y=0.0, heading=0.0))
        slow.take_all()
        await soon()
        assert slow.heard() == [b"at 99"]
        assert scene.count("hq_dropped") == 0


@jumping
async def test_what_cannot_be_shown_is_counted_and_hurts_nobody() -> None:
    async with serving() as scene:
        program = scene.connect().greeted()
        scene.say(topics.LIDAR, Switch(on=True))
        assert scene.count("hq_left_out") == 1
        scene.say(topics.POSE, Pose(x=1.0, y=0.0, heading=0.0))
        assert program.heard() == [b"at 1"]


@jumping
async def test_nothing_is_encoded_for_nobody() -> None:
    async with serving() as scene:
        scene.say(topics.POSE, Pose(x=1.0, y=0.0, heading=0.0))
        assert scene.side.encoded == 0


# What is refused


class Told:
    """What the robot's gateway was told that the listener refused."""

    def __init__(self, scene: Scene) -> None:
        self.refusals: list[Refusal] = []
        scene.gateway.bus.answer(KEYS.key("@rpc/control/refused/hq.toy"), self._hear)

    def _hear(self, question: IncomingQuery) -> None:
        self.refusals += payloads.decode(Refusals, question.payload).refusals
        question.answer(payloads.encode(Query()))

    def shown(self) -> list[tuple[str | None, str, str, str, int]]:
        """Who, command, code, reason, and how often."""
        return [(each.who, each.command, each.code, each.reason, each.count) for each in self.refusals]


@jumping
async def test_what_a_client_may_not_is_told_to_the_gateway() -> None:
    async with serving() as scene:
        told, program = Told(scene), scene.connect().greeted()
        program.say(b"go", b"go", b"go")
        await asyncio.sleep(2.0)
        reason = "connected: let go of the stick first"
        assert told.shown() == [
            ("hq.toy.2", "drive", "neutral_first", reason, 1),
            ("hq.toy.2", "drive", "neutral_first", reason, 2),
        ]
        assert scene.count("hq_refused") == 3


@jumping
async def test_a_robot_that_is_missing_is_a_reason_where_it_has_a_gateway_to_be_told() -> None:
    async with serving() as scene:
        told, program = Told(scene), scene.connect().greeted()
        program.say(b"stand")
        scene.status.put(payloads.encode(Status(state="connecting", protocol="toy")))
        program.say(b"go")
        await soon()
        assert told.shown() == [("hq.toy.2", "drive", "not_ready", "robot connecting", 1)]
        scene.go()
        for _ in range(3):
            program.say(b"go")
        await asyncio.sleep(2.0)
        assert len(told.refusals) == 1, "there is nobody to be told"


@jumping
async def test_what_the_gateway_refuses_by_itself_is_not_told_a_second_time() -> None:
    async with serving() as scene:
        told, program = Told(scene), scene.connect().greeted()
        scene.gateway.authority.acquire(Acquire(who="operator"), scene.now)
        program.say(b"stand", b"go")
        await soon()
        assert program.heard()[-1] == b"! not driving: held by operator (priority 0)"
        assert told.shown() == []
        program.say(b"go")
        await soon()
        assert told.shown() == [
            ("hq.toy.2", "drive", "neutral_first", "held by operator (priority 0): let go of the stick first", 1)
        ]


@jumping
async def test_a_listener_that_ends_does_not_wait_to_tell() -> None:
    async with serving() as scene:
        told, program = Told(scene), scene.connect().greeted()
        program.say(b"go", b"go")
        await soon()
        ended_at = scene.now
    assert scene.now - ended_at < 0.5
    assert len(told.refusals) == 1


# Control


@jumping
async def test_a_client_drives_and_its_name_is_shown() -> None:
    async with serving() as scene:
        program = scene.connect().greeted()
        program.say(b"stand", b"go")
        await soon()
        assert scene.gateway.taken() == [("drive", Drive(forward=0.5))]
        assert scene.gateway.report().holder == "hq.toy.2"
        assert KEYS.alive("hq.toy.2") in scene.bus._shared.tokens


@jumping
async def test_what_was_said_while_the_process_stood_still_moves_nothing_and_neutral_must_come_anew() -> None:
    async with serving() as scene:
        driver, idle = scene.connect().greeted(), scene.connect().greeted()
        driver.say(b"stand", b"go")
        idle.say(b"stand")
        await soon()
        scene.gateway.taken()
        scene.skipped_s += 0.7
        idle.say(b"go")
        driver.say(b"go", b"stand", b"go")
        await soon()
        assert [moved for moved in scene.gateway.taken() if moved[1] != Drive()] == []
        assert scene.gateway.report().holder is None
        await asyncio.sleep(0.4)
        driver.say(b"go")
        await soon()
        assert scene.gateway.taken() == []
        driver.say(b"stand", b"go")
        await soon()
        assert scene.gateway.taken() == [("drive", Drive(forward=0.5))]


@jumping
async def test_what_a_client_holds_is_repeated_until_its_machine_falls_silent() -> None:
    async with serving() as scene:
        scene.side.hold = True
        program = scene.connect().greeted()
        program.say(b"stand", b"go")
        await asyncio.sleep(4.0)
        assert scene.gateway.report().holder == "hq.toy.2"
        assert scene.gateway.taken()[-1] == ("drive", Drive(forward=0.5))
        program.link.silent_s = 1.2
        await asyncio.sleep(0.3)
        assert scene.gateway.report().holder is None
        scene.gateway.taken()
        program.link.silent_s = 0.0
        program.say(b"go")
        await soon()
        assert scene.gateway.taken() == []
        program.say(b"stand", b"go")
        await soon()
        assert scene.gateway.taken() == [("drive", Drive(forward=0.5))]


@jumping
async def test_a_refused_client_is_told_why_and_not_all_the_time() -> None:
    async with serving() as scene:
        program = scene.connect().greeted()
        for _ in range(10):
            program.say(b"go")
            await asyncio.sleep(0.02)
        assert program.heard() == [b"! connected: let go of the stick first"]
        assert (scene.count("hq_refused"), scene.manager.snapshots()[0].counters["refused"]) == (10, 10)
        await asyncio.sleep(TELL_S)
        program.say(b"go")
        await soon()
        assert program.heard() == [b"! connected: let go of the stick first"]


@jumping
async def test_one_drives_and_another_is_told_who() -> None:
    async with serving() as scene:
        first, second = scene.connect().greeted(), scene.connect().greeted()
        first.say(b"stand", b"go")
        await soon()
        second.say(b"stand", b"go")
        await soon()
        assert second.heard() == [b"! not driving: held by hq.toy.2 (priority 0)"]
        assert first.heard() == []


@jumping
async def test_a_client_that_lost_the_robot_is_told_and_the_idle_ones_are_not() -> None:
    async with serving() as scene:
        first, second = scene.connect().greeted(), scene.connect().greeted()
        first.say(b"stand", b"go")
        await soon()
        scene.gateway.authority.takeover(Acquire(who="operator"), scene.now)
        scene.report()
        await soon()
        assert first.heard() == [b"! not driving: the lease has ended (taken over by operator)"]
        assert second.heard() == []


@pytest.mark.parametrize("end", ["leaves", "floods", "rubbish", "stalls"])
@jumping
async def test_a_driver_that_is_lost_in_any_way_gives_the_robot_back(end: str) -> None:
    async with serving(rate_hz=100.0) as scene:
        program = scene.connect().greeted()
        program.say(b"stand", b"go")
        await soon()
        assert scene.gateway.report().holder == "hq.toy.2"
        if end == "leaves":
            program.leave()
        elif end == "floods":
            program.say(*[b"go"] * 200)
        elif end == "rubbish":
            program.receiver.received(b"\xff")
        else:
            program.take_nothing()
            for _ in range(70):
                program.say(b"go")
                await asyncio.sleep(0.1)
        await soon()
        assert scene.gateway.report().state == "free"
        assert KEYS.alive("hq.toy.2") not in scene.bus._shared.tokens
        assert scene.listener.clients == {}


@jumping
async def test_a_driver_that_is_closed_gives_the_robot_back_before_its_last_words_are_out() -> None:
    async with serving(idle_s=1.0) as scene:
        program = scene.connect().greeted()
        program.say(b"stand", b"go")
        await soon()
        program.take_nothing()
        scene.say(topics.TEXT, Text(text="last words"))
        for _ in range(40):
            if not scene.listener.clients[2].session.over:
                await asyncio.sleep(0.05)
        assert scene.listener.clients[2].session.state is State.CLOSING
        assert scene.gateway.report().state == "free"


@jumping
async def test_motion_that_is_not_repeated_ends_with_the_deadman_and_the_lease_follows() -> None:
    async with serving() as scene:
        program = scene.connect().greeted()
        program.say(b"stand", b"go")
        await asyncio.sleep(1.3)
        program.say(b"go")
        await soon()
        assert program.heard() == [b"! deadman: let go of the stick first"]
        await asyncio.sleep(2.0)
        assert scene.gateway.report().holder is None
        assert scene.listener._active == set()


@jumping
async def test_what_a_robot_refuses_is_told_to_whom_it_was_refused() -> None:
    async with serving() as scene:
        first, second = scene.connect().greeted(), scene.connect().greeted()
        first.say(b"stand", b"go")
        await soon()
        scene.gateway.authority.hold_back("busy: map")
        first.say(b"go")
        scene.report()
        assert first.heard() == [b"! drive: busy: map: send a neutral drive first"]
        assert second.heard() == []
        first.say(b"stand", b"go")
        assert [message for _, message in scene.gateway.taken()][-1] == Drive(forward=0.5)


# The robot comes and goes


@jumping
async def test_clients_are_told_when_the_robot_goes_and_comes() -> None:
    async with serving() as scene:
        program, early = scene.connect().greeted(), scene.connect()
        early.heard()
        scene.go()
        scene.go()
        assert program.heard() == [b"! no gateway serves the robot"]
        assert early.heard() == [], "not before the handshake"
        await asyncio.sleep(TELL_S)
        scene.come()
        scene.say(topics.STATUS, STATUS)
        assert program.heard() == [b"! the robot is there"]
        scene.say(topics.STATUS, Status(state="offline", reason="no route", protocol="toy"))
        assert program.heard() == [b"! robot offline: no route"]


@jumping
async def test_a_client_that_comes_while_the_robot_is_away_is_told_so() -> None:
    async with serving(robot=False) as scene:
        program = scene.connect()
        program.say(b"hi")
        assert program.heard() == [b"who are you", b"welcome", b"! no gateway serves the robot"]
        program.say(b"stand", b"go")
        await soon()
        assert scene.gateway.asked == []
        scene.come()
        assert program.heard() == [b"! the robot is there"]
        program.say(b"stand", b"go")
        await soon()
        assert scene.gateway.report().holder == "hq.toy.2"


@jumping
async def test_a_driver_whose_gateway_went_must_let_go_first() -> None:
    async with serving() as scene:
        program = scene.connect().greeted()
        program.say(b"stand", b"go")
        await soon()
        scene.go()
        assert b"! not driving: the robot's gateway is gone" in program.heard()
        scene.come()
        scene.gateway.authority.stop("a new gateway knows of no lease")
        scene.gateway.taken()
        program.say(b"go")
        await soon()
        assert scene.gateway.taken() == []
        program.say(b"stand", b"go")
        await soon()
        assert scene.gateway.report().holder == "hq.toy.2"


# Questions


def answering(scene: Scene, topic: Topic, answer: Callable[[IncomingQuery], None]) -> list[IncomingQuery]:
    asked: list[IncomingQuery] = []

    def take(question: IncomingQuery) -> None:
        asked.append(question)
        answer(question)

    scene.gateway.bus.answer(KEYS.key(topic.path), take)
    return asked


@jumping
async def test_a_question_of_many_is_asked_once_and_answered_to_each() -> None:
    async with serving() as scene:
        asked = answering(scene, topics.RPC_MAP, lambda question: question.answer(payloads.encode(MAP)))
        programs = [scene.connect().greeted() for _ in range(5)]
        for program in programs[:4]:
            program.say(b"map?", b"map?")
        await soon()
        assert len(asked) == 1
        assert [program.heard() for program in programs] == [[b"@rpc/map: Map"]] * 4 + [[]]
        programs[0].say(b"map?")
        await soon()
        assert len(asked) == 2, "what is asked later is asked anew"
        assert programs[0].heard() == [b"@rpc/map: Map"]


@pytest.mark.parametrize(
    "answer",
    [
        lambda question: None,
        lambda question: question.refuse(NotReady("robot: busy")),
        lambda question: question.answer(b"\xc1"),
        lambda question: question.answer(payloads.pack({"rows": 7})),
    ],
)
@jumping
async def test_a_question_without_an_answer_is_answered_with_what_is_known(
    answer: Callable[[IncomingQuery], None],
) -> None:
    async with serving() as scene:
        answering(scene, topics.RPC_POSE, answer)
        program = scene.connect().greeted()
        for _ in range(2):
            program.say(b"pose?")
            await soon()
            assert program.heard() == [b"@rpc/pose: NoneType"]


@jumping
async def test_a_bus_that_cannot_be_asked_leaves_no_question_open(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serving() as scene:

        async def fails(*args: Any, **kwargs: Any) -> list[Answer]:
            raise BusError("the bus is closed")

        monkeypatch.setattr(scene.bus, "ask", fails)
        program = scene.connect().greeted()
        for _ in range(2):
            program.say(b"map?")
            await soon()
            assert program.heard() == [b"@rpc/map: NoneType"]


@jumping
async def test_a_client_that_asked_and_left_is_not_answered_and_the_others_are() -> None:
    async with serving() as scene:
        answering(scene, topics.RPC_MAP, lambda question: question.answer(payloads.encode(MAP)))
        first, second = scene.connect().greeted(), scene.connect().greeted()
        first.say(b"map?")
        second.say(b"map?")
        first.leave()
        await soon()
        assert (first.heard(), second.heard()) == ([], [b"@rpc/map: Map"])


@jumping
async def test_different_questions_do_not_wait_for_each_other() -> None:
    async with serving() as scene:
        answering(scene, topics.RPC_MAP, lambda question: question.answer(payloads.encode(MAP)))
        program = scene.connect().greeted()
        program.say(b"map?", b"pose?")
        await soon()
        assert sorted(program.heard()) == [b"@rpc/map: Map", b"@rpc/pose: NoneType"]


# What is followed only now and then


@jumping
async def test_what_a_client_wants_is_followed_while_one_wants_it() -> None:
    async with serving() as scene:
        first, second = scene.connect().greeted(), scene.connect().greeted()
        scan = Scan(0.0, 0.1, 0.1, 10.0, np.ones(3, np.float32))
        scene.say(topics.SCAN, scan)
        assert scene.side.encoded == 0
        first.say(b"scans on")
        second.say(b"scans on")
        scene.say(topics.SCAN, scan)
        assert scene.side.encoded == 1
        assert (first.heard(), second.heard()) == ([b"scan"], [b"scan"])
        first.say(b"scans off")
        scene.say(topics.SCAN, scan)
        assert (first.heard(), second.heard()) == ([], [b"scan"])
        second.leave()
        await soon()
        scene.say(topics.SCAN, scan)
        assert scene.side.encoded == 2, "nobody wants it"


# The end


@jumping
async def test_an_ending_listener_takes_leave_of_all_and_gives_the_robot_back() -> None:
    async with serving() as scene:
        driver, idle, early = scene.connect().greeted(), scene.connect().greeted(), scene.connect()
        driver.say(b"stand", b"go")
        await soon()
        assert scene.gateway.report().holder == "hq.toy.2"
        listener = scene.listener
    assert all(program.link.closed for program in (driver, idle, early))
    assert {shown.reason for shown in scene.manager.snapshots()} == {"gateway stopped"}
    assert scene.gateway.report().state == "free"
    assert scene.bus._shared.tokens == [KEYS.alive("gateway")]
    await soon()
    assert listener.clients == {}
    assert len(asyncio.all_tasks()) == 1
    late = Program(scene.accept(), "tcp://10.0.0.1:1")
    assert late.link.closed


@jumping
async def test_an_ending_listener_does_not_wait_long_for_a_client_that_takes_nothing() -> None:
    async with serving() as scene:
        program = scene.connect().greeted()
        program.take_nothing()
        scene.say(topics.TEXT, Text(text="last words"))
        start = scene.loop.time()
    assert scene.loop.time() - start <= 1.0
    assert program.link.closed


@jumping
async def test_a_listener_and_its_clients_print_themselves() -> None:
    async with serving() as scene:
        scene.connect()
        assert repr(scene.listener) == "<Listener toy tcp://127.0.0.1:11002, 1 clients>"
        assert repr(scene.listener.clients[2]) == "<Client 2 <ToySession toy.2 handshaking>>"


# What waits for more of it


class HalfSide(ToySide):
    """A protocol whose clients say two halves of a motion, one after the other."""

    def session(self, number: int, bounds: Limits) -> ToySession:
        session = super().session(number, bounds)
        session.handled = frozenset({bytes})
        session.half_at = math.inf
        return session

    def take(self, session: ToySession, message: bytes) -> tuple[Telemetry, ...]:
        if message != b"half":
            return super().take(session, message)
        if session.half_at == math.inf:
            session.half_at = session.said_at
            return ()
        session.half_at = math.inf
        return (_TAKEN[b"go"],)

    def deadline(self, session: ToySession) -> float:
        return session.half_at + 0.03

    def expire(self, session: ToySession, now: float) -> tuple[Telemetry, ...]:
        if now < self.deadline(session):
            return ()
        session.half_at = math.inf
        return ((topics.CMD_DRIVE, Drive(forward=0.25)),)


@contextlib.asynccontextmanager
async def halves(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[tuple[Scene, Program]]:
    """A client of such a protocol that may drive."""
    monkeypatch.setattr(Scene, "side_class", HalfSide)
    async with serving() as scene:
        program = scene.connect().greeted()
        program.say(b"stand")
        yield scene, program


def driven(scene: Scene) -> list[float]:
    """The speeds that were commanded since the last call."""
    return [message.forward for _, message in scene.gateway.taken() if isinstance(message, Drive)]


@jumping
async def test_what_waits_for_more_is_carried_out_when_it_has_waited_long_enough() -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        async with halves(monkeypatch) as (scene, program):
            program.say(b"half")
            await asyncio.sleep(0.029)
            assert driven(scene) == []
            await asyncio.sleep(0.0015)
            assert driven(scene) == [0.25]
            assert scene.count("hq_commands") == 2
            await asyncio.sleep(1.0)
            assert driven(scene) == []


@jumping
async def test_what_comes_in_time_is_carried_out_with_it_at_once_and_the_next_has_its_own_time() -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        async with halves(monkeypatch) as (scene, program):
            program.say(b"half")
            await asyncio.sleep(0.02)
            program.say(b"half", b"half")
            await asyncio.sleep(0.001)
            assert driven(scene) == [0.5]
            await asyncio.sleep(0.02)
            assert driven(scene) == [], "the second has waited 21 ms"
            await asyncio.sleep(0.0095)
            assert driven(scene) == [0.25]


@jumping
async def test_what_waits_of_a_client_that_is_gone_is_nothing() -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        async with halves(monkeypatch) as (scene, program):
            program.say(b"half")
            program.leave()
            await asyncio.sleep(1.0)
            assert driven(scene) == []
            assert scene.count("hq_commands") == 1


@jumping
async def test_what_waited_while_the_process_stood_still_moves_nothing() -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        async with halves(monkeypatch) as (scene, program):
            program.say(b"half")
            scene.skipped_s += 5.0
            await asyncio.sleep(0.05)
            assert driven(scene) == []
            assert program.heard() == [b"! the gateway stood still: let go of the stick first"]


# Whether the robot is there


class ToldSide(ToySide):
    def presence(self, there: bool) -> Send:
        self.encoded += 1
        return lambda session, now: session.send(b"there" if there else b"lost")


@jumping
async def test_every_client_is_shown_once_that_the_robot_is_lost_and_that_it_is_there_again() -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(Scene, "side_class", ToldSide)
        async with serving() as scene:
            programs = [scene.connect().greeted() for _ in range(3)]
            silent = scene.connect()
            silent.heard()
            scene.say(topics.STATUS, Status(state="connecting", protocol="toy"))
            scene.say(topics.STATUS, Status(state="handshaking", protocol="toy"))
            scene.go()
            assert [program.heard().count(b"lost") for program in programs] == [1, 1, 1]
            scene.come()
            scene.say(topics.STATUS, STATUS)
            assert [program.heard().count(b"there") for program in programs] == [1, 1, 1]
            scene.go()
            assert [program.heard().count(b"lost") for program in programs] == [1, 1, 1]
            assert silent.heard() == [], "nothing before the handshake"


# A protocol that fails at what it does not know


class LostSide(ToySide):
    """A protocol of another package that has never met this robot."""

    def begin(self, session: ToySession, now: float) -> None:
        session.send({"toy": b"welcome"}[self.view.protocol or ""])

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        return {"text": super().show}[topic.path](topic, message)

    def take(self, session: ToySession, message: bytes) -> tuple[Telemetry, ...]:
        return (_TAKEN[message],)

    def presence(self, there: bool) -> Send:
        raise KeyError(there)


@jumping
async def test_a_listener_goes_on_without_what_its_protocol_fails_at_and_says_so_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(Scene, "side_class", LostSide)
        async with serving() as scene:
            scene.say(topics.STATUS, Status(state="established", protocol="unheard of"))
            program = scene.connect()
            program.say(b"hi")
            assert program.heard() == [b"who are you"], "and no welcome"
            for x in range(50):
                scene.say(topics.POSE, Pose(x=float(x), y=0.0, heading=0.0))
                program.say(b"what is this")
            scene.say(topics.TEXT, Text("hello"))
            assert program.heard() == [b"hello"]
            program.say(b"stand", b"go")
            await soon()
            assert [message for _, message in scene.gateway.taken()] == [Drive(forward=0.5)]
            scene.go()
            scene.come()
            assert scene.reason("toy.2") is None
            assert scene.count("hq_left_out") >= 1 + 50 + 50 + 2
            assert scene.count("hq_malformed") == 50
    errors = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert sorted(errors) == [
        "toy: a client not sent: KeyError('unheard of'); going on without",
        "toy: pose not shown: KeyError('pose'); going on without",
        "toy: status not shown: KeyError('status'); going on without",
        "toy: the robot's presence not shown: KeyError(True); going on without",
        "toy: what a client said not taken: KeyError(b'what is this'); going on without",
    ]


class SessionlessSide(ToySide):
    def session(self, number: int, bounds: Limits) -> ToySession:
        raise KeyError(self.view.protocol)


@jumping
async def test_a_client_for_which_there_is_no_session_is_turned_away() -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(Scene, "side_class", SessionlessSide)
        async with serving() as scene:
            for _ in range(5):
                assert scene.connect().link.closed
            assert (scene.count("hq_accepted"), scene.count("hq_turned_away")) == (0, 5)
            assert repr(scene.listener._ids) == "<ClientIds 0 of 254 taken>"


@jumping
async def test_a_question_that_no_robot_is_asked_is_refused() -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setitem(_TAKEN, b"sessions?", (topics.RPC_SESSIONS("x"), Query()))
        async with serving() as scene:
            program = scene.connect().greeted()
            program.say(b"sessions?")
            await soon()
            assert program.heard() == [b"! robots are not asked for @rpc/sessions/x"]
