"""Opens the audit log of a gateway as its configuration wants it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

from zbridge.app.config import Plan
from zbridge.control.audit_log import Audit, AuditFile
from zbridge.control.context import Conditions
from zbridge.metrics import Metrics


@contextlib.contextmanager
def open_audit(plan: Plan, metrics: Metrics, conditions: Conditions) -> Iterator[Audit]:
    """Open the audit log: the file that the configuration names, else the process's log at DEBUG."""
    control, name = plan.config.control, plan.config.robot.name
    if control.audit is None or plan.device is None:
        yield Audit(name, logging.getLogger("zbridge.control.audit_log").debug)
        return
    loop = asyncio.get_running_loop()

    def tell(text: str | None) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(conditions.set, "audit", text)

    file = AuditFile(
        Path(control.audit),
        metrics,
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
