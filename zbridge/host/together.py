"""Many gateways in one process and one session on the bus, for robots that trust each other. Knows no protocol.

Theory of operation. Each gateway is a task with a share of the bus: queues, bounds, threads and declarations of its own
on one session. What one of them raises ends that gateway alone, which begins anew after a pause that grows. A robot
that sends more than its part of the processor is not read meanwhile, and reads are short, so that the others wait for
milliseconds at most. What is shared all the same: the interpreter (protocol code that never returns stops all robots),
the session's one receiving thread, and the certificate.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import time
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

from zbridge.app.config import GatewayPlan
from zbridge.app.endpoint import serve_metrics
from zbridge.app.gateway import Gateway, Neighbourhood, robot_metrics
from zbridge.app.joining import SessionUseless, can_connect, join_bus, watch_certificate, watch_session
from zbridge.app.process_usage import USAGE
from zbridge.app.readings import LoopLateness
from zbridge.blackbox import DISK
from zbridge.blackbox.box import CLOSE_S
from zbridge.bus import Bus
from zbridge.bus.tls.files import own_certificate
from zbridge.control.faults import OpenFaults
from zbridge.errors import ZbridgeError
from zbridge.host.addresses import hold_addresses
from zbridge.host.settings import HostSettings
from zbridge.log import Log, current_robot
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.session_table import Backoff
from zbridge.tasks import together
from zbridge.transport.tcp import SHARED_READ_BYTES

log = Log("zbridge.host.together")

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 60.0
"""The pause before a gateway that failed begins anew doubles from the first to the longest."""
HEALTHY_S = 60.0
"""A gateway that ran for so long begins with the first pause again."""

Hold = Callable[[GatewayPlan], contextlib.AbstractAsyncContextManager[None]]


class Together:
    """The gateways of one process, by name: the robot's, or its file's.

    plans: all with the same ``[bus]`` and different robots (:mod:`zbridge.host.settings` checks both). The counters of
    a gateway have the labels ``realm`` and ``robot``; every ``[metrics]`` address shows those of all. hold: holds the
    robot's addresses while its gateway runs. listen: where the metrics are served besides.
    """

    def __init__(
        self,
        plans: Mapping[str, GatewayPlan],
        host: HostSettings,
        hold: Hold = hold_addresses,
        listen: Address | None = None,
    ) -> None:
        self.left = True
        """Whether the bus was closed in order; if not, one of its threads may hang."""
        self.metrics = Metrics()
        self._plans = plans
        self._host = host
        self._hold = hold
        self._listen = listen
        self._bus: Bus | None = None
        self._failed = self.metrics.count("gateway_failures")
        self._neighbourhood = Neighbourhood(host.share, bytearray(SHARED_READ_BYTES))
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._gateways: dict[str, Gateway] = {}
        """Those that run."""

    def __len__(self) -> int:
        return len(self._tasks)

    async def run(self) -> None:
        """Serve all robots until cancelled; then stop those that move, and close the bus."""
        while True:
            self._bus = await join_bus(next(iter(self._plans.values())), self.metrics)
            try:
                await self._serve(self._bus)
            except SessionUseless as error:
                log.error("shared_session_useless", "{error}", error=error)
            finally:
                DISK.settle(CLOSE_S)
                self.left = await self._bus.close()

    async def _serve(self, bus: Bus) -> None:
        """Run all gateways; raise SessionUseless when the session is of no use any more."""
        any_plan = next(iter(self._plans.values()))
        settings = any_plan.config.bus
        certificate = own_certificate(settings.tls)
        watches: list[Coroutine[Any, Any, None]] = []
        async with contextlib.AsyncExitStack() as stack:
            stack.callback(self.metrics.add_source(USAGE.readings))
            stack.callback(LoopLateness(self.metrics).begin())
            for address in filter(None, {self._listen, *(plan.metrics for plan in self._plans.values())}):
                await stack.enter_async_context(serve_metrics(address, self.metrics, self.missing))
            stack.push_async_callback(self.close)
            for number, (name, plan) in enumerate(self._plans.items()):
                self.start(name, plan, (number + random.random()) * self._host.stagger_s)
            if certificate is not None:
                watches.append(watch_certificate(certificate, bus, OpenFaults()))
            if settings.effective_mode == "client":
                watches.append(watch_session(any_plan, bus, can_connect))
            if watches:
                await together(*watches)
            await asyncio.Event().wait()

    def missing(self) -> tuple[str, ...]:
        """Return what the gateways lack to be of use."""
        running = {name: gateway.missing() for name, gateway in self._gateways.items()}
        reasons = {name: running.get(name, ("no gateway",)) for name in self._tasks}
        return tuple(f"{name}: {reason}" for name, each in reasons.items() for reason in each)

    def start(self, name: str, plan: GatewayPlan, after_s: float = 0.0) -> None:
        """Start a gateway in ``after_s`` seconds; raise ValueError if the name is taken."""
        if name in self._tasks:
            raise ValueError(f"{name!r}: is already running")
        self._tasks[name] = asyncio.create_task(self._keep_running(name, plan, after_s), name=f"gateway {name}")

    async def stop(self, name: str) -> None:
        """Stop a robot, and end its gateway; nothing happens if there is none of this name."""
        task = self._tasks.pop(name, None)
        if task is not None:
            task.cancel()
            await asyncio.wait((task,))

    async def close(self) -> None:
        """Stop all robots at once, and end their gateways; idempotent."""
        tasks, self._tasks = tuple(self._tasks.values()), {}
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    async def _keep_running(self, name: str, plan: GatewayPlan, after_s: float) -> None:
        """Run a gateway, and again after it failed, until cancelled."""
        current_robot.set(plan.config.robot.name)
        await asyncio.sleep(after_s)
        backoff, metrics = Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S), robot_metrics(plan, self.metrics)
        while True:
            begun = time.monotonic()
            try:
                await self._run(name, plan, metrics)
                return
            except ZbridgeError as error:
                log.error("gateway_failed", "{name}: {error}", name=name, error=error)
            except Exception:
                log.exception("gateway_fault", "{name}: the gateway failed", name=name)
            self._failed.value += 1
            if time.monotonic() - begun >= HEALTHY_S:
                backoff.reset()
            pause_s = backoff.delay_s()
            log.warning("gateway_restarts", "{name}: restarts in {delay_s:.1f} s", name=name, delay_s=pause_s)
            await asyncio.sleep(pause_s)

    async def _run(self, name: str, plan: GatewayPlan, metrics: Metrics) -> None:
        assert self._bus is not None, "run() opens the bus"
        bus = self._bus.share(metrics)
        try:
            async with self._hold(plan):
                self._gateways[name] = gateway = Gateway(plan, metrics)
                await gateway.run_on(bus, self._neighbourhood)
        finally:
            self._gateways.pop(name, None)
            await bus.close()
