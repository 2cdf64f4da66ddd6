"""Drives one robot for one viewer: holds the lease in its name while it drives, and gives it back when it pauses.

Theory of operation. :meth:`Pilot.drive` stores the newest Twist and wakes a task, which acquires the robot, hands on
what comes, and releases the robot when nothing came for ``PAUSE_S``: before the gateway's deadman, so that the next
Twist may begin with motion. A mode other than none holds the lease until the mode is none again or the viewer is gone.
After a stop, a refusal or a loss the viewer owes a zero or a second of silence (:class:`Debt`).
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable

from zbridge.client import Driver, Robot
from zbridge.errors import BusError, LeaseLost, NeutralFirst, TooFast, ZbridgeError, describe
from zbridge.fleet.messages import Drive
from zbridge.views.foxglove.twist import Debt

DEADMAN_S = 0.5
"""The gateway stops a robot whose viewer's Twists stay away so long, should this process be gone or stand still."""
PAUSE_S = 0.4
"""Silence after which a robot is stopped and released."""
WAIT_S = 2.0
"""Longest wait for the robot's gateway."""


class Pilot:
    """Holds a robot for a viewer, from its first Twist or mode on.

    who, name: as for :meth:`zbridge.client.Robot.control`. tell: tells the person what was not carried out. on_mode:
    called when the mode that the viewer has set ends with the lease.
    """

    def __init__(
        self, robot: Robot, who: str, name: str, tell: Callable[[str], None], on_mode: Callable[[str], None]
    ) -> None:
        self.mode = "none"
        self._on_mode = on_mode
        self._robot = robot
        self._who = who
        self._name = name
        self._tell = tell
        self._debt = Debt()
        self._clock = asyncio.get_running_loop().time
        self._drive: Drive | None = None
        self._drive_at = 0.0
        self._modes: asyncio.Queue[tuple[str, asyncio.Future[None]]] = asyncio.Queue(8)
        self._came = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    def __repr__(self) -> str:
        return f"<Pilot {self._who} of {self._robot.name}, mode {self.mode}, {self._debt!r}>"

    @property
    def at_work(self) -> bool:
        """Whether the lease is held or asked for."""
        return self._task is not None and not self._task.done()

    def drive(self, drive: Drive) -> None:
        """Carry out a Twist, soon; the newest wins. Raise Refused if the viewer owes a zero."""
        if not self._debt.pays(moving=drive.moving, now=self._clock()):
            raise NeutralFirst(f"{self._debt.why}; let go for a second, then drive")
        if drive.moving or self.at_work:
            self._drive, self._drive_at = drive, self._clock()
            self._wake()

    async def set_mode(self, mode: str) -> None:
        """Set who moves the robot; raise Refused or BusError."""
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        try:
            self._modes.put_nowait((mode, done))
        except asyncio.QueueFull:
            raise TooFast("too many changes of the mode at the same time") from None
        self._wake()
        await done

    def stopped(self) -> None:
        """Take note that the robot is being stopped: motion that comes now was meant before."""
        self._drive = None
        self._debt.owe(f"{self._robot.name} was stopped")

    async def end(self) -> None:
        """Release the robot: its viewer is gone."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

    def _wake(self) -> None:
        self._came.set()
        if not self.at_work:
            self._task = asyncio.get_running_loop().create_task(self._hold())

    async def _hold(self) -> None:
        """Acquire the robot, and drive it until there is nothing to hold it for."""
        failed: Exception = LeaseLost("the robot was released")
        try:
            async with self._robot.control(self._who, name=self._name, deadman_s=DEADMAN_S, wait_s=WAIT_S) as driver:
                lost = asyncio.create_task(driver.lost.wait())
                lost.add_done_callback(lambda _: self._came.set())
                try:
                    while await self._next(driver):
                        pass
                finally:
                    lost.cancel()
        except ZbridgeError as error:
            failed = error
            self._debt.owe(str(error))
            self._tell(str(error))
        except Exception as error:  # told, for nobody awaits this task
            failed = BusError(describe(error))
            self._tell(describe(error))
        finally:
            if self.mode != "none":
                self._on_mode("none")
            self.mode, self._drive = "none", None
            while not self._modes.empty():
                _, done = self._modes.get_nowait()
                if not done.done():
                    done.set_exception(failed)

    async def _next(self, driver: Driver) -> bool:
        """Carry out what comes next; False when the robot is to be released."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PAUSE_S):
                await self._came.wait()
        came = self._came.is_set()
        self._came.clear()
        if driver.loss is not None:
            raise driver.loss
        while not self._modes.empty():
            await self._set_mode(driver)
        drive, self._drive = self._drive, None
        if drive is not None and self._clock() - self._drive_at < PAUSE_S:  # an older one waited for the lease
            await driver(drive.forward, drive.left, drive.turn)
        return came or self.mode != "none"

    async def _set_mode(self, driver: Driver) -> None:
        mode, done = self._modes.get_nowait()
        try:
            await driver.mode(mode)
        except BaseException as error:
            if not done.done():
                done.set_exception(error if isinstance(error, ZbridgeError) else BusError("the viewer is gone"))
            raise
        self.mode = mode
        if not done.done():
            done.set_result(None)
