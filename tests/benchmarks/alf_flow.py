"""Runs of the ALF benchmark: a vehicle, what its scans go through, who counts them, and what that took.

The course of a run is that of :mod:`tests.benchmarks.flow`: the vehicle probes until a scan has arrived, holds, and
on ``go`` everything counts.
"""

from __future__ import annotations

import contextlib
import json
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.benchmarks.alf_wire import Dialect
from tests.benchmarks.flow import QUIET_S, RUN_S, SETTLE_S, Route, Run
from tests.benchmarks.harness import Process, cpu_s, memory_mb, process, thread_cpu_s
from tests.benchmarks.peer import ROBOT
from tests.ports import free_port

SCANS_HZ = 10.0
COMMANDS_HZ = 50.0
GREETING_S = 1.2
"""The gateway greets a vehicle with a stop, for a second."""
_PACKAGE = "tests.benchmarks"


class Stage:
    """The processes of one run; two of them are the same where nothing lies between."""

    def __init__(
        self, stack: contextlib.ExitStack, route: Route, dialect: Dialect, count: int, *, rate_hz: float, profile: bool
    ) -> None:
        self._stack = stack
        self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.sink = self.start(f"{_PACKAGE}.alf_consumer", self.endpoint)
        self.sink.hear()
        if route is Route.ZENOH:
            self.source = self.tested = self.start(f"{_PACKAGE}.alf_bare", self.endpoint, count)
        else:
            self.source = self.start(f"{_PACKAGE}.alf_vehicle", dialect, count, rate_hz)
            self.tested = self._through(route, dialect, self.source.hear()["port"], profile=profile)
        self.start_s = (self.sink.hear()["first_ns"] - self.tested.started_ns) / 1e9
        self.source.say("hold")
        self.source.hear()
        time.sleep(SETTLE_S)
        self.sink.say("reset")
        self.sink.hear()

    def start(self, module: str, *arguments: object) -> Process:
        """Start a process that ends with the run."""
        return self._stack.enter_context(process(module, *arguments))

    def profile(self) -> dict[str, Any]:
        """End the process under test and read what its profiler found."""
        self.tested.end()
        found: dict[str, Any] = json.loads((self._folder / "profile.json").read_text())
        return found

    def _through(self, route: Route, dialect: Dialect, port: int, *, profile: bool) -> Process:
        if route is Route.SCRIPT:
            return self.start(f"{_PACKAGE}.alf_script", port, self.endpoint)
        file = self._folder / "gateway.toml"
        file.write_text(_configuration(port, self.endpoint, dialect))
        if profile:
            return self.start(f"{_PACKAGE}.profiler", self._folder / "profile.json", "run", file)
        return self.start("zbridge", "run", file)


@contextlib.contextmanager
def _stage(
    route: Route, dialect: Dialect, count: int, *, rate_hz: float = 0.0, profile: bool = False
) -> Iterator[Stage]:
    with contextlib.ExitStack() as stack:
        yield Stage(stack, route, dialect, count, rate_hz=rate_hz, profile=profile)


def saturated(route: Route, dialect: Dialect, count: int, *, profile: bool = False) -> Run:
    """Send ``count`` scans as fast as they are taken."""
    with _stage(route, dialect, count, profile=profile) as stage:
        if profile:
            stage.tested.signal(signal.SIGUSR1)
        pid = stage.tested.pid
        cpu, threads = cpu_s(pid), thread_cpu_s(pid)
        stage.sink.say(f"await {count} {QUIET_S} {RUN_S}")
        stage.source.say("go")
        begun_ns = stage.source.hear(RUN_S)["begun_ns"]
        got = stage.sink.hear(RUN_S + QUIET_S)
        return Run(
            sent=count,
            arrived=got["count"],
            lost=count - got["count"],
            seconds=(got["last_ns"] - begun_ns) / 1e9,
            cpu_s=cpu_s(pid) - cpu,
            latencies_us=(),
            start_s=stage.start_s,
            memory_mb=memory_mb(pid),
            threads_s=_spent(threads, thread_cpu_s(pid)),
            profile=stage.profile() if profile else None,
        )


def steady(dialect: Dialect, seconds: float, *, profile: bool = False) -> tuple[Run, int]:
    """Let one vehicle measure at 10 Hz and be driven at 50 Hz; give also how many commands it read meanwhile."""
    count = round(SCANS_HZ * seconds)
    with _stage(Route.GATEWAY, dialect, count, rate_hz=SCANS_HZ, profile=profile) as stage:
        driver = stage.start(f"{_PACKAGE}.alf_driver", stage.endpoint, COMMANDS_HZ)
        driver.hear()
        time.sleep(GREETING_S)
        driver.say("go")
        time.sleep(SETTLE_S)
        if profile:
            stage.tested.signal(signal.SIGUSR1)
        pid = stage.tested.pid
        begun_s, cpu, threads = time.monotonic(), cpu_s(pid), thread_cpu_s(pid)
        stage.source.say("go")
        stage.source.hear(seconds + RUN_S)
        took_s, cpu, threads = time.monotonic() - begun_s, cpu_s(pid) - cpu, _spent(threads, thread_cpu_s(pid))
        driver.say("end")
        driver.hear()
        stage.sink.say(f"await {count} {QUIET_S} {RUN_S}")
        got = stage.sink.hear()
        stage.source.say("commands?")
        commands = stage.source.hear()["commands"]
        run = Run(
            sent=count,
            arrived=got["count"],
            lost=count - got["count"],
            seconds=took_s,
            cpu_s=cpu,
            latencies_us=(),
            start_s=stage.start_s,
            memory_mb=memory_mb(pid),
            threads_s=threads,
            profile=stage.profile() if profile else None,
        )
    return run, commands


def _configuration(port: int, endpoint: str, dialect: Dialect) -> str:
    return f"""
[robot]
name = "{ROBOT}"
[device]
protocol = "alf"
connect = ["tcp://127.0.0.1:{port}"]
[device.options]
dialect = "{dialect}"
[bus]
mode = "peer"
listen = ["{endpoint}"]
multicast = false
stream = "block"
"""


def _spent(before: dict[int, tuple[str, float]], after: dict[int, tuple[str, float]]) -> dict[int, tuple[str, float]]:
    return {thread: (name, spent - before.get(thread, ("", 0.0))[1]) for thread, (name, spent) in after.items()}
