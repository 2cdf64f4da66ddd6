"""Coroutines that run together, until an event, or until a signal: each ends with all that it started."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from typing import Any, TypeVar

from zbridge.log import Log

T = TypeVar("T")

log = Log("zbridge.app")


class Tasks:
    """Tasks that run beside what their owner does. What one raises is logged."""

    def __init__(self) -> None:
        self.running: set[asyncio.Task[None]] = set()

    def __len__(self) -> int:
        return len(self.running)

    def __repr__(self) -> str:
        return f"<Tasks {len(self)}>"

    def start(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine from now on, until it ends, or until :meth:`cancel`."""
        task = asyncio.ensure_future(work)
        self.running.add(task)
        task.add_done_callback(self._done)

    def cancel(self) -> None:
        """Cancel the tasks that still run."""
        for task in self.running:
            task.cancel()

    async def end(self) -> None:
        """Cancel the tasks that still run, and wait for their ends."""
        self.cancel()
        await asyncio.gather(*self.running, return_exceptions=True)

    def _done(self, task: asyncio.Task[None]) -> None:
        self.running.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            log.error("task_failed", "{error}", error=error, exc_info=error)


async def together(*work: Coroutine[Any, Any, None], first: Callable[[], Awaitable[None]] | None = None) -> None:
    """Run coroutines until all have ended, or one fails: then cancel the others and raise its exception.

    first: awaited before any of them is cancelled.
    """
    tasks = [asyncio.ensure_future(each) for each in work]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
        for task in tasks:
            if task.done():
                task.result()
    finally:
        try:
            if first is not None:
                await asyncio.shield(first())
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.shield(asyncio.gather(*tasks, return_exceptions=True))


async def race(*work: Coroutine[Any, Any, object]) -> None:
    """Run coroutines until one of them ends: then cancel the others, wait for their ends, and raise what it raised."""
    tasks = [asyncio.ensure_future(each) for each in work]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.shield(asyncio.gather(*tasks, return_exceptions=True))


async def occurs(event: asyncio.Event, within_s: float | None) -> bool:
    """Wait for an event, so long at most (None: as long as it takes); return whether it is set."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(within_s):  # wait_for of Python 3.11 may lose a cancellation
            await event.wait()
    return event.is_set()


async def until(event: asyncio.Event, work: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine until it ends, or an event is set: then cancel it and wait until it has ended."""
    await race(work, event.wait())


async def until_signal(
    work: Coroutine[Any, Any, T], on: Mapping[int, Callable[[], Coroutine[Any, Any, None]]] | None = None
) -> T | None:
    """Run a coroutine until it ends, and return its result; or until SIGTERM or SIGINT: then end it, and return None.

    ``on``: what other signals run beside.
    """
    task = asyncio.ensure_future(work)
    loop = asyncio.get_running_loop()
    asked: list[int] = []

    def end(number: int) -> None:
        """Cancel once: a second signal must not interrupt the end."""
        if not asked:
            task.cancel()
        asked.append(number)

    beside = Tasks()

    def start(begin: Callable[[], Coroutine[Any, Any, None]]) -> None:
        beside.start(begin())

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, end, number)
    for other, begin in (on or {}).items():
        loop.add_signal_handler(other, start, begin)
    with contextlib.suppress(asyncio.CancelledError):
        return await task
    return None
