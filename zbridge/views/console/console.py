"""The pages and programs that follow the fleet, and the pages that drive: who they are, and what they are told."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial

import msgspec
from starlette.websockets import WebSocket

from zbridge.bus import Bus
from zbridge.client.fleet import Fleet
from zbridge.client.fleet_model import FleetModel
from zbridge.errors import RateLimited
from zbridge.fleet.topics import is_name
from zbridge.metrics import Metrics
from zbridge.views.console.callers import Callers
from zbridge.views.console.drive_socket import DriveSocket
from zbridge.views.console.feed import FleetFeed
from zbridge.views.console.history import ControlHistory
from zbridge.views.console.journal import Journal
from zbridge.views.console.orders import Orders
from zbridge.views.console.page import LOGIN_ENDED, FleetFollower, Page, Request
from zbridge.views.console.rights import Action, Caller
from zbridge.views.console.robot_watch import RobotWatches
from zbridge.views.console.roster import Roster
from zbridge.views.console.seats import Seat, Seats

REFRESH_S = 0.5
"""Seconds between two looks at the fleet. Pages are told then, also if nothing has changed: that it is so."""
FOLLOWERS, FOLLOWERS_EACH = 100, 25
"""Most pages and programs that follow the fleet at a time, and most of one user; further ones are told so."""
DRIVES, DRIVES_EACH = 32, 16
"""Most pages that drive, and most of one user."""
NOTICES = 4
"""Notices of single robots that are shown."""
FULL, FORBIDDEN = 1013, 1008
"""Codes by which sockets are closed."""
_encode = msgspec.json.Encoder().encode
_ACTIONS: Mapping[str, Action] = {
    "look": Action.LOOK,
    "stop_all": Action.STOP,
    "stop": Action.STOP,
    "release": Action.UNLATCH_FLEET,
    "unlatch": Action.UNLATCH,
    "switch": Action.SWITCH,
    "forget": Action.FORGET,
}


class StopNotice(msgspec.Struct, frozen=True):
    """What pages are told of an order, a stop for example. at: Unix seconds. good: None while it is not known."""

    action: str
    text: str
    at: float
    good: bool | None = None


def _importance(notice: StopNotice) -> tuple[bool, float]:
    return (notice.good is not True, notice.at)


class Console:
    """Everybody who follows the fleet or drives. faults: of the console's own files, by what they hold."""

    def __init__(
        self,
        fleet: Fleet,
        bus: Bus,
        model: FleetModel,
        roster: Roster,
        callers: Callers,
        journal: Journal,
        metrics: Metrics,
        faults: dict[str, str | None],
    ) -> None:
        self.notices: dict[str, StopNotice] = {}
        """The last one of each robot, and under "" that of the fleet."""
        self.fleet, self.bus, self.callers, self.journal = fleet, bus, callers, journal
        self.feed = FleetFeed(model)
        self._model = model
        self._roster = roster
        self.metrics = metrics
        self._faults = faults
        self._fault: str | None = None
        self._history = ControlHistory(bus, fleet.realm, lambda robot: self._watches.history_changed(robot))
        self._watches = RobotWatches(bus, fleet.realm, self._history.payload, metrics)
        self.orders = Orders(fleet, bus, self.feed, roster, self._history, journal, self._notify)
        self._followers: dict[FleetFollower, str] = {}
        """All of them, and the user of each."""
        self._drives: Counter[str] = Counter()
        """Pages that drive, by user."""
        self._connected = True
        self._seats = Seats()
        self._numbers = itertools.count(1)

    def __repr__(self) -> str:
        return f"<Console {self.feed!r}, {len(self._followers)} followers>"

    async def run(self) -> None:
        """Follow the fleet, and tell the followers."""
        self._history.open()
        with contextlib.closing(self.bus.watch_connected(self._follow_bus)), contextlib.closing(self._history):
            while True:
                self._tell(self._changes() or b"{}")
                self._faults["users"] = await asyncio.to_thread(self.callers.refresh)
                await asyncio.to_thread(self._roster.save)
                self._faults["roster"] = self._roster.fault
                self._tell_faults()
                await asyncio.sleep(REFRESH_S)

    async def close(self) -> None:
        """Give back all robots, wait for the orders that are under way, and keep who was seen."""
        await self._seats.close()
        await self.orders.close()
        await asyncio.to_thread(self._roster.save)

    # Sockets and streams

    async def serve(self, socket: WebSocket) -> None:
        """Serve one page."""
        caller = self.callers.recognise(socket.scope)
        if caller is None or self.is_full(caller):
            await socket.close(LOGIN_ENDED if caller is None else FULL)
            return
        await socket.accept()
        with self.following(caller) as follower:
            is_valid = partial(self.callers.is_valid, caller)
            page = Page(socket, follower, is_valid, lambda request: self._carry_out(page, caller, request))
            try:
                await page.serve()
            finally:
                self._look(page, "")

    @contextlib.contextmanager
    def following(self, caller: Caller) -> Iterator[FleetFollower]:
        """Tell one more follower, unless :meth:`is_full`, while the context lasts."""
        follower = FleetFollower(lambda: self._snapshot(caller))
        self._followers[follower] = caller.user
        try:
            yield follower
        finally:
            del self._followers[follower]

    def is_full(self, caller: Caller) -> bool:
        """Return whether the fleet is followed by as many as may, or by as many for this user."""
        users = [*self._followers.values()]
        return len(users) >= FOLLOWERS or (bool(caller.user) and users.count(caller.user) >= FOLLOWERS_EACH)

    async def drive(self, socket: WebSocket) -> None:
        """Serve the socket by which a page drives a robot."""
        caller, robot = self.callers.recognise(socket.scope), socket.path_params["robot"]
        if caller is None or not caller.may(Action.DRIVE) or not is_name(robot):
            await socket.close(LOGIN_ENDED if caller is None else FORBIDDEN)
            return
        user = caller.user
        if self._drives.total() >= DRIVES or (user and self._drives[user] >= DRIVES_EACH):
            await socket.close(FULL)
            return
        await socket.accept()
        name = self.fleet.name or "console"
        who = f"{name}.{user or f'browser{next(self._numbers)}'}"
        seat = Seat(self.fleet, robot, who, name, user, lambda: self.feed.accepts(robot))
        is_valid = partial(self.callers.is_valid, caller)
        driving = DriveSocket(socket, seat, self._seats, caller, is_valid, self.journal, self.metrics)
        self._drives[user] += 1
        try:
            await driving.serve()
        finally:
            self._drives[user] -= 1

    # What they are told

    def _follow_bus(self, connected: bool) -> None:
        """The bus was lost, or is back: robots then have some seconds to show that they are there too."""
        if connected:
            self._model.opened_at = self._model.clock()
        self._connected = connected
        self._tell(_encode({"bus": connected}))

    def _changes(self) -> bytes | None:
        self._roster.add(self.feed.alive())
        return self.feed.refresh(self._roster.names, connected=self._connected)

    def _snapshot(self, caller: Caller) -> bytes:
        return self.feed.snapshot(
            realm=self.fleet.realm,
            bus=self._connected,
            notices=self.notices,
            now=time.time(),
            fault=self._fault,
            me={"user": caller.user, "role": caller.role, "may": sorted(caller.rights)},
        )

    def _tell(self, message: bytes) -> None:
        for follower in self._followers:
            follower.tell(message)

    def _tell_faults(self) -> None:
        fault = "; ".join(filter(None, self._faults.values())) or None
        if fault != self._fault:
            self._fault = fault
            self._tell(_encode({"fault": fault}))

    def _notify(self, action: str, robot: str, text: str, good: bool | None) -> None:
        """Tell all. What is said of one robot hides nothing that is said of the fleet, or bad news of another one."""
        if not robot and good is None:
            self.notices.clear()
        self.notices.pop(robot, None)
        self.notices[robot] = StopNotice(action, text, time.time(), good)
        others = sorted(self.notices.keys() - {"", robot}, key=lambda each: _importance(self.notices[each]))
        if len(others) >= NOTICES:
            del self.notices[others[0]]
        self._tell(_encode({"notices": self.notices, "now": time.time()}))

    # What pages ask for

    def _carry_out(self, page: Page, caller: Caller, request: Request) -> None:
        action, robot = _ACTIONS[request.do], request.robot
        if not caller.may(action):
            self.journal.note(caller, request.do, robot, "no right", refused=True)
            page.warn(request, caller.refusal(action))
        elif request.do == "look":
            self._look(page, robot)
        else:
            try:
                self._order(caller, request)
            except RateLimited as refusal:
                page.warn(request, f"{robot}: {request.do} NOT sent: {refusal}")

    def _order(self, caller: Caller, request: Request) -> None:
        robot = request.robot
        if request.do == "stop_all":
            self.orders.stop_all(caller)
        elif request.do == "release":
            self.orders.release_all(caller)
        elif robot and request.do == "stop":
            self.orders.stop(caller, robot)
        elif robot and request.do == "unlatch":
            self.orders.unlatch(caller, robot)
        elif robot and request.do == "forget":
            self.orders.forget(caller, robot)
        elif robot and request.name:
            self.orders.switch(caller, robot, request.name, on=request.on)

    def _look(self, page: Page, robot: str) -> None:
        """Show a page another robot, or none."""
        before = page.look(self._watches.join(robot) if robot else None)
        if before is not None:
            self._watches.leave(before.robot)
