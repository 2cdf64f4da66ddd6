"""What callers do to robots: stops, releases, switches; and what came of it, told to all and written down."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from zbridge.bus import Bus
from zbridge.client.driver import default_who
from zbridge.client.fleet import Fleet
from zbridge.client.stops import new_stop, summarize
from zbridge.errors import ZbridgeError
from zbridge.fleet.messages import Stop
from zbridge.views.console.feed import FleetFeed
from zbridge.views.console.fleet_stop import StopReport, listed, stop_fleet
from zbridge.views.console.history import ControlHistory
from zbridge.views.console.journal import Journal
from zbridge.views.console.rights import Caller
from zbridge.views.console.roster import Roster

SAME_PRESS_S = 0.3
"""Seconds within which two presses of STOP ALL are one: nobody was released in between."""
RELEASED_S = 1.0
"""Seconds after a release until robots have shown whether they are still latched."""


class Orders:
    """Carries out what callers may do; the caller's rights are checked before.

    notify: tells all pages of ``"all"`` robots or of ``"one"``: a text, and whether it went well (None: not known yet).
    """

    def __init__(
        self,
        fleet: Fleet,
        bus: Bus,
        feed: FleetFeed,
        roster: Roster,
        history: ControlHistory,
        journal: Journal,
        notify: Callable[[str, str, bool | None], None],
    ) -> None:
        self._fleet = fleet
        self._bus = bus
        self._feed = feed
        self._roster = roster
        self._history = history
        self._journal = journal
        self._notify = notify
        self._stopping: asyncio.Task[StopReport] | None = None
        self._stopped_at = -math.inf
        self._releasing: asyncio.Task[StopReport] | None = None

    def __repr__(self) -> str:
        return f"<Orders for {self._fleet!r}>"

    async def close(self) -> None:
        """Wait for the stops and releases of the fleet that are on their way."""
        under_way = [task for task in (self._stopping, self._releasing) if task is not None]
        await asyncio.gather(*under_way, return_exceptions=True)

    def stop_all(self, caller: Caller) -> asyncio.Task[StopReport]:
        """Send a stop at each press: robots may have been released, and driven, since the last one was confirmed."""
        now = asyncio.get_running_loop().time()
        if self._stopping is not None and now - self._stopped_at < SAME_PRESS_S:
            return self._stopping
        self._stopped_at = now
        for task in (self._stopping, self._releasing):
            if task is not None:
                task.cancel()
        self._notify("all", "STOP ALL is sent; waiting for the gateways to confirm it", None)
        self._stopping = asyncio.create_task(self._stop_all(caller))
        return self._stopping

    def release_all(self, caller: Caller) -> asyncio.Task[StopReport]:
        """Release the fleet's latched stops, unless that is under way."""
        if self._releasing is None or self._releasing.done():
            self._releasing = asyncio.create_task(self._release_all(caller))
        return self._releasing

    async def stop(self, caller: Caller, robot: str) -> StopReport:
        """Stop one robot, without a latch."""
        self._notify("one", f"{robot}: the stop is sent; waiting for its gateway to confirm it", None)
        outcomes = await self._fleet.send_stop(self._new_stop(caller, "console", latch=False), [robot])
        error = outcomes[robot]
        text = str(error) if error is not None else f"{robot} stopped (its gateway sent it)"
        return self._report(caller, "stop", robot, StopReport(text, good=error is None))

    async def unlatch(self, caller: Caller, robot: str) -> StopReport:
        """Release the latched stops of one robot."""
        try:
            released = await self._fleet[robot].unlatch()
            report = StopReport(f"{robot}: {len(released)} latched stops released", good=True)
        except ZbridgeError as error:
            report = StopReport(str(error), good=False)
        return self._report(caller, "unlatch", robot, report)

    async def switch(self, caller: Caller, robot: str, name: str, *, on: bool) -> StopReport:
        """Set a switch of a robot: ``light``, ``lidar`` or ``camera``."""
        target, word = self._fleet[robot], "on" if on else "off"
        switches = {"light": target.set_light, "lidar": target.set_lidar, "camera": target.set_camera}
        try:
            await switches[name](on)
            report = StopReport(f"{robot}: {name} {word} was sent", good=True)
        except ZbridgeError as error:
            report = StopReport(str(error), good=False)
        return self._report(caller, f"{name} {word}", robot, report)

    def forget(self, caller: Caller, robot: str) -> None:
        """Forget a robot that has no gateway."""
        if not self._feed.is_alive(robot):
            self._roster.forget(robot)
            self._feed.forget(robot)
            self._journal.note(caller, "forget", robot)

    def _new_stop(self, caller: Caller, reason: str, *, latch: bool) -> Stop:
        name = self._fleet.name or ("console" if caller.user else default_who())
        stop = new_stop(f"{name}.{caller.user}" if caller.user else name, reason, latch=latch)
        assert isinstance(stop.id, bytes)
        self._history.note_own(stop.id, caller.user or "this console")
        return stop

    async def _stop_all(self, caller: Caller) -> StopReport:
        try:
            stop = self._new_stop(caller, "STOP ALL in the console", latch=True)
            report = await stop_fleet(self._fleet, self._bus, stop, self._roster.names.copy(), self._feed.is_alive)
        except ZbridgeError as error:
            report = StopReport(f"STOP ALL: {error}", good=False)
        return self._report(caller, "stop_all", "", report)

    async def _release_all(self, caller: Caller) -> StopReport:
        try:
            outcomes = await self._fleet.unlatch()
        except ZbridgeError as error:
            return self._report(caller, "release", "", StopReport(f"Release: {error}", good=False))
        await asyncio.sleep(RELEASED_S)
        latched = [name for name in self._feed.latched() if name in outcomes]
        text = summarize(outcomes, "released") if outcomes else "No gateway is on the bus"
        if latched:
            text += f"; still latched by a stop of its own, released on the robot's page: {listed(latched)}"
        good = bool(outcomes) and not any(outcomes.values()) and not latched
        return self._report(caller, "release", "", StopReport(text, good=good))

    def _report(self, caller: Caller, action: str, robot: str, report: StopReport) -> StopReport:
        self._notify("one" if robot else "all", report.text, report.good)
        self._journal.note(caller, action, robot, report.text)
        return report
