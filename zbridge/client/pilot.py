"""Drives one robot by one stick: acquires the lease, sends the stick's commands, and releases it. Knows no device.

Theory of operation. The stick (:mod:`zbridge.lease.stick`) decides, and the pilot acts. A task holds the lease
from ACQUIRE on; it ends with the lease. While the lease is held, a drive is sent within :meth:`Pilot.drive`. The newest
command waits for the lease, or for a mode in transit, for at most :data:`STALE_S`. A timer serves the stick's
deadlines.

A lease that ends without :meth:`Pilot.release` is reported once, and the stick then needs neutral. A refused command
ends the lease if the stick's rules say so; otherwise :meth:`Pilot.drive` raises the refusal. Only one request for the
lease runs at a time: a task waits until the previous one has released its lease.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager

from zbridge.client.driver import Driver
from zbridge.errors import BusError, LeaseLost, NeutralFirst, RateLimited, Refused, ZbridgeError, describe
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Motor
from zbridge.fleet.topics import Topic
from zbridge.lease.stick import Stick, StickAction

STALE_S = 0.4
"""Seconds after which a drive that waits for the lease is dropped."""
MODES = 8
"""Most modes in transit; one more is refused."""
_RELEASED = "the robot was released"


class Pilot:
    """Drives one robot for one user. All calls belong on the event loop's thread.

    control: acquires the lease, as :meth:`zbridge.client.Robot.control` does. on_end: called when the lease, or the
    wait for it, ends, with the reason; None: it was released. turn: shared by pilots that may acquire only one after
    another.
    """

    def __init__(
        self,
        stick: Stick,
        control: Callable[[], AbstractAsyncContextManager[Driver]],
        *,
        on_end: Callable[[ZbridgeError | None], None] = lambda error: None,
        turn: asyncio.Lock | None = None,
    ) -> None:
        self.stick = stick
        self.mode = "none"
        """The mode that was set with this lease."""
        self._control = control
        self._on_end = on_end
        self._turn = turn or asyncio.Lock()
        self._loop = asyncio.get_running_loop()
        self._driver: Driver | None = None
        """While the lease is held."""
        self._waiting: tuple[Topic, Drive | Motor, float] | None = None
        """The newest command that could not be sent, and when it came."""
        self._granted: asyncio.Future[Driver] = self._loop.create_future()
        self._setting = 0
        """Modes that are not set yet."""
        self._task: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        """Including those that release their lease."""
        self._timer: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<Pilot with {self.stick!r}, mode {self.mode}>"

    @property
    def refusal(self) -> Refused | None:
        """Why the robot's gateway refused a command, until the next motion raises it."""
        return self._driver.refusal if self._driver is not None else None

    def drive(self, drive: Drive) -> None:
        """Take a position of the stick; raise NeutralFirst if neutral is needed, Refused as the robot's gateway did."""
        self._command(topics.CMD_DRIVE, drive)

    def motor(self, name: str, value: float) -> None:
        """Move one motor (rad/s, or metres for a linear motor) as :meth:`drive` moves the robot; 0 is neutral."""
        self._command(topics.CMD_MOTOR(name), Motor(value))

    def rest(self) -> None:
        """Take a centred stick without a command: of a robot that accepts no drive, and whose motors were not moved."""
        self.stick.neutral(self._loop.time())

    def _command(self, topic: Topic, command: Drive | Motor) -> None:
        now = self._loop.time()
        self._expire(now)
        self.stick.heard(now)
        action = self.stick.motion(now) if command.moving else self.stick.neutral(now)
        if action is StickAction.SEND:
            self._send(topic, command, now)
        elif action is not StickAction.NOTHING:
            self._waiting = (topic, command, now)
            if action is StickAction.ACQUIRE:
                self._begin()
        self._arm()

    def take(self) -> None:
        """Acquire the lease without motion; release it, unless the stick's rules do."""
        if self.stick.want(self._loop.time()) is StickAction.ACQUIRE:
            self._begin()

    async def set_mode(self, mode: str) -> None:
        """Set who moves the robot, and keep the lease until the mode is none; raise Refused or BusError."""
        if self._setting >= MODES:
            raise RateLimited("too many changes of the mode at the same time")
        self._setting += 1
        self.stick.in_use = True
        self.take()
        try:
            driver = await asyncio.shield(self._granted)
            try:
                await driver.mode(mode)
            except Exception as error:
                if self._driver is driver:
                    self._outlasts(error)
                raise _known(error) from error
            if self._driver is not driver:
                raise LeaseLost(_RELEASED)
            self.mode = mode
        finally:
            self._setting -= 1
            self.stick.in_use = self.mode != "none" or self._setting > 0
            self._arm()
        self._send_waiting()

    def require_neutral(self, why: str) -> None:
        """Drop the motion that waits; the stick must be centred once, because it may still be deflected."""
        if self._waiting is not None and self._waiting[1].moving:
            self._waiting = None
        self.stick.refused(why)

    def release(self) -> None:
        """Release the lease, or stop acquiring it; a moving robot is stopped. Idempotent."""
        if self.stick.active:
            self._end(None)

    async def close(self) -> None:
        """Release the lease, and wait until that is done."""
        self.release()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    # The lease

    def _begin(self) -> None:
        self._granted = self._loop.create_future()
        self._task = task = self._loop.create_task(self._hold())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _hold(self) -> None:
        """Hold the lease until it ends."""
        me = asyncio.current_task()
        try:
            async with self._turn, self._control() as driver:
                self._driver = driver
                self.stick.granted()
                self._granted.set_result(driver)
                self._send_waiting()
                self._arm()
                if self._driver is driver:
                    await driver.lost.wait()
                    raise driver.loss or LeaseLost("the lease is lost")
        except Exception as error:
            if self._task is me:
                self._end(error)

    def _end(self, error: Exception | None) -> None:
        """Record the end of the lease, and why."""
        task, self._task = self._task, None
        if task is not None and task is not asyncio.current_task():
            task.cancel()
        self._driver = self._waiting = None
        self.stick.in_use = False
        failure = None if error is None else _known(error)
        if failure is None:
            self.stick.released()
        else:
            self.stick.lost(str(failure))
        if self._setting and not self._granted.done():
            self._granted.set_exception(failure or LeaseLost(_RELEASED))
        self._on_end(failure)
        self.mode = "none"

    # What is sent

    def _send_waiting(self) -> None:
        if self._waiting is not None and self._driver is not None:
            self._send(*self._waiting)

    def _send(self, topic: Topic, command: Drive | Motor, came_at: float) -> None:
        """Send a command, or let it wait; raise Refused if the lease outlasts that."""
        assert self._driver is not None, "a command without a lease"
        self._waiting = None
        stale = self._loop.time() - came_at >= STALE_S
        if stale or (command.moving and self.stick.needs_neutral is not None):
            return
        try:
            if self._setting or not self._driver.now(command, topic):
                self._waiting = (topic, command, came_at)
        except Exception as error:
            if self._outlasts(error):
                raise

    def _outlasts(self, error: Exception) -> bool:
        """End the lease, unless the rules keep it after this error; return whether they do."""
        if isinstance(error, LeaseLost) or not isinstance(error, Refused) or not self.stick.rules.keeps:
            self._end(error)
            return False
        if isinstance(error, NeutralFirst):
            self.require_neutral("motion was refused")
        return True

    # Time

    def _expire(self, now: float) -> None:
        if self.stick.expire(now) or self.stick.wants_release(now):
            self.release()

    def _arm(self) -> None:
        """Wake at the stick's deadline, or before it: most drives postpone it."""
        deadline = self.stick.deadline()
        if self._timer is not None and self._timer.when() > deadline:
            self._timer.cancel()
            self._timer = None
        if self._timer is None and deadline < math.inf:
            self._timer = self._loop.call_at(deadline, self._on_timer)

    def _on_timer(self) -> None:
        self._timer = None
        self._expire(self._loop.time())
        self._arm()


def _known(error: Exception) -> ZbridgeError:
    return error if isinstance(error, ZbridgeError) else BusError(describe(error))
