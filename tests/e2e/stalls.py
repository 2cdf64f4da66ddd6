"""A robot that stalls, or whose link is cut, while it is driven: how long after it goes on is it at rest?

    python -m tests.e2e.stalls                                    # everything, 30 repetitions; about an hour and a half
    python -m tests.e2e.stalls --repetitions 2 --robots tcpudp-1.3,alf --stalls 2.5 --cuts 2 --out stalls.jsonl

Each sitting has a real gateway process, a fragile robot in a process of its own that tells its commanded motion
(:mod:`tests.e2e.moving_robot`), and a driver on the bus in a process of its own. It is driven for a moment; then

stall: the robot's process is stopped (SIGSTOP) and goes on after some seconds (SIGCONT);
cut: what is between the robot's network namespace and the gateway's forwards nothing for some seconds. Both keep
     their addresses, routes and carriers, and nobody is told: the packets are lost as behind a switch without power.

Meanwhile the driver goes neutral, is killed, falls silent, or (cuts only) drives on without ever being neutral. The
time to rest runs from the moment when the robot or its link goes on, or from when the driver's motion had to end if
that is later; a simulation that was held up by its own send goes on when its kernel has tried again ("held up": the
longest time after the link was back). Then the robot must stay at rest for ``REST_S``, and be driven again over the
same connection.
A cut of ``SHOWN_S`` and more must show in ``status.reason``, no longer afterwards, and in the counter ``link_stalls``.

What drives a robot by datagrams says nothing of a cut by itself: where no stop was on its way by TCP the driver may
go on after it, and the robot must be at rest after the driver's neutral.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TextIO

import zenoh

import zbridge
from tests.e2e.conftest import free_port
from tests.e2e.loss import NotHereError, Watch, apart, configuration
from tests.e2e.moving_robot import GOES_ON, ROBOTS
from zbridge.client import Fleet
from zbridge.errors import BusError, LeaseLost, Refused
from zbridge.fleet.messages import Status

LIMIT_S = 1.5
"""Most seconds from going on to rest."""
REST_S = 1.5
"""Seconds that a robot must stay at rest."""
STALLS_S = (0.3, 0.7, 2.0, 2.5, 5.0, 20.0)
CUTS_S = (1.0, 2.0, 4.0, 6.0, 8.0, 10.0)
CAUSES = {"stall": ("neutral", "killed", "silent"), "cut": ("neutral", "killed", "silent", "driving")}
"""What the driver does meanwhile, in rotation; each robot begins with another one."""
DEADMAN_S = 0.5
FIRST, AGAIN = 0.4, 0.8
"""Speed before, and speed of the driving that shows afterwards that the connection survived."""
TOLERANCE = 0.02
PERIOD_S = 0.04
"""From one command of the driver to the next."""
PATIENCE_S = 4.0
"""Longest wait for rest, and for motion afterwards; after a cut for as long as it was besides."""
START_S = 20.0
CPU_S = 0.4
"""Processor time of one repetition: three interpreters start."""
SHOWN_S = 2.0
"""The shortest cut that `status` and the counter must show."""
LINK_STALLS = "zbridge_link_stalls_total"
KERNEL = (6, 15)
"""The first Linux with TCP_RTO_MAX_MS."""
LANES = 10
"""Sittings at a time: they mostly wait."""
SITTING = 6
"""Repetitions in a sitting."""


@dataclass(frozen=True)
class Case:
    """One cell of the plan. way: "stall" or "cut"."""

    robot: str
    way: str
    seconds: float

    @property
    def duration_s(self) -> float:
        """Expect a repetition to last so long, where the robot comes to rest."""
        start_s = 3.0 + 2.5 * ROBOTS[self.robot].udp
        return start_s / SITTING + self.seconds + 1.0 + REST_S


@dataclass
class Outcome:
    """One repetition. rest_s: None where the robot drove on; faults: what else was wrong."""

    case: Case
    number: int
    cause: str
    rest_s: float | None = None
    faults: list[str] = field(default_factory=list)
    measured: bool = False
    reasons: list[str] = field(default_factory=list)
    """What `status` said during a cut and did not say before."""
    link_stalls: int = 0
    held_up_s: float = 0.0
    """How long the robot's program waited for its own send after the link was back; the time to rest begins then."""
    machine_late_s: float = 0.0
    """How late this machine was between going on and rest."""
    judge: dict[str, Any] = field(default_factory=dict)
    motion: list[tuple[float, float]] = field(default_factory=list)
    """Seconds from going on, speed obeyed from then on."""
    log: list[str] = field(default_factory=list)

    @property
    def drove_on(self) -> bool:
        """Whether the robot was never at rest."""
        return self.measured and self.rest_s is None

    @property
    def late(self) -> bool:
        """Whether the robot was at rest, but too late."""
        return self.rest_s is not None and self.rest_s > LIMIT_S

    @property
    def good(self) -> bool:
        """Whether everything was as it should be."""
        return self.rest_s is not None and not self.late and not self.faults


