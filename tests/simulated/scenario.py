"""One scenario, which is JSON: who takes part, what they do, what fails and when. Building and running it.

``robot``: protocol and options of the robot. ``gateways``, ``drivers``, ``programs``: name, host, router and options.
``others``: gateways of other robots, which are away. ``control``: the table of the gateways. ``steps``: each has
``who`` and ``do``, or ``fault``; and ``t``, or ``when`` (a state) and ``after``. ``seconds``: how long, before
everything is healed and the robot must be drivable once more.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import shutil
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from tests.simulated.bus import Fabric
from tests.simulated.checker import Checker
from tests.simulated.engine import Host, World
from tests.simulated.faults import Faults
from tests.simulated.gateway_member import GatewayMember
from tests.simulated.hq_programs import HQ_PROGRAMS, HqProgram
from tests.simulated.members import ROBOT, DriverMember, Member
from tests.simulated.net import Network, Paths
from tests.simulated.restart_rules import RestartRules
from tests.simulated.robots import AlfRobot, SimRobot, TcpUdpRobot
from tests.simulated.webots_robot import WebotsRobot

HEAL_S = 14.0
"""Seconds without faults before the robot must be drivable."""
PROBE_S = 8.0
LEAVE_S = 4.0
ROBOT_PORT = 11001
HQ_PORT = 12000
ROBOTS: dict[str, type[SimRobot]] = {"tcpudp": TcpUdpRobot, "alf": AlfRobot, "wc2ec": WebotsRobot}


class Outcome:
    """What came of a run."""

    def __init__(self, scenario: dict[str, Any]) -> None:
        self.scenario = scenario
        self.violations: list[str] = []
        self.hash = ""
        self.seconds = 0.0
        self.counts: Counter[str] = Counter()
        self.lines: list[str] = []

    @property
    def rules(self) -> set[str]:
        """The names of the rules that were broken."""
        return {violation.split(":")[0].split()[-1] for violation in self.violations}


class Simulation:
    """A scenario with all that takes part."""

    def __init__(self, scenario: dict[str, Any], *, keep_trace: bool = False) -> None:
        self.scenario = scenario
        self.world = World(scenario["seed"], keep_trace=keep_trace)
        self.paths = Paths(self.world)
        self.network = Network(self.world, self.paths)
        self.fabric = Fabric(self.world, self.paths)
        self.hosts: dict[str, Host] = {}
        self.folder = Path(tempfile.mkdtemp(prefix="zbridge-simulated-", dir=_memory()))
        for name, value in scenario.get("network", {}).items():
            setattr(self.fabric if hasattr(self.fabric, name) else self.paths, name, value)
        robot = scenario["robot"]
        self.robot_protocol: str = robot["protocol"]
        kind = ROBOTS[robot["protocol"]]
        self.robot = kind(self.host("robot"), "robot", self.network, ROBOT_PORT, robot.get("options", {}))
        self.gateways = [self._gateway(each) for each in scenario["gateways"]]
        self.drivers = [self._driver(number, each) for number, each in enumerate(scenario["drivers"])]
        self.programs = [self._program(number, each) for number, each in enumerate(scenario.get("programs", []))]
        self.others = [self._gateway(each) for each in scenario.get("others", [])]
        members = [*self.gateways, *self.drivers, *self.others]
        self.members: dict[str, Member] = {each.name: each for each in members}
        self.checker = Checker(self)
        self.restart_rules = RestartRules(self)
        self.faults = Faults(self)

    def host(self, name: str) -> Host:
        """Return a host; its clocks are its own."""
        if name not in self.hosts:
            rng = self.world.rng(f"host {name}")
            self.hosts[name] = Host(self.world, name, rng.uniform(-1e-4, 1e-4), rng.uniform(10, 1e5))
        return self.hosts[name]

    def _gateway(self, given: dict[str, Any]) -> GatewayMember:
        robot = self.scenario["robot"]
        device = {
            "protocol": robot["protocol"],
            "connect": [f"tcp://{'away' if 'robot' in given else 'robot'}:{ROBOT_PORT}"],
            "options": robot.get("device", {}),
        }
        listeners = [
            {
                "protocol": protocol,
                "listen": f"tcp://{given['host']}:{HQ_PORT + number}",
                "options": {"hold": given.get("hold", False)} if protocol == "wc2ec" else {},
            }
            for number, protocol in enumerate(given.get("hq", []))
        ]
        configuration = {
            "robot": {"name": given.get("robot", ROBOT)},
            "hq": listeners,
            "control": self.scenario.get("control", {}),
            "bus": {"mode": "client", "connect": ["tcp/router:7447"]},
        }
        if given.get("device", True):
            configuration["device"] = device
        host = self.host(given["host"])
        arguments = (host, given["name"], self.network, self.fabric, given.get("router", "router1"))
        return GatewayMember(*arguments, configuration, self.folder)

    def _driver(self, number: int, given: dict[str, Any]) -> DriverMember:
        options = {"percent": self.scenario["robot"]["protocol"] == "alf", **given.get("options", {})}
        host, router = self.host(given["host"]), given.get("router", "router1")
        return DriverMember(host, given["name"], self.network, self.fabric, router, number, options)

    def _program(self, number: int, given: dict[str, Any]) -> HqProgram:
        kind, options = HQ_PROGRAMS[given["protocol"]], given.get("options", {})
        address = (given["gateway_host"], HQ_PORT + given.get("listener", 0))
        return kind(self.host(given["host"]), given["name"], self.network, address, 2 + number, options)

    def run(self) -> Outcome:
        """Run it to the end."""
        world, outcome = self.world, Outcome(self.scenario)
        for member in self.members.values():
            world.after(world.rng(f"start {member.name}").random() * 0.3, member.start)
        self.faults.plan(self.scenario["steps"])
        seconds = self.scenario["seconds"]
        world.run_until(seconds)
        self.faults.heal_all()
        world.run_until(seconds + HEAL_S)
        self.checker.probe()
        world.run_until(seconds + HEAL_S + PROBE_S)
        self.checker.probed()
        self.restart_rules.ended()
        for driver in self.drivers:
            driver.stop()
        for gateway in (*self.gateways, *self.others):
            gateway.stop()
        world.run_until(seconds + HEAL_S + PROBE_S + LEAVE_S)
        self.checker.ended()
        outcome.violations = self.checker.violations
        outcome.hash, outcome.seconds = world.trace_hash, world.now
        outcome.counts, outcome.lines = self.checker.counts, world.lines or []
        return outcome


def run(scenario: dict[str, Any], *, keep_trace: bool = False) -> Outcome:
    """Run a scenario once; the same scenario gives the same trace."""
    with _Quiet() as errors:
        return _run(json.loads(json.dumps(scenario)), errors, keep_trace=keep_trace)


def _run(scenario: dict[str, Any], errors: _Quiet, *, keep_trace: bool) -> Outcome:
    simulation = Simulation(scenario, keep_trace=keep_trace)
    errors.world = simulation.world
    try:
        return simulation.run()
    finally:
        shutil.rmtree(simulation.folder, ignore_errors=True)


class _Quiet(logging.Handler):
    """Keeps logs and the garbage of dead processes quiet; an error with a traceback is a violation."""

    world: World | None = None

    def __enter__(self) -> _Quiet:
        self._log = logging.getLogger("zbridge")
        self._before = (self._log.level, self._log.propagate, sys.unraisablehook)
        self._log.addHandler(self)
        self._log.setLevel(logging.ERROR)
        self._log.propagate = False
        sys.unraisablehook = lambda _: None
        gc.disable()
        return self

    def __exit__(self, *_: object) -> None:
        with warnings.catch_warnings():  # of coroutines that a killed process never began
            warnings.simplefilter("ignore", RuntimeWarning)
            self._leave()

    def _leave(self) -> None:
        world, self.world = self.world, None
        if world is not None:
            world.watchers.clear()
            world.over = True
        del world
        gc.enable()
        self._log.removeHandler(self)
        level, self._log.propagate, _ = self._before
        self._log.setLevel(level)
        gc.collect()
        sys.unraisablehook = self._before[2]

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info and self.world is not None:
            self.world.errors.append(f"logged: {record.getMessage()}: {record.exc_info[1]!r}")


def _memory() -> str | None:
    """Return a folder in memory, where there is one."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
