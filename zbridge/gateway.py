"""One gateway process: the bus, the claim on the robot, its device side, and the counters' endpoint."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import secrets
import signal
import time
from collections.abc import Coroutine, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from zbridge.audit import Audit, AuditFile
from zbridge.bus import Bus, open_bus
from zbridge.claim import Claim
from zbridge.config import Plan
from zbridge.device import Device
from zbridge.errors import BusError
from zbridge.exporter import serve_metrics
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics
from zbridge.session.control import TOKEN_BYTES, Authority
from zbridge.session.manager import SessionManager
from zbridge.session.motion import MotionLimits

log = logging.getLogger("zbridge.gateway")

RETRY_S = 1.0
"""Seconds between attempts to open the bus."""


class Gateway:
    """A gateway from its plan to its end."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self.left = True
        """Whether the bus was left in order; if not, its threads may hang."""
        self.metrics = Metrics()
        self.sessions = SessionManager()

    def __repr__(self) -> str:
        return f"<Gateway {self._plan.config.robot.name}>"

    async def run(self) -> None:
        """Serve the robot until cancelled; leave it standing still and the bus in order."""
        with self._audit() as audit:
            await self._run(audit)

    async def _run(self, audit: Audit) -> None:
        robot = self._plan.config.robot
        bus = await self._open_bus()
        claim = Claim(bus, KeySpace(robot.realm, robot.name))
        try:
            async with contextlib.AsyncExitStack() as stack:
                if self._plan.metrics is not None:
                    await stack.enter_async_context(serve_metrics(self._plan.metrics, self.metrics))
                while True:
                    await claim.take()
                    await self._serve(bus, claim, audit)
        finally:
            claim.release()
            self.left = await bus.close()

    async def _serve(self, bus: Bus, claim: Claim, audit: Audit) -> None:
        """Serve the robot until another gateway turns out to have the better claim."""
        serving = asyncio.ensure_future(self._device(bus, audit).run())
        losing = asyncio.ensure_future(claim.lost())
        try:
            await asyncio.wait((serving, losing), return_when=asyncio.FIRST_COMPLETED)
            if serving.done():
                serving.result()
        finally:
            for task in (serving, losing):
                task.cancel()
            await asyncio.shield(asyncio.gather(serving, losing, return_exceptions=True))

    def _device(self, bus: Bus, audit: Audit) -> Device:
        plan, config = self._plan, self._plan.config
        control = config.control
        return Device(
            plan.protocol.robot(plan.options, len(plan.addresses), self.metrics),
            plan.addresses,
            protocol=plan.protocol.name,
            keys=KeySpace(config.robot.realm, config.robot.name),
            bus=bus,
            authority=Authority(control.lease_s, control.deadman_s, partial(secrets.token_bytes, TOKEN_BYTES)),
            limits=MotionLimits(control.rate_hz or math.inf, control.slew_per_s or math.inf),
            manager=self.sessions,
            metrics=self.metrics,
            audit=audit,
            clock=time.monotonic,  # the time line of every event loop on Linux, without its rounding
        )

    @contextlib.contextmanager
    def _audit(self) -> Iterator[Audit]:
        """Keep the audit log open: a file where the configuration names one, always the gateway's own log."""
        control, name = self._plan.config.control, self._plan.config.robot.name
        if control.audit is None:
            yield Audit(name, logging.getLogger("zbridge.audit").debug)
            return
        file = AuditFile(Path(control.audit), self.metrics, file_bytes=control.audit_bytes, files=control.audit_files)
        try:
            yield Audit(name, file.write)
        finally:
            file.close()

    async def _open_bus(self) -> Bus:
        while True:
            try:
                return await open_bus(self._plan.config.bus, self.metrics)
            except BusError as error:
                log.warning("no bus: %s; next attempt in %g s", error, RETRY_S)
                await asyncio.sleep(RETRY_S)


async def until_signal(work: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine until it ends or SIGTERM or SIGINT comes; then cancel it and wait for it to tidy up."""
    task = asyncio.ensure_future(work)
    loop = asyncio.get_running_loop()
    asked: list[int] = []

    def end(number: int) -> None:
        """Cancel once: a second signal must not cut the tidying up short."""
        if not asked:
            task.cancel()
        asked.append(number)

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, end, number)
    with contextlib.suppress(asyncio.CancelledError):
        await task