# Processes

_ENDS_WITH_US = ("setpriv", "--pdeathsig", "KILL") if shutil.which("setpriv") else ()
_HERE = str(Path(__file__).parents[2])


async def _started(stack: contextlib.AsyncExitStack, *command: str, output: Any = subprocess.PIPE) -> _Process:
    """Start a process that is killed with the context, in a session of its own: Ctrl-C is for us alone."""
    process = await asyncio.create_subprocess_exec(
        *_ENDS_WITH_US,
        *command,
        stdin=subprocess.PIPE,
        stdout=output,
        stderr=output if output is not subprocess.PIPE else None,
        start_new_session=True,
        cwd=_HERE,
    )
    stack.push_async_callback(_killed, process)
    return process


async def _killed(process: _Process) -> None:
    if process.returncode is None:
        process.kill()
    await asyncio.wait_for(process.wait(), 5)


async def _line(process: _Process, timeout_s: float = START_S) -> str:
    assert process.stdout is not None
    line = await asyncio.wait_for(process.stdout.readline(), timeout_s)
    if not line:
        raise RuntimeError(f"a part of the scene ended with {await process.wait()}")
    return line.decode().strip()


def _tell(process: _Process, word: str) -> None:
    assert process.stdin is not None
    process.stdin.write(f"{word}\n".encode())


_Process = asyncio.subprocess.Process


# The road between gateway and robot

_GATE = "echo open; while read on; do echo $on > /proc/sys/net/ipv4/ip_forward; echo done; done"
_numbers = itertools.count()


class Road:
    """Two network namespaces: one forwards packets or not, in the other one lives the robot.

    To be used in a namespace of the measurement's own. What holds them are two processes: they go with them.
    """

    def __init__(self, gate: _Process, keeper: _Process, number: int) -> None:
        self._gate, self._number = gate, number
        self._far = ("nsenter", "--target", str(keeper.pid), "--net")
        self._net = f"10.{64 + number // 250 % 60}.{number % 250}"
        self.host = f"{self._net}.6"
        self.enter = self._far

    @classmethod
    async def lay(cls, stack: contextlib.AsyncExitStack) -> Road:
        """Make the namespaces and connect them."""
        gate = await _started(stack, "unshare", "--net", "sh", "-c", _GATE)
        keeper = await _started(stack, "unshare", "--net", "sh", "-c", "echo open; exec cat")
        for process in (gate, keeper):
            await _line(process)
        road = cls(gate, keeper, next(_numbers))
        await asyncio.to_thread(road._connect, gate.pid, keeper.pid)
        stack.callback(_ip, "", f"link delete near{road._number}")
        await road.mend()
        return road

    def _connect(self, gate: int, keeper: int) -> None:
        near = f"near{self._number}"
        net = self._net
        _ip(
            "",
            f"link add {near} type veth peer name left netns {gate}",
            f"address add {net}.1/30 dev {near}",
            f"link set {near} up",
        )
        _ip(
            f"nsenter --target {gate} --net",
            f"link add right type veth peer name robot netns {keeper}",
            f"address add {net}.2/30 dev left",
            f"address add {net}.5/30 dev right",
            "link set left up",
            "link set right up",
        )
        _ip(
            f"nsenter --target {keeper} --net",
            "link set lo up",
            f"address add {net}.6/30 dev robot",
            "link set robot up",
            f"route add default via {net}.5",
        )
        _ip("", f"route add {net}.4/30 via {net}.2")

    async def cut(self) -> None:
        """Lose every packet, in both directions, from now on."""
        await self._forward(0)

    async def mend(self) -> None:
        """Lose no packet any more."""
        await self._forward(1)

    async def _forward(self, on: int) -> None:
        _tell(self._gate, str(on))
        if await _line(self._gate) != "done":
            raise RuntimeError("the kernel did not take ip_forward")


