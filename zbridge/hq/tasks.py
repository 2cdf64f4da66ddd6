"""The tasks that one listener starts and has to end."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any


class Tasks:
    """The tasks of one listener. A task is kept until it ends, or until :meth:`cancel`."""

    def __init__(self) -> None:
        self.running: set[asyncio.Task[None]] = set()

    def __repr__(self) -> str:
        return f"<Tasks {len(self.running)}>"

    def start(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine on the running event loop."""
        task = asyncio.get_running_loop().create_task(work)
        self.running.add(task)
        task.add_done_callback(self.running.discard)

    def cancel(self) -> None:
        """Cancel the tasks that still run."""
        for task in tuple(self.running):
            task.cancel()
