"""One robot on the bus, from its first connection to its last stop: puts the parts of this package together.

In: ``commands`` (what drives), ``queries`` (what is asked). Out: ``telemetry``, ``presence`` (``status``). Between them
stand the links of ``connection`` and the enforcer of :mod:`zbridge.control`.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

import msgspec

from zbridge.bus import Handle
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.context import RobotContext
from zbridge.control.enforcer import Enforcer, Save
from zbridge.control.events import StopCause
from zbridge.control.lease_server import LeaseServer
from zbridge.control.motion_limits import MotionLimits
from zbridge.control.standstill import IDLE_STOP_S, STOP_REPEAT_S, Standstill
from zbridge.errors import BusError, NotReady, Refused, Unsupported
from zbridge.protocol.kept import Budget, Exported
from zbridge.protocol.session import PARTIAL, Session, State
from zbridge.robot.claim import Standing
from zbridge.robot.commands import Commands
from zbridge.robot.connection import Connection, LinkHooks, Links, LinkSettings
from zbridge.robot.fleet_latches import FleetLatchNews
from zbridge.robot.observer import ObservedRobot, Observer
from zbridge.robot.on_demand import OnDemand
from zbridge.robot.presence import Presence
from zbridge.robot.publishers import RobotPublishers
from zbridge.robot.queries import PendingQueries, Queries
from zbridge.robot.telemetry import Telemetry
from zbridge.transport import ConversationHooks, Parcel, Transferable
from zbridge.transport.reading import ReadTimes
from zbridge.wire.frames import Partial

HEARD_S = 3.0
"""A robot of which nothing came for so long is not healthy."""
ASIDE_S = 1.0
"""Longest time for the last stop to be written, before the robot is left to another gateway."""
HEARTBEAT_S = 1.0
"""Seconds between repetitions of ``status`` and ``control``."""
LEAVE_S = 0.7
"""Longest time the robot is given to hear that the gateway leaves."""
FLUSH_S = 0.2
"""Longest time the bus is given to take the last words."""
_LEAVING = "gateway stopped"
_CRASHED = "crashed"
_ASIDE = "another gateway serves the robot"
_TAKING_OVER = "another process takes the robot over"
_LOOK_S = 0.005
"""Seconds between two looks whether the links can be handed over."""


class ControlParts(msgspec.Struct, frozen=True, kw_only=True):
    """What decides over the motion of one robot.

    limits: None where drives are not limited. idle_stop_s: see :class:`Standstill`. save: see :class:`Enforcer`.
    """

    authority: Authority
    audit: Audit
    limits: MotionLimits | None = None
    idle_stop_s: float = IDLE_STOP_S
    save: Save = lambda latches: None


class RobotDevice(Transferable):
    """One robot on the bus; ``run`` serves it. protocol: as ``status`` shows it. observer: None: nobody observes."""

    def __init__(
        self,
        context: RobotContext,
        protocol: str,
        settings: LinkSettings,
        control: ControlParts,
        observer: Observer | None = None,
    ) -> None:
        loop = asyncio.get_running_loop()
        self._protocol = protocol
        self._detached = asyncio.Event()
        self._crashed = False
        """Whether the robot was taken over from a process that died."""
        self._commanded: list[Handle] = []
        self._declared: list[Handle] = []
        self._on_demand: list[OnDemand] = []
        self._observer = watching = observer or Observer()  # a plain Observer ignores everything
        bus, keys, open_faults = context.bus, context.keys, context.open_faults
        self.publishers = RobotPublishers(bus, keys, open_faults, context.clock, watching.published, context.box)
        self._links = links = Links()
        publish = self.publishers.publish
        self._context = context = msgspec.structs.replace(context, publish=publish, pump=links.pump)  # now complete
        self._pending = pending = PendingQueries(loop)
        self._standstill = Standstill(context, control.authority, control.idle_stop_s)
        self.enforcer = enforcer = Enforcer(
            context, control.authority, self._standstill, control.audit, control.limits, control.save
        )
        enforcer.settled = observer.changed if observer is not None else None
        self.observed = ObservedRobot(context, links, control.authority)
        self._leases = LeaseServer(context, enforcer)
        self._latch_news = FleetLatchNews(bus, keys, enforcer, self._leases, settings.chance)
        self._commands = Commands(context, enforcer)
        self._queries = Queries(context, self._commands, pending)
        self._telemetry = Telemetry(context, self.publishers, pending, links)
        self._presence = Presence(
            context, protocol, links, enforcer, self._standstill, self._commands, pending, watching
        )
        hooks = self._hooks(settings, observer)
        for name, address in zip(context.robot.link_names, settings.addresses, strict=True):
            links.add(Connection(name, f"{keys.robot} {name}", address, settings, hooks))

    def _hooks(self, settings: LinkSettings, observer: Observer | None) -> LinkHooks:
        context, presence = self._context, self._presence
        conversation = ConversationHooks(
            deliver=self._telemetry.deliver,
            before=self.enforcer.keep_time,
            clock=context.clock,
            share=settings.share,
            times=ReadTimes(context.metrics.histogram("socket_to_bus_seconds")),
            malformed=context.metrics.count("malformed_frames"),
            foreign=context.metrics.count("foreign_datagrams"),
            surplus=context.metrics.count("surplus_datagrams"),
        )
        read = observer.read if observer is not None else None
        changes = (presence.session_changed, presence.state_changed, presence.count_connection, presence.stalled)
        return LinkHooks(self._session, *changes, self._observer.linked, read, conversation)

    def __repr__(self) -> str:
        return f"<RobotDevice {self._context.keys.robot} {self.observed.state}>"

    async def run(self, begin: Callable[[], Awaitable[None]] | None = None) -> None:
        """Serve the robot until cancelled; then stop it if it moves, and take leave of it.

        Returns where :meth:`detach` was called. ``begin``: after :meth:`restore`, waited for once everything is
        declared; until then nothing is read or written, and only ``control`` is published, which confirms stops.
        """
        if begin is None:
            self._show()
        bus = self._context.bus
        bus.on_relief(self._links.resume_reading)
        self._listen()
        self._declared = [bus.watch_connected(self._on_bus)]
        if begin is not None:
            await bus.alive(self._context.keys.alive("gateway"))  # by its answer the bus knows our keys
            await begin()
            await self.resume()
            if self._crashed:
                self.publishers.repeat()
            self._show()
        if not self.observed.aside:
            self._standstill.begin()
        self._observer.began(self.observed)
        async with asyncio.TaskGroup() as tasks:
            work = [tasks.create_task(self._beat()), tasks.create_task(self._latch_news.run())]
            work += [tasks.create_task(connection.run()) for connection in self._links]
            try:
                await self._detached.wait()
            finally:  # the links' tasks still run: the group ends them only after this
                if not self._detached.is_set():
                    await asyncio.shield(self._shut_down())
                for task in work:
                    task.cancel()

    def _show(self) -> None:
        self._context.open_faults.changed = self._presence.publish_status
        self._presence.publish_status()
        self.enforcer.report()

    def _listen(self) -> None:
        """Take commands and queries from the bus, and watch for listeners; idempotent. Not while another one serves."""
        if self.observed.aside:
            return
        context = self._context
        self._on_demand = self._on_demand or self._telemetry.serve()
        self._commanded = self._commanded or [
            *self._leases.serve(),
            context.bus.subscribe(context.keys.key("@cmd/**"), self._commands.take, priority=self.enforcer.admission),
            *self._queries.serve(),
        ]

    def _session(self, link: str, address: str) -> Session[Any]:
        """Make the session of a new connection; the names of the one before it are given up."""
        if link == self._links.first.name:
            self.publishers.forget_names()
        return self._context.robot.session(link, address)

    def _refuse_all(self, reason: str | None) -> None:
        """Take no command and give no lease from now on; None: again."""
        self._commands.refuse_all(reason)
        self._leases.refuse_all(reason)

    def _on_bus(self, connected: bool) -> None:
        if not connected:
            self.enforcer.authority.bus_lost()
            self.enforcer.settle()
        else:
            self._latch_news.returned()

    async def _beat(self) -> None:
        while True:
            await asyncio.sleep(HEARTBEAT_S)
            self.publishers.expire()
            self._context.open_faults.expire()
            if self._commanded:  # else another gateway, or the next process, says it
                self._presence.publish_status()
                self.enforcer.beat()

    # Another gateway serves the robot too

    @property
    def standing(self) -> Standing:
        """How this gateway stands with the robot."""
        session, talk = self._context.robot.driving, self._links.first.conversation
        record = self.enforcer.authority.latches.record
        if talk is None or session is None:
            return Standing(record=record)
        established = session.state is State.ESTABLISHED and session.doubtful is None
        now = self._context.clock()
        healthy = established and not talk.stalled and now - talk.heard_at <= HEARD_S
        connected_s = now - talk.connected_at if talk.link is not None and talk.connected_at is not None else 0.0
        return Standing(healthy, connected_s, record)

    @property
    def must_stay(self) -> bool:
        """Whether there is a connection that must not be closed while another gateway has one."""
        return not self._context.robot.closing_harmless and any(connection.is_up for connection in self._links)

    async def step_aside(self) -> None:
        """Stop the robot once, and leave it to another gateway: only what keeps the connections alive is written.

        Nothing is published, and no command or query taken, until :meth:`step_in`.
        """
        if self.observed.aside:  # as the process before this one
            return
        self._refuse_all(_ASIDE)
        self.enforcer.stop(_ASIDE, StopCause.ANOTHER_GATEWAY)
        self.enforcer.beat()
        self._pending.refuse_all(_ASIDE)
        self.observed.aside = True
        self._standstill.close()
        await self.withdraw()
        self.publishers.mute(True)
        await self._stop_written()
        self.enforcer.lease_hook.forget()
        for connection in self._links:
            connection.mute(True)
        on_demand, self._on_demand = self._on_demand, []
        for each in on_demand:
            each.close(tell=True)
        self._observer.changed()

    async def step_in(self) -> None:
        """Serve the robot again, beginning with a stop."""
        self.observed.aside = False
        for connection in self._links:
            connection.mute(False)
        self.publishers.mute(False)
        self._listen()
        self._refuse_all(None)
        self._latch_news.returned()
        self._standstill.begin()
        self.enforcer.stop("served again", StopCause.ANOTHER_GATEWAY)
        self._show()
        self._observer.changed()

    async def _stop_written(self) -> None:
        session, until = self._context.robot.driving, self._context.clock() + ASIDE_S
        while session and session.outbox.waits(now := self._context.clock()) and now < until:  # noqa: ASYNC110 - bounded
            await asyncio.sleep(_LOOK_S)

    # A restart: another process takes the robot over

    async def prepare(self, reason: str, within_s: float) -> None:
        """Stop the robot, end the lease and take no commands; wait until the links can be handed over.

        A driven robot that misses some stops is sent two more of them first: a successor that hangs writes nothing.
        Raises Refused with the reason where that takes longer than ``within_s``; :meth:`resume` takes it all back.
        """
        if not self._context.robot.hands_over:
            raise Unsupported(f"protocol {self._protocol} does not hand its sessions over")
        self._refuse_all(reason)
        driven = self.enforcer.authority.motion.driven
        self.enforcer.stop(reason, StopCause.RESTART)
        self._context.pump()
        until = self._context.clock() + within_s
        if driven and math.isfinite(often_s := self._context.robot.idle_stop_s):
            await asyncio.sleep(2 * often_s)
        while any(connection.blocker for connection in self._links):
            if self._context.clock() >= until:
                raise NotReady("; ".join(f"{each.name}: {each.blocker}" for each in self._links if each.blocker))
            await asyncio.sleep(_LOOK_S)

    def suspend(self) -> None:
        """Read and write nothing from now on."""
        for connection in self._links:
            connection.suspend()

    def export(self, parcel: Parcel, budget: Budget | None = None) -> Exported:
        """Put the links into a parcel; describe them, the robot, and what was published."""
        return {
            "links": [connection.export(parcel, budget) for connection in self._links],
            "robot": self._context.robot.export(budget),
            "published": self.publishers.export(budget),
            "latches": self.enforcer.authority.latches.export(),
            "aside": self.observed.aside,
        }

    def deposit(self, parcel: Parcel, budget: Budget) -> Exported | None:
        """Describe what another process needs to resume if this one dies; None if it could not.

        The incomplete frames are not described: :meth:`partial` tells them after each read.
        """
        session = self._context.robot.driving
        if not self._context.robot.hands_over or session is None or session.state is not State.ESTABLISHED:
            return None
        talks = (connection.conversation for connection in self._links)
        if any(talk is not None and talk.link is None for talk in talks):  # a link that is not up yet
            return None
        return {**self.export(parcel, budget), _CRASHED: True}

    async def restore(self, state: Exported, parcel: Parcel, partials: Sequence[Partial] = ()) -> None:
        """Restore what another process exported, or deposited; raise ProtocolError.

        Call :meth:`run` with ``begin`` then. partials: with a deposit, the incomplete frames of the links that are up.
        """
        self._refuse_all(_TAKING_OVER)
        self._crashed = bool(state.get(_CRASHED))
        self.observed.aside = self.publishers.muted = state["aside"]
        for connection in self._links:
            connection.mute(self.observed.aside)
        self.enforcer.authority.restore_latches(state["latches"])
        for link, partial_frame in zip(filter(None, state["links"]), partials, strict=False):
            link["session"][PARTIAL] = list(partial_frame)
        for connection, link in zip(self._links, state["links"], strict=True):
            connection.restore(link, parcel)
        if not self._crashed:
            self._latch_news.inherited()
        self.publishers.restore(state["published"])  # a new session gives up the names of the one before it
        if any(state["links"]):
            self._context.robot.restore(state["robot"])
        session = self._context.robot.driving
        if session is not None and session.state is State.ESTABLISHED:
            self._presence.restore(session)
            if self._crashed:  # what waited then may have been written since, and may be motion
                session.outbox.forget()
                with contextlib.suppress(Refused):
                    self._standstill.stop(ordered=False)
                self.enforcer.lease_hook.notify(anew=True)

    async def resume(self) -> None:
        """Read, write and take commands: again, or for the first time with what was taken over."""
        self._listen()
        reason = _ASIDE if self.observed.aside else None
        self._refuse_all(reason)
        self._context.open_faults.changed = self._presence.publish_status
        for connection in self._links:
            await connection.resume()

    async def withdraw(self) -> None:
        """Take no commands and queries from the bus any more: another process does."""
        self._context.open_faults.changed = lambda: None
        handles, self._commanded = self._commanded, []
        for handle in handles:
            handle.close()

    async def detach(self) -> None:
        """Give the links up and end :meth:`run`; the robot notices nothing."""
        self._detached.set()
        self._standstill.close()
        self.enforcer.close()
        self._context.open_faults.changed = lambda: None
        for connection in self._links:
            connection.detach()

    async def _shut_down(self) -> None:
        """Stop a moving robot, take leave of it, say so on the bus, and leave the robot's keys to others."""
        self._presence.leave()
        self._refuse_all(_LEAVING)
        if self.enforcer.authority.motion.moving:
            self.enforcer.stop(_LEAVING, StopCause.GATEWAY_ENDING)
        self.enforcer.lease_hook.leave()
        await asyncio.sleep(min(self._standstill.stopping_s, STOP_REPEAT_S))
        await asyncio.gather(*(connection.close(_LEAVING, LEAVE_S) for connection in self._links))
        self._presence.publish_status()
        self._standstill.close()
        self.enforcer.close()
        self._observer.ended()
        with contextlib.suppress(BusError, TimeoutError):
            async with asyncio.timeout(FLUSH_S):
                await self._context.bus.flush()
        self._context.open_faults.changed = lambda: None
        for handle in (*self._commanded, *self._on_demand, *self._declared):
            handle.close()
        self.publishers.close()