def _ip(prefix: str, *lines: str) -> None:
    done = subprocess.run(
        [*prefix.split(), "ip", "-batch", "-"],
        input="\n".join(lines) + "\n",
        capture_output=True,
        text=True,
        timeout=10,
    )
    if done.returncode:
        raise OSError(f"ip: {done.stderr.strip()}")


# The robot


class MovingRobot:
    """The fragile robot's process, and what it told of its motion."""

    def __init__(self, process: _Process) -> None:
        self.process = process
        self.changes: list[tuple[float, float]] = [(0.0, 0.0)]
        """When it told a speed, and which."""
        self.report: dict[str, Any] = {}
        self.went_on = 0.0
        """When its program last went on after its own send held it up."""
        self._moved = asyncio.Event()

    @property
    def speed(self) -> float:
        """The speed of the last command that it obeyed."""
        return self.changes[-1][1]

    async def listen(self) -> None:
        """Take what it tells until it ends."""
        assert self.process.stdout is not None
        async for line in self.process.stdout:
            if line.startswith(b"{"):
                self.report = json.loads(line)
                continue
            at, what = line.split()
            if what == GOES_ON.encode():
                self.went_on = float(at)
                continue
            self.changes.append((float(at), float(what)))
            self._moved.set()

    async def moving(self, speed: float, timeout_s: float) -> bool:
        """Wait until it moves at a speed; tell whether it does."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while not _same(self.speed, speed):
                    self._moved.clear()
                    await self._moved.wait()
                return True
        return False

    async def rest(self, since: float, patience_s: float) -> float | None:
        """Wait until it has been at rest for REST_S; give when it came to rest, None if it did not in time."""
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline + REST_S:
            came = max(since, self.changes[-1][0])
            if self.speed and time.monotonic() > deadline:
                return None
            if not self.speed and time.monotonic() - came >= REST_S:
                return came
            await asyncio.sleep(0.02)
        return None


def _same(one: float, other: float) -> bool:
    return abs(one - other) <= TOLERANCE


# The driver


async def be_driver(endpoint: str, robot: str, speed: str) -> None:
    """Hold the lease and drive, until stdin ends. Words on stdin: neutral, silent, again SPEED."""
    words = asyncio.StreamReader()
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(words), sys.stdin)
    driven: float | None = float(speed)
    async with contextlib.AsyncExitStack() as stack:
        fleet = await stack.enter_async_context(zbridge.connect([endpoint]))
        drive = await stack.enter_async_context(fleet[robot].control("driver", deadman_s=DEADMAN_S, wait_s=START_S))
        while True:
            word: bytes | None = None
            try:
                if driven is not None:
                    await drive(forward=driven)
                async with asyncio.timeout(PERIOD_S):
                    word = await words.readline()
                if not word:
                    return
                what, *value = word.decode().split()
                driven = float(value[0]) if value else None
                if what != "silent":
                    await drive()
            except LeaseLost:
                return
            except (TimeoutError, Refused):
                await asyncio.sleep(0 if word is None else PERIOD_S)


# One repetition


class Scene:
    """What all repetitions share: the bus, a program on it, and a watch of this machine."""

    def __init__(self, fleet: Fleet, endpoint: str, watch: Watch, folder: Path, seed: int) -> None:
        self.fleet, self.endpoint, self.watch, self.folder, self.seed = fleet, endpoint, watch, folder, seed


@contextlib.asynccontextmanager
async def scenery(seed: int) -> AsyncIterator[Scene]:
    """Open a router here, and what else all repetitions share."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        watch = Watch(stack)
        stack.enter_context(zenoh.open(configuration("router", [endpoint])))
        async with zbridge.connect([endpoint]) as fleet:
            yield Scene(fleet, endpoint, watch, folder, seed)


