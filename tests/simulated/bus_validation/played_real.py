"""Plays a trace on real Zenoh: each agent and router is a process, and each link between hosts a road that can be cut.

To be used in a network namespace of the caller's own. The first router is here; the other router and the agents of the
first one are at the end of a road each; the agents of the second router are beside it.
"""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import time
from typing import Any, NamedTuple

from tests.e2e.conftest import until
from tests.e2e.rigs.processes import Part, Road
from tests.machine import Withheld
from tests.ports import free_port
from tests.simulated.bus_validation.trace import Entry, Log, Step, Trace

NODE = (sys.executable, "-m", "tests.simulated.bus_validation.node")
LEAD_S = 0.2
"""Seconds before the first step of a trace."""
OPEN_S = 30.0
"""Longest wait for routers, or agents, to open."""


class Played(NamedTuple):
    """What was observed, and for how long this machine kept the processes of the trace from running, in seconds."""

    log: Log
    withheld_s: float


def play(trace: Trace) -> Played:
    """Play it."""
    with contextlib.ExitStack() as stack:
        scene = _Scene(stack, trace)
        scene.open()
        machine = Withheld()
        before_s = machine.seconds(scene.pids)
        scene.play()
        withheld_s = machine.seconds(scene.pids) - before_s
    return Played(scene.read(), withheld_s)


class _Scene:
    def __init__(self, stack: contextlib.ExitStack, trace: Trace) -> None:
        self._stack = stack
        self._trace = trace
        self._log: list[Entry] = []
        self._began = 0.0
        self._roads: dict[str, Road] = {}
        self._nodes: dict[str, Part] = {}
        self._spare: dict[str, Part] = {}
        self._port = free_port()
        self._second_port = free_port()
        for router in trace.routers:
            self._nodes[router] = self._router(router)
        for step in trace.steps:
            if step.what == "start":
                self._spare[step.who] = self._router(step.who) if "router" in step.who else self._agent(step.who)
        for agent in trace.agents:
            self._nodes[agent] = self._agent(agent)
        for part in (*self._nodes.values(), *self._spare.values()):
            assert part.line(60.0) == "ready"

    def _road(self, one: str, other: str) -> Road:
        name = f"{one}-{other}"
        if name not in self._roads:
            self._roads[name] = Road(self._stack)
        return self._roads[name]

    def _router(self, name: str) -> Part:
        if name == "router1":
            return self._part(name, (), f"tcp/0.0.0.0:{self._port}", "")
        road = self._road(name, "router1")
        return self._part(name, road.enter, f"tcp/127.0.0.1:{self._second_port}", f"tcp/{road.near}:{self._port}")

    def _agent(self, name: str) -> Part:
        router = self._trace.agents[name]
        if router == "router1":
            road = self._road(name, router)
            return self._part(name, road.enter, "", f"tcp/{road.near}:{self._port}")
        return self._part(name, self._road(router, "router1").enter, "", f"tcp/127.0.0.1:{self._second_port}")

    def _part(self, name: str, enter: tuple[str, ...], listen: str, connect: str) -> Part:
        return _Node(self._stack, self._log, name, *enter, *NODE, listen, connect)

    @property
    def pids(self) -> list[int]:
        """The processes that take part."""
        return [part.pid for part in (*self._nodes.values(), *self._spare.values())]

    def open(self) -> None:
        """Open the routers, and then the agents."""
        for names in (self._trace.routers, tuple(self._trace.agents)):
            for name in names:
                self._say(name, "open")
            until(lambda names=names: {each.who for each in self._log} >= set(names), OPEN_S, "open sessions")

    def play(self) -> None:
        """Carry out the steps in time."""
        self._began = began = time.monotonic() + LEAD_S
        for step in sorted(self._trace.steps, key=lambda step: step.at):
            time.sleep(max(0.0, began + step.at - time.monotonic()))
            self._do(step)
        time.sleep(max(0.0, began + self._trace.lasts_s - time.monotonic()))

    def read(self) -> Log:
        """Return what the agents observed, in order and by the time line of the trace."""
        log = Log()
        for at, who, what, fields in sorted(self._log, key=lambda entry: entry.at):
            if who in self._trace.agents and at - self._began <= self._trace.lasts_s:
                put = (fields[3] - self._began,) if what == "got" else fields[3:]
                log.append(Entry(at - self._began, who, what, fields[:3] + put))
        return log

    def _do(self, step: Step) -> None:
        node = self._nodes.get(step.who)
        if step.what in ("cut", "mend", "cut one way"):
            _ROADS[step.what](self._roads[step.who], *step.arguments)
        elif step.what == "start":
            self._nodes[step.who] = self._spare[step.who]
            self._say(step.who, "open")
        elif step.what in _SIGNALS:
            assert node is not None
            node.signal(_SIGNALS[step.what])
        else:
            self._say(step.who, step.what, *step.arguments)

    def _say(self, who: str, *word: Any) -> None:
        self._nodes[who].say(json.dumps(word))


class _Node(Part):
    """A process whose lines become entries of the log, but for the first."""

    def __init__(self, stack: contextlib.ExitStack, log: list[Entry], name: str, *command: str) -> None:
        def heard(line: str) -> None:
            if line == "ready":
                self._lines.put(line)
                return
            at, what, fields = json.loads(line)
            log.append(Entry(at, name, what, tuple(fields)))

        super().__init__(stack, *command, heard=heard)


_ROADS = {"cut": Road.cut, "mend": Road.mend, "cut one way": Road.cut_one_way}
_SIGNALS = {"kill": signal.SIGKILL, "pause": signal.SIGSTOP, "resume": signal.SIGCONT}
