"""What callers do to robots: stops, releases, switches; and what came of it, told to all and written down."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from zbridge.bus import Bus
from zbridge.client.driver import default_who
from zbridge.client.fleet import Fleet
from zbridge.client.stops import listed, new_stop, summarize
from zbridge.errors import RateLimited, ZbridgeError, describe
from zbridge.fleet.messages import Stop
from zbridge.log import Log
from zbridge.views.console.feed import FleetFeed
from zbridge.views.console.fleet_stop import StopReport, stop_fleet
from zbridge.views.console.history import ControlHistory
from zbridge.views.console.journal import Journal
from zbridge.views.console.rights import Caller
from zbridge.views.console.roster import Roster

log = Log("zbridge.console")

SAME_PRESS_S = 0.1
"""Seconds within which two presses are one: nobody can have driven the robot in between."""
ORDERS = 16
"""Most orders of one user under way; a stop of a robot that is known is never refused."""
RELEASED_S = 1.0
"""Seconds after a release until robots have shown whether they are still latched."""
_STOPPING_ALL = "STOP ALL is sent; waiting for the gateways to confirm it"
_TITLES = {"stop_all": "STOP ALL: ", "release": "Release: "}

Order = asyncio.Task[StopReport]
Work = Callable[[], Awaitable[StopReport]]
Notify = Callable[[str, str, str, bool | None], None]


class Orders:
    """Carries out what callers may do; the caller's rights are checked before.

    notify: tells all pages what is being done, to which robot ("": all), a text, and whether it went well (None: not
    known yet).
    """

    def __init__(
        self,
        fleet: Fleet,
        bus: Bus,
        feed: FleetFeed,
        roster: Roster,
        history: ControlHistory,
        journal: Journal,
        notify: Notify,
    ) -> None:
        self._fleet = fleet
        self._bus = bus
        self._feed = feed
        self._roster = roster
        self._history = history
        self._journal = journal
        self._notify = notify
        self._running: dict[Order, str] = {}
        """Orders under way, and the user of each."""
        self._newest: dict[str, tuple[Order, str, float]] = {}
        """By robot ("": all), while it is under way: what was ordered last, its action, and when."""

    def __repr__(self) -> str:
        return f"<Orders for {self._fleet!r}, {len(self._running)} under way>"

    async def close(self) -> None:
        """Wait for the orders that are under way."""
        await asyncio.gather(*self._running, return_exceptions=True)

    def stop_all(self, caller: Caller) -> Order:
        """Latch a stop of the fleet, at each press: robots may have been released, and driven, since the last one."""
        if (order := self._same_press("stop_all", "")) is not None:
            self._journal.note(caller, "stop_all", result="asked: pressed again")
            self._notify("stop_all", "", _STOPPING_ALL, None)
            return order
        for running in self._running:
            if running.get_name() in _TITLES:
                running.cancel()
        return self._begin(caller, "stop_all", "", lambda: self._stop_all(caller), _STOPPING_ALL)

    def release_all(self, caller: Caller) -> Order:
        """Release the fleet's latched stops, unless that is under way."""
        order, action, _ = self._newest.get("", (None, "", 0.0))
        if order is not None and action == "release":
            return order
        said = "Release is sent; waiting for the gateways to confirm it"
        return self._begin(caller, "release", "", self._release_all, said)

    def stop(self, caller: Caller, robot: str) -> Order:
        """Stop one robot, without a latch; raise RateLimited for too many that nobody knows."""
        said = f"{robot}: the stop is sent; waiting for its gateway to confirm it"
        if (order := self._same_press("stop", robot)) is not None:
            self._notify("stop", robot, said, None)
            return order
        if robot not in self._feed.rows:
            self._check_room(caller)
        return self._begin(caller, "stop", robot, lambda: self._stop(caller, robot), said)

    def unlatch(self, caller: Caller, robot: str) -> Order:
        """Release the latched stops of one robot; raise RateLimited."""
        self._check_room(caller)
        return self._begin(caller, "unlatch", robot, lambda: self._unlatch(robot))

    def switch(self, caller: Caller, robot: str, name: str, *, on: bool) -> Order:
        """Set a switch of a robot: ``light``, ``lidar`` or ``camera``; raise RateLimited."""
        self._check_room(caller)
        word = "on" if on else "off"
        return self._begin(caller, f"{name} {word}", robot, lambda: self._switch(robot, name, on=on))

    def forget(self, caller: Caller, robot: str) -> None:
        """Forget a robot that has no gateway."""
        if not self._feed.is_alive(robot):
            self._roster.forget(robot)
            self._feed.forget(robot)
            self._journal.note(caller, "forget", robot)

    # How orders run

    def _same_press(self, action: str, robot: str) -> Order | None:
        order, what, begun_at = self._newest.get(robot, (None, "", 0.0))
        same = what == action and asyncio.get_running_loop().time() - begun_at < SAME_PRESS_S
        return order if same else None

    def _check_room(self, caller: Caller) -> None:
        if sum(user == caller.user for user in self._running.values()) >= ORDERS:
            raise RateLimited(f"{ORDERS} orders are under way; STOP ALL always works")

    def _begin(self, caller: Caller, action: str, robot: str, work: Work, said: str | None = None) -> Order:
        self._journal.note(caller, action, robot, "asked")
        order = asyncio.create_task(self._run(caller, action, robot, work), name=action)
        order.add_done_callback(lambda order: self._end(order, robot))
        self._running[order] = caller.user
        self._newest[robot] = (order, action, asyncio.get_running_loop().time())
        if said is not None:
            self._notify(action, robot, said, None)
        return order

    async def _run(self, caller: Caller, action: str, robot: str, work: Work) -> StopReport:
        try:
            report = await work()
        except ZbridgeError as error:
            report = StopReport(f"{_TITLES.get(action, '')}{error}", good=False)
        except Exception as error:  # whatever it is, who pressed must know
            log.exception("order_failed", "{action} {robot}", action=action, robot=robot)
            report = StopReport(f"{_TITLES.get(action, '')}this console failed: {describe(error)}", good=False)
        self._journal.note(caller, action, robot, report.text)
        if self._is_newest(asyncio.current_task(), robot):
            self._notify(action, robot, report.text, report.good)
        return report

    def _is_newest(self, order: asyncio.Task[Any] | None, robot: str) -> bool:
        return robot in self._newest and self._newest[robot][0] is order

    def _end(self, order: Order, robot: str) -> None:
        del self._running[order]
        if self._is_newest(order, robot):
            del self._newest[robot]

    # What they do

    def _new_stop(self, caller: Caller, reason: str, *, latch: bool) -> Stop:
        name = self._fleet.name or ("console" if caller.user else default_who())
        stop = new_stop(f"{name}.{caller.user}" if caller.user else name, reason, latch=latch)
        assert isinstance(stop.id, bytes)
        self._history.note_own(stop.id, caller.user or "this console")
        return stop

    async def _stop_all(self, caller: Caller) -> StopReport:
        stop = self._new_stop(caller, "STOP ALL in the console", latch=True)
        return await stop_fleet(self._fleet, self._bus, stop, self._roster.names.copy(), self._feed.is_alive)

    async def _stop(self, caller: Caller, robot: str) -> StopReport:
        outcomes = await self._fleet.send_stop(self._new_stop(caller, "console", latch=False), [robot])
        error = outcomes[robot]
        text = str(error) if error is not None else f"{robot} stopped (its gateway sent it)"
        return StopReport(text, good=error is None)

    async def _unlatch(self, robot: str) -> StopReport:
        released = await self._fleet[robot].unlatch()
        return StopReport(f"{robot}: {len(released)} latched stops released", good=True)

    async def _switch(self, robot: str, name: str, *, on: bool) -> StopReport:
        target = self._fleet[robot]
        switches = {"light": target.set_light, "lidar": target.set_lidar, "camera": target.set_camera}
        await switches[name](on)
        return StopReport(f"{robot}: {name} {'on' if on else 'off'} was sent", good=True)

    async def _release_all(self) -> StopReport:
        outcomes = await self._fleet.unlatch()
        await asyncio.sleep(RELEASED_S)
        latched = [name for name in self._feed.latched() if name in outcomes]
        text = summarize(outcomes, "released") if outcomes else "No gateway is on the bus"
        if latched:
            text += f"; still latched by a stop of its own, released on the robot's page: {listed(latched)}"
        good = bool(outcomes) and not any(outcomes.values()) and not latched
        return StopReport(text, good=good)
