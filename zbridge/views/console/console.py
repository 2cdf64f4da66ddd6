"""The pages and programs that follow the fleet, and the pages that drive: who they are, and what they are told."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import time
from collections.abc import Coroutine, Iterator, Mapping
from typing import Any

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from zbridge.bus import Bus
from zbridge.client.fleet import Fleet
from zbridge.client.fleet_model import FleetModel
from zbridge.fleet.topics import is_name
from zbridge.metrics import Metrics
from zbridge.tasks import Tasks
from zbridge.views.console.callers import Callers
from zbridge.views.console.drive_socket import DriveSocket
from zbridge.views.console.feed import FleetFeed
from zbridge.views.console.history import ControlHistory
from zbridge.views.console.journal import Journal
from zbridge.views.console.orders import Orders
from zbridge.views.console.page import FleetFollower, Page, Request
from zbridge.views.console.rights import Action, Caller
from zbridge.views.console.robot_watch import RobotWatches
from zbridge.views.console.roster import Roster
from zbridge.views.console.seats import Seat, Seats

REFRESH_S = 0.5
"""Seconds between two looks at the fleet."""
FOLLOWERS, DRIVES = 100, 32
"""Most pages and programs that follow the fleet, and most pages that drive, at a time; further ones are told so."""
ORDERS = 32
"""Most stops of single robots, releases and switches that pages have under way."""
ALIVE_S = 2.0
"""Pages hear something at least so often, seconds: one that hears nothing does not take what it shows for present."""
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
    """What pages are told of a stop or a release. at: Unix seconds. good: None while it is on its way."""

    text: str
    at: float
    good: bool | None = None


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
        """The last one ``"all"`` of the fleet, and ``"one"`` of a single robot since."""
        self.fleet, self.bus, self.callers, self.journal = fleet, bus, callers, journal
        self.feed = FleetFeed(model)
        self._model = model
        self._roster = roster
        self._metrics = metrics
        self._faults = faults
        self._history = ControlHistory(bus, fleet.realm, lambda robot: self._watches.history_changed(robot))
        self._watches = RobotWatches(bus, fleet.realm, self._history.payload)
        self.orders = Orders(fleet, bus, self.feed, roster, self._history, journal, self._notify)
        self._followers: set[FleetFollower] = set()
        self._sockets: dict[WebSocket, Caller] = {}
        self._work = Tasks()
        self._connected = True
        self._told_at = -math.inf
        self._seats = Seats()
        self._drives = 0
        self._numbers = itertools.count(1)

    def __repr__(self) -> str:
        return f"<Console {self.feed!r}, {len(self._followers)} followers>"

    async def run(self) -> None:
        """Follow the fleet, and tell the followers."""
        self._history.open()
        with contextlib.closing(self.bus.watch_connected(self._follow_bus)), contextlib.closing(self._history):
            while True:
                self._refresh()
                if asyncio.get_running_loop().time() - self._told_at >= ALIVE_S:
                    self._tell(b"{}")
                self._faults["users"] = await asyncio.to_thread(self.callers.refresh)
                self._end_logins()
                await asyncio.to_thread(self._roster.save)
                self._faults["roster"] = self._roster.fault
                await asyncio.sleep(REFRESH_S)

    async def close(self) -> None:
        """Give back all robots, and wait for the stops that are on their way."""
        await self._seats.close()
        await asyncio.gather(self.orders.close(), *self._work.running, return_exceptions=True)

    # Sockets and streams

    async def serve(self, socket: WebSocket) -> None:
        """Serve one page."""
        caller = self.callers.recognise(socket.scope)
        if caller is None or self.full:
            await socket.close(FULL if caller is not None else FORBIDDEN, "log in first" if caller is None else "full")
            return
        await socket.accept()
        with self.following(caller) as follower, self._open(socket, caller):
            page = Page(socket, follower, lambda request: self._carry_out(page, caller, request))
            try:
                await page.serve()
            finally:
                self._look(page, "")

    @contextlib.contextmanager
    def following(self, caller: Caller) -> Iterator[FleetFollower]:
        """Tell one more follower, unless the console is :attr:`full`, while the context lasts."""
        follower = FleetFollower(lambda: self._snapshot(caller))
        self._followers.add(follower)
        try:
            yield follower
        finally:
            self._followers.discard(follower)

    @property
    def full(self) -> bool:
        """Whether nobody more can follow the fleet."""
        return len(self._followers) >= FOLLOWERS

    async def drive(self, socket: WebSocket) -> None:
        """Serve the socket by which a page drives a robot."""
        caller, robot = self.callers.recognise(socket.scope), socket.path_params["robot"]
        if caller is None or not caller.may(Action.DRIVE) or not is_name(robot) or self._drives >= DRIVES:
            await socket.close(FULL if self._drives >= DRIVES else FORBIDDEN)
            return
        await socket.accept()
        name = self.fleet.name or "console"
        who = f"{name}.{caller.user or f'browser{next(self._numbers)}'}"
        seat = Seat(self.fleet, robot, who, name, caller.user, lambda: self.feed.accepts(robot))
        self._drives += 1
        try:
            with self._open(socket, caller):
                await DriveSocket(socket, seat, self._seats, caller, self.journal, self._metrics).serve()
        finally:
            self._drives -= 1

    @contextlib.contextmanager
    def _open(self, socket: WebSocket, caller: Caller) -> Iterator[None]:
        """Close the socket when its caller's login ends."""
        self._sockets[socket] = caller
        try:
            yield
        finally:
            del self._sockets[socket]

    def _end_logins(self) -> None:
        for socket, caller in self._sockets.items():
            if not self.callers.is_valid(caller):
                self._work.start(_end(socket))

    # What they are told

    def _follow_bus(self, connected: bool) -> None:
        """The bus was lost, or is back: robots then have some seconds to show that they are there too."""
        if connected:
            self._model.opened_at = self._model.clock()
        self._connected = connected
        self._tell(_encode({"bus": connected}))

    def _refresh(self) -> None:
        self._roster.add(self.feed.alive())
        changes = self.feed.refresh(self._roster.names, connected=self._connected)
        if changes is not None:
            self._tell(changes)

    def _snapshot(self, caller: Caller) -> bytes:
        return self.feed.snapshot(
            realm=self.fleet.realm,
            bus=self._connected,
            notices=self.notices,
            fault="; ".join(filter(None, self._faults.values())) or None,
            me={"user": caller.user, "role": caller.role, "may": sorted(caller.rights)},
        )

    def _tell(self, message: bytes) -> None:
        self._told_at = asyncio.get_running_loop().time()
        for follower in self._followers:
            follower.tell(message)

    def _notify(self, of: str, text: str, good: bool | None) -> None:
        """Tell all. of: what is said of ``"one"`` robot hides nothing that is said of ``"all"``."""
        if of == "all" and good is None:
            self.notices.clear()
        self.notices[of] = StopNotice(text, time.time(), good)
        self._refresh()
        self._tell(_encode({"notices": self.notices}))

    # What pages ask for

    def _carry_out(self, page: Page, caller: Caller, request: Request) -> None:
        action, robot = _ACTIONS[request.do], request.robot
        if not caller.may(action):
            self.journal.note(caller, request.do, robot, "refused: no right")
            page.warn(caller.refusal(action))
        elif request.do == "look":
            self._look(page, robot)
        elif request.do == "stop_all":
            self.orders.stop_all(caller)
        elif request.do == "release":
            self.orders.release_all(caller)
        elif robot:
            self._carry_out_for_one(page, caller, request)

    def _carry_out_for_one(self, page: Page, caller: Caller, request: Request) -> None:
        robot = request.robot
        if request.do == "forget":
            self.orders.forget(caller, robot)
            self._refresh()
        elif len(self._work) >= ORDERS:
            page.warn(f"{robot}: {request.do} NOT sent: {ORDERS} orders are under way; use STOP ALL")
        elif request.do == "stop":
            self._work.start(_await(self.orders.stop(caller, robot)))
        elif request.do == "unlatch":
            self._work.start(_await(self.orders.unlatch(caller, robot)))
        elif request.name:
            self._work.start(_await(self.orders.switch(caller, robot, request.name, on=request.on)))

    def _look(self, page: Page, robot: str) -> None:
        """Show a page another robot, or none."""
        before = page.look(self._watches.join(robot) if robot else None)
        if before is not None:
            self._watches.leave(before.robot)


async def _await(work: Coroutine[Any, Any, object]) -> None:
    """Await what was told to all already."""
    await work


async def _end(socket: WebSocket) -> None:
    with contextlib.suppress(WebSocketDisconnect, WebSocketDisconnected):
        await socket.close(FORBIDDEN, "the login has ended")