class Sitting:
    """One robot, its gateway and its driver, from their start to their end, and some repetitions with them."""

    def __init__(self, scene: Scene, case: Case, numbers: deque[int]) -> None:
        self._scene, self._case, self._kind = scene, case, ROBOTS[case.robot]
        self._numbers = numbers
        self._name = f"{case.robot}-{case.way}-{case.seconds:g}-{numbers[0]}"
        self._rng = random.Random(f"{self._name} {scene.seed}")
        self._statuses: list[tuple[float, Status]] = []
        self._patience_s = PATIENCE_S + case.seconds * (case.way == "cut")

    async def run(self, took: Callable[[Outcome], object]) -> None:
        """Take numbers and measure; what does not come about is a fault, after which nothing more is done here."""
        async with contextlib.AsyncExitStack() as stack:
            try:
                await self._begin()
                await self._set_up(stack)
                await self._drive(stack, FIRST)
                await self._measure(stack)
                while self._numbers and self.outcome.good:
                    took(self.outcome)
                    await self._begin()
                    _tell(self._driver, f"again {FIRST}")
                    await self._measure(stack)
                await self._report()
            except (RuntimeError, OSError, TimeoutError, BusError) as error:
                self.outcome.faults.append(f"{type(error).__name__}: {error}")
            if not self.outcome.good and (log := self._log_file).exists():
                self.outcome.log = log.read_text(errors="replace").splitlines()[-12:]
        self._log_file.unlink(missing_ok=True)
        took(self.outcome)

    async def _begin(self) -> None:
        number, causes = self._numbers.popleft(), CAUSES[self._case.way]
        cause = causes[(number + list(ROBOTS).index(self._case.robot)) % len(causes)]
        self.outcome = Outcome(self._case, number, cause)

    # The scene

    async def _set_up(self, stack: contextlib.AsyncExitStack) -> None:
        self._road = await Road.lay(stack) if self._case.way == "cut" else None
        host, enter = (self._road.host, self._road.enter) if self._road else ("127.0.0.1", ())
        seed = str(self._rng.randrange(1 << 30))
        robot = [*enter, sys.executable, "-m", "tests.e2e.moving_robot", self._case.robot, host, seed]
        process = await _started(stack, *robot)
        port = int(await _line(process))
        self._robot = MovingRobot(process)
        self._attend(stack, self._robot.listen())
        self._attend(stack, self._watch_status())
        with self._log_file.open("w") as log:
            configured = self._configured(host, port)
            self._gateway = await _started(
                stack, sys.executable, "-m", "zbridge", "run", str(configured), output=log.fileno()
            )
        await self._until(lambda: self._status_is("established"), START_S, "established")

    def _attend(self, stack: contextlib.AsyncExitStack, work: Any) -> None:
        task = asyncio.create_task(work)

        async def end() -> None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

        stack.push_async_callback(end)

    @property
    def _log_file(self) -> Path:
        return self._scene.folder / f"{self._name}.log"

    def _configured(self, host: str, port: int) -> Path:
        self._metrics = free_port()
        options = f"[device.options]\n{self._kind.options}" if self._kind.options else ""
        file = self._scene.folder / f"{self._name}.toml"
        file.write_text(
            f'[robot]\nname = "{self._name}"\n'
            f'[device]\nprotocol = "{self._kind.protocol}"\nconnect = ["tcp://{host}:{port}"]\n{options}'
            f'[bus]\nconnect = ["{self._scene.endpoint}"]\nmulticast = false\n'
            f'[metrics]\nlisten = "127.0.0.1:{self._metrics}"\n'
        )
        return file

    async def _watch_status(self) -> None:
        async for status in self._scene.fleet[self._name].status:
            self._statuses.append((time.monotonic(), status))

    def _status_is(self, state: str) -> bool:
        return bool(self._statuses) and self._statuses[-1][1].state == state

    @property
    def _reason(self) -> str | None:
        return self._statuses[-1][1].reason

    async def _until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                raise RuntimeError(f"not {what} within {timeout_s:g} s; status {self._statuses[-1:]}")
            if self._gateway.returncode is not None:
                raise RuntimeError(f"the gateway ended with {self._gateway.returncode}")
            await asyncio.sleep(0.02)

    async def _counters(self) -> list[str]:
        """Read the gateway's counters, a line each."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self._metrics)
        with contextlib.closing(writer):
            writer.write(b"GET /metrics HTTP/1.0\r\n\r\n")
            page = await asyncio.wait_for(reader.read(), 5)
        return [line for line in page.decode().splitlines() if not line.startswith("#")]

    async def _link_stalls(self) -> int:
        """Give the gateway's count of links that took nothing."""
        return sum(int(line.split()[-1]) for line in await self._counters() if line.startswith(LINK_STALLS))

    # What is measured

    async def _drive(self, stack: contextlib.AsyncExitStack, speed: float) -> None:
        part = [sys.executable, "-m", "tests.e2e.stalls", "--be-driver", self._scene.endpoint, self._name, str(speed)]
        self._driver = await _started(stack, *part)

    async def _measure(self, stack: contextlib.AsyncExitStack) -> None:
        outcome, robot = self.outcome, self._robot
        if not await robot.moving(FIRST, START_S):
            counted = [line for line in await self._counters() if not line.endswith(" 0")]
            await self._report()
            raise RuntimeError(f"the robot was never driven; status {self._statuses[-1:]}; counters {counted}")
        await asyncio.sleep(self._rng.uniform(0.3, 0.8))
        before, stalls = self._reason, await self._link_stalls()
        went, ended, on = await self._disturb()
        gated = not self._kind.udp or await self._link_stalls() > stalls
        if outcome.cause == "driving" and not gated:  # its datagrams were lost, and what it says now is fresh
            await asyncio.sleep(REST_S)
            _tell(self._driver, "neutral")
            ended = time.monotonic()
        since = max(on, ended)
        rested = await robot.rest(since, self._patience_s)
        since = max(since, robot.went_on)
        outcome.held_up_s = max(0.0, robot.went_on - on)
        outcome.measured = True
        outcome.rest_s = None if rested is None else max(0.0, rested - since)
        outcome.motion = [(at - on, speed) for at, speed in robot.changes if at > went]
        outcome.machine_late_s = self._scene.watch.late_between(since, rested or time.monotonic())
        outcome.link_stalls = await self._link_stalls() - stalls
        if self._case.way == "cut":
            self._judge_status(before, went, on, ended)
        elif outcome.link_stalls:
            outcome.faults.append("link_stalls counted a robot whose kernel took everything")
        if rested is not None:
            await self._drive_again(stack)
        if self._case.way == "cut" and outcome.reasons and self._reason in outcome.reasons:
            outcome.faults.append(f"status still shows the cut: {self._reason}")

    async def _disturb(self) -> tuple[float, float, float]:
        """Stall the robot or cut its link; tell when, when the driver's motion had to end, and when it went on."""
        seconds, cut = self._case.seconds, self._road is not None
        went = time.monotonic()
        await self._halt()
        share = self._rng.uniform(0.1, 0.6 if cut else 0.9)
        await _sleep_until(went + share * seconds)
        ended = self._let_go()
        await _sleep_until(went + seconds)
        on = time.monotonic()
        await self._go_on()
        return went, ended, on

    async def _halt(self) -> None:
        if self._road is not None:
            await self._road.cut()
        else:
            os.kill(self._robot.process.pid, signal.SIGSTOP)

    async def _go_on(self) -> None:
        if self._road is not None:
            await self._road.mend()
        else:
            os.kill(self._robot.process.pid, signal.SIGCONT)

    def _let_go(self) -> float:
        """Let the driver do what it does meanwhile; tell by when its motion must have ended."""
        cause = self.outcome.cause
        if cause == "killed":
            self._driver.kill()
        elif cause != "driving":
            _tell(self._driver, cause)
        return time.monotonic() + DEADMAN_S * (cause == "silent")

    def _judge_status(self, before: str | None, went: float, on: float, ended: float) -> None:
        """Note what `status` said during the cut; a longer one must be shown, there and by the counter.

        Datagrams are not acknowledged: a robot driven by them needs a stop by TCP that is not.
        """
        outcome = self.outcome
        said = {status.reason for at, status in self._statuses if went < at < on}
        outcome.reasons = sorted(reason for reason in said if reason and reason != before)
        if self._case.seconds < SHOWN_S or (self._kind.udp and (outcome.cause == "driving" or on - ended < 1.0)):
            return
        if not outcome.reasons:
            outcome.faults.append("status did not show the cut")
        if not outcome.link_stalls:
            outcome.faults.append("link_stalls did not count the cut")

    async def _drive_again(self, stack: contextlib.AsyncExitStack) -> None:
        """Drive again, after a neutral: the connection must have survived, and no motion of before may come."""
        again = len(self._robot.changes)
        if self.outcome.cause == "killed" or self._driver.returncode is not None:
            await self._drive(stack, AGAIN)
        else:
            _tell(self._driver, f"again {AGAIN}")
        if not await self._robot.moving(AGAIN, self._patience_s + DEADMAN_S):
            self.outcome.faults.append(f"not driven again: {self._statuses[-1][1]}")
        old = [speed for _, speed in self._robot.changes[again:] if speed and not _same(speed, AGAIN)]
        if old:
            self.outcome.faults.append(f"obeyed an old drive: {old[:5]}")

    async def _report(self) -> None:
        """End the robot, and take what its judge noted: it must have had one connection all the time."""
        self._robot.process.send_signal(signal.SIGCONT)
        _tell(self._robot.process, "end")
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._robot.process.wait(), 5)
        await asyncio.sleep(0)
        report = self._robot.report
        self.outcome.judge = {key: value[-5:] if isinstance(value, list) else value for key, value in report.items()}
        if not report.get("alive", True):
            self.outcome.faults.append(f"the robot died: {report['violations'][-1:]}")
        lost = [event for event in report.get("events", ()) if "connection" in event or "controller left" in event]
        if lost:
            self.outcome.faults.append(f"the connection was lost: {lost[0]}")


