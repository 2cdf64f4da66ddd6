"""HQ programs of every protocol and version at once at one robot, all of them fragile judges, and so is the robot.

    python -m tests.e2e.measured.hq_judge --seconds 60                # every robot: each drives, then one for a minute
    python -m tests.e2e.measured.hq_judge --robot alf --driver ec --seconds 10

Each program has its listener. All must see what the robot has; one after the other drives, while the others idle
beside it as legacy programs do, sending neutral; then one drives to and fro for as long as is said.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import struct
import tempfile
import time
from collections.abc import AsyncIterator, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from gateways.alf.conformance.fragile_hq import FragileAlfHq
from gateways.alf.conformance.parser import Dialect
from gateways.tcpudp.conformance.fragile_hq import FragileTcpUdpHq
from gateways.tcpudp.conformance.parser import FeatureFlag
from gateways.wc2ec.conformance.fragile_hq import FragileExternalController
from tests.e2e.conftest import HOST, Bench, Gateway, device, listener
from tests.e2e.measured import mixed
from tests.e2e.rigs.fragile import DISTURBED, Fragile, charges, disturbed, fragile_robot
from tests.e2e.rigs.hq_scene import playing, ports, pushed, soon
from tests.e2e.rigs.processes import report
from tests.ports import free_port

LEASE_S = 1.2
"""Seconds of neutral after which a robot is given back: short, so that the next program may have it soon."""
LET_GO_S = 0.1
"""Seconds between letting go of a stick and pushing it: datagrams may overtake."""
BETWEEN_S = 0.01
"""Seconds between the two wheels; the bytes of one take 6 ms besides. Legacy controllers take 11 to 20 ms."""
IDLE_S = 0.3
"""Seconds between two neutrals of an external controller that idles."""
JOIN_S = 0.5
"""For how long the listener of an external controller waits for the other wheel."""
RANGES = tuple(120.0 + degree / 2 for degree in range(360))
"""Simulated lidar data: centimetres, one a degree."""
_AT_ONCE = {"misnamed": 0.0, "times": {"unasked_s": 0.05}}
ROBOTS: dict[str, tuple[str, dict[str, Any]]] = {
    **{f"tcpudp-{version}": (f"tcpudp-{version}", _AT_ONCE) for version in ("1.1", "1.2")},
    "tcpudp-1.3": ("tcpudp-1.3-udp", _AT_ONCE),
    "alf": ("alf", {}),
    "wc2ec": ("wc2ec", {}),
}
"""The fragile robots, and what they are told."""
ALF_FULL = {"text": 255, "binary": 100}
_BEARINGS = ", ".join(f"ds{number} = {45.0 * number}" for number in range(8))
_TABLES = ", ".join(f"ds{number} = [[0.0, 0.0], [1000.0, 2.0]]" for number in range(8))
WEBOTS = f"scan_range_m = [0.0, 2.0]\nbearings_deg = {{ {_BEARINGS} }}\ntables = {{ {_TABLES} }}\n"


class Program:
    """An HQ program on a listener of its own; ``number``: of its client there."""

    name: str
    protocol: str
    options = ""
    number = 1
    judge: Any

    @property
    def ready(self) -> bool:
        return bool(self.judge.connected.is_set())

    async def drive(self, forward: float) -> None:
        """Push the stick."""
        raise NotImplementedError

    async def idle(self) -> None:
        """Let go of the stick, if there is one."""

    async def release(self) -> None:
        """Give the robot back, if there is a word for it."""

    def sees(self, robot: str) -> bool:
        """Tell whether it was shown what the robot has."""
        raise NotImplementedError

    async def leave(self) -> None:
        """Leave, if that is not left to the gateway."""


class Tcp(Program):
    """A TCP/UDP program of one version."""

    protocol = "tcpudp"

    def __init__(self, version: str, *, udp: bool) -> None:
        self.name = f"tcp{version}"
        port = free_port()  # each binds one of its own, as if it had a machine of its own
        self.judge = FragileTcpUdpHq(version=version, udp=udp, lidar_sim=version != "1.1", udp_port=port)
        listed = '"1.1", "1.2", "1.3"' if version == "1.3" else f'"{version}"'
        self.options = f"options = {{ versions = [{listed}], client_port = {port} }}"

    @property
    def ready(self) -> bool:
        self.number = self.judge.client_id
        return self.judge.established.is_set()

    async def ask(self) -> None:
        """Ask for map and position, one after the other: without that a program of 1.1 is sent none."""
        self.judge.ask_map()
        await soon(lambda: self.judge.counts[53], "an answer to 52")
        self.judge.ask_position()

    async def drive(self, forward: float) -> None:
        self.judge.idle()  # it may not have said so yet
        self.judge.mode(2)  # joystick
        await asyncio.sleep(LET_GO_S)
        self.judge.move(0.0, 1.0 if forward > 0 else -1.0, abs(forward))

    async def idle(self) -> None:
        self.judge.idle()

    async def release(self) -> None:
        self.judge.mode(1)  # none

    def sees(self, robot: str) -> bool:
        """Position and map where the robot has them; of another robot, that it can be driven."""
        judge = self.judge
        if robot.startswith("tcpudp"):
            return judge.position is not None and bool(judge.map)
        return judge.settings is not None and judge.settings.features >= {FeatureFlag.JOYSTICK}


class Alf(Program):
    """The driving program of ALF in one dialect, or the scanning one, which sends no commands."""

    protocol = "alf"

    def __init__(self, dialect: Dialect, *, scans: bool = False) -> None:
        self.name = "alf-scans" if scans else f"alf-{dialect}"
        self.judge = FragileAlfHq(dialect=dialect, deployed="scanning" if scans else "driving")
        self.options = f'options = {{ dialect = "{dialect}" }}'
        self._scans, self._full = scans, ALF_FULL[dialect]

    async def drive(self, forward: float) -> None:
        self.judge.drive(round(abs(forward) * self._full), int(forward < 0))

    async def idle(self) -> None:
        self.judge.idle()

    def sees(self, robot: str) -> bool:
        """Drive info of a vehicle, or measurements: a robot of 1.1 has none, nor can be fed with one."""
        if self._scans:
            return robot == "tcpudp-1.1" or (self.judge.scanner is not None and self.judge.scans > 0)
        return robot != "alf" or bool(self.judge.infos)

    async def leave(self) -> None:
        """Say END first in one dialect; in the other the gateway does."""
        if self.judge.dialect == "binary":
            await self.judge.end()


class Ec(Program):
    """An external controller that drives the wheels, and sets them to 0 again and again while it idles."""

    protocol = "wc2ec"
    name = "ec"
    options = f"options = {{ join_s = {JOIN_S} }}"
    """On a busy machine its two wheels are further apart than elsewhere."""

    def __init__(self) -> None:
        self.judge = FragileExternalController(split=True)
        self._forward, self._setting = 0.0, asyncio.Lock()

    @property
    def ready(self) -> bool:
        return len(self._wheels) == 2 and self.judge.ready.is_set()

    @property
    def _wheels(self) -> list[str]:
        return [name for name in self.judge.motors if "left" in name or "right" in name]

    async def drive(self, forward: float) -> None:
        """Set both wheels once, it holds: 10 rad/s are full scale of the robots here."""
        self._forward = forward
        async with self._setting:  # an idle that has begun is not mixed with it
            for name in self._wheels:
                await self.judge.set(name, 10.0 * forward)
                await asyncio.sleep(BETWEEN_S)

    async def idle(self) -> None:
        await self.drive(0.0)

    async def keep_idle(self) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                if not self._forward:
                    await self.drive(0.0)
                await asyncio.sleep(IDLE_S)

    def sees(self, robot: str) -> bool:
        """The robot's own devices, else sectors of whatever scan there is."""
        names = {name: number for number, (_, name) in self.judge.devices.items()}
        if robot == "wc2ec":
            sensors = {f"ds{number}" for number in range(8)}
            expected = sensors | {"left wheel motor", "right wheel motor", "lift"}
        else:
            sensors = {name for name in names if name.startswith("sector")}
            expected = sensors | {"left", "right"}
            if len(sensors) < (0 if robot == "tcpudp-1.1" else 6):
                return False
            if robot == "alf":
                sensors -= {"sector4"}  # behind the scanner: shown to who came before the first scan, and never known
        known = [self.judge.values.get(names[sensor], -1.0) >= 0.0 for sensor in sensors if sensor in names]
        return names.keys() == expected and (robot == "tcpudp-1.1" or all(known))


