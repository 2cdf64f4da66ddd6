"""What fails, one after the other, at random from a seed."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import socket
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from tests.e2e.measured.hq_churn import use
from tests.soak.network import CLEAN, Link
from tests.soak.recorder import Recorder
from tests.soak.scene import COUNTED, ROBOT_PLANS, Scene
from tests.soak.turns import Disturbances, forge

LOST = 0.02
LONGEST_S = 8.0
UNNOTICED_S = 0.3
"""A gateway that is frozen for longer may be killed by its supervisor."""
KILLED_S = 8.0
"""Least seconds between two crashes of a gateway: its supervisor gives up a connection after three in a row."""
CONNECTIONS = 20
BUS_S = 6.0
"""Seconds that a bus needs to be whole again after a fault: positions of that time count as lost by it."""


class Faults:
    """Makes things fail; each method is one way. What a fault disturbs is noted for those who judge."""

    def __init__(self, scene: Scene, recorder: Recorder, disturbances: Disturbances, rng: random.Random) -> None:
        self.done: Counter[str] = Counter()
        self.bus_faults: list[tuple[float, float]] = []
        """From when to when positions may be lost on the bus."""
        self._scene, self._recorder, self._disturbances, self._rng = scene, recorder, disturbances, rng
        self._crashed: dict[str, float] = {}
        self._lease_s = 3.0
        self._ways: dict[Callable[[], None], int] = {
            self.bus_cut: 5, self.router_restart: 2, self.field_cut: 5, self.robot_frozen: 3, self.gateway_frozen: 2,
            self.gateway_briefly_frozen: 2, self.gateway_killed: 3, self.gateway_restart: 2, self.file_changes: 1,
            self.recorder_comes_or_goes: 3, self.descriptors_exhausted: 3, self.hq_programs_come_and_go: 2,
            self.forged_commands: 2,
        }  # fmt: skip

    def storm(self, seconds: float) -> None:
        """Let things fail for so long, over links that are never good."""
        until = time.monotonic() + seconds
        self._set_links()
        while (left_s := until - time.monotonic()) > 0:
            time.sleep(min(left_s, self._rng.expovariate(0.5)))
            (way,) = self._rng.choices([*self._ways], [*self._ways.values()])
            self.done[way.__name__.replace("_", " ")] += 1
            try:
                way()
            except (AssertionError, OSError) as error:  # what it wanted is not there now
                self.done[f"not possible: {type(error).__name__}"] += 1

    def calm(self) -> None:
        """Let both links be good again."""
        for link in (self._scene.bus_link, self._scene.field_link):
            link.set(CLEAN, CLEAN)
        while self._scene.router.process.poll() is not None:
            with contextlib.suppress(AssertionError):
                self._scene.start_router()

    def _set_links(self) -> None:
        for link in (self._scene.bus_link, self._scene.field_link):
            there, back = (self._rng.uniform(0.0, 0.03) for _ in range(2))
            link.set((there, there / 4, LOST), (back, back / 4, LOST))

    def _for_a_while(self, longest_s: float = LONGEST_S) -> None:
        time.sleep(self._rng.uniform(0.3, self._rng.uniform(0.3, longest_s)))

    def _cut(self, link: Link) -> None:
        """Lose every packet for a while, in one direction or both."""
        there, back = self._rng.choice(((True, True), (True, False), (False, True)))
        link.cut(there=there, back=back)
        self._for_a_while()
        link.mend()

    def bus_cut(self) -> None:
        began = time.monotonic()
        self._cut(self._scene.bus_link)
        self.bus_faults.append((began, time.monotonic() + BUS_S))

    def router_restart(self) -> None:
        began = time.monotonic()
        self._scene.router.kill()
        self._for_a_while(3.0)
        self._scene.start_router()
        self.bus_faults.append((began, time.monotonic() + BUS_S))

    def forged_commands(self) -> None:
        forge(self._scene.session, [*ROBOT_PLANS], self._rng, 1.0)

    def field_cut(self) -> None:
        self._disturbances.begin(*ROBOT_PLANS)
        self._cut(self._scene.field_link)
        self._disturbances.end(*ROBOT_PLANS)

    def robot_frozen(self) -> None:
        name = self._rng.choice(self._scene.names)
        part = self._scene.part(name)
        self._disturbances.begin(name)
        part.signal(signal.SIGSTOP)
        self._for_a_while()
        part.signal(signal.SIGCONT)
        self._disturbances.end(name)

    # Gateways

    def _churned(self) -> str:
        """Choose a gateway that may die; wait until it has not crashed for a while."""
        name = self._rng.choice([name for name, plan in ROBOT_PLANS.items() if not plan.steady])
        time.sleep(max(0.0, self._crashed.get(name, 0.0) + KILLED_S - time.monotonic()))
        self._crashed[name] = time.monotonic()
        return name

    def gateway_killed(self) -> None:
        name = self._churned()
        os.kill(self._scene.supervisor.gateway(name), signal.SIGKILL)
        self._disturbances.end(name)

    def gateway_frozen(self) -> None:
        name = self._churned()
        pid = self._scene.supervisor.gateway(name)
        os.kill(pid, signal.SIGSTOP)
        self._disturbances.end(name)  # from now on: its supervisor stops the robot
        self._for_a_while()
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)

    def gateway_briefly_frozen(self) -> None:
        name = self._rng.choice(self._scene.names)
        pid = self._scene.supervisor.gateway(name)
        os.kill(pid, signal.SIGSTOP)
        time.sleep(self._rng.uniform(0.02, UNNOTICED_S))
        os.kill(pid, signal.SIGCONT)
        self._disturbances.end(name)

    def gateway_restart(self) -> None:
        name = self._churned()
        os.kill(self._scene.supervisor.gateway(name), signal.SIGUSR2)
        self._disturbances.end(name)

    def file_changes(self) -> None:
        name = self._churned()
        self._lease_s = 5.0 - self._lease_s
        self._scene.write(name, self._lease_s)
        self._scene.supervisor.reload()
        self._disturbances.end(name)

    def descriptors_exhausted(self) -> None:
        """Let a gateway or the supervisor have no more descriptors than it has now, for a while."""
        name = self._rng.choice([*self._scene.names, ""])
        pid = self._scene.supervisor.gateway(name) if name else self._scene.supervisor.process.pid
        former = Path(f"/proc/{pid}/limits").read_text().partition("Max open files")[2].split()[0]
        _limit_files(pid, str(use(pid)["files"]))
        if name and name != COUNTED:
            self._connect(name)
        self._for_a_while(4.0)
        _limit_files(pid, former)

    def hq_programs_come_and_go(self) -> None:
        name = self._rng.choice([*ROBOT_PLANS])
        for _ in range(CONNECTIONS):
            self._connect(name)

    def _connect(self, name: str) -> None:
        """Connect to a robot's listener, and leave at once or after its first bytes."""
        address = self._scene.bus_link.far, self._scene.hq_port(name)
        with contextlib.suppress(OSError), socket.create_connection(address, timeout=0.3) as connection:
            if self._rng.random() < 0.5:
                connection.settimeout(0.2)
                connection.recv(100)

    def recorder_comes_or_goes(self) -> None:
        self._recorder.comes_or_goes()


def _limit_files(pid: int, count: str) -> None:
    """Set the soft limit of a process's descriptors."""
    with contextlib.suppress(subprocess.CalledProcessError):  # it has just ended
        subprocess.run(["prlimit", "--pid", str(pid), f"--nofile={count}:"], check=True, capture_output=True)
