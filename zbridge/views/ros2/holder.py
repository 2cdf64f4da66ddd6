"""Holds the lease of one robot for the publisher that drives it, through the client's lease."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable

from zbridge.client import Driver, Robot
from zbridge.errors import ZbridgeError, describe
from zbridge.fleet.messages import Drive
from zbridge.views.ros2.driving import DEADMAN_S

STALE_S = 0.4
"""A command that waited so long for the lease is not carried out."""
WAIT_S = 2.0
"""Longest wait for the robot's gateway."""
NAME = "ros2"
"""The first part of the holder's name where no certificate says another; the publisher's node follows."""


class Holder:
    """One lease after the other. name: the first part of the holder's; on_lost: called with the reason of a loss."""

    def __init__(self, robot: Robot, name: str, on_lost: Callable[[str], None]) -> None:
        self._robot = robot
        self._name = name
        self._on_lost = on_lost
        self._clock = asyncio.get_running_loop().time
        self._came = asyncio.Event()
        self._drive: Drive | None = None
        self._drive_at = 0.0
        self._driver: Driver | None = None
        """While the lease is held."""
        self._failed: Exception | None = None
        """Why the last command was not sent."""
        self._task: asyncio.Task[None] | None = None
        self._earlier: set[asyncio.Task[None]] = set()
        """Tasks that release their lease."""

    def __repr__(self) -> str:
        return f"<Holder of {self._robot.name} {'at work' if self._task is not None else 'idle'}>"

    def acquire(self, node: str, drive: Drive) -> None:
        """Ask for the robot in the name of a node, and carry the command out when it is granted."""
        self.release()
        self._task = asyncio.get_running_loop().create_task(self._hold(f"{self._name}.{node.strip('/')}"))
        self.send(drive)

    def send(self, drive: Drive) -> None:
        """Carry out a command, at once while the lease is held; the newest of those that wait for it wins."""
        if self._driver is not None and self._drive is None:
            try:
                if self._driver.now(drive):
                    return
            except Exception as error:  # the task that holds the lease tells it
                self._failed = error
        self._drive, self._drive_at = drive, self._clock()
        self._came.set()

    def release(self) -> None:
        """Give the robot back; it is stopped if it moves."""
        task, self._task = self._task, None
        self._drive = self._driver = self._failed = None
        if task is not None and not task.done():
            self._earlier.add(task)
            task.add_done_callback(self._earlier.discard)
            task.cancel()

    async def close(self) -> None:
        """Give the robot back, and wait until it is."""
        self.release()
        await asyncio.gather(*self._earlier, return_exceptions=True)

    async def _hold(self, who: str) -> None:
        me = asyncio.current_task()
        why = "the robot was released"
        try:
            if self._earlier:
                await asyncio.wait(tuple(self._earlier))
            async with self._robot.control(who, name=self._name, deadman_s=DEADMAN_S, wait_s=WAIT_S) as driver:
                await self._drive_on(driver)
        except ZbridgeError as error:
            why = str(error)
        except Exception as error:  # nobody awaits this task
            why = describe(error)
        if self._task is me:
            self._task = None
            self._on_lost(why)

    async def _drive_on(self, driver: Driver) -> None:
        self._driver = driver
        lost = asyncio.get_running_loop().create_task(driver.lost.wait())
        lost.add_done_callback(lambda _: self._came.set())
        try:
            while driver.loss is None and self._failed is None:
                drive, self._drive = self._drive, None
                if drive is not None and self._clock() - self._drive_at < STALE_S:
                    await driver(drive.forward, drive.left, drive.turn)
                await self._came.wait()
                self._came.clear()
            error = self._failed or driver.loss
            assert error is not None
            raise error
        finally:
            if self._driver is driver:
                self._driver = None
            lost.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await lost
