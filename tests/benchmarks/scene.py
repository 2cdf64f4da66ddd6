"""A robot that is driven, what it is driven through, and who drives it: the processes of one run, and what is asked.

All processes read the same monotonic clock. A command is matched by its running number, and its first arrival counts:
a gateway repeats the drive that stands.
"""

from __future__ import annotations

import contextlib
import json
import math
import signal
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import chain
from pathlib import Path
from statistics import mean, median
from typing import Any

from tests.benchmarks.drives import ADVERSE
from tests.benchmarks.harness import WAIT_S, Process, cpu_s, process, thread_cpu_s
from tests.benchmarks.peer import ROBOT
from tests.ports import free_port
from tests.scraped import scrape, totals

GREETING_S = 1.2
"""The gateway greets a robot with a stop, for a second."""
WARM = 10
"""Commands at the beginning of a drive that do not count."""
ENDLESS_S = 60
_ARRIVE_S = 0.2
_POLL_S = 0.25
_DRAIN_S = 30.0
_PACKAGE = "tests.benchmarks"


class Through(Enum):
    """What commands go through between client and robot."""

    GATEWAY = "gateway"
    SCRIPT = "script"


@dataclass(frozen=True)
class Drive:
    """What came of driving: the microseconds of every command that arrived, in order, and what it took."""

    sent: int
    latencies_us: tuple[float, ...]
    sent_ns: dict[int, int]
    """When each was sent, by its number."""
    seqs: tuple[int, int]
    applied: int
    """Commands that arrived and were nobody's to give."""
    cpu_us: float
    """CPU time of the process under test for each command."""

    @classmethod
    def joined(cls, drives: Sequence[Drive]) -> Drive:
        """Put drives of the same kind together."""
        return cls(
            sent=sum(drive.sent for drive in drives),
            latencies_us=tuple(chain.from_iterable(drive.latencies_us for drive in drives)),
            sent_ns=dict(chain.from_iterable(drive.sent_ns.items() for drive in drives)),
            seqs=(drives[0].seqs[0], drives[-1].seqs[1]),
            applied=sum(drive.applied for drive in drives),
            cpu_us=mean(drive.cpu_us for drive in drives),
        )

    @property
    def median_us(self) -> float:
        return median(self.latencies_us)

    @property
    def p99_us(self) -> float:
        return p99(self.latencies_us)

    @property
    def arrived(self) -> float:
        """The part of the commands that arrived; the others were replaced by newer ones, or lost."""
        return len(self.latencies_us) / self.sent


@dataclass(frozen=True)
class Flood:
    """What came of adversaries: the driver's time before and meanwhile, and what the gateway counted."""

    count: int
    seconds: float
    rate_hz: float
    calm: Drive
    meanwhile: Drive
    counted: dict[str, int]

    @property
    def uncounted(self) -> int:
        """Adversaries' commands that the gateway neither refused nor counted as dropped (negative: too many)."""
        return self.count - sum(self.counted.values())


def p99(values: tuple[float, ...]) -> float:
    """Give the value that 99 of 100 do not exceed."""
    return sorted(values)[max(0, math.ceil(0.99 * len(values)) - 1)]


