"""One listener with a toy protocol on a fake bus, its links played by hand, on a clock that jumps.

A frame is a length byte and so many bytes. A client says ``hi`` first; ``go`` and ``stand`` drive, ``map?`` asks.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
from collections.abc import AsyncIterator, Callable
from typing import Any
from unittest import mock

import numpy as np

from tests.fake_bus import FakeBus
from tests.fake_link import FakeLink
from tests.hq.gateway import KEYS, Gateway
from zbridge.clocks import Clocks
from zbridge.control.events import StopCause
from zbridge.errors import EncodeError, ProtocolError, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Acquire
from zbridge.fleet.messages import Drive, FleetMessage, Map, Pose, Query, Scan, Status, Stop, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.hq import listener as listeners
from zbridge.hq.listener import Listener
from zbridge.hq.robot_subscription import RobotSubscription
from zbridge.hq.settings import HqSettings, ListenerPlan
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import HqSide, Protocol, Send, Telemetry
from zbridge.protocol.session import Limits, Role, Session, State
from zbridge.protocol.session_table import ClientIds, SessionTable
from zbridge.transport.link import Receiver

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
    said_at = 0.0

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
    follows = ("pose", "text", "lidar")
    quiet_s = 0.0

    def __init__(self, options: Any, view: RobotView, metrics: Metrics) -> None:
        self.view = view
        self.encoded = 0
        self.made: list[ToySession] = []

    def numbers(self, clients: int) -> ClientIds:
        return ClientIds(range(2, 256), self.quiet_s)

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
        taken = COMMANDS.get(message)
        if taken is None:
            raise ProtocolError(f"what is {message!r}")
        return (taken,)

    def answer(self, session: ToySession, topic: Topic, message: FleetMessage | None, now: float) -> None:
        session.send(b"%s: %s" % (topic.path.encode(), type(message).__name__.encode()))

    def tell(self, session: ToySession, text: str, now: float) -> None:
        session.send(b"! " + text.encode())

    def wanted(self) -> tuple[Topic, ...]:
        return (topics.SCAN,) if any(session.scans for session in self.made if not session.over) else ()


COMMANDS: dict[bytes, Telemetry] = {
    b"go": (topics.CMD_DRIVE, Drive(forward=0.5)),
    b"stand": (topics.CMD_DRIVE, Drive()),
    b"stop": (topics.CMD_STOP, Stop()),
    b"map?": (topics.RPC_MAP, Query()),
    b"pose?": (topics.RPC_POSE, Query()),
}


class HandLink(FakeLink):
    """A link that ends as a real one does: its receiver is told soon after it was closed."""

    def close(self) -> None:
        if not self.closed:
            super().close()
            asyncio.get_running_loop().call_soon(self.receiver.lost, "closed by us")

    def abort(self) -> None:
        self.close()


class Program:
    """An HQ program at the other end of a link."""

    def __init__(self, receiver: Receiver, peer: str) -> None:
        self.link = HandLink(peer, receiver)
        receiver.attached(self.link)

    def say(self, *messages: bytes) -> None:
        self.link.receiver.received(b"".join(map(framed, messages)))

    def greeted(self) -> Program:
        """Shake hands, and forget what was heard."""
        self.say(b"hi")
        self.heard()
        return self

    def heard(self) -> list[bytes]:
        """What was heard since the last call."""
        written, self.link.written = self.link.written, []
        return [frame[1:] for frame in written]

    async def said(self, *messages: bytes) -> list[bytes]:
        """Say that, let it be done, and return what was heard since the last call."""
        self.say(*messages)
        await soon()
        return self.heard()

    def leave(self) -> None:
        if not self.link.closed:
            self.link.closed = True
            self.link.receiver.lost("closed by peer")

    def hears(self, text: str) -> None:
        assert (b", ".join(self.heard()).decode() or NOTHING) == text

    def stalls(self) -> None:
        self.link.ready = False

    def takes(self) -> None:
        self.link.ready = True
        self.link.receiver.writable()

    def is_(self, state: str) -> None:
        assert self.link.closed is (state == "closed"), state


class Scene:
    """A listener that runs, and the robot's gateway beside it."""

    def __init__(
        self, *, allow: tuple[str, ...] = (), robot: bool = True, side: type[ToySide] = ToySide, **settings: Any
    ) -> None:
        self.side_class = side
        self.loop = asyncio.get_running_loop()
        self.skipped_s = 0.0
        self.bus = FakeBus("hq")
        self.gateway = Gateway(self.bus.join("gw"), self)
        self.status = self.gateway.bus.publisher(KEYS.key("status"), topics.STATUS)
        self.token = None
        if robot:
            self.come()
        self.metrics = Metrics()
        self.manager = SessionTable()
        self.robot = RobotSubscription(self.bus, KEYS, self.metrics)
        self.robot.open()
        limits = HqSettings(protocol="toy", listen="tcp://127.0.0.1:0", **settings)
        networks = tuple(map(ipaddress.ip_network, allow))
        protocol = Protocol("toy", "", HqSettings, 1, robot=None, simulate=None, hq=self._side)  # type: ignore[arg-type]
        plan = ListenerPlan(protocol, None, Address("127.0.0.1", 0), limits, networks)
        self.accept: Callable[[], Receiver]
        clocks = Clocks(lambda: self.now, raw_ms=lambda: self.now * 1000)
        self.listener = Listener(plan, "toy", self.robot, self.manager, self.metrics, clocks)
        self.hosts = 0
        self.programs: dict[str, Program] = {}

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

    def say(self, topic: Topic, message: FleetMessage) -> None:
        self.gateway.bus.publisher(KEYS.key(topic.path), topic).put(payloads.encode(message))

    def pose(self, x: float) -> None:
        """Let the robot be at ``x``."""
        self.say(topics.POSE, Pose(x=x, y=0.0, heading=0.0))

    def connect(self, host: str = "10.0.0.1") -> Program:
        self.hosts += 1
        return Program(self.accept(), f"tcp://{host}:{5000 + self.hosts}")

    def greeted(self, count: int) -> list[Program]:
        """Connect so many programs that have shaken hands."""
        return [self.connect().greeted() for _ in range(count)]

    def driven(self) -> list[float]:
        """The speeds that were commanded since the last call."""
        taken = (message for _, message in self.gateway.taken())
        return [message.forward for message in taken if isinstance(message, Drive) and message.moving]

    def count(self, name: str, **labels: str) -> int:
        return self.metrics.total(name, **labels)

    def robot_is(self, what: str) -> None:
        if what == "there":
            self.come()
        elif what == "gone":
            assert self.token is not None
            self.token.close()
        else:
            state, _, reason = what.partition(" ")
            self.say(topics.STATUS, Status(state=state, reason=reason or None, protocol="toy"))  # type: ignore[arg-type]

    def show(self) -> None:
        """Let the gateway say how things stand."""
        self.gateway.control.put(payloads.encode(self.gateway.report()))

    def skip(self, seconds: float) -> None:
        self.skipped_s += seconds

    def ended(self, text: str) -> None:
        name, _, reason = text.partition(" ")
        assert next(shown.reason for shown in self.manager.snapshots() if shown.name == name) == reason

    async def play(self, script: str) -> None:
        """Play the steps of a script, one after the other, separated by semicolons; each takes a millisecond.

        A program is a letter: ``a connects``, ``a greets`` (shakes hands too), ``a drives``, or see ``SAYS``. Other
        steps are in ``STEPS``, and looks, ``holder hq.toy.2``, in ``LOOKS``.
        """
        for step in script.split("; "):
            word, _, rest = step.partition(" ")
            if len(word) == 1:
                verb, _, rest = rest.partition(" ")
                if verb in ("connects", "greets", "drives"):
                    self.programs[word] = self.connect() if verb == "connects" else self.connect().greeted()
                    self.programs[word].say(*[b"stand", b"go"] * (verb == "drives"))
                else:
                    SAYS[verb](self.programs[word], rest)
            elif word in LOOKS:
                assert LOOKS[word](self) == rest, step
            elif word == "wait":
                await asyncio.sleep(float(rest))
            else:
                STEPS[word](self, rest)
            await soon()


