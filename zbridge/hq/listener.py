"""One listener for HQ programs: accepts them as if it were the robot, and ends them. Knows no protocol.

Theory of operation. :class:`Listener` accepts links and makes a :class:`Client` of each; a client translates what its
program sends and commands the robot through its operator; :class:`Broadcast` shows the robot to all clients. Every
0.1 s the listener lets clients that hold the robot repeat and renew, every 0.5 s it ends those that break its limits.
A freeze of the process takes the robot from every client. At the end every client is closed and the robot given back.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from zbridge.clocks import Clocks
from zbridge.hq.admission import FULL, Admission
from zbridge.hq.broadcast import Broadcast
from zbridge.hq.client import SWEEP_S, Client
from zbridge.hq.context import Bridge, ListenerContext, listener_counts
from zbridge.hq.freeze import FROZEN, FreezeWatch
from zbridge.hq.handover import ListenerHandover
from zbridge.hq.listener_log import ConnectionLog, FailureLog
from zbridge.hq.refusal_reports import RefusalReports
from zbridge.hq.robot_queries import RobotQueries
from zbridge.hq.robot_subscription import RobotSubscription
from zbridge.hq.settings import ListenerPlan
from zbridge.log import Log
from zbridge.metrics import Metrics
from zbridge.protocol.address import DatagramAddress
from zbridge.protocol.kept import Exported
from zbridge.protocol.plugin import ATTEND_S
from zbridge.protocol.session import Limits, Session
from zbridge.protocol.session_table import SessionTable
from zbridge.tasks import Tasks
from zbridge.transport import Accepted, Conversation, Door, Link, Parcel, Receiver, SourceDoor, TlsLink, listen
from zbridge.transport.kernel import KERNEL, Kernel

log = Log("zbridge.hq")

LEAVE_S = 0.7
"""Longest time that clients, and the robot's gateway, are given to learn that the listener ends."""
_FRAME_BYTES = 64 * 1024


