"""Everything that a soak runs, each part a process of its own, in three network namespaces.

room: the router, drivers, HQ programs, the recorder, and who looks on; host: the supervisor and its gateways; field:
the robots. The links between them (:mod:`tests.soak.network`) delay and lose packets.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from queue import Queue

import msgpack
import zenoh

from tests.e2e.conftest import Fleet, configuration, until
from tests.e2e.rigs import loss
from tests.e2e.rigs.fragile import ROBOTS, charges
from tests.e2e.rigs.moving_robot import MovingRobot
from tests.e2e.rigs.processes import LINE_S, Namespace, Part, ip
from tests.e2e.rigs.supervised import Supervised, children
from tests.scraped import scrape, totals
from tests.soak import counted
from tests.soak.network import Link

ROUTER_PORT, METRICS_PORT, HQ_PORT = 7447, 9100, 21_000
COUNTED = "counted"
ESTABLISHED_S = 150.0
"""Longest wait for all robots once nothing is wrong any more."""
NEW_S = 15.0
"""Seconds without a session after which somebody starts a robot's program again."""
_JOINED = "in one read: "
"""What robots say of packets that a link has joined, which loses some and delivers them again."""
LOSS_COUNTERS = ("bus_dropped", "bus_replaced", "untranslatable_messages", "malformed_frames", "names_dropped")


@dataclass(frozen=True)
class Plan:
    """A robot: which fragile one it is, and the program of ``tests.e2e.rigs.hq_programs`` that may drive it.

    steady: its gateway is never killed or restarted, so that what it uses can be compared over hours.
    """

    kind: str
    program: str
    options: str = ""
    steady: bool = True

    @property
    def protocol(self) -> str:
        return ROBOTS[self.kind].protocol


ROBOT_PLANS = {
    "udp": Plan("tcpudp-1.3-udp", "tcpudp"),
    "vehicle": Plan("alf", "alf"),
    "webots": Plan("wc2ec", "wc2ec-repeats", "hold = false"),
    "tcp": Plan("tcpudp-1.3", "tcpudp-by-tcp", steady=False),
    "binary": Plan("alf-binary", "alf", steady=False),
}


@dataclass
class Losses:
    """What became of the counted robot's positions, and how long they took since somebody asked."""

    expected: int | None = None
    lost: list[tuple[float, float, int]] = field(default_factory=list)
    """Between which times, and how many."""
    came: int = 0
    disordered: int = 0
    late_s: list[float] = field(default_factory=list)
    _at: float = 0.0

    def take(self, sample: zenoh.Sample) -> None:
        """Take a position from the bus."""
        at = time.monotonic()
        late_s, number = counted.read(msgpack.unpackb(sample.payload.to_bytes()))
        self.late_s.append(late_s)
        if self.expected is not None and number > self.expected:
            self.lost.append((self._at, at, number - self.expected))
        self.disordered += self.expected is not None and number < self.expected
        self.expected, self._at = number + 1, at
        self.came += 1