class Scene:
    """The processes of one run; numbers, and so values, are never used twice."""

    def __init__(
        self, stack: contextlib.ExitStack, through: Through, options: str, watch: str, *, router: bool = False
    ) -> None:
        self._stack = stack
        self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        self._endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._router = self._start(f"{_PACKAGE}.router", self._endpoint) if router else None
        if self._router is not None:
            self._router.hear()
        self._metrics_port = free_port()
        self._number = 1
        self.load_hz = 0.0
        self._robot = self._start(f"{_PACKAGE}.steered")
        robot_port = self._robot.hear()["port"]
        self._consumer: Process | None = None
        if through is Through.SCRIPT:
            self.tested = self._start(f"{_PACKAGE}.steering", robot_port, self._endpoint)
        else:
            self.tested = self._start_gateway(robot_port, options, watch)
            self._consumer = self._start(f"{_PACKAGE}.consumer", "all", self._endpoint, 0, 1)
        self._driver = self._start(f"{_PACKAGE}.driver", self._endpoint, int(through is Through.GATEWAY))
        self._driver.hear()
        self._robot.hear()
        time.sleep(GREETING_S if through is Through.GATEWAY else 0)
        self._ask(self._driver, "wait")
        if self._consumer is not None:
            for _ in ("ready", "first"):
                self._consumer.hear()

    # Driving

    def drive(self, rate_hz: float, count: int) -> Drive:
        """Drive at a steady pace."""
        self._robot.say("report")  # what came before is nobody's
        self._robot.hear()
        cpu = cpu_s(self.tested.pid)
        first = self._begin(rate_hz, count + WARM)
        driven = self._driver.hear(WAIT_S + (count + WARM) / rate_hz)
        time.sleep(_ARRIVE_S)
        return self._matched(first, driven, cpu_s(self.tested.pid) - cpu)

    @contextlib.contextmanager
    def load(self) -> Iterator[None]:
        """Let the robot send what a busy robot sends; ``load_hz`` tells the rate at which it came to the consumer."""
        assert self._consumer is not None
        self._robot.say("load")
        time.sleep(_ARRIVE_S)
        self._ask(self._consumer, "reset")
        begun = time.monotonic()
        yield
        count = self._ask(self._consumer, f"await 1 1 {WAIT_S}")["count"]
        self.load_hz = count / (time.monotonic() - begun)
        self._robot.say("calm")
        time.sleep(_ARRIVE_S)

    def renew(self, count: int) -> tuple[float, ...]:
        """Renew the lease again and again; microseconds to each answer."""
        return tuple(self._ask(self._driver, f"renew {count}")["took_us"][WARM:])

    def flood(self, count: int, flood_hz: float, drive_hz: float, calm_s: float) -> Flood:
        """Drive in peace, then continue while another process sends what nobody may."""
        adversary = self._start(f"{_PACKAGE}.adversary", self._endpoint)
        adversary.hear()
        lease = self._ask(self._driver, "lease")
        calm = self.drive(drive_hz, int(calm_s * drive_hz))
        seqs = " ".join(map(str, calm.seqs))
        self._ask(adversary, f"arm {lease['lease']} {lease['ended']} {seqs} {count}")
        before, cpu = self._counters(), cpu_s(self.tested.pid)
        first = self._begin(drive_hz, int(ENDLESS_S * drive_hz))
        time.sleep((WARM + 1) / drive_hz)
        adversary.say(f"go {flood_hz}")
        sent = adversary.hear(WAIT_S + ENDLESS_S)
        counted, ended_ns = self._drained(before, count)
        driven = self._ask(self._driver, "halt")
        meanwhile = self._matched(first, driven, cpu_s(self.tested.pid) - cpu, sent["begun_ns"], ended_ns)
        seconds = (sent["ended_ns"] - sent["begun_ns"]) / 1e9
        return Flood(count, seconds, count / seconds, calm, meanwhile, counted)

    # Floods

    @property
    def endpoint(self) -> str:
        """Where everybody finds the bus."""
        return self._endpoint

    def start(self, module: str, *arguments: object) -> Process:
        """Start one more process of this package."""
        return self._start(f"{_PACKAGE}.{module}", *arguments)

    def lease(self) -> str:
        """Let the driver have the lease; give its public id, in hex."""
        written: str = self._ask(self._driver, "lease")["lease"]
        return written.partition(":")[0]

    def begin(self, rate_hz: float, count: int) -> int:
        """Let the driver begin, to drive until :meth:`halt`; give its first number."""
        self._ask(self._robot, "report")  # what came before is nobody's
        return self._begin(rate_hz, count)

    def halt(self, first: int, from_ns: int, until_ns: int) -> tuple[Drive, list[int], list[int]]:
        """Let the driver end: what came of the drives of a time, and when the robot was sent motion, and stops."""
        driven = self._ask(self._driver, "halt")
        time.sleep(_ARRIVE_S)
        told = self._ask(self._robot, "report")
        moved_ns = [at_ns for at_ns, number in told["moves"] if number]
        return _match(first, driven, told["moves"], 0.0, from_ns, until_ns), moved_ns, told["stops"]

    # Profiling

    def mark(self) -> dict[int, tuple[str, float]]:
        """Let whoever watches begin anew; give the CPU time of every thread up to now."""
        self.tested.signal(signal.SIGUSR1)
        return thread_cpu_s(self.tested.pid)

    def watched(self) -> Any:
        """End the process under test and read what was seen."""
        self.tested.end()
        return json.loads((self._folder / "watched.json").read_text())

    # Private

    def _start(self, module: str, *arguments: object) -> Process:
        return self._stack.enter_context(process(module, *arguments))

    def _start_gateway(self, robot_port: int, options: str, watch: str) -> Process:
        file = self._folder / "gateway.toml"
        where = "listen" if self._router is None else "connect"
        file.write_text(_configuration(robot_port, f'{where} = ["{self._endpoint}"]', self._metrics_port, options))
        if watch:
            return self._start(f"{_PACKAGE}.{watch}", self._folder / "watched.json", "run", file)
        return self._start("zbridge", "run", file)

    def _ask(self, asked: Process, words: str) -> dict[str, Any]:
        asked.say(words)
        return asked.hear()

    def _begin(self, rate_hz: float, count: int) -> int:
        """Let the driver begin; give its first number."""
        first, self._number = self._number, self._number + count
        if self._number > ADVERSE:
            raise ValueError(f"{self._number} commands, a run has {ADVERSE} numbers")
        self._driver.say(f"drive {first} {count} {rate_hz}")
        return first

    def _matched(
        self, first: int, driven: dict[str, Any], cpu_s: float, from_ns: int = 0, until_ns: int | None = None
    ) -> Drive:
        """Find what became of the commands, of those that were sent from one moment to another."""
        return _match(first, driven, self._ask(self._robot, "report")["moves"], cpu_s, from_ns, until_ns)

    def _drained(self, before: dict[str, int], count: int) -> tuple[dict[str, int], int]:
        """Wait until as many were counted as were sent, or none any more; give the counts and the time of the last."""
        counted, changed_ns, end = dict[str, int](), time.perf_counter_ns(), time.monotonic() + _DRAIN_S
        while time.monotonic() < end:
            now = {name: value - before[name] for name, value in self._counters().items()}
            if now != counted:
                counted, changed_ns = now, time.perf_counter_ns()
            elif sum(counted.values()) >= count or time.perf_counter_ns() - changed_ns > 1e9:
                break
            time.sleep(_POLL_S)
        return counted, changed_ns

    def _counters(self) -> dict[str, int]:
        """Read what the gateway has refused, and dropped before it was looked at."""
        values = self.counters()
        return {name: values[name] for name in ("refused", "bus_dropped")}

    def counters(self) -> dict[str, int]:
        """Read every counter of the gateway."""
        return totals(scrape(self._metrics_port, timeout_s=WAIT_S))


