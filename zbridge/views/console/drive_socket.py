"""The socket by which one page drives one robot. Apart from the page's own, so that no picture delays a command."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from zbridge.fleet.messages import Drive
from zbridge.metrics import Metrics
from zbridge.protocol.rate_limit import RateLimit
from zbridge.tasks import race
from zbridge.views.console.drive_link import TICK_S, DriveLink, Due, PageCommand
from zbridge.views.console.journal import Journal
from zbridge.views.console.rights import Action, Caller
from zbridge.views.console.seats import Seat, Seats

MESSAGES_HZ = 200.0
"""Most messages a second; a page that sends more is closed."""
IDLE_S = 1.0
"""Seconds between two looks whether the login of a page that does not drive has ended."""
_MALFORMED, _TOO_MANY = 1003, 1008
_encode = msgspec.json.Encoder().encode


class TakeControl(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="take"):
    """Acquire the robot, or take it over."""

    takeover: bool = False


class GiveControl(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="give"):
    """Give the robot back."""


class ResumeControl(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="resume"):
    """Get the control back that the page had before it was reloaded."""

    token: Annotated[str, msgspec.Meta(max_length=100)]


class SetMode(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="do", tag="mode"):
    """Set who moves the robot."""

    mode: Literal["none", "manual", "autonomous"]


_decode = msgspec.json.Decoder(PageCommand | TakeControl | GiveControl | ResumeControl | SetMode).decode


class DriveSocket:
    """One page that drives, or wants to. is_valid: returns whether its caller may still be there."""

    def __init__(
        self,
        socket: WebSocket,
        seat: Seat,
        seats: Seats,
        caller: Caller,
        is_valid: Callable[[], bool],
        journal: Journal,
        metrics: Metrics,
    ) -> None:
        self._socket = socket
        self._seat = seat
        self._seats = seats
        self._metrics = metrics
        self._caller = caller
        self._is_valid = is_valid
        self._journal = journal
        self._held = False
        self._loop = asyncio.get_running_loop()
        self._link = DriveLink(self._loop.time())
        self._rate = RateLimit(MESSAGES_HZ)
        self._changed = asyncio.Event()
        self._told: dict[str, Any] = {}
        self._timer: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<DriveSocket {self._seat!r}, {self._link!r}>"

    async def serve(self) -> None:
        """Serve the page until it leaves, or sends what it must not; the robot is sent neutral then."""
        self._sit(self._seat)
        try:
            with contextlib.suppress(WebSocketDisconnect, WebSocketDisconnected):
                await race(self._receive(), self._send())
        finally:
            self._cancel_timer()
            self._seat.halt("the page was closed or reloaded", moving=self._link.moving)
            if self._held:
                self._note("drive", "the page was closed or reloaded")
            self._seats.leave(self._seat)

    def _sit(self, seat: Seat) -> None:
        self._seat = seat
        self._seats.sit(seat)
        seat.changed = self._on_change

    def _on_change(self) -> None:
        if not self._seat.active:
            self._link.sent(moving=False)
        elif self._seat.held and self._seat.token is None:
            self._seats.issue(self._seat)
        if self._seat.held is not self._held:
            self._held = self._seat.held
            self._note("drive", "has control" if self._held else self._seat.notice or "gave control back")
        self._changed.set()

    # What the page sends

    async def _receive(self) -> None:
        while True:
            try:
                message = _decode(await self._socket.receive_text())
            except (msgspec.MsgspecError, KeyError) as error:  # KeyError: of starlette, for a message of bytes
                self._count("malformed")
                await self._socket.close(_MALFORMED, f"{error}"[:100])
                return
            if not self._is_valid():
                return
            now = self._loop.time()
            if not self._rate.take(now):
                self._count("rate")
                await self._socket.close(_TOO_MANY, f"more than {MESSAGES_HZ:g} messages a second")
                return
            self._link.heard(now)
            self._take(message, now)
            self._arm()

    def _take(self, message: Any, now: float) -> None:
        match message:
            case PageCommand():
                self._drive(message, now)
            case TakeControl():
                self._take_control(takeover=message.takeover)
            case GiveControl():
                self._halt("control was given back")
                self._seat.give()
            case ResumeControl():
                self._resume(message.token)
            case SetMode():
                self._note(f"mode {message.mode}", "asked")
                self._seat.set_mode(message.mode)
                self._link.sent(moving=self._seat.autonomous)

    def _take_control(self, *, takeover: bool) -> None:
        if takeover and not self._caller.may(Action.TAKE_OVER):
            self._journal.note(self._caller, "take_over", self._seat.robot, "no right", refused=True)
            self._seat.notice = self._caller.refusal(Action.TAKE_OVER)
            self._changed.set()
            return
        self._note("take_over" if takeover else "take", "asked")
        if not self._seats.closed:
            self._seat.take(takeover=takeover)

    def _drive(self, command: PageCommand, now: float) -> None:
        if not self._seat.active:
            self._count("no_lease")
            return
        verdict = self._link.take(command, now)
        if not self._seat.held:
            self._count("no_lease")  # what is commanded before the lease is granted never moves the robot
            return
        if verdict.centre is not None:
            self._halt(verdict.centre)
        if verdict.drop is not None:
            self._count(verdict.drop.value)
            return
        drive = Drive(forward=command.forward, left=command.left, turn=command.turn)
        sent = self._seat.drive(drive, command.motor)
        if sent:
            self._link.sent(moving=command.moving or self._seat.autonomous)
        elif command.moving:
            self._count("refused")
            self._halt(self._seat.needs_neutral or self._seat.notice or "the command was refused", again=False)

    def _halt(self, why: str, *, again: bool = True) -> None:
        """Stop the robot, and require neutral. again: also if that is required already."""
        if again or self._link.moving:
            self._seat.halt(why, moving=self._link.moving)
            self._link.sent(moving=False)

    def _resume(self, token: str) -> None:
        if self._seat.active:
            return
        seat = self._seats.resume(self._seat.robot, self._seat.user, token)
        if seat is None:
            self._seat.notice = "control was given up meanwhile"
            self._changed.set()
            return
        self._seats.leave(self._seat)
        self._sit(seat)
        seat.halt("the page was reloaded", moving=False)

    def _note(self, action: str, result: str) -> None:
        self._journal.note(self._caller, action, self._seat.robot, result)

    def _count(self, why: str) -> None:
        self._metrics.count("console_commands_dropped", reason=why).value += 1

    # What is due

    def _arm(self) -> None:
        self._cancel_timer()
        if self._seat.active:
            self._timer = self._loop.call_at(self._link.deadline(), self._expire)

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _expire(self) -> None:
        self._timer = None
        due = self._link.expire(self._loop.time())
        if due is Due.NEUTRAL:
            self._seat.rest()
            self._link.sent(moving=False)
        elif due is Due.SILENT:
            self._halt("the page was silent")
            self._seat.give("the page was silent for too long")
            return
        self._arm()

    # What the page is sent

    async def _send(self) -> None:
        """Send ticks while the robot is driven, and what has changed."""
        while self._is_valid():
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TICK_S if self._seat.active else IDLE_S):
                    await self._changed.wait()
            self._changed.clear()
            now = self._loop.time()
            message = self._news()
            if self._seat.active and (tick := self._link.tick(now)) is not None:
                message["tick"] = tick
                if self._link.acknowledged is not None:
                    seq, came_at = self._link.acknowledged
                    message |= {"ack": seq, "held_ms": round(1000 * (now - came_at), 1)}
            if message:
                await self._socket.send_text(_encode(message).decode())

    def _news(self) -> dict[str, Any]:
        """Return the state of the seat, if it has changed."""
        seat = self._seat
        state = "held" if seat.held else "asking" if seat.active else "none"
        told = {"state": state, "needs": seat.needs_neutral, "notice": seat.notice, "mode": seat.mode}
        told["token"] = seat.token if seat.held else None
        if told == self._told:
            return {}
        self._told = told
        return {"control": told}