async def _sleep_until(at: float) -> None:
    await asyncio.sleep(max(0.0, at - time.monotonic()))


# The plan


async def measure(
    cases: Sequence[Case],
    *,
    repetitions: int,
    lanes: int = LANES,
    seed: int = 1,
    took: Callable[[Outcome], None] = lambda _: None,
) -> list[Outcome]:
    """Do every case so often, so many at a time, and call ``took`` with each outcome; the longest go first."""
    plan = [
        (case, deque(range(first, min(first + SITTING, repetitions))))
        for case in sorted(cases, key=lambda case: case.duration_s, reverse=True)
        for first in range(0, repetitions, SITTING)
    ]
    waiting = iter(plan)
    outcomes: list[Outcome] = []

    def take(outcome: Outcome) -> None:
        outcomes.append(outcome)
        took(outcome)

    async with scenery(seed) as scene:

        async def lane() -> None:
            for case, numbers in waiting:
                while numbers:
                    await Sitting(scene, case, numbers).run(take)

        async with asyncio.TaskGroup() as tasks:
            for _ in range(min(lanes, len(plan))):
                tasks.create_task(lane())
    return outcomes


def estimate_s(cases: Iterable[Case], repetitions: int, lanes: int) -> float:
    """Expect the whole plan to last so long: the waiting, or the work of this machine's processors."""
    each = [case.duration_s for case in cases]
    work_s = CPU_S * len(each) * repetitions / (os.cpu_count() or 1)
    return max(sum(each) * repetitions / lanes, work_s, max(each, default=0.0))