@contextlib.contextmanager
def scene(through: Through, options: str = "gap_s = 0", watch: str = "", *, router: bool = False) -> Iterator[Scene]:
    """Set a scene up. ``options``: the gateway's ``[device.options]``; ``watch``: the module that runs it and looks.

    router: everybody is linked to one, instead of to the process under test.
    """
    with contextlib.ExitStack() as stack:
        yield Scene(stack, through, options, watch, router=router)


def _match(
    first: int,
    driven: dict[str, Any],
    moves: list[tuple[int, int]],
    cpu_s: float,
    from_ns: int = 0,
    until_ns: int | None = None,
) -> Drive:
    sent_ns: list[int] = driven["sent_ns"]
    arrived: dict[int, int] = {}
    for at_ns, number in moves:
        arrived.setdefault(number, at_ns)
    counted = [
        (number, at_ns)
        for number, at_ns in enumerate(sent_ns, first)
        if number >= first + WARM and at_ns >= from_ns and (until_ns is None or at_ns <= until_ns)
    ]
    return Drive(
        sent=len(counted),
        latencies_us=tuple((arrived[number] - at_ns) / 1e3 for number, at_ns in counted if number in arrived),
        sent_ns=dict(counted),
        seqs=(driven["first_seq"], driven["first_seq"] + len(sent_ns) - 1),
        applied=sum(number >= ADVERSE for number in arrived),
        cpu_us=cpu_s / len(sent_ns) * 1e6,
    )


def bare_queries(count: int) -> tuple[float, ...]:
    """Ask a bare queryable as the lease is asked; microseconds to each answer."""
    with contextlib.ExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        answering = stack.enter_context(process(f"{_PACKAGE}.answering", endpoint))
        answering.hear()
        driver = stack.enter_context(process(f"{_PACKAGE}.driver", endpoint, 0))
        driver.hear()
        time.sleep(_ARRIVE_S)
        driver.say(f"renew {count}")
        return tuple(driver.hear()["took_us"][WARM:])


def _configuration(robot_port: int, bus: str, metrics_port: int, options: str) -> str:
    return f"""
[robot]
name = "{ROBOT}"
[device]
protocol = "tcpudp"
connect = ["tcp://127.0.0.1:{robot_port}"]
[device.options]
{options}
[bus]
mode = "peer"
{bus}
multicast = false
[metrics]
listen = "127.0.0.1:{metrics_port}"
"""
