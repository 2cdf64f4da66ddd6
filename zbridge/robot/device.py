"""One robot on the bus, from its first connection to its last stop: puts the parts of this package together.

In: ``commands`` (what drives), ``queries`` (what is asked). Out: ``telemetry``, ``presence`` (``status``). Between them
stand the links of ``connection`` and the enforcer of :mod:`zbridge.control`.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from zbridge.bus import Bus, Handle
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.conditions import Conditions
from zbridge.control.context import RobotContext
from zbridge.control.enforcer import Enforcer
from zbridge.control.faults import Faults
from zbridge.control.lease_server import LeaseServer
from zbridge.control.motion_limits import MotionLimits
from zbridge.control.standstill import IDLE_STOP_S, STOP_REPEAT_S, Standstill
from zbridge.errors import BusError, Refused
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics
from zbridge.protocol.address import DeviceAddress
from zbridge.protocol.plugin import Robot
from zbridge.protocol.session import Datagram, Session, State
from zbridge.protocol.session_table import SessionTable
from zbridge.robot.commands import Commands
from zbridge.robot.connection import Connect, Connection, Hooks, Links
from zbridge.robot.observer import Boundary, LastStop, Nobody, Observer, StopFrame
from zbridge.robot.presence import Presence
from zbridge.robot.publishers import RobotPublishers
from zbridge.robot.queries import PendingQueries, Queries
from zbridge.robot.telemetry import Telemetry
from zbridge.transport import connect

HEARTBEAT_S = 1.0
"""Seconds between repetitions of ``status`` and ``control``."""
LEAVE_S = 0.7
"""Longest time the robot is given to hear that the gateway leaves."""
FLUSH_S = 0.2
"""Longest time the bus is given to take the last words."""
_LEAVING = "gateway stopped"


class Device:
    """One robot on the bus; ``run`` serves it. addresses: one for each of the robot's links."""

    def __init__(
        self,
        robot: Robot,
        addresses: tuple[DeviceAddress, ...],
        *,
        protocol: str,
        keys: KeySpace,
        bus: Bus,
        authority: Authority,
        manager: SessionTable,
        metrics: Metrics,
        audit: Audit,
        limits: MotionLimits | None = None,
        conditions: Conditions | None = None,
        idle_stop_s: float = IDLE_STOP_S,
        connect: Connect = connect,
        observer: Observer | None = None,
        clock: Callable[[], float] | None = None,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        loop = asyncio.get_running_loop()
        clock, conditions = clock or loop.time, conditions or Conditions()
        self._observer = observer or Nobody()
        self._publishers = publishers = RobotPublishers(bus, keys, conditions, clock)
        self._links = links = Links()
        self._context = context = RobotContext(
            robot, keys, bus, metrics, conditions, Faults(keys.robot), publishers.publish, links.pump, clock, clock_ns
        )
        pending = PendingQueries(loop)
        self._standstill = Standstill(context, authority, idle_stop_s)
        self._enforcer = Enforcer(context, authority, self._standstill, audit, limits)
        self._enforcer.settled = self._observer.changed
        self._leases = LeaseServer(context, self._enforcer)
        self._commands = Commands(context, self._enforcer)
        self._queries = Queries(context, self._commands, pending)
        self._telemetry = Telemetry(context, self._publishers, pending, links)
        self._presence = Presence(context, protocol, links, self._enforcer, self._standstill, self._commands, pending)
        conditions.changed = self._presence.publish_status
        for name, address in zip(robot.link_names, addresses, strict=True):
            hooks = self._hooks(name, address, connect, manager)
            links.add(Connection(name, f"{keys.robot} {name}", address, hooks))

    def _hooks(self, name: str, address: DeviceAddress, connect: Connect, sessions: SessionTable) -> Hooks:
        context, presence = self._context, self._presence
        return Hooks(
            session=partial(self._session, name, str(address)),
            deliver=self._telemetry.deliver,
            session_changed=presence.session_changed,
            state_changed=self._state_changed,
            connect=connect,
            manager=sessions,
            malformed=context.metrics.count("malformed"),
            foreign=context.metrics.count("foreign_datagrams"),
            clock=context.clock,
            before=self._enforcer.keep_time,
            stalled=partial(presence.stalled, name),
            linked=partial(self._observer.linked, name),
        )

    def __repr__(self) -> str:
        return f"<Device {self._context.keys.robot} {self._links.first.state}>"

    async def run(self) -> None:
        """Serve the robot until cancelled; then stop it if it moves, and take leave of it."""
        context = self._context
        self._presence.publish_status()
        self._enforcer.report()
        self._standstill.begin()
        self._observer.began(self)
        declared = [
            *self._leases.serve(),
            context.bus.subscribe(context.keys.key("@cmd/**"), self._commands.take, lane=self._enforcer.gate),
            context.bus.watch_connected(self._on_bus),
            *self._queries.serve(),
            *self._telemetry.serve(),
        ]
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._beat())
            for connection in self._links:
                tasks.create_task(connection.run())
            try:
                await asyncio.Event().wait()
            finally:  # the links' tasks still run: the group ends them only after this
                await asyncio.shield(self._shut_down(declared))

    @property
    def reached(self) -> bool:
        """Whether the robot was ever reached."""
        return self._presence.reached

    @property
    def driven(self) -> bool:
        """Whether a program drives the robot, or told it to move by itself."""
        return self._enforcer.authority.driven or self._enforcer.authority.moving

    @property
    def state(self) -> str:
        """The state of the robot, as on ``status``."""
        return self._links.first.state

    def last_stop(self) -> LastStop:
        """Give what stops the robot now; see :class:`LastStop`."""
        session, driven, state = self._context.robot.driving, self.driven, self.state
        if session is None or session.state is not State.ESTABLISHED:
            return LastStop(driven, state=state)
        try:
            frames = self._context.robot.stop_frames()
        except Refused:
            frames = ()
        except Exception as error:
            self._context.faults.note("stop", error)
            frames = ()
        stop = tuple(StopFrame(bytes(frame), type(frame) is Datagram) for frame in frames)
        return LastStop(driven, stop, session.outbox.gap_s, state)

    def boundary(self, name: str) -> Boundary:
        """Give where the stream of a link stands; see :class:`Boundary`."""
        conversation = next((each.conversation for each in self._links if each.name == name), None)
        if conversation is None:
            return Boundary(outgoing=False, incoming=False)
        return Boundary(not conversation.stalled, conversation.session.between_frames)

    def _state_changed(self) -> None:
        self._presence.publish_status()
        self._observer.changed()

    def refuse(self, command: str, refusal: Refused, who: str) -> None:
        """Show on ``control`` what was refused to somebody."""
        self._enforcer.refuse(command, refusal, who)
        self._enforcer.settle()

    def _session(self, link: str, address: str) -> Session[Any]:
        """Make the session of a new connection; the names of the one before it are given up."""
        if link == self._links.first.name:
            self._publishers.forget_names()
        return self._context.robot.session(link, address)

    def _on_bus(self, connected: bool) -> None:
        if not connected:
            self._enforcer.bus_lost()

    async def _beat(self) -> None:
        while True:
            await asyncio.sleep(HEARTBEAT_S)
            self._publishers.expire()
            self._presence.publish_status()
            self._enforcer.beat()

    async def _shut_down(self, declared: list[Handle]) -> None:
        """Stop a moving robot, take leave of it, say so on the bus, and leave the robot's keys to others."""
        self._presence.leave()
        self._commands.refuse_all(_LEAVING)
        self._leases.refuse_all(_LEAVING)
        if self._enforcer.authority.moving:
            self._enforcer.stop(_LEAVING)
        await asyncio.sleep(min(self._standstill.stopping_s, STOP_REPEAT_S))
        await asyncio.gather(*(connection.close(_LEAVING, LEAVE_S) for connection in self._links))
        self._presence.publish_status()
        self._standstill.close()
        self._enforcer.close()
        self._observer.ended()
        with contextlib.suppress(BusError, TimeoutError):
            async with asyncio.timeout(FLUSH_S):
                await self._context.bus.flush()
        self._context.conditions.changed = lambda: None
        for handle in declared:
            handle.close()
        self._publishers.close()
