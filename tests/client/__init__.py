"""The client over a fake bus. The robot's side is the gateway's own lease and commands; only the robot is played."""

from __future__ import annotations

import asyncio
import time
from types import SimpleNamespace
from typing import Any

from tests.fake_bus import FakeBus
from tests.proofs import numbered
from zbridge.client import Fleet
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.context import ProtocolFaults, RobotContext
from zbridge.control.enforcer import Enforcer
from zbridge.control.faults import OpenFaults
from zbridge.control.lease_server import LeaseServer
from zbridge.control.standstill import Standstill
from zbridge.errors import NotReady, Refused, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, Pose, Status
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import Outcome, RobotSide
from zbridge.protocol.session import State
from zbridge.robot.commands import Commands

LEASE_S, DEADMAN_S = 3.0, 2.0


def raw_ms() -> float:
    """Return the time of the loop: a busy machine must not make commands older than the loop knows."""
    return asyncio.get_running_loop().time() * 1000


class Machine(RobotSide):
    """A robot that takes every command and keeps it; ``refusal`` and ``unstoppable`` say why not, ``left_out`` what."""

    link_names = ("robot",)

    def __init__(self) -> None:
        self.commands: list[tuple[str, FleetMessage]] = []
        self.stops = 0
        self.refusal: str | None = None
        self.unstoppable: str | None = None
        self.left_out: str | None = None

    def session(self, link: str, peer: str) -> Any:
        raise NotImplementedError

    @property
    def driving(self) -> Any:
        outbox = SimpleNamespace(muted=False)
        return SimpleNamespace(over=False, busy=None, doubts=(), doubtful=None, state=State.ESTABLISHED, outbox=outbox)

    def translator(self, kind: type) -> Any:
        raise NotImplementedError

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        if self.refusal is not None:
            raise NotReady(self.refusal)
        self.commands.append((topic.path.removeprefix("@cmd/"), command))
        return Outcome(left_out=self.left_out)

    def stop(self, now: float, until: float) -> None:
        if self.unstoppable is not None:
            raise Unsupported(self.unstoppable)
        self.stops += 1

    def ask(self, topic: Topic) -> None:
        raise NotImplementedError


class Gateway:
    """The gateway of one robot: lease, commands, stop, ``control`` and ``status``; quiet until :meth:`serve`."""

    def __init__(self, bus: FakeBus, name: str = "r1") -> None:
        self.name = name
        self.keys = KeySpace("fleet", name)
        self.machine = Machine()
        self.asked: list[tuple[float, str]] = []
        """When which question about the lease came."""
        self._bus = bus.join(f"gateway of {name}")
        self._loop = asyncio.get_running_loop()
        metrics = Metrics()
        self.authority = Authority(LEASE_S, DEADMAN_S, numbered())
        context = RobotContext(
            self.machine,
            self.keys,
            self._bus,
            metrics,
            OpenFaults(),
            ProtocolFaults(name),
            publish=self.publish,
            pump=lambda: None,
            clock=self._loop.time,
            clock_ns=time.time_ns,
            raw_ms=raw_ms,
        )
        standstill = Standstill(context, self.authority, idle_stop_s=0.0)
        self.enforcer = Enforcer(context, self.authority, standstill, Audit(name, lambda line: None))
        self.leases = LeaseServer(context, self.enforcer)
        self.commands = Commands(context, self.enforcer)

    def serve(self) -> None:
        """Come to the bus."""
        self._bus.announce(self.keys.alive("gateway"))
        self.publish(topics.STATUS, Status(state="established"))
        self.enforcer.report()
        for name in ("acquire/*", "takeover/*", "renew", "release"):
            self._bus.answer(self.keys.key(f"@rpc/control/{name}"), self._note)
        self.leases.serve()
        self._bus.subscribe(self.keys.key("@cmd/**"), self.commands.take)

    async def vanish(self) -> None:
        """Be gone, without a word."""
        self.enforcer.close()
        await self._bus.close()

    def publish(self, topic: Topic, message: FleetMessage) -> None:
        self.put(topic, payloads.encode(message))

    def put(self, topic: Topic, payload: bytes) -> None:
        """Publish this payload, whatever it is; a state keeps its last value for as long as the gateway is there."""
        self._bus.publisher(self.keys.key(topic.path), topic).put(payload)

    def refuse(self, command: str, refusal: Refused, who: str | None, by: str | None = None) -> None:
        """Show a refusal on ``control``. by: the listener that tells of it."""
        self.authority.refuse(command, refusal, who, by=by)
        self.enforcer.settle()

    @property
    def control(self) -> Control:
        return self.authority.report(self._loop.time())

    @property
    def driven(self) -> list[FleetMessage]:
        """The drive commands that were carried out."""
        return [command for name, command in self.machine.commands if name == "drive"]

    def questions(self, name: str) -> list[float]:
        """When this was asked: ``acquire``, ``takeover``, ``renew``, ``release``."""
        return [at for at, path in self.asked if path.split("/")[2] == name]

    def _note(self, question: Any) -> None:
        self.asked.append((self._loop.time(), self.keys.path(question.key)))


class World:
    """Robots, each with its gateway, and programs; the first robot is ``robot``, with ``gateway`` and ``machine``."""

    def __init__(self, *names: str, served: bool = True) -> None:
        self.loop = asyncio.get_running_loop()
        self.bus = FakeBus()
        self.gateways = {name: Gateway(self.bus, name) for name in names or ("r1",)}
        self.gateway = next(iter(self.gateways.values()))
        self.machine = self.gateway.machine
        self.fleet = Fleet(self.bus.join("mine"), clock_ms=raw_ms)
        self.robot = self.fleet[self.gateway.name]
        self.others = Fleet(self.bus.join("others"), clock_ms=raw_ms)[self.gateway.name]
        for gateway in self.gateways.values():
            if served:
                gateway.serve()

    def pose(self, *xs: float) -> None:
        """Have the robot publish poses."""
        for x in xs:
            self.gateway.publish(topics.POSE, at(x))


def at(x: float) -> Pose:
    return Pose(x=float(x), y=0.0, heading=0.0)


async def settle() -> None:
    """Let what is ready run, without time passing."""
    for _ in range(10):
        await asyncio.sleep(0)


def subscriptions(bus: FakeBus, key: str) -> int:
    """Count the subscriptions of this very key."""
    return sum(key_expr == key for key_expr, _ in bus.network.subscribers)


def tokens(bus: FakeBus, name: str = "r1") -> list[str]:
    """List the liveliness tokens of programs that drive, without the numbers of their wishes."""
    return [token.rpartition(".")[0] for token in numbered_tokens(bus, name)]


def numbered_tokens(bus: FakeBus, name: str = "r1") -> list[str]:
    """List the liveliness tokens of programs that drive."""
    prefix = f"fleet/{name}/@alive/"
    return [token.removeprefix(prefix) for token in bus.network.tokens if token.startswith(prefix + "operator.")]
