"""What the pages see and do: the fleet's rows, stops and releases, and what came of them."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import time
from collections.abc import Coroutine
from typing import Any

import msgspec
from starlette.websockets import WebSocket

from zbridge.bus import Bus
from zbridge.client.driver import default_who
from zbridge.client.fleet import Fleet
from zbridge.client.fleet_model import FleetModel
from zbridge.client.stops import new_stop, summarize
from zbridge.errors import ZbridgeError
from zbridge.fleet.messages import Stop
from zbridge.fleet.topics import is_name
from zbridge.metrics import Metrics
from zbridge.tasks import Tasks
from zbridge.views.console.drive_socket import DriveSocket
from zbridge.views.console.feed import FleetFeed
from zbridge.views.console.fleet_stop import StopReport, listed, stop_fleet
from zbridge.views.console.history import ControlHistory
from zbridge.views.console.page import Page, Request
from zbridge.views.console.robot_watch import RobotWatches
from zbridge.views.console.roster import Roster
from zbridge.views.console.seats import Seat, Seats

REFRESH_S = 0.5
"""Seconds between two looks at the fleet."""
PAGES = 100
"""Most pages at a time; further ones are told so."""
STOPS = 32
"""Most stops of single robots, and switches, at a time."""
ALIVE_S = 2.0
"""Pages hear something at least so often, seconds: one that hears nothing does not take what it shows for present."""
SAME_PRESS_S = 0.3
"""Seconds within which two presses of STOP ALL are one: nobody was released in between."""
RELEASED_S = 1.0
"""Seconds after a release until robots have shown whether they are still latched."""
DRIVES = 32
"""Most pages that drive, or want to, at a time."""
_FULL, _NO_NAME = 1013, 1008
_encode = msgspec.json.Encoder().encode


class StopNotice(msgspec.Struct, frozen=True):
    """What pages are told of a stop or a release. at: Unix seconds. good: None while it is on its way."""

    text: str
    at: float
    good: bool | None = None


class Console:
    """What the pages see and do."""

    def __init__(self, fleet: Fleet, bus: Bus, model: FleetModel, roster: Roster) -> None:
        self.notices: dict[str, StopNotice] = {}
        """The last one ``"all"`` of the fleet, and ``"one"`` of a single robot since."""
        self._fleet = fleet
        self._bus = bus
        self._model = model
        self._roster = roster
        self._feed = FleetFeed(model)
        self._pages: set[Page] = set()
        self._stopping: asyncio.Task[None] | None = None
        self._stopped_at = -math.inf
        self._releasing: asyncio.Task[None] | None = None
        self._work = Tasks()
        self._connected = True
        self._told_at = -math.inf
        self._history = ControlHistory(bus, fleet.realm, self._history_changed)
        self._watches = RobotWatches(bus, fleet.realm, self._history.payload)
        self._seats = Seats()
        self._drives = 0
        self._numbers = itertools.count(1)
        self.metrics = Metrics()

    def __repr__(self) -> str:
        return f"<Console {self._feed!r}, {len(self._pages)} pages>"

    async def run(self) -> None:
        """Follow the fleet, and tell the pages."""
        self._history.open()
        with contextlib.closing(self._bus.watch_connected(self._follow_bus)), contextlib.closing(self._history):
            while True:
                self._refresh()
                if asyncio.get_running_loop().time() - self._told_at >= ALIVE_S:
                    self._tell(b"{}")
                await asyncio.to_thread(self._roster.save)
                await asyncio.sleep(REFRESH_S)

    async def serve(self, socket: WebSocket) -> None:
        """Serve one page."""
        if len(self._pages) >= PAGES:
            await socket.close(_FULL, f"{PAGES} pages are open, the most there may be")
            return
        await socket.accept()
        page = Page(socket, self._snapshot, self._carry_out)
        self._pages.add(page)
        try:
            await page.serve()
        finally:
            self._pages.discard(page)
            self._look(page, "")

    async def drive(self, socket: WebSocket) -> None:
        """Serve the socket by which a page drives a robot."""
        robot = socket.path_params["robot"]
        if not is_name(robot) or self._drives >= DRIVES:
            why = (_NO_NAME, "this is no robot's name") if self._drives < DRIVES else (_FULL, f"{DRIVES} pages drive")
            await socket.close(*why)
            return
        await socket.accept()
        name = self._fleet.name or "console"
        who = f"{name}.browser{next(self._numbers)}"
        seat = Seat(self._fleet, robot, who, name, "", lambda: self._accepts(robot))
        self._drives += 1
        try:
            await DriveSocket(socket, seat, self._seats, self.metrics).serve()
        finally:
            self._drives -= 1

    def _accepts(self, robot: str) -> tuple[str, ...]:
        entry = self._model.robots.get(robot)
        return entry.status.commands if entry is not None and entry.status is not None else ()

    async def close(self) -> None:
        """Give back all robots, and wait for the stops that are on their way."""
        await self._seats.close()
        fleet = [task for task in (self._stopping, self._releasing) if task is not None]
        await asyncio.gather(*fleet, *self._work.running, return_exceptions=True)

    def _follow_bus(self, connected: bool) -> None:
        """The bus was lost, or is back: robots then have some seconds to show that they are there too."""
        if connected:
            self._model.opened_at = self._model.clock()
        self._connected = connected
        self._tell(_encode({"bus": connected}))

    def _refresh(self) -> None:
        self._roster.add(name for name, entry in self._model.robots.items() if entry.alive)
        changes = self._feed.refresh(self._roster.names, connected=self._connected)
        if changes is not None:
            self._tell(changes)

    def _snapshot(self) -> bytes:
        return self._feed.snapshot(
            realm=self._fleet.realm, bus=self._connected, notices=self.notices, roster=self._roster.fault
        )

    def _history_changed(self, robot: str) -> None:
        self._watches.history_changed(robot)

    def _tell(self, message: bytes) -> None:
        self._told_at = asyncio.get_running_loop().time()
        for page in self._pages:
            page.tell(message)

    def _notify(self, of: str, text: str, *, good: bool | None = None) -> None:
        """Tell all pages. of: ``"all"`` or ``"one"``: what is said of one robot hides nothing that is said of all."""
        self.notices[of] = StopNotice(text, time.time(), good)
        self._tell(_encode({"notices": self.notices}))

    # What pages ask for

    def _carry_out(self, page: Page, request: Request) -> None:
        robot = request.robot
        if request.do == "stop_all":
            self._begin_stop_all()
        elif request.do == "release" and (self._releasing is None or self._releasing.done()):
            self._releasing = asyncio.create_task(self._release())
        elif request.do == "look":
            self._look(page, robot)
        elif request.do == "stop" and robot:
            self._begin(self._stop(robot), f"{robot}: NOT stopped: {STOPS} stops are on their way; use STOP ALL")
        elif request.do == "switch" and robot and request.name:
            switching = self._switch(robot, request.name, on=request.on)
            self._begin(switching, f"{robot}: {request.name} was not sent: {STOPS} commands are on their way")
        elif request.do == "forget" and not self._is_alive(robot):
            self._roster.forget(robot)
            self._model.robots.pop(robot, None)
            self._refresh()

    def _look(self, page: Page, robot: str) -> None:
        """Show a page another robot, or none."""
        before = page.look(self._watches.join(robot) if robot else None)
        if before is not None:
            self._watches.leave(before.robot)

    def _begin(self, work: Coroutine[Any, Any, None], otherwise: str) -> None:
        """Work beside; tell ``otherwise`` if too much is under way."""
        if len(self._work) < STOPS:
            self._work.start(work)
        else:
            work.close()
            self._notify("one", otherwise, good=False)

    def _new_stop(self, reason: str, *, latch: bool) -> Stop:
        stop = new_stop(self._fleet.name or default_who(), reason, latch=latch)
        assert isinstance(stop.id, bytes)
        self._history.note_own(stop.id, "this console")
        return stop

    def _begin_stop_all(self) -> None:
        """Send a stop at each press: robots may have been released, and driven, since the last one was confirmed."""
        now = asyncio.get_running_loop().time()
        if now - self._stopped_at < SAME_PRESS_S:
            return
        self._stopped_at = now
        for task in (self._stopping, self._releasing):
            if task is not None:
                task.cancel()
        self.notices.clear()
        self._notify("all", "STOP ALL is sent; waiting for the gateways to confirm it")
        self._stopping = asyncio.create_task(self._stop_all())

    async def _stop_all(self) -> None:
        try:
            stop = self._new_stop("STOP ALL in the console", latch=True)
            report = await stop_fleet(self._fleet, self._bus, stop, self._roster.names.copy(), self._is_alive)
        except ZbridgeError as error:
            report = StopReport(f"STOP ALL: {error}", good=False)
        self._notify("all", report.text, good=report.good)

    async def _release(self) -> None:
        try:
            outcomes = await self._fleet.unlatch()
        except ZbridgeError as error:
            self._notify("all", f"Release: {error}", good=False)
            return
        await asyncio.sleep(RELEASED_S)
        self._refresh()
        latched = [name for name, row in self._feed.rows.items() if row["latched"] and name in outcomes]
        text = summarize(outcomes, "released") if outcomes else "No gateway is on the bus"
        if latched:
            text += f"; still latched by a stop of its own, which zbridge unlatch ends: {listed(latched)}"
        self._notify("all", text, good=bool(outcomes) and not any(outcomes.values()) and not latched)

    async def _stop(self, robot: str) -> None:
        self._notify("one", f"{robot}: the stop is sent; waiting for its gateway to confirm it")
        outcomes = await self._fleet.send_stop(self._new_stop("console", latch=False), [robot])
        if (error := outcomes[robot]) is not None:
            self._notify("one", str(error), good=False)
        else:
            self._notify("one", f"{robot} stopped (its gateway sent it)", good=True)

    async def _switch(self, robot: str, name: str, *, on: bool) -> None:
        target = self._fleet[robot]
        switches = {"light": target.set_light, "lidar": target.set_lidar, "camera": target.set_camera}
        try:
            await switches[name](on)
        except ZbridgeError as error:
            self._notify("one", str(error), good=False)
        else:
            self._notify("one", f"{robot}: {name} {'on' if on else 'off'} was sent", good=True)

    def _is_alive(self, robot: str) -> bool:
        entry = self._model.robots.get(robot)
        return entry is not None and entry.alive
