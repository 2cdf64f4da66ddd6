"""The right to drive one robot, as programs use it; a :class:`LeaseHolder` keeps the lease itself."""

from __future__ import annotations

import asyncio
import contextlib
import getpass
import socket
from collections.abc import Callable, Coroutine
from typing import Any

from zbridge.bus import Bus, Sample
from zbridge.bus.tls.membership import Right, no_answer, require_right
from zbridge.clocks import raw_ms
from zbridge.errors import BusError, Held, LeaseLost, NeutralFirst, PayloadError, Refused
from zbridge.errors import refusal as refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Acquire
from zbridge.fleet.messages import Control, Drive, FleetMessage, Mode, Motor, Raw, Refusal
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.lease.commands import CommandPublishers
from zbridge.lease.lease_client import LeaseClient
from zbridge.lease.lease_events import NAMED, LeaseEvent, LeaseEventKind
from zbridge.lease.lease_holder import LeaseHolder

REPEAT_S = 0.05
"""Seconds between the commands of :meth:`Driver.during`."""
SETTLED_S = 0.15
"""Seconds until ``control`` has shown the refusals from before a neutral; a gateway shows them within 0.05 s."""
_MOVING = ("drive", "mode", "motor/", "raw/")
"""Prefixes of the names of commands that need the lease."""


