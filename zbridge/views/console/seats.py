"""The control of robots from pages: who has it, and for how long it waits for a page that is being reloaded.

A *seat* is one page's control of one robot: a pilot with its stick. It belongs to one drive socket at a time. When that
socket ends, the robot is sent neutral, and a seat that holds the lease waits :data:`RELOAD_S` for the page to come back
with its token. Tokens are replaced at each connection, and valid only while no socket has the seat: a copied tab cannot
use the one that it copied.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
from collections.abc import Callable, Iterator
from functools import partial

from zbridge.client.fleet import Fleet
from zbridge.client.pilot import Pilot
from zbridge.errors import NeutralFirst, NotReady, Refused, Unsupported, ZbridgeError
from zbridge.fleet.messages import Drive
from zbridge.fleet.printable import shown
from zbridge.lease.stick import Stick, StickRules
from zbridge.tasks import Tasks
from zbridge.views.console.drive_link import MotorCommand

RELOAD_S = 3.0
"""Seconds for which control waits for its page."""
SEATS = 32
"""Most seats that wait for their pages; further ones are given up at once."""
DEADMAN_S = 0.4
"""The gateway stops a robot when this process has been silent for so long: it is dead or frozen."""
WAIT_S = 3.0
"""Longest wait for the robot's gateway."""
RULES = StickRules(advice=": centre the stick first")
ZEROS = 3
"""How often a motor is sent 0: a full bus drops commands."""
_REASON = 300


class Seat:
    """One page's control of one robot.

    who: the holder that others are shown; name: the first part of it, of this program. user: whose page it is.
    accepts: returns the commands that the robot accepts now. changed: called when anything of it has changed.
    """

    def __init__(
        self, fleet: Fleet, robot: str, who: str, name: str, user: str, accepts: Callable[[], tuple[str, ...]]
    ) -> None:
        self.robot = robot
        self.user = user
        self.token: str | None = None
        self.notice: str | None = None
        """What the user must know: why control was refused or lost, or why a command was not carried out."""
        self.changed: Callable[[], None] = lambda: None
        self._control = partial(fleet[robot].control, who, name=name, deadman_s=DEADMAN_S, wait_s=WAIT_S)
        self._accepts = accepts
        self._pilot: Pilot | None = None
        self._turning: dict[str, int] = {}
        """Motors that turn until they are sent 0, and how often they must be sent it."""
        self.autonomous = False
        """Whether the mode autonomous is in force, or was asked for."""
        self._work = Tasks()

    def __repr__(self) -> str:
        return f"<Seat at {self.robot} {self._pilot!r}>"

    @property
    def held(self) -> bool:
        """Whether the lease is held."""
        return self._pilot is not None and self._pilot.stick.held

    @property
    def active(self) -> bool:
        """Whether the lease is held or asked for."""
        return self._pilot is not None and self._pilot.stick.active

    @property
    def needs_neutral(self) -> str | None:
        """Why motion is refused until the stick was centred; None if it is not."""
        return self._pilot.stick.needs_neutral if self._pilot is not None and self.active else None

    @property
    def mode(self) -> str:
        """The mode that was set with this lease, and has not ended."""
        mode = self._pilot.mode if self._pilot is not None else "none"
        return mode if self.autonomous or mode != "autonomous" else "none"

    def take(self, *, takeover: bool) -> None:
        """Acquire the lease, or take it over. The stick may be deflected already: it must be centred first."""
        if self.active:
            return
        self.notice = None
        control = partial(self._control, takeover=takeover)
        self._pilot = Pilot(Stick(RULES, "control was just taken"), control, on_end=self._on_end)
        self._pilot.take()
        self.changed()

    def give(self, why: str | None = None) -> None:
        """Give the lease back."""
        if self._pilot is not None:
            self._pilot.release()
        if why is not None:
            self.notice = why
        self.changed()

    def drive(self, drive: Drive, motor: MotorCommand | None = None) -> bool:
        """Send the robot a command; return whether it was sent. A motor that was moved is sent 0 by the next drive.

        A robot that moves by itself is sent no neutral, which pages repeat all the time; motion stops it.
        """
        if not self.autonomous or self._pilot is None:
            return self._drive(drive, motor)
        if drive.moving or (motor is not None and motor.value):
            self.halt("the mode was autonomous", moving=True)
        elif self._pilot.refusal is not None:
            self.halt(shown(self._pilot.refusal, _REASON), moving=True)
        elif "mode" not in self._accepts():
            self.halt(f"{self.robot} accepts no mode now", moving=True)
        return self.held

    def _drive(self, drive: Drive, motor: MotorCommand | None = None) -> bool:
        if self._pilot is None:
            return False
        before = (self.needs_neutral, self.notice)
        if motor is None and not drive.moving:
            self.notice = None
        try:
            self._send(self._pilot, drive, motor)
        except NeutralFirst:
            return False
        except Refused as refusal:
            self.notice = shown(refusal, _REASON)
            return False
        finally:
            if before != (self.needs_neutral, self.notice):
                self.changed()
        return self.held

    def _send(self, pilot: Pilot, drive: Drive, motor: MotorCommand | None) -> None:
        try:
            self._give(pilot, drive, motor)
        except Unsupported as refusal:  # of the command before: what the robot cannot do of it was left out
            self.notice = f"in part only: {shown(refusal, _REASON)}"
            self._give(pilot, drive, motor)

    def _give(self, pilot: Pilot, drive: Drive, motor: MotorCommand | None) -> None:
        turning = motor.name if motor is not None and motor.value and not motor.linear else None
        stopping = [name for name in self._turning if name != turning]
        for name in stopping:
            pilot.motor(name, 0.0)
            self._turning[name] -= 1
            if not self._turning[name]:
                del self._turning[name]
        if turning is not None:
            self._turning[turning] = ZEROS
        if motor is not None:
            pilot.motor(motor.name, motor.value)
        elif "drive" in self._accepts():
            pilot.drive(drive)
        elif drive.moving:
            raise NotReady(f"{self.robot} accepts no drive now")
        elif not stopping:
            pilot.rest()

    def halt(self, why: str, *, moving: bool) -> None:
        """Require neutral. moving: whether the robot may move now: it is sent neutral then."""
        if self._pilot is None:
            return
        notice = self.notice
        if moving:
            self.rest()
        self.notice = notice
        self._pilot.require_neutral(why)
        self.changed()

    def rest(self) -> None:
        """Send neutral; it ends the mode autonomous."""
        self._drive(Drive())
        if self.autonomous:
            self.set_mode("none")

    def set_mode(self, mode: str) -> None:
        """Set who moves the robot. What moves it until now ends."""
        if self.held and self._pilot is not None:
            self._drive(Drive())
            self.autonomous = mode == "autonomous"
            self._work.start(self._set_mode(self._pilot, mode))

    async def close(self) -> None:
        """Give the lease back, and wait until that is done."""
        await self._work.end()
        if self._pilot is not None:
            await self._pilot.close()

    async def _set_mode(self, pilot: Pilot, mode: str) -> None:
        if not pilot.stick.held:  # it was given back, or lost: nobody acquires it again by this
            return
        try:
            await pilot.set_mode(mode)
        except ZbridgeError as error:
            self.notice = shown(error, _REASON)
            self.autonomous = False
        self.changed()

    def _on_end(self, error: ZbridgeError | None) -> None:
        if error is not None:
            self.notice = shown(error, _REASON)
        self.token, self.autonomous = None, False
        self.changed()