class Scene:
    """What runs. folder: for robot files and logs."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path, seed: int) -> None:
        self.stack, self.seed, self.faults = stack, seed, list[str]()
        self.replaced: Counter[str] = Counter()
        self.host, self.field = Namespace(stack, "echo $word > /proc/sys/net/ipv4/ip_forward"), Namespace(stack)
        self.bus_link = Link(stack, (), "10.77.1", self.host)
        self.field_link = Link(stack, self.host.enter, "10.77.2", self.field)
        self._route()
        self.router_at = f"tcp/{self.bus_link.near}:{ROUTER_PORT}"
        self.reach = f"tcp/127.0.0.1:{ROUTER_PORT}"
        self.start_router()
        self.session = stack.enter_context(zenoh.open(configuration("client", self.reach)))
        self.fleet = Fleet(self.session, "fleet/*/status")
        stack.callback(self.fleet.close)
        self.losses = Losses()
        self._poses = self.session.declare_subscriber(f"fleet/{COUNTED}/pose", self.losses.take)
        self._begin_robots()
        self.folder = folder / "robots"
        self.folder.mkdir()
        for name in self.names:
            self.write(name)
        self.supervisor = Supervised(stack, self.folder, enter=self.host.enter)

    @property
    def names(self) -> list[str]:
        return [COUNTED, *ROBOT_PLANS]

    def _route(self) -> None:
        """Let datagrams from the room to the field through: what is measured goes the same way."""
        self.host.keeper.say("1")
        assert self.host.keeper.line() == "done"
        ip(f"route add {self.field_link.far}/32 via {self.bus_link.far}")
        ip(f"route add {self.bus_link.near}/32 via {self.field_link.near}", enter=self.field.enter)

    def start_router(self) -> None:
        self.router = loss.router(self.stack, f"tcp/0.0.0.0:{ROUTER_PORT}")

    # Robots

    def _begin_robots(self) -> None:
        self.driven: list[tuple[float, int]] = []
        """When the counted robot got which number."""
        ports: Queue[int] = Queue()

        def hear(line: str) -> None:
            at, _, number = line.partition(" ")
            if number:
                self.driven.append((float(at), int(number)))
            elif at:
                ports.put(int(at))

        command = (*self.field.enter, sys.executable, "-m", "tests.soak.counted", self.field_link.far)
        self.counted = Part(self.stack, *command, heard=hear)
        self.counted_port = ports.get(timeout=LINE_S)
        self.robots = {name: self._robot(name) for name in ROBOT_PLANS}

    def _robot(self, name: str, port: int = 0) -> MovingRobot:
        options = {"port": port, **({"side": 200} if ROBOT_PLANS[name].protocol == "tcpudp" else {})}
        enter, host = self.field.enter, self.field_link.far
        return MovingRobot(self.stack, ROBOT_PLANS[name].kind, host, enter, self.seed, **options)

    def part(self, name: str) -> Part:
        """Give the process of a robot."""
        return self.counted if name == COUNTED else self.robots[name].part

    def judge(self, name: str) -> None:
        """End a robot, and note what it says of its gateway."""
        robot = self.robots[name]
        robot.part.say("end")
        with contextlib.suppress(AssertionError):
            until(lambda: bool(robot.report), 5)
        if not robot.report:
            self.faults.append(f"{name}: the robot's program says nothing")
        elif not robot.report["alive"]:
            self.faults.append(f"{name}: the robot died: {robot.report['violations'][-1:]}")
        said = charges(robot.report.get("violations", ()), late_s=1.0)  # commands come too rarely over such a link
        self.faults += [f"{name}: {text[:200]}" for text in said if _JOINED not in text]

    def replace(self, name: str) -> None:
        """Start a robot's program again: legacy ones give one usable connection per start."""
        old = self.robots[name]
        self.judge(name)
        events = [*old.report.get("events", ())][-3:]
        self.replaced[name] += 1
        if ROBOT_PLANS[name].steady:
            self.faults.append(f"{name}: its connection was lost though its gateway lived: {events}")
        old.part.kill()
        self.robots[name] = self._robot(name, old.port)

    # Gateways

    def write(self, name: str, lease_s: float = 3.0) -> None:
        """Write a robot's file, at one stroke."""
        plan = ROBOT_PLANS.get(name)
        port = self.counted_port if plan is None else self.robots[name].port
        kind = ROBOTS[plan.kind] if plan else ROBOTS["tcpudp-1.3"]
        address = json.dumps([f"tcp://{self.field_link.far}:{port}"])
        text = f'[robot]\nname = "{name}"\n[device]\nprotocol = "{kind.protocol}"\nconnect = {address}\n'
        text += f"[device.options]\n{kind.options}\n"
        if plan is None:
            text += f'[metrics]\nlisten = "0.0.0.0:{METRICS_PORT}"\n'
        else:
            text += f'[[hq]]\nprotocol = "{plan.protocol}"\nlisten = "tcp://0.0.0.0:{self.hq_port(name)}"\n'
            text += f"options = {{ {plan.options} }}\n"
        text += f'[control]\nlease_s = {lease_s}\n[bus]\nconnect = ["{self.router_at}"]\nmulticast = false\n'
        new = self.folder / f"{name}.new"
        new.write_text(text)
        new.rename(self.folder / f"{name}.toml")

    def hq_port(self, name: str) -> int:
        return HQ_PORT + self.names.index(name)

    def pids(self) -> dict[str, int]:
        """Give the processes that live as long as the soak: supervisor, fork server, gateways that nobody kills."""
        steady = [COUNTED, *(name for name, plan in ROBOT_PLANS.items() if plan.steady)]
        gateways = {f"gateway {name}": self.supervisor.gateway(name) for name in steady}
        found = {"supervisor": self.supervisor.process.pid, **gateways}
        names = {pid: Path(f"/proc/{pid}/comm").read_text().strip() for pid in children(found["supervisor"])}
        forks = [pid for pid, name in names.items() if not name.startswith("zb ")]
        return {**found, **({"fork server": forks[0]} if forks else {})}

    def established(self, name: str) -> bool:
        """Whether a gateway said within the last two seconds that it has its robot."""
        last = self.fleet.last(f"{name}/status")
        return last.get("state") == "established" and time.monotonic() - last["at"] < 2.0

    def settle(self) -> None:
        """Wait until every robot is established; start the program of one again that gives no connection."""
        began, gone = time.monotonic(), dict[str, float]()
        while missing := [name for name in self.names if not self.established(name)]:
            waited_s = time.monotonic() - began
            if waited_s > ESTABLISHED_S:
                states = {name: self.fleet.last(f"{name}/status") for name in missing}
                raise AssertionError(f"not established {ESTABLISHED_S:g} s after the last fault: {states}")
            for name in missing:
                offline = self.fleet.last(f"{name}/status").get("state") == "offline" and name != COUNTED
                if offline and waited_s > gone.setdefault(name, waited_s) + NEW_S:
                    gone[name] = ESTABLISHED_S
                    self.replace(name)
            time.sleep(0.1)

    def counters(self) -> Counter[str]:
        """Read the counters of the counted robot's gateway, over the bus's link."""
        return totals(scrape(METRICS_PORT, host=self.bus_link.far))
