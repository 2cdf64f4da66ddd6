"""Plays a trace on the simulated bus, in virtual time."""

from __future__ import annotations

from typing import Any

from tests.simulated.bus import Fabric, SimSession
from tests.simulated.bus_session import SimBus
from tests.simulated.bus_validation.agent import Agent
from tests.simulated.bus_validation.trace import Entry, Log, Step, Trace
from tests.simulated.engine import Host, Process, SimLoop, World
from tests.simulated.net import Paths
from zbridge.metrics import Metrics


def play(trace: Trace, seed: int) -> Log:
    """Play it once, and return what was observed, in order."""
    return _Scene(trace, seed).play()


class _Scene:
    def __init__(self, trace: Trace, seed: int) -> None:
        self._trace = trace
        self._log = Log()
        self._world = World(seed)
        self._paths = Paths(self._world)
        self._fabric = Fabric(self._world, self._paths)
        self._agents: dict[str, _SimAgent] = {}
        self._ended: list[_SimAgent] = []

    def play(self) -> Log:
        """Carry out the steps in time."""
        for agent in self._trace.agents:
            self._agents[agent] = self._open(agent)
        for step in self._trace.steps:
            self._world.at(step.at, lambda step=step: self._do(step))
        self._world.run_until(self._trace.lasts_s)
        self._world.over = True
        for agent in (*self._agents.values(), *self._ended):
            agent.forget()
        return self._log

    def _do(self, step: Step) -> None:
        here, _, there = step.who.partition("-")
        here = here if here.startswith("router") else f"host of {here}"
        if step.what == "cut":
            self._paths.cut(here, there)
            self._fabric.follow()
        elif step.what == "cut one way":
            source, target = (there, here) if step.arguments[0] else (here, there)
            self._paths.cut(source, target, both=False)
            self._fabric.follow()
        elif step.what == "mend":
            self._paths.heal(here, there)
        elif step.who.startswith("router"):
            self._fabric.kill_router(step.who) if step.what == "kill" else self._fabric.start_router(step.who)
        elif step.what == "start":
            self._ended.append(self._agents[step.who])
            self._agents[step.who] = self._open(step.who)
        else:
            agent = self._agents[step.who]
            agent.do(step.what, step.arguments)

    def _open(self, name: str) -> _SimAgent:
        router = self._trace.agents[name]
        host = f"host of {name}" if router == "router1" else router

        def record(what: str, *fields: Any) -> None:
            self._log.append(Entry(self._world.now, name, what, fields))

        return _SimAgent(Host(self._world, host), name, self._fabric, router, record)


class _SimAgent:
    def __init__(self, host: Host, name: str, fabric: Fabric, router: str, record: Any) -> None:
        self.process = Process(host, name)
        self._loop = SimLoop(self.process)
        self._session = SimSession(fabric, self.process, router)
        self._world, self._record = host.world, record
        self._bus = SimBus(self._session, Metrics())
        self._agent: Agent | None = None
        self._loop.call_soon(self._begin)

    def _begin(self) -> None:
        self._agent = Agent(self._bus, self._record, lambda: self._world.now)
        self._record("opened")

    def do(self, what: str, arguments: tuple[Any, ...]) -> None:
        if what == "kill":
            self.process.kill()
        elif what == "pause":
            self.process.pause()
        elif what == "resume":
            self.process.resume()
        elif what == "close":
            self._loop.call_soon(lambda: self._loop.create_task(self._bus.close()))
        else:
            self._loop.call_soon(lambda: self._agent.do(what, *arguments))

    def forget(self) -> None:
        """Let nothing run any more that garbage would run."""
        self._loop.abandon()
        for task in self._loop.abandoned:
            task._log_destroy_pending = False