def table(outcomes: Iterable[Outcome]) -> Iterator[str]:
    """Write the results as the rows of a Markdown table."""
    yield "| robot | version | what | s | times | median s | worst s | held up s | drove on | late | other faults |"
    yield "|---|---|---|---:|---:|---:|---:|---:|---:|---:|---|"
    cells: dict[Case, list[Outcome]] = {}
    for outcome in outcomes:
        cells.setdefault(outcome.case, []).append(outcome)
    names = list(ROBOTS)
    for case in sorted(cells, key=lambda case: (case.way != "stall", names.index(case.robot), case.seconds)):
        yield _row(case, cells[case])


def _row(case: Case, outcomes: list[Outcome]) -> str:
    kind = ROBOTS[case.robot]
    times = [outcome.rest_s for outcome in outcomes if outcome.rest_s is not None]
    drove_on, late = sum(outcome.drove_on for outcome in outcomes), sum(outcome.late for outcome in outcomes)
    median, worst = (f"{of(times):.2f}" if times else "-" for of in (statistics.median, max))
    held_up = max(outcome.held_up_s for outcome in outcomes)
    faults = [fault for outcome in outcomes for fault in outcome.faults]
    kinds = [
        f"{sum(one.startswith(kind) for one in faults)} x {kind}" for kind in sorted({f.split(":")[0] for f in faults})
    ]
    told = "; ".join(kinds).replace("|", "/") or "-"
    count = f"{case.seconds:g} | {len(outcomes)}"
    return (
        f"| {kind.protocol} | {kind.version} | {case.way} | {count} | {median} | {'never' if drove_on else worst} "
        f"| {held_up:.2f} | {drove_on} | {late} | {told} |"
    )


def beyond_kernel(case: Case) -> bool:
    """Tell whether a cut is longer than a kernel without TCP_RTO_MAX_MS allows."""
    release = tuple(int(part) for part in os.uname().release.split("-")[0].split(".")[:2])
    return case.way == "cut" and release < KERNEL and case.seconds > 4.0


