"""One gateway process, from its plan to its end. Knows no protocol.

Theory of operation. The bus is opened first, and again until that succeeds. Listeners run from then on. The device side
runs only while this process owns the robot (:class:`Ownership`): it waits while another gateway does. What one part
raises ends all others; each part leaves its peers in order before the bus is closed.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import secrets
import signal
import time
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

from zbridge.app.config import Plan
from zbridge.app.joining import CertificateEnded, join_bus, watch_certificate
from zbridge.app.prometheus import serve_metrics
from zbridge.bus import Bus, Handle, IncomingQuery
from zbridge.bus.tls.files import own_certificate
from zbridge.bus.tls.member import own_name
from zbridge.control.audit_log import Audit, AuditFile
from zbridge.control.authority import Authority
from zbridge.control.conditions import Conditions
from zbridge.control.motion_limits import MotionLimits
from zbridge.errors import Held
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Sessions
from zbridge.fleet.topics import KeySpace
from zbridge.hq import Listener, RobotSubscription
from zbridge.hq.names import listener_names, process_name
from zbridge.metrics import Metrics
from zbridge.protocol.session_table import SessionTable
from zbridge.robot.device import Device
from zbridge.robot.ownership import Ownership
from zbridge.robot.settings import DevicePlan

log = logging.getLogger("zbridge.app.gateway")

TELL_S = 60.0
"""Seconds between two log lines about other gateways that serve the same robot."""
_NAMED = 3
"""Other gateways that a log line names."""
_RIVALS = "rivals"


class Gateway:
    """A gateway of one robot: its device side, its listeners, or both, as the plan says.

    metrics, sessions, conditions: of this process, shared by all parts.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._keys = KeySpace(plan.config.robot.realm, plan.config.robot.name)
        self.left = True
        """Whether the bus was closed in order; if not, one of its threads may hang."""
        self.metrics = Metrics()
        self.sessions = SessionTable()
        self.conditions = Conditions()
        self._own: str | None = None
        """The name in our certificate."""
        self._process = "gateway"
        """The name of this process on the bus, while it does not serve the robot."""

    def __repr__(self) -> str:
        return f"<Gateway {self._plan.config.robot.name}>"

    async def run(self) -> None:
        """Serve the robot and its HQ programs until cancelled; then stop the robot and close the bus."""
        self._own = own_name(self._plan.config.bus.tls)
        with self._audit() as audit:
            while True:
                bus = await join_bus(self._plan, self.metrics)
                try:
                    await self._run(bus, audit)
                except CertificateEnded as error:
                    log.error("%s", error)
                finally:
                    self.left = await bus.close()

    async def _run(self, bus: Bus, audit: Audit) -> None:
        async with contextlib.AsyncExitStack() as stack:
            if self._plan.metrics is not None:
                await stack.enter_async_context(serve_metrics(self._plan.metrics, self.metrics))
            names = listener_names(self._plan.listeners, self._own, bus.zid)
            self._process = process_name(names, self._own, bus.zid) if names else "gateway"
            robot = RobotSubscription(bus, self._keys, self.metrics)
            certificate = own_certificate(self._plan.config.bus.tls)
            work: list[Coroutine[Any, Any, None]] = [
                Listener(listener, name, robot, self.sessions, self.metrics, time.monotonic).run()
                for listener, name in zip(self._plan.listeners, names, strict=True)
            ]
            if work:
                robot.open()
                stack.callback(robot.close)
            if certificate is not None:
                work.append(watch_certificate(certificate, bus, self.conditions))
            if self._plan.device is not None:
                work.append(self._robot(bus, audit, self._plan.device))
            else:
                stack.callback(self._show_sessions(bus, self._process).close)
            await together(*work)

    async def _robot(self, bus: Bus, audit: Audit, plan: DevicePlan) -> None:
        """Serve the robot whenever no other gateway does."""
        ownership = Ownership(bus, self._keys)
        try:
            while True:
                shown = self._show_sessions(bus, self._process) if self._plan.listeners else None
                await ownership.take()
                if shown is not None:
                    shown.close()
                shown = self._show_sessions(bus, "gateway")
                try:
                    await self._serve(bus, ownership, self._device(bus, audit, plan))
                finally:
                    shown.close()
        finally:
            ownership.release()

    def _show_sessions(self, bus: Bus, who: str) -> Handle:
        """Answer queries for the session table of this process; ``who`` names the process."""

        def answer(question: IncomingQuery) -> None:
            question.answer(payloads.encode(Sessions(self.sessions.snapshots())))

        return bus.answer(self._keys.key(topics.RPC_SESSIONS(who).path), answer)

    async def _work(self, bus: Bus, device: Device) -> None:
        """Run the robot, and its camera where it has one."""
        if self._plan.camera is None:
            await device.run()
        else:
            from zbridge.camera.camera import Camera

            camera = Camera(self._plan.camera, self._keys, bus, self.metrics, self.conditions)
            await together(device.run(), camera.run())

    async def _serve(self, bus: Bus, ownership: Ownership, device: Device) -> None:
        """Serve the robot until another gateway has to take it."""
        serving = asyncio.ensure_future(self._work(bus, device))
        watching = asyncio.ensure_future(ownership.watch(lambda: device.reached, self._rival_teller(device)))
        try:
            await asyncio.wait((serving, watching), return_when=asyncio.FIRST_COMPLETED)
            for task in (serving, watching):
                if task.done():
                    task.result()
        finally:
            for task in (serving, watching):
                task.cancel()
            await asyncio.shield(asyncio.gather(serving, watching, return_exceptions=True))
            self.conditions.set(_RIVALS, None)

    def _rival_teller(self, device: Device) -> Callable[[tuple[str, ...]], None]:
        """Return what reports other gateways: on ``status`` always, on ``control`` and in the log every TELL_S."""
        robot, told_at = self._plan.config.robot.name, -math.inf

        def tell(zids: tuple[str, ...]) -> None:
            nonlocal told_at
            more = f" and {len(zids) - _NAMED} more" if len(zids) > _NAMED else ""
            text = f"another gateway serves this robot too: {', '.join(zids[:_NAMED])}{more}"
            self.conditions.set(_RIVALS, text if zids else None)
            if zids and time.monotonic() - told_at >= TELL_S:
                told_at = time.monotonic()
                log.error("%s: %s", robot, text)
                for zid in zids[:_NAMED]:
                    device.refuse("claim", Held("this gateway serves the robot"), zid)

        return tell

    def _device(self, bus: Bus, audit: Audit, plan: DevicePlan) -> Device:
        control = self._plan.config.control
        limited = control.rate_hz is not None or control.slew_per_s is not None
        return Device(
            plan.protocol.robot(plan.options, len(plan.addresses), self.metrics),
            plan.addresses,
            protocol=plan.protocol.name,
            keys=self._keys,
            bus=bus,
            authority=Authority(control.lease_s, control.deadman_s, secrets.token_bytes),
            limits=MotionLimits(control.rate_hz or math.inf, control.slew_per_s or math.inf) if limited else None,
            manager=self.sessions,
            metrics=self.metrics,
            audit=audit,
            conditions=self.conditions,
            idle_stop_s=control.idle_stop_s,
            clock=time.monotonic,  # the time line of event loops on Linux, without their rounding
        )

    @contextlib.contextmanager
    def _audit(self) -> Iterator[Audit]:
        """Open the audit log: the file that the configuration names, else the process's log at DEBUG."""
        control, name = self._plan.config.control, self._plan.config.robot.name
        if control.audit is None or self._plan.device is None:
            yield Audit(name, logging.getLogger("zbridge.control.audit_log").debug)
            return
        loop = asyncio.get_running_loop()

        def tell(text: str | None) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self.conditions.set, "audit", text)

        file = AuditFile(
            Path(control.audit),
            self.metrics,
            file_bytes=control.audit_bytes,
            files=control.audit_files,
            days=control.audit_days,
            tell=tell,
        )
        audit = Audit(name, file.write)
        try:
            yield audit
        finally:
            audit.close()
            file.close()


async def together(*work: Coroutine[Any, Any, None]) -> None:
    """Run coroutines until all have ended, or one fails: then cancel the others and raise its exception."""
    tasks = [asyncio.ensure_future(each) for each in work]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
        for task in tasks:
            if task.done():
                task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.shield(asyncio.gather(*tasks, return_exceptions=True))


async def until_signal(work: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine until it ends, or SIGTERM or SIGINT comes: then cancel it and wait until it has ended."""
    task = asyncio.ensure_future(work)
    loop = asyncio.get_running_loop()
    asked: list[int] = []

    def end(number: int) -> None:
        """Cancel once: a second signal must not interrupt the end."""
        if not asked:
            task.cancel()
        asked.append(number)

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, end, number)
    with contextlib.suppress(asyncio.CancelledError):
        await task
