"""One run: a source, what it goes through, a sink, and what that took.

The source probes until the sink has seen one, then holds, the sink forgets, and on ``go`` everything that is
sent counts. All processes read the same monotonic clock.
"""

from __future__ import annotations

import contextlib
import json
import signal
import tempfile
import time
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from statistics import median
from typing import Any

from tests.benchmarks.harness import Process, cpu_s, memory_mb, process, thread_cpu_s
from tests.benchmarks.peer import ROBOT
from tests.benchmarks.wire import Kind
from tests.ports import free_port

RUN_S = 40.0
"""Longest time one run may take."""
QUIET_S = 1.0
"""Silence after which what has not arrived is lost."""
SETTLE_S = 0.1
"""Time for the last probe to arrive."""
_PACKAGE = "tests.benchmarks"


class Route(Enum):
    """What the bytes go through between robot and consumer."""

    GATEWAY = "gateway"
    SCRIPT = "script"
    ZENOH = "bare zenoh"
    TCP = "bare tcp"


@dataclass(frozen=True)
class Load:
    """What the source sends: ``rate_hz`` 0 is as fast as it goes; ``keep`` looks at every single arrival.

    ``shared_memory`` False: as between two machines, where payloads of 3 kB and more have to travel.
    """

    kind: Kind
    count: int
    rate_hz: float = 0.0
    keep: bool = False
    shared_memory: bool = True


@dataclass(frozen=True)
class Run:
    """What one run took. CPU is that of the process under test: gateway, script or bare loop."""

    sent: int
    arrived: int
    lost: int
    seconds: float
    cpu_s: float
    latencies_us: tuple[float, ...]
    start_s: float
    memory_mb: float
    threads_s: dict[int, tuple[str, float]]
    profile: dict[str, Any] | None

    @property
    def rate_hz(self) -> float:
        """Messages that arrived, per second."""
        return self.arrived / self.seconds

    @property
    def cpu_us(self) -> float:
        """CPU time for each message that was sent, microseconds."""
        return self.cpu_s / self.sent * 1e6

    @property
    def latency_us(self) -> float:
        """Median from the call that sends to the handler that receives, microseconds."""
        return median(self.latencies_us)


def run(route: Route, load: Load, *, stream: str = "drop", profile: bool = False) -> Run:
    """Make one run. ``stream``: the gateway's ``[bus] stream``."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        source, tested, sink = _start(stack, route, load, endpoint, folder, stream=stream, profile=profile)
        start_s = (sink.hear()["first_ns"] - tested.started_ns) / 1e9
        source.say("hold")
        source.hear()
        time.sleep(SETTLE_S)
        sink.say("reset")
        sink.hear()
        if profile:
            tested.signal(signal.SIGUSR1)
        cpu, threads = cpu_s(tested.pid), thread_cpu_s(tested.pid)
        sink.say(f"await {load.count} {QUIET_S} {RUN_S}")
        source.say("go")
        sent = source.hear(RUN_S)
        got = sink.hear(RUN_S + QUIET_S)
        cpu, memory = cpu_s(tested.pid) - cpu, memory_mb(tested.pid)
        threads = _spent(threads, thread_cpu_s(tested.pid))
        tested.end()
        profiled = json.loads((folder / "profile.json").read_text()) if profile else None
    arrivals = dict(got["arrivals"])
    return Run(
        sent=load.count,
        arrived=got["count"],
        lost=load.count - (len(arrivals) if load.keep else got["count"]),
        seconds=(got["last_ns"] - sent["begun_ns"]) / 1e9,
        cpu_s=cpu,
        latencies_us=_latencies_us(sent["sent_ns"], arrivals),
        start_s=start_s,
        memory_mb=memory,
        threads_s=threads,
        profile=profiled,
    )


def _start(
    stack: contextlib.ExitStack,
    route: Route,
    load: Load,
    endpoint: str,
    folder: Path,
    *,
    stream: str,
    profile: bool,
) -> tuple[Process, Process, Process]:
    """Start source, process under test and sink; two of them are the same where nothing lies between."""

    def start(module: str, *arguments: object) -> Process:
        return stack.enter_context(process(module, *arguments))

    if route is not Route.TCP:
        sink = start(f"{_PACKAGE}.consumer", load.kind, endpoint, int(load.keep), int(load.shared_memory))
        sink.hear()
    if route is Route.ZENOH:
        source = start(f"{_PACKAGE}.bare", load.kind, endpoint, load.count, load.rate_hz)
        return source, source, sink
    source = start(f"{_PACKAGE}.robot", load.kind, load.count, load.rate_hz)
    port = source.hear()["port"]
    if route is Route.TCP:
        sink = start(f"{_PACKAGE}.tcp", port)
        return source, sink, sink
    if route is Route.SCRIPT:
        return source, start(f"{_PACKAGE}.script", port, endpoint), sink
    file = folder / "gateway.toml"
    file.write_text(_configuration(port, endpoint, stream))
    if profile:
        return source, start(f"{_PACKAGE}.profiler", folder / "profile.json", "run", file), sink
    return source, start("zbridge", "run", file), sink


def _configuration(port: int, endpoint: str, stream: str) -> str:
    return f"""
[robot]
name = "{ROBOT}"
[device]
protocol = "tcpudp"
connect = ["tcp://127.0.0.1:{port}"]
[bus]
mode = "peer"
listen = ["{endpoint}"]
multicast = false
stream = "{stream}"
"""


def _spent(before: dict[int, tuple[str, float]], after: dict[int, tuple[str, float]]) -> dict[int, tuple[str, float]]:
    return {thread: (name, spent - before.get(thread, ("", 0.0))[1]) for thread, (name, spent) in after.items()}


def _latencies_us(sent_ns: list[int], arrivals: dict[int, int]) -> tuple[float, ...]:
    return tuple((arrivals[number] - at_ns) / 1e3 for number, at_ns in enumerate(sent_ns, 1) if number in arrivals)
