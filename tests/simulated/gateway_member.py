"""A gateway in a simulation: the product's own, with simulated clocks, randomness, sockets, processes and bus.

Theory of operation. A member is one line of processes. The one that has the robot has the member's name, its successor
the name with ``+`` behind it, one that has handed over the name with ``-``. The names change when *go* is sent: from
then on the successor answers for what the member does. Where the process before dies earlier, its successor has the
name at once, and resumes the work or ends; then a new process is started, as systemd does.
"""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path
from typing import Any

from tests.simulated.bus import Fabric, SimSession
from tests.simulated.bus_session import SimBus
from tests.simulated.engine import Host, Process
from tests.simulated.handover import SimProcesses, Spawner, UnixEnd
from tests.simulated.members import Member
from tests.simulated.net import Network
from tests.simulated.sockets import SimKernel
from zbridge.app.config import GatewayPlan, plan
from zbridge.app.gateway import Gateway
from zbridge.app.process_usage import ProcessUsage
from zbridge.app.runtime import Runtime
from zbridge.errors import LinkError, ZbridgeError
from zbridge.fleet.processes import DiskSpace, ProcessStats
from zbridge.metrics import Metrics

NEW, OLD = "+", "-"
BOOT_S = (0.15, 0.6)
"""Seconds until a process that was started runs the gateway."""
OPEN_S = 0.05
"""Seconds that a session takes to connect."""
AGAIN_S = 1.0
"""Seconds until a process that ended with an error is started again."""


class SimUsage(ProcessUsage):
    """The same numbers always."""

    def read(self) -> ProcessStats:
        return ProcessStats(host="sim", pid=1, version="0", robots=self.robots)

    def free(self, robot: str) -> tuple[DiskSpace, ...]:
        return ()


class Life:
    """One process of a member."""

    def __init__(self, process: Process, session: SimSession) -> None:
        self.process = process
        self.session = session
        self.gateway: Gateway | None = None
        self.task: asyncio.Task[None]
        self.begun = False
        """Whether it has, or had, the robot."""


class GatewayMember(Member):
    """A gateway, and its restarts."""

    def __init__(
        self,
        host: Host,
        name: str,
        network: Network,
        fabric: Fabric,
        router: str,
        configuration: dict[str, Any],
        folder: Path,
    ) -> None:
        super().__init__(host, name, network, fabric, router)
        self.configuration = configuration
        self.folder = folder / name
        shutil.rmtree(self.folder, ignore_errors=True)
        self.serves = "device" in configuration
        """Whether it may serve the robot; else it only has listeners."""
        self.life: Life
        self.successor: Life | None = None
        """The process that takes over."""
        self._before: Life | None = None
        """The process that has handed over."""

    def part(self, which: str) -> Life | None:
        """Return the successor, or the process that has handed over."""
        return self.successor if which == NEW else self._before

    def start(self) -> None:
        if not self.alive:
            self.successor = None
        super().start()

    async def _main(self) -> None:
        self.life = Life(self.process, self.session)
        self.life.begun = True
        self._watch(self.life)
        await self._live(self.life, None)

    def restart(self) -> None:
        """Hand everything over to a new process, as SIGUSR2 does."""
        if self.running and self.life.gateway is not None:
            self.host.world.note(self.name, "told to restart")
            assert self.process.loop is not None
            self.process.loop.create_task(self.life.gateway.restarts.restart())

    def spawn(self, far_end: UnixEnd) -> None:
        """Start a successor, which takes over from the far end."""
        process = self.new_process(self.name + NEW)
        far_end.inherit(process)
        life = self.successor = Life(process, SimSession(self.fabric, process, self.router))
        process.on_go.append(lambda: self._promote(life, "go"))
        self._watch(life)
        assert process.loop is not None
        life.task = process.loop.create_task(self._live(life, far_end))
        life.task.add_done_callback(lambda task: self._ended(life, task))

    def _watch(self, life: Life) -> None:
        """Follow the death of a process."""

        def died() -> None:
            if life is self.successor:
                self.successor = None
            elif life.process is self.process and self.successor is not None:
                self._promote(self.successor, "the process before it died")

        life.process.on_death.append(died)

    def _promote(self, life: Life, why: str) -> None:
        """Let a successor have the name of the member."""
        if not life.process.alive or life.process is self.process:
            return
        self._graves.append((self.process, self.task))
        self.process.name, life.process.name = self.name + OLD, self.name
        self._before, self.life, self.successor, self.ending = self.life, life, None, False
        self.process, self.session, self.task = life.process, life.session, life.task
        self.host.world.note(self.name, "took over", why)

    async def _live(self, life: Life, far_end: Any) -> None:
        """Be one process of the member."""
        process = life.process
        try:
            if far_end is not None:
                await asyncio.sleep(process.rng.uniform(*BOOT_S))
            life.gateway = gateway = Gateway(
                plan(self.configuration),
                predecessor=far_end,
                successor=Spawner(self, process),
                runtime=self._runtime(life),
            )
            await gateway.run()
        finally:
            if process.alive:
                self.host.world.note(process.name, "ended")
                process.after(1e-3, lambda: self._exit(life))

    def _look(self, task: asyncio.Task[None]) -> None:
        """Start again where a process that has handed over, and is frozen, still has the ports of the listeners."""
        error = None if task.cancelled() else task.exception()
        if isinstance(error, LinkError) and self._before is not None and self._before.process.paused:
            self.host.world.note(self.process.name, "finds its ports taken", str(error))
            self.host.world.after(AGAIN_S, self.start)
            return
        super()._look(task)

    def _ended(self, life: Life, task: asyncio.Task[None]) -> None:
        """Judge the end of a successor: it may end with an error before it has the robot."""
        gateway = life.gateway
        life.begun = gateway is not None and gateway._incoming is not None and gateway._incoming.begun.is_set()
        if task.cancelled() or not life.process.alive:
            return
        error = task.exception()
        if error is None:
            return
        if life.begun or not isinstance(error, ZbridgeError):
            self._look(task)
            return
        self.host.world.note(life.process.name, "took nothing over", str(error))
        life.process.exit()
        if life.process is self.process and not self.ending:
            self.host.world.after(AGAIN_S, self.start)

    def _exit(self, life: Life) -> None:
        """Let a process that has ended exit; what it leaves is a leak, unless it never had the robot."""
        process = life.process
        assert process.loop is not None
        tasks, timers = process.loop.left
        if life.begun and (tasks or timers or process.descriptors):
            what = f"{len(tasks)} tasks, {timers} timers, {process.descriptors}: {tasks[:2]} {process.loop.waiting}"
            self.host.world.note(process.name, "leaves", what)
        process.exit()

    def _runtime(self, life: Life) -> Runtime:
        process, rng = life.process, life.process.rng

        async def join(plan: GatewayPlan, metrics: Metrics) -> Any:
            if not life.session.open:  # it has left the bus
                life.session = SimSession(self.fabric, process, self.router)
                if life is self.life:
                    self.session = life.session
            return SimBus(life.session, metrics)

        async def can_connect(plan: GatewayPlan) -> bool:
            await asyncio.sleep(OPEN_S)
            return self.fabric.accepts(self.host.name, self.router)

        return Runtime(
            clock=self.host.monotonic,
            clock_ns=self.host.wall_ns,
            raw_ms=self.host.raw_ms,
            suspended_s=lambda: self.host.suspended_s,
            chance=rng.random,
            secret=rng.randbytes,
            kernel=SimKernel(process, self.network),
            folder=self.folder,
            processes=SimProcesses(process),
            join=join,
            can_connect=can_connect,
            usage=SimUsage(),
        )