DRIVES = {"tcp1.1": 0.4, "alf-text": -0.4, "tcp1.2": 0.6, "alf-binary": -0.6, "tcp1.3": 0.8, "ec": -0.8}
"""Who drives, and at what fraction of full scale; each at its own, so that the robot can tell them apart."""


@dataclass
class Judgement(mixed.Judgement):
    """What came of one robot."""

    drove: list[str] = field(default_factory=list)
    received: dict[str, int] = field(default_factory=dict)
    """Messages that each program got."""

    def __str__(self) -> str:
        return (
            f"{self.name}: {', '.join(self.drove)} drove, {self.seconds:.0f} s, received {self.received}, "
            f"{len(self.faults)} faults, {len(self.excused)} excused (the judge's process was late)"
        )

    def hear(self, who: str, alive: bool, violations: Iterable[str]) -> None:
        """Take note of violations; of those by the judge's own lateness, or by the machine's, apart."""
        for text in violations:
            charged = charges([text], self.late_s)
            (self.faults if charged else self.excused).append(f"{who}: {text}")
        if not alive:
            self.faults.append(f"{who} died")


class Stage:
    """One robot, its gateway, and all programs connected."""

    def __init__(self, robot: str, bench: Bench, gateway: Gateway, programs: list[Program]) -> None:
        self.robot, self.bench, self.gateway, self.programs = robot, bench, gateway, programs
        self._fed = 0

    def program(self, name: str) -> Program:
        return next(program for program in self.programs if program.name == name)

    @property
    def control(self) -> dict[str, Any]:
        return self.bench.fleet.last("r1/control")

    async def all_see(self) -> None:
        """Wait until each sees what the robot has; feed the robot with lidar data where it asks."""

        def blind() -> list[str]:
            feeder = self.program("tcp1.3").judge
            if feeder.counts[60] > self._fed:
                self._fed = feeder.counts[60]
                feeder.feed(RANGES)
            return [program.name for program in self.programs if not program.sees(self.robot)]

        await soon(lambda: not blind(), "all see the robot")

    async def drive(self, name: str, seconds: float = 0.0) -> None:
        """Let one program drive, once the robot is nobody's, until it has moved as commanded; then idle.

        ``seconds``: of going to and fro, while the others idle beside it.
        """
        await soon(lambda: self.control.get("state") == "free", f"{self.robot} is given back")
        program, forward, ends = self.program(name), DRIVES[name], time.monotonic() + seconds
        while True:
            before = self._place()
            holder = f"hq.{program.name}.{program.number}"
            moves = partial(self._moves, before, forward, holder)
            await pushed(program, forward, moves, f"{holder} moves {self.robot}")
            if time.monotonic() >= ends:
                break
            await asyncio.sleep(0.3)
            forward = -forward
        await program.idle()
        await soon(lambda: self.robot != "alf" or not self._place()[0], f"{name} lets go of {self.robot}")
        await program.release()

    def _moves(self, before: list[float], forward: float, holder: str) -> bool:
        held = (self.control["state"], self.control["holder"]) == ("held", holder)
        return held and self._moved(before, forward)

    def _place(self) -> list[float]:
        """Read what changes when the robot moves: its speed, what it sees around it, or its place along its way."""
        last = self.bench.fleet.last
        if self.robot == "alf":
            return [last("r1/motion").get("speed") or 0.0]
        if self.robot == "wc2ec":
            return [last(f"r1/sensor/ds{number}").get("value", 0.0) for number in range(8)]
        return [last("r1/pose").get("x", 0.0)]

    def _moved(self, before: list[float], forward: float) -> bool:
        """Tell whether it moved in this direction, or with Webots at all."""
        now = self._place()
        if self.robot == "alf":
            return now[0] * forward > 0.0
        changes = [after - then for after, then in zip(now, before, strict=True)]
        return any(abs(change) > 0.03 and (self.robot == "wc2ec" or change * forward > 0.0) for change in changes)