class Listener:
    """Serves the clients of one ``[[hq]]`` until cancelled.

    name: of the listener on the bus. exported: the listener as another process exported it, and its sockets. clocks,
    kernel: of this machine, or of a simulated one.
    """

    def __init__(
        self,
        plan: ListenerPlan,
        name: str,
        robot: RobotSubscription,
        sessions: SessionTable,
        metrics: Metrics,
        clocks: Clocks = Clocks(),  # noqa: B008 -- frozen
        exported: tuple[Exported, Parcel] | None = None,
        kernel: Kernel = KERNEL,
    ) -> None:
        self._exported = exported
        self._clocks, self._clock = clocks, clocks.clock
        self.name = name
        self.address = plan.address
        self.protocol = plan.protocol.name
        self.ready = asyncio.Event()
        """Set when clients are accepted; ``address`` has the port then."""
        self.clients: dict[int, Client] = {}
        self._sessions = sessions
        self._context = context = self._make_context(plan, robot, metrics)
        self._numbers = context.side.numbers(plan.settings.clients)
        self._admission = Admission(plan)
        self._broadcast = Broadcast(context, self.clients)
        self._queries = RobotQueries(context)
        self._refusals = RefusalReports(
            robot.bus, robot.keys, f"hq.{name}", context.tasks, context.counts.refusals_untold
        )
        self._active: set[Client] = set()
        """Clients whose operator has to be called regularly."""
        self._secured: Callable[[Receiver], Receiver] | None = None
        if (tls := plan.tls) is not None:
            self._secured = lambda receiver: TlsLink(receiver, tls, plan.settings.handshake_s)
        self._closing = False
        kind = partial(SourceDoor, to=plan.to) if isinstance(plan.address, DatagramAddress) else Door
        self._door = kind(exported[0]["door"], exported[1], kernel) if exported is not None else kind(kernel=kernel)
        self.handover = ListenerHandover(context, self._door, self.clients, self._numbers, self._add)
        """How the listener is handed to another process."""

    def __repr__(self) -> str:
        return f"<Listener {self.name} {self.address}, {len(self.clients)} clients>"

    async def run(self, begin: Callable[[], Awaitable[None]] | None = None) -> None:
        """Listen until cancelled; then close every client and give the robot back. Raises LinkError.

        Returns where another process has taken the listener over. ``begin``: of a listener that was handed over; called
        when everything is restored, and waited for before anything is read or written.
        """
        self._broadcast.begin()
        async with listen(
            self.address,
            lambda: Accepted(self._admit),
            datagrams=self._context.side.datagrams,
            foreign=self._context.counts.foreign_datagrams,
            secured=self._secured,
            door=self._door,
        ) as self.address:
            if self._exported is not None and begin is not None:
                await self.handover.restore(*self._exported)
                self._broadcast.follow_wanted()
                await begin()
                self._context.freeze.begin(self._clock())
                await self.handover.resume()
            template = "{listener}: HQ programs connect at {address}"
            log.info("hq_listening", template, listener=self.name, address=self.address)
            self.ready.set()
            try:
                await self._attend()
            finally:
                if self.handover.detached.is_set():
                    self._refusals.close()
                    await asyncio.shield(self._context.tasks.end())
                else:
                    await asyncio.shield(self._leave())

    def _make_context(self, plan: ListenerPlan, robot: RobotSubscription, metrics: Metrics) -> ListenerContext:
        assert plan.protocol.hq is not None
        label = plan.settings.name or f"{plan.protocol.name}:{plan.address.port}"
        tasks, counts = Tasks(), listener_counts(metrics, label)
        return ListenerContext(
            name=self.name,
            settings=plan.settings,
            side=plan.protocol.hq(plan.options, robot.view, metrics),
            robot=robot,
            bridge=Bridge(robot.bus, robot.keys, robot.view, tasks.start),
            tasks=tasks,
            counts=counts,
            connections=ConnectionLog(self.name),
            failures=FailureLog(self.name, counts.left_out),
            freeze=FreezeWatch(self._clock(), self._on_freeze, self._clocks.suspended_s),
            clock=self._clock,
            clock_ms=self._clocks.raw_ms,
            limits=Limits(
                frame_bytes=_FRAME_BYTES, handshake_s=plan.settings.handshake_s, rate_hz=plan.settings.rate_hz
            ),
        )

    # While it listens

    async def _attend(self) -> None:
        freeze, sweep_at = self._context.freeze, self._clock() + SWEEP_S
        freeze.begin(self._clock())
        while not self.handover.detached.is_set():
            await asyncio.sleep(ATTEND_S)
            freeze.beat(self._clock())
            if self.handover.suspended:
                continue
            for client in tuple(self._active):
                client.tick()
                if not client.operator.active:
                    self._active.discard(client)
            if self._clock() >= sweep_at:
                sweep_at = self._clock() + SWEEP_S  # sweeps that a freeze left out are not made up for
                self._context.connections.flush(self._clock())
                for client in tuple(self.clients.values()):
                    client.sweep()

    def _on_freeze(self, frozen_s: float) -> None:
        template = "{listener}: frozen for {frozen_s:.1f} s: every HQ program must send neutral first"
        log.warning("listener_froze", template, listener=self.name, frozen_s=frozen_s)
        for client in tuple(self.clients.values()):
            client.let_go(FROZEN)

    async def _leave(self) -> None:
        """Close every client, give the robot back, and wait at most LEAVE_S until both are done."""
        self._closing = True
        tasks, clients = self._context.tasks, tuple(self.clients.values())
        for client in clients:
            client.close()
            client.conversation.close("gateway stopped")
        self._refusals.close()
        waiting = {client.conversation.ended for client in clients} | tasks.running
        if waiting:
            await asyncio.wait(waiting, timeout=LEAVE_S)
        for client in clients:
            client.conversation.abandon()
        self._context.connections.flush()
        tasks.cancel()
        self._context.bridge.close()

    # Clients come and go

    def _admit(self, link: Link) -> Conversation | None:
        """Make a client of an accepted link; None if it is refused."""
        context, now = self._context, self._clock()
        host = link.peer.partition("://")[2].rpartition(":")[0].strip("[]")
        reason = "the gateway stops" if self._closing else self._admission.refusal(host, len(self.clients), now)
        number = self._numbers.take(now) if reason is None else None
        if number is None:
            self._turn_away(link, host, reason or FULL)
            return None
        try:
            session = context.side.session(number, context.limits)
        except Exception as error:
            context.failures.note("no session for a client", error)
            self._numbers.release(number, now, rests=False)
            self._turn_away(link, host, "the listener cannot serve the robot")
            return None
        client = self._add(number, host, session)
        context.counts.accepted.value += 1
        template = "{listener}: {peer} connected as client {client}"
        level = client.level("connected")
        log.log(level, "hq_connected", template, listener=self.name, peer=link.peer, client=number)
        return client.conversation

    def _add(self, number: int, host: str, session: Session[Any]) -> Client:
        session.name = f"{self.name}.{number}"
        client = self.clients[number] = Client(
            self._context, number, host, session, queries=self._queries, refusals=self._refusals, spoke=self._on_spoken
        )
        client.conversation.ended.add_done_callback(lambda _: self._dismiss(client))
        self._sessions.add(session)
        return client

    def _turn_away(self, link: Link, host: str, reason: str) -> None:
        count = self._context.counts.turned_away
        count.value += 1
        if self._context.connections.first(host, f"turned away: {reason}", self._clock()):
            log.warning(
                "hq_turned_away",
                "{listener}: {peer} turned away ({count} so far): {reason}",
                listener=self.name,
                peer=link.peer,
                count=count.value,
                reason=reason,
            )

    def _on_spoken(self, client: Client) -> None:
        if client.operator.active:
            self._active.add(client)
        self._broadcast.follow_wanted()

    def _dismiss(self, client: Client) -> None:
        """Forget a client whose conversation has ended; its number may be given again."""
        client.close()
        self.clients.pop(client.number, None)
        self._active.discard(client)
        self._numbers.release(client.number, self._clock(), rests=client.session.traffic.frames_in > 0)
        self._sessions.remove(client.session)
        self._broadcast.follow_wanted()
        log.log(
            client.level("gone"),
            "hq_gone",
            "{listener}: client {client} gone: {reason}",
            listener=self.name,
            client=client.number,
            reason=client.session.reason,
            peer=client.session.peer,
        )