NOTHING = "nothing"
SCAN = Scan(0.0, 0.1, 0.1, 10.0, np.ones(3, np.float32))
OPERATOR = Acquire(who="operator")


def spelled(*values: object) -> str:
    return " ".join(map(str, values)) or NOTHING


SAYS: dict[str, Callable[[Program, str], object]] = {
    "says": lambda program, text: program.say(*text.encode().split(b", ")),
    "garbles": lambda program, text: program.link.receiver.received(framed(text.encode()) + b"\xff rubbish"),
    "hears": Program.hears,  # since the last look
    "leaves": lambda program, _: program.leave(),
    "stalls": lambda program, _: program.stalls(),
    "takes": lambda program, _: program.takes(),
    "owes": lambda program, seconds: setattr(program.link, "silent_s", float(seconds)),  # an acknowledgement
    "is": Program.is_,  # open or closed
}
STEPS: dict[str, Callable[[Scene, str], object]] = {
    "robot": Scene.robot_is,  # there, gone, or its state and the reason
    "at": lambda scene, x: scene.pose(float(x)),
    "text": lambda scene, text: scene.say(topics.TEXT, Text(text=text)),
    "scan": lambda scene, _: scene.say(topics.SCAN, SCAN),
    "frozen": lambda scene, seconds: scene.skip(float(seconds)),
    "operator-drives": lambda scene, _: scene.gateway.authority.acquire(OPERATOR, scene.now),
    "operator-takes-over": lambda scene, _: scene.gateway.authority.takeover(OPERATOR, scene.now),
    "gateway-refuses": lambda scene, why: scene.gateway.authority.require_neutral(why, StopCause.ROBOT_BUSY),
    "gateway-leaves-out": lambda scene, what: scene.gateway.authority.refuse("drive", Unsupported(what), "hq.toy.2"),
    "gateway-forgets": lambda scene, _: scene.gateway.authority.stop("a new gateway knows of no lease"),
    "shown": lambda scene, _: scene.show(),
    "forget": lambda scene, _: scene.driven(),
    "ended": Scene.ended,  # a session, and why
}
OUTCOMES = ("accepted", "turned_away")
COUNTS = ("dropped", "left_out", "commands", "refused", "malformed_frames")
LOOKS: dict[str, Callable[[Scene], str]] = {
    "clients": lambda scene: spelled(*sorted(scene.listener.clients)),
    "holder": lambda scene: scene.gateway.report().holder or NOTHING,
    "state": lambda scene: scene.gateway.report().state,
    "driven": lambda scene: spelled(*scene.driven()),
    "asked": lambda scene: spelled(*scene.gateway.asked),
    "stops": lambda scene: spelled(len(scene.bus.values("fleet/r1/@cmd/stop"))),
    "encoded": lambda scene: spelled(scene.side.encoded),
    "tokens": lambda scene: spelled(*(key.removeprefix(KEYS.alive("")) for key in scene.bus.network.tokens)),
    "active": lambda scene: spelled(*(client.number for client in scene.listener._active)),
    **{what: lambda scene, name=f"hq_{what}": spelled(scene.count(name)) for what in COUNTS},
    **{what: lambda scene, what=what: spelled(scene.count("hq_connections", outcome=what)) for what in OUTCOMES},
    "sessions": lambda scene: spelled(*(client.session.state.value for client in scene.listener.clients.values())),
}


@contextlib.asynccontextmanager
async def serving(**settings: Any) -> AsyncIterator[Scene]:
    """Run a listener whose links are accepted by hand."""
    scene = Scene(**settings)

    @contextlib.asynccontextmanager
    async def listen(address: Address, receiver: Callable[[], Receiver], **kwargs: Any) -> AsyncIterator[Address]:
        scene.accept = receiver
        yield Address(address.host, 11002)

    with mock.patch.object(listeners, "listen", listen):
        task = scene.loop.create_task(scene.listener.run())
        await asyncio.wait_for(scene.listener.ready.wait(), 1.0)
    try:
        yield scene
        assert not task.done(), task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def play(special: str, script: str) -> None:
    """Play a script with a listener whose settings are special: ``rate_hz=50 side=HalfSide``."""
    sides = {side.__name__: side for side in ToySide.__subclasses__()}
    settings = dict(pair.split("=") for pair in special.split())
    async with serving(**{name: sides.get(value) or float(value) for name, value in settings.items()}) as scene:
        await scene.play(script)


async def soon() -> None:
    """Let what was begun be done."""
    await asyncio.sleep(0.001)