class Seats:
    """All seats whose pages are there, or may come back."""

    def __init__(self) -> None:
        self.closed = False
        self._seated: set[Seat] = set()
        self._waiting: dict[Seat, asyncio.TimerHandle] = {}
        self._work = Tasks()

    def __repr__(self) -> str:
        return f"<Seats {len(self._seated)}, {len(self._waiting)} waiting>"

    def __iter__(self) -> Iterator[Seat]:
        yield from self._seated
        yield from self._waiting

    def sit(self, seat: Seat) -> None:
        """Note that a socket has this seat."""
        self._seated.add(seat)

    def issue(self, seat: Seat) -> None:
        """Give a seat a new token; the one before is void."""
        seat.token = secrets.token_urlsafe(24)

    def resume(self, robot: str, user: str, token: str) -> Seat | None:
        """Return the seat of a page that has come back, None if the token is not valid.

        A token whose seat has a socket was copied: it is replaced.
        """
        for seat in self._seated:
            if _is_token(seat, token):
                self.issue(seat)
                seat.changed()
                return None
        for seat in self._waiting:
            if _is_token(seat, token) and (seat.robot, seat.user) == (robot, user):
                self._waiting.pop(seat).cancel()
                self.issue(seat)
                self.sit(seat)
                return seat
        return None

    def leave(self, seat: Seat) -> None:
        """Note that the socket of a seat has ended: it waits for its page, if it holds the lease."""
        self._seated.discard(seat)
        seat.changed = lambda: None
        if not seat.held or self.closed or len(self._waiting) >= SEATS:
            self._work.start(seat.close())
            return
        self._waiting[seat] = asyncio.get_running_loop().call_later(RELOAD_S, self._give_up, seat)

    async def close(self) -> None:
        """Give back all leases, and let nobody sit down any more."""
        self.closed = True
        for timer in self._waiting.values():
            timer.cancel()
        await asyncio.gather(*(seat.close() for seat in self), *self._work.running, return_exceptions=True)
        self._waiting.clear()

    def _give_up(self, seat: Seat) -> None:
        self._waiting.pop(seat, None)
        self._work.start(seat.close())


def _is_token(seat: Seat, token: str) -> bool:
    return seat.token is not None and hmac.compare_digest(seat.token.encode(), token.encode())