def default_who() -> str:
    """Return the name of this program, ``user@host``."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # the user id has no name
        user = "somebody"
    return f"{user}@{socket.gethostname()}"


class Driver:
    """The lease of one robot: call ``await drive(forward=0.3)`` repeatedly, because motion lasts only ``deadman_s``.

    ``lost`` is set when the lease is lost; from then on every command raises LeaseLost with the reason and the new
    holder. If the gateway refused a command, the next command raises Refused: NeutralFirst if the robot was stopped,
    for example because the program was paused; then call :meth:`neutral`, and start a new motion.
    """

    def __init__(
        self,
        bus: Bus,
        keys: KeySpace,
        request: Acquire,
        name: str,
        *,
        takeover: bool,
        wait_s: float,
        clock_ms: Callable[[], float] = raw_ms,
    ) -> None:
        self._clock_ms = clock_ms
        self.who = request.who[:NAMED]
        self.robot = keys.robot
        self.lost = asyncio.Event()
        self.loss: LeaseLost | None = None
        self._bus = bus
        self._keys = keys
        self._name = name
        self._takeover = takeover
        self._wait_s = wait_s
        self._client = LeaseClient(
            keys, request, name, concerns=self._concerns, clock_ms=clock_ms, takeover=takeover, wait_s=wait_s
        )
        loop = asyncio.get_running_loop()
        self._holder = LeaseHolder(bus, self._client, spawn=self._spawn, on_event=self._on_event, clock=loop.time)
        self._granted: asyncio.Future[None] = loop.create_future()
        self._tasks: set[asyncio.Task[None]] = set()
        self._lock = asyncio.Lock()
        self._refusal: Refused | None = None
        self._commands = CommandPublishers(bus, keys)

    def __repr__(self) -> str:
        return f"<Driver of {self.robot} {'lost' if self.loss else 'holding'}>"

    async def __call__(
        self, forward: float = 0.0, left: float = 0.0, turn: float = 0.0, *, light: bool | None = None
    ) -> None:
        """Drive: fractions of full scale, -1 to 1, ``turn`` counter-clockwise; all zero is neutral.

        Raises ValueError if a value is outside -1..1, LeaseLost, or Refused with the gateway's reason.
        """
        for name, value in (("forward", forward), ("left", left), ("turn", turn)):
            if not -1.0 <= value <= 1.0:
                raise ValueError(f"{name} = {value!r}: expected -1 to 1")
        await self._send(topics.CMD_DRIVE, Drive(forward=forward, left=left, turn=turn, light=light))
        await asyncio.sleep(0)  # a program that drives in a loop must get a chance to notice a loss

    async def during(self, seconds: float, forward: float = 0.0, left: float = 0.0, turn: float = 0.0) -> None:
        """Drive for ``seconds``, then send neutral; raise as a call does."""
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        while (left_s := end - loop.time()) > 0:
            await self(forward, left, turn)
            await asyncio.sleep(min(REPEAT_S, left_s))
        await self()

    async def neutral(self) -> None:
        """Send neutral: how a program answers NeutralFirst, before it starts a new motion.

        The gateway stops a robot whose driver was paused for longer than ``deadman_s``, and refuses motion until a
        neutral: a program that wakes up must not move a robot before it decides to. Refusals of motion sent earlier are
        dropped for :data:`SETTLED_S`; the next motion raises a later one: answer it in the same way. For a robot that
        is driven by motors, ``motor(name, 0.0)`` is neutral. Raises LeaseLost, or Refused as a call does.
        """
        for settled_s in (SETTLED_S, 0.0):  # twice: a full bus drops drives
            if isinstance(self._refusal, NeutralFirst):
                self._refusal = None
            await self()
            await asyncio.sleep(settled_s)
        if isinstance(self._refusal, NeutralFirst):
            self._refusal = None

    async def motor(self, name: str, value: float) -> None:
        """Move one motor: rad/s, or metres for a linear motor; must be repeated like a drive."""
        await self._send(topics.CMD_MOTOR(name), Motor(value))

    async def mode(self, mode: str) -> None:
        """Set who moves the robot: ``none``, ``manual`` or ``autonomous`` (for as long as the lease is held)."""
        if mode not in ("none", "manual", "autonomous"):
            raise ValueError(f"mode = {mode!r}: expected 'none', 'manual' or 'autonomous'")
        await self._send(topics.CMD_MODE, Mode(mode))  # type: ignore[arg-type]

    async def raw(self, protocol: str, message_id: int, body: bytes = b"") -> None:
        """Send a legacy message that no fleet message represents."""
        await self._send(topics.CMD_RAW(protocol), Raw(id=message_id, body=body))

    def now(self, command: Drive | Motor, topic: Topic = topics.CMD_DRIVE) -> bool:
        """Send a drive, or a motor's command on its topic, without waiting, for callbacks; raise as a call does.

        False: nothing was sent, because it must not overtake another command in transit.
        """
        if self._lock.locked():
            return False
        refusal, _ = self._put(topic, command, self._clock_ms())
        if refusal is not None:
            raise refusal
        return True

    @property
    def refusal(self) -> Refused | None:
        """Why the robot's gateway refused a command, until the next motion raises it."""
        return self._refusal

    async def _send(self, topic: Topic, message: FleetMessage) -> None:
        given_ms = self._clock_ms()
        async with self._lock:
            refusal, unwritten = self._put(topic, message, given_ms)
            if unwritten:
                await self._bus.flush()
            if refusal is not None:
                raise refusal

    def _put(self, topic: Topic, message: FleetMessage, given_ms: float) -> tuple[Refused | None, bool]:
        """Put a command; return the refusal of an earlier one that is to be raised now that neutral was sent.

        given_ms: the raw clock when the program gave it. Also returns whether the bus must be flushed.
        """
        if self.loss is not None:
            loss = LeaseLost(str(self.loss), self.loss.code, holder=self.loss.holder)
            loss.expired = self.loss.expired
            raise loss  # a new exception each time: the traceback of a raised one grows
        refusal, self._refusal = self._refusal, None
        if refusal is not None and getattr(message, "moving", True):
            raise refusal
        unwritten = self._commands.put(topic, message, self._client, given_ms)
        return refusal, unwritten

    # The lease

    async def acquire(self) -> None:
        """Acquire the lease.

        Raises Held if another program has it, Malformed for an invalid request; after ``wait_s`` NotReady or
        RateLimited if the gateway kept refusing so, BusError if none answered; BusRefused, at once, if a router knows
        this program by a role that may not drive.
        """
        right = Right.TAKE_OVER if self._takeover else Right.DRIVE
        await require_right(self._bus.ask, self._keys.realm, self._name, right, self.robot)
        self._holder.announce()
        with contextlib.suppress(BusError, PayloadError):
            for answer in await self._bus.ask(self._keys.key(topics.CONTROL.path), timeout_s=0.3):
                if answer.error is None:  # ignore the refusals of an earlier program of this name
                    self._client.news.take(payloads.decode(Control, answer.payload))
                    break
        self._spawn(self._holder.keep())
        self._holder.want()
        await self._granted

    def read_control(self, sample: Sample) -> None:
        """Handle news from ``control``: the holder of the lease, and refusals of this program's commands."""
        try:
            control = payloads.decode(Control, sample.payload)
        except PayloadError:
            return
        for refusal in self._holder.read_control(control):
            text = f"{self.robot}: {refusal.command}: {refusal.reason}"
            self._refusal = refused(refusal.code, text)

    async def release(self) -> None:
        """Release the lease and wait for the answer; a moving robot is stopped."""
        for task in self._tasks:
            task.cancel()
        self._granted.cancel()
        if self.loss is None:
            self._lose("released")
        self._holder.close()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._holder.withdraw()
        self._commands.close()

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _concerns(self, refusal: Refusal) -> bool:
        return refusal.who == self.who and refusal.command.startswith(_MOVING)

    def _on_event(self, event: LeaseEvent) -> None:
        if event.kind is LeaseEventKind.LOST:
            self._lose("the gateway does not answer" if event.unanswered else str(event.error), event)
        elif not self._granted.done():
            if event.kind is LeaseEventKind.GRANTED:
                self._granted.set_result(None)
            else:
                self._granted.set_exception(self._denial(event))

    def _denial(self, event: LeaseEvent) -> Exception:
        """Return the exception for a lease that was not granted."""
        error = event.error
        if event.unanswered or error is None:
            return BusError(f"{self.robot}: {no_answer(self._name, self._wait_s)}")
        if isinstance(error, Held):
            expires = f", {event.expires_in_s:.1f} s left" if event.expires_in_s is not None else ""
            return Held(f"{self.robot} is {error}{expires}", holder=error.holder)
        if isinstance(error, Refused):
            return refused(error.code, f"{self.robot}: {error}")
        return error

    def _lose(self, reason: str, event: LeaseEvent | None = None) -> None:
        holder = event.holder if event is not None else None
        text = f"{self.robot}: {reason}" + (f"; held by {holder}" if holder else "")
        self.loss = LeaseLost(text, holder=holder)
        self.loss.expired = event is not None and event.expired
        self.lost.set()