def _parsed() -> argparse.Namespace:
    def seconds(text: str) -> tuple[float, ...]:
        return tuple(float(part) for part in text.split(",") if part)

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=30)
    parser.add_argument("--robots", default=",".join(ROBOTS), help="some of %(default)s")
    parser.add_argument("--stalls", type=seconds, default=STALLS_S, help='seconds, as in 0.3,2.5; "" for none')
    parser.add_argument("--cuts", type=seconds, default=CUTS_S, help='seconds; "" for none')
    parser.add_argument("--lanes", type=int, default=LANES, help="repetitions at a time")
    parser.add_argument("--out", type=Path, help="where one JSON line a repetition goes")
    parser.add_argument("--seed", type=int, default=os.getpid(), help="of the moments")
    parser.add_argument("--apart", action="store_true", help=argparse.SUPPRESS)
    wanted = parser.parse_args()
    wanted.robots = wanted.robots.split(",")
    if unknown := [name for name in wanted.robots if name not in ROBOTS]:
        parser.error(f"no robot {', '.join(unknown)}: expected some of {', '.join(ROBOTS)}")
    return wanted


def _cases(wanted: argparse.Namespace) -> list[Case]:
    ways = [("stall", seconds) for seconds in wanted.stalls] + [("cut", seconds) for seconds in wanted.cuts]
    cases = [Case(robot, way, seconds) for way, seconds in ways for robot in wanted.robots]
    allowed = [case for case in cases if not beyond_kernel(case)]
    if len(allowed) < len(cases):
        print("This kernel has no TCP_RTO_MAX_MS: cuts of up to 4 s only.")
    return allowed


def _go_apart(wanted: argparse.Namespace) -> None:
    """Become the same program in a network namespace of its own, if cuts are wanted; without one leave them out."""
    if wanted.apart:
        _ip("", "link set lo up")
    elif wanted.cuts:
        try:
            prefix = apart()
        except NotHereError as error:
            print(f"No cuts: {error}")
            wanted.cuts = ()
        else:
            again = [sys.executable, "-m", "tests.e2e.stalls", *sys.argv[1:], "--apart", "--seed", str(wanted.seed)]
            os.execvp(prefix[0], [*prefix, *again])


def _measure(cases: list[Case], wanted: argparse.Namespace, out: TextIO | None) -> list[Outcome]:
    """Measure until done or interrupted."""
    outcomes: list[Outcome] = []
    count, began = len(cases) * wanted.repetitions, time.monotonic()

    def took(outcome: Outcome) -> None:
        outcomes.append(outcome)
        if out is not None:
            print(json.dumps({**asdict(outcome), "good": outcome.good}), file=out, flush=True)
        if len(outcomes) % max(1, count // 20) == 0:
            bad = sum(not outcome.good for outcome in outcomes)
            passed = time.monotonic() - began
            print(f"{len(outcomes)} of {count} after {passed:.0f} s, {bad} bad", file=sys.stderr, flush=True)

    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background of a shell's script
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(measure(cases, repetitions=wanted.repetitions, lanes=wanted.lanes, seed=wanted.seed, took=took))
    return outcomes


def main() -> None:
    if sys.argv[1:2] == ["--be-driver"]:
        asyncio.run(be_driver(*sys.argv[2:]))
        return
    wanted = _parsed()
    _go_apart(wanted)
    os.nice(5)
    cases = _cases(wanted)
    minutes = estimate_s(cases, wanted.repetitions, wanted.lanes) / 60
    print(f"{len(cases)} cases, {wanted.repetitions} times each, {wanted.lanes} at a time: some {minutes:.0f} minutes")
    print(f"Linux {os.uname().release}, {os.cpu_count()} processors; seed {wanted.seed}", flush=True)
    with contextlib.ExitStack() as stack:
        out = stack.enter_context(wanted.out.open("a")) if wanted.out else None
        outcomes = _measure(cases, wanted, out)
    print("\n".join(table(outcomes)))
    good = sum(outcome.good for outcome in outcomes)
    print(f"\n{good} of {len(outcomes)} as they should be; {len(cases) * wanted.repetitions - len(outcomes)} not done.")
    sys.exit(not outcomes or good < len(outcomes))


if __name__ == "__main__":
    main()