@contextlib.asynccontextmanager
async def stage(robot: str, process: Fragile) -> AsyncIterator[Stage]:
    """Start a gateway with a listener for each program, and connect them all."""
    ec, first = Ec(), Tcp("1.1", udp=False)
    programs: list[Program] = [
        *(first, Tcp("1.2", udp=True), Tcp("1.3", udp=True)),
        *(Alf("text"), Alf("binary"), Alf("text", scans=True), ec),
    ]
    at = dict(zip((program.name for program in programs), ports(len(programs)), strict=True))
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), stack)
        parts = [listener(one.name, one.protocol, at[one.name], one.options) for one in programs]
        options = (WEBOTS if robot == "wc2ec" else "") + process.kind.options
        parts += [device(process.port, process.kind.protocol, options), f"[control]\nlease_s = {LEASE_S}\n"]
        gateway = bench.gateway(*parts)
        await soon(lambda: gateway.listens(len(programs)), "listeners")
        await soon(lambda: bench.fleet.state() == "established", "established")
        async with playing(*(program.judge.run(HOST, at[program.name]) for program in programs)):
            await soon(lambda: all(program.ready for program in programs), "all connected")
            await first.ask()
            async with playing(ec.keep_idle()):
                yield Stage(robot, bench, gateway, programs)
                for program in programs:
                    await program.leave()
            gateway.end()
            await asyncio.sleep(0.1)  # what a gateway says last is heard


