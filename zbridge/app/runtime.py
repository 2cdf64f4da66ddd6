"""What a gateway takes from its machine.

Clocks, randomness, sockets, processes, a folder, the bus, and the file of its audit log. A simulation injects its own
:class:`Runtime`.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import secrets
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

from zbridge.app.config import GatewayPlan
from zbridge.app.handover.processes import PROCESSES, Processes
from zbridge.app.joining import can_connect, join_bus
from zbridge.app.process_usage import USAGE, ProcessUsage
from zbridge.bus import Bus
from zbridge.clocks import Clocks
from zbridge.control.audit_log import Audit, AuditFile
from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.log import Log
from zbridge.metrics import Metrics
from zbridge.transport.kernel import KERNEL, Kernel

log = Log("zbridge.control.audit_log")


class Runtime(Clocks, frozen=True):
    """The machine below one gateway.

    chance: 0 to 1. secret: so many random bytes. folder: where latched stops are kept; None: where
    :func:`zbridge.control.latch_store.state_folder` says. processes: for a restart. join: opens the bus, however long
    that takes. can_connect: whether a second session connects to it. usage: of this process.
    """

    chance: Callable[[], float] = random.random
    secret: Callable[[int], bytes] = secrets.token_bytes
    kernel: Kernel = KERNEL
    folder: Path | None = None
    processes: Processes = PROCESSES
    join: Callable[[GatewayPlan, Metrics], Awaitable[Bus]] = join_bus
    can_connect: Callable[[GatewayPlan], Awaitable[bool]] = can_connect
    usage: ProcessUsage = USAGE


RUNTIME = Runtime()
"""This machine."""


@contextlib.contextmanager
def open_audit(plan: GatewayPlan, metrics: Metrics, open_faults: OpenFaults) -> Iterator[Audit]:
    """Open the audit log: the file that the configuration names, else the process's log at DEBUG."""
    control, name = plan.config.control, plan.config.robot.name
    if control.audit is None or plan.device is None:
        yield Audit(name, lambda line: log.debug("audit", "{line}", line=line))
        return
    loop = asyncio.get_running_loop()

    def report(text: str | None) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(open_faults.set, FaultCode.AUDIT_LOG, text)

    file = AuditFile(
        Path(control.audit),
        metrics,
        file_bytes=control.audit_bytes,
        files=control.audit_files,
        days=control.audit_days,
        tell=report,
    )
    audit = Audit(name, file.write)
    try:
        yield audit
    finally:
        audit.close()
        file.close()