async def judge(robot: str, drivers: Iterable[str], *, driver: str = "", seconds: float = 0.0) -> Judgement:
    """Judge one robot: let each of ``drivers`` drive a moment, then ``driver`` for a time.

    Judges it again where the robot's own lateness spoilt its handshake, and where somebody complains though the machine
    was so late that two wheels of one command may have been taken for two.
    """
    judgement = Judgement(robot, faults=["disturbed again and again: this machine is too busy"])
    for _ in range(DISTURBED):
        with fragile_robot(ROBOTS[robot][0], **ROBOTS[robot][1]) as process:
            try:
                judgement = await _judged(robot, [*drivers], driver, seconds, process)
            except AssertionError:
                if process.process.poll() is not None or not disturbed(await asyncio.to_thread(process.ended)):
                    raise
                continue
        if judgement.clean or judgement.late_s < JOIN_S:
            return judgement
    return judgement


async def _judged(robot: str, drivers: list[str], driver: str, seconds: float, process: Fragile) -> Judgement:
    judgement = Judgement(robot, drove=[*drivers])
    began = time.monotonic()
    async with stage(robot, process) as on:
        withheld_s = on.bench.withheld_s
        await on.all_see()
        for name in drivers:
            await on.drive(name)
        if seconds:
            await on.drive(driver, seconds)
            judgement.drove.append(f"{driver} for {seconds:g} s")
        judgement.late_s = on.bench.withheld_s - withheld_s
    report = await asyncio.to_thread(process.ended)
    judgement.seconds = time.monotonic() - began
    judgement.hear("robot", report["alive"], report["violations"])
    for program in on.programs:
        judgement.hear(program.name, program.judge.alive, program.judge.violations)
        judgement.received[program.name] = len(program.judge.received)
    told = [command for row in report["received"] if (command := commanded(robot, row)) is not None]
    forwards = sorted({round(forward, 3) for forward, _ in told})
    judgement.faults += [
        f"the robot was never told to drive at {DRIVES[name]:g}, as {name} wanted; it was at {forwards}"
        for name in drivers
        if DRIVES[name] not in forwards
    ]
    if any(turn for _, turn in told):
        judgement.faults.append("the robot was told to turn, though nobody turns")
    return judgement


def commanded(robot: str, row: list[Any]) -> tuple[float, float] | None:
    """Give the fractions of full scale, forward and turning, that the robot was commanded; None for other commands."""
    if robot == "alf":  # 3: speed in percent, direction, steering, light
        _, kind, fields = row
        return ((-1 if fields[1] else 1) * fields[0] / 100, fields[2]) if kind == 3 else None
    if robot == "wc2ec":  # 130: the velocity of the left wheel; the wheels are set one by one
        _, command, _, number, value = row
        return (float(value) / 10, 0.0) if (command, number) == (130, 8) else None
    _, _, kind, body = row
    if kind == 11:  # x, y, speed
        _, y, speed = struct.unpack("<3f", bytes.fromhex(body))
        return y * speed, 0.0
    return (0.0, struct.unpack("<f", bytes.fromhex(body))[0]) if kind == 12 else None


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--robot", choices=ROBOTS)
    parser.add_argument("--driver", choices=DRIVES, default="tcp1.3", help="who drives all the time")
    wanted = parser.parse_args()
    robots = [wanted.robot] if wanted.robot else ROBOTS
    report(asyncio.run(judge(robot, DRIVES, driver=wanted.driver, seconds=wanted.seconds)) for robot in robots)


if __name__ == "__main__":
    main()
