"""One listener for HQ programs: accepts them, shows each the robot, and lets each command as far as it may.

Every client has a session, an outbox and a hand on the robot of its own: what one does or fails to do costs the
others nothing.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import math
from collections.abc import Callable, Coroutine
from typing import Any

from zbridge.bus import Bus
from zbridge.errors import BusError, EncodeError, PayloadError, ProtocolError, Refused, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, Status
from zbridge.fleet.topics import Delivery, KeySpace, Topic
from zbridge.hq.arrivals import Arrivals, Folding
from zbridge.hq.bridge import Bridge
from zbridge.hq.intent import Intent
from zbridge.hq.operator import REPEAT_S, Operator
from zbridge.hq.refusals import Teller
from zbridge.hq.robot_subscription import RobotSubscription
from zbridge.hq.settings import ListenerPlan
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import HqSide, Send
from zbridge.protocol.session import Limits, Session, State
from zbridge.protocol.session_table import ClientIds, SessionTable
from zbridge.transport.conversation import Accepted, Conversation
from zbridge.transport.link import Link
from zbridge.transport.tcp import listen

log = logging.getLogger("zbridge.hq")

STALL_S = 5.0
"""Seconds of not taking what is written after which a client is given up; seconds of taking it make up for them."""
RUBBISH = 20
"""Malformed messages between two looks, with no other among them, after which a client is given up."""
SWEEP_S = 0.5
"""Seconds between two looks at all clients."""
TELL_S = 5.0
"""Seconds within which a client is not told the same thing again."""
ANSWER_S = 2.5
"""Longest time a client's question waits for the robot's answer."""
LEAVE_S = 0.7
"""Longest time clients are given to hear that the listener ends, and the robot's gateway to hear of it."""
BROKEN = 64
"""Different things a protocol failed at that are logged; the others are counted."""
ATTEND_EVERY = 64
"""Clients that are written to between two looks at the stops and commands that wait."""
FROZEN_S = 0.6
"""Seconds without a beat after which a process is taken to have been frozen: what its clients said meanwhile is old."""
CATCH_UP_S = 0.3
"""Seconds for which old words may still come in after that."""
_STOOD_STILL = "the gateway stood still"
_FULL = "as many clients as there can be"
_FRAME_BYTES = 64 * 1024
_ANSWERED = {topics.RPC_MAP.path: topics.MAP, topics.RPC_POSE.path: topics.POSE}


class Client:
    """One HQ program: its session, its conversation, and its hand on the robot."""

    def __init__(self, number: int, host: str, session: Session[Any]) -> None:
        self.number = number
        self.host = host
        self.session = session
        self.helm: Operator
        self.conversation: Conversation
        self.begun = False
        self.heard = 0
        self.silent_s = 0.0
        self.stalled_s = 0.0
        self.seen = (0, 0)
        """Messages that were malformed, and all, at the last look."""
        self.told: dict[str, float] = {}
        self.due = math.inf
        """When what it said is carried out that waits for more of it."""
        self.timer: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<Client {self.number} {self.session!r}>"


class Listener:
    """Serves the clients of one ``[[hq]]`` until cancelled. ``name``: of the listener on the bus."""

    def __init__(
        self,
        plan: ListenerPlan,
        name: str,
        audience: RobotSubscription,
        bus: Bus,
        keys: KeySpace,
        manager: SessionTable,
        metrics: Metrics,
        clock: Callable[[], float] | None = None,
    ) -> None:
        assert plan.protocol.hq is not None
        self.name = name
        self.address = plan.address
        self.ready = asyncio.Event()
        self.clients: dict[int, Client] = {}
        self._plan = plan
        self._settings = plan.settings
        self._audience = audience
        self._side: HqSide = plan.protocol.hq(plan.options, audience.view, metrics)
        self._keys = keys
        self._manager = manager
        self._loop = asyncio.get_running_loop()
        self._clock = clock or self._loop.time
        self._tasks: set[asyncio.Task[None]] = set()
        self._bridge = Bridge(bus, keys, audience.view, self._spawn)
        self._bus = bus
        untold = metrics.count("hq_refusals_untold", listener=name)
        self._teller = Teller(bus, keys, f"hq.{name}", self._spawn, untold)
        numbers = self._side.numbers
        self._ids = ClientIds(numbers if self._side.quiet_s else numbers[: plan.settings.clients], self._side.quiet_s)
        self._asked: dict[str, list[Client]] = {}
        self._active: set[Client] = set()
        self._closing = False
        self._awake_at = self._clock()
        self._stale_until = -math.inf
        self._arrivals = Arrivals(plan.settings.accept_hz)
        self._life = Folding()
        self._broken: set[tuple[str, type[Exception]]] = set()
        self._limits = Limits(
            frame_bytes=_FRAME_BYTES, handshake_s=plan.settings.handshake_s, rate_hz=plan.settings.rate_hz
        )
        self._wanted: set[str] = set()
        self._missing: str | None = audience.view.missing
        self._accepted = metrics.count("hq_accepted", listener=name)
        self._turned_away = metrics.count("hq_turned_away", listener=name)
        self._dropped = metrics.count("hq_dropped", listener=name)
        self._left_out = metrics.count("hq_left_out", listener=name)
        self._commands = metrics.count("hq_commands", listener=name)
        self._refused = metrics.count("hq_refused", listener=name)
        self._malformed = metrics.count("hq_malformed", listener=name)
        self._foreign = metrics.count("hq_foreign_datagrams", listener=name)
        self._rivals = metrics.count("hq_rival_sources", listener=name)

    def __repr__(self) -> str:
        return f"<Listener {self.name} {self.address}, {len(self.clients)} clients>"

    async def run(self) -> None:
        """Listen until cancelled; then take leave of every client, and give the robot back. Raises LinkError."""
        self._audience.follow(self._side.follows, self._on_message, self._on_gateway)
        async with listen(
            self._plan.address,
            lambda: Accepted(self._admit, logging.DEBUG),  # what ended is told of the client
            datagrams=self._side.datagrams,
            foreign=self._foreign,
        ) as self.address:
            log.info("%s: HQ programs connect at %s", self.name, self.address)
            self.ready.set()
            try:
                await self._attend()
            finally:
                await asyncio.shield(self._leave())

    async def _attend(self) -> None:
        self._awake_at = self._clock()
        sweep_at = self._awake_at + SWEEP_S
        while True:
            await asyncio.sleep(REPEAT_S)
            self._stale()
            self._awake_at = self._clock()
            for client in tuple(self._active):
                if self._side.hold and client.conversation.silent_s > self._side.deadman_s - REPEAT_S:
                    client.helm.let_go("the connection is silent")
                client.helm.tick()
                if not client.helm.active:
                    self._active.discard(client)
            if self._clock() >= sweep_at:
                sweep_at = self._clock() + SWEEP_S  # not made up for after a process was frozen
                self._log_folded(self._clock())
                self._sweep()

    def _stale(self) -> bool:
        """Tell whether what comes in now may have waited while this process stood still; then nothing moves by it."""
        now = self._clock()
        if now - self._awake_at >= FROZEN_S:
            log.warning("%s: stood still for %.1f s: all sticks must be let go of", self.name, now - self._awake_at)
            self._awake_at, self._stale_until = now, now + CATCH_UP_S
            for client in tuple(self.clients.values()):
                client.helm.let_go(_STOOD_STILL)
        return now < self._stale_until

    async def _leave(self) -> None:
        self._closing = True
        clients = tuple(self.clients.values())
        for client in clients:
            client.helm.close()
            client.conversation.close("gateway stopped")
        self._teller.close()
        waiting = {client.conversation.ended for client in clients} | self._tasks
        if waiting:
            await asyncio.wait(waiting, timeout=LEAVE_S)
        for client in clients:
            client.conversation.abandon()
        self._log_folded(math.inf)
        for task in tuple(self._tasks):
            task.cancel()
        self._bridge.close()

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # Clients come and go

    def _admit(self, link: Link) -> Conversation | None:
        """Take a client in; None where its network is not allowed, too many come, or there is no place."""
        host = link.peer.removeprefix("tcp://").rpartition(":")[0].strip("[]")
        reason = self._unwelcome(host)
        number = self._ids.take(self._clock()) if reason is None else None
        if number is None:
            self._turn_away(link, host, reason or _FULL)
            return None
        try:
            session = self._side.session(number, self._limits)
        except Exception as error:
            self._leave_out("no session for a client", error)
            self._ids.release(number, self._clock(), rests=False)
            self._turn_away(link, host, "the listener cannot serve the robot")
            return None
        self._accepted.value += 1
        session.name = f"{self.name}.{number}"
        client = self.clients[number] = Client(number, host, session)
        client.helm = self._helm(client)
        client.conversation = Conversation(
            session,
            self._loop,
            deliver=lambda messages: self._deliver(client, messages),
            changed=lambda: self._on_session(client),
            malformed=self._malformed,
            foreign=self._foreign,
            rivals=self._rivals,
            refused=lambda refusal: self._refuse(client, topics.CMD_DRIVE, refusal),
            may_warn=lambda kind: self._life.first(host, kind, self._clock()),
            clock=self._clock,
        )
        client.conversation.ended.add_done_callback(lambda _: self._dismiss(client))
        self._manager.add(session)
        self._log_life("connected", client, "%s connected as client %d", link.peer, number)
        return client.conversation

    def _unwelcome(self, host: str) -> str | None:
        if self._closing:
            return "the gateway stops"
        if not self._arrivals.admit(host, self._clock()):
            return f"more than {self._settings.accept_hz:g} connections a second of its address"
        if len(self.clients) >= self._settings.clients:
            return _FULL
        if not self._plan.allow:
            return None
        address = ipaddress.ip_address(host.partition("%")[0])
        address = getattr(address, "ipv4_mapped", None) or address
        return None if any(address in network for network in self._plan.allow) else "its network is not allowed"

    def _turn_away(self, link: Link, host: str, reason: str) -> None:
        self._turned_away.value += 1
        if self._life.first(host, f"turned away: {reason}", self._clock()):
            so_far = self._turned_away.value
            log.warning("%s: %s turned away (%d so far): %s", self.name, link.peer, so_far, reason)

    def _log_life(self, kind: str, client: Client, text: str, *values: object) -> None:
        """Log what happens to a client; of what happens to many of one address, a line a second."""
        first = self._life.first(client.host, kind, self._clock())
        log.log(logging.INFO if first else logging.DEBUG, f"%s: {text}", self.name, *values)

    def _log_folded(self, now: float) -> None:
        for line in self._life.due(now):
            log.info("%s: %s", self.name, line)

    def _helm(self, client: Client) -> Operator:
        side, who = self._side, f"hq.{self.name}.{client.number}"
        return Operator(
            Intent(side.deadman_s, modes=side.modes),
            self._bridge,
            who=who,
            modes=side.name if side.modes else None,
            steers=side.steers,
            hold=side.hold,
            tell=lambda text: self._tell(client, text),
            clock=self._clock,
        )

    def _on_session(self, client: Client) -> None:
        if client.session.state is State.ESTABLISHED and not client.begun:
            client.begun = True
            agreed = f", version {client.session.version}" if client.session.version else ""
            self._log_life("established", client, "client %d established%s", client.number, agreed)
            self._send(client, self._side.begin)
            missing = self._audience.view.missing
            if missing is not None:
                self._tell(client, missing)
        elif client.session.over:
            client.helm.close()

    def _dismiss(self, client: Client) -> None:
        """Forget a client whose conversation has ended; its number is free again after a while."""
        client.helm.close()
        self._set_timer(client, math.inf)
        self.clients.pop(client.number, None)
        self._active.discard(client)
        self._ids.release(client.number, self._clock(), rests=client.session.traffic.frames_in > 0)
        self._manager.remove(client.session)
        self._follow_wanted()
        self._log_life("gone", client, "client %d gone: %s", client.number, client.session.reason)

    def _sweep(self) -> None:
        """Give up clients that take nothing, say nothing for too long, or say nothing but rubbish."""
        idle_s = self._settings.idle_s
        for client in tuple(self.clients.values()):
            stalled = client.conversation.stalled
            client.stalled_s = max(0.0, client.stalled_s + (SWEEP_S if stalled else -SWEEP_S))
            heard = client.session.traffic.bytes_in
            client.silent_s = client.silent_s + SWEEP_S if heard == client.heard else 0.0
            client.heard = heard
            before, client.seen = client.seen, (client.session.traffic.malformed, client.session.traffic.frames_in)
            rubbish, frames = (now - then for now, then in zip(client.seen, before, strict=True))
            if rubbish >= RUBBISH and rubbish >= frames:
                client.conversation.close("nothing but rubbish")
            elif client.stalled_s >= STALL_S:
                client.conversation.cut(f"took nothing for {STALL_S:g} s")
            elif idle_s is not None and client.silent_s >= idle_s:
                client.conversation.close(f"silent for {idle_s:g} s")

    # What the robot says

    def _on_message(self, topic: Topic, message: FleetMessage) -> None:
        if isinstance(message, Control):
            for client in tuple(self.clients.values()):
                client.helm.look(message)
            return
        if isinstance(message, Status):
            self._tell_of_robot()
        if not self.clients:
            return
        try:
            send = self._side.show(topic, message)
        except Exception as error:
            self._leave_out(f"{topic.path} not shown", error)
            return
        self._show(send)

    def _show(self, send: Send | None) -> None:
        """Let every client have something, if there is anything."""
        if send is None:
            return
        for number, client in enumerate(tuple(self.clients.values()), 1):
            if not number % ATTEND_EVERY:
                self._bus.attend()
            if client.begun and not client.session.over:
                self._send(client, send)

    def _leave_out(self, what: str, error: Exception) -> None:
        """Go on without what the protocol cannot show or take; what is not its own refusal is logged once, in full.

        A robot may be of a protocol that this one knows nothing of, and both of packages that never met.
        """
        self._left_out.value += 1
        kind = (what, type(error))
        if isinstance(error, EncodeError | ProtocolError):
            log.debug("%s: %s: %s", self.name, what, error)
        elif kind not in self._broken and len(self._broken) < BROKEN:
            self._broken.add(kind)
            log.error("%s: %s: %r; going on without", self.name, what, error, exc_info=error)

    def _on_gateway(self, alive: bool) -> None:
        self._tell_of_robot()
        if not alive:
            for client in tuple(self.clients.values()):
                client.helm.gateway_lost()

    def _tell_of_robot(self) -> None:
        """Say that the robot is gone, or there again, however soon that comes again."""
        missing = self._audience.view.missing
        if (missing is None) is not (self._missing is None):
            text = missing or "the robot is there"
            for client in tuple(self.clients.values()):
                client.told.pop(text, None)
                self._tell(client, text)
            self._show_presence(missing is None)
        self._missing = missing

    def _show_presence(self, there: bool) -> None:
        try:
            send = self._side.presence(there)
        except Exception as error:
            self._leave_out("the robot's presence not shown", error)
            return
        self._show(send)

    def _send(self, client: Client, send: Send) -> None:
        """Let a client have something, as far as its queue takes it."""
        try:
            send(client.session, self._clock())
        except Refused:
            client.session.traffic.dropped += 1
            self._dropped.value += 1
        except Exception as error:
            self._leave_out("a client not sent", error)
        client.conversation.pump()

    def _tell(self, client: Client, text: str) -> None:
        """Say something to the people at a client, not the same thing all the time."""
        now = self._clock()
        if client.begun and now - client.told.get(text, -TELL_S) >= TELL_S:
            client.told = {old: at for old, at in client.told.items() if now - at < TELL_S} | {text: now}
            self._send(client, lambda session, now: self._side.tell(session, text, now))

    # What clients say

    def _deliver(self, client: Client, messages: list[Any]) -> None:
        client.helm.intent.heard(self._clock())
        stale, intent = self._stale(), client.helm.intent
        for message in messages:
            try:
                for topic, command in self._side.take(client.session, message):
                    if stale:  # neutral that waited as well is no answer to that
                        intent.refused(_STOOD_STILL)
                    self._carry_out(client, topic, command)
            except (ProtocolError, EncodeError) as error:
                client.session.malformed(str(error))
            except Exception as error:
                client.session.malformed(repr(error))
                self._leave_out("what a client said not taken", error)
        if stale:
            intent.refused(_STOOD_STILL)
        if client.helm.active:
            self._active.add(client)
        self._set_timer(client, self._side.deadline(client.session))
        self._follow_wanted()

    def _set_timer(self, client: Client, due: float) -> None:
        """Have what a client said carried out when it has waited long enough for more of it."""
        if due == client.due:
            return
        if client.timer is not None:
            client.timer.cancel()
        client.due = due
        client.timer = self._loop.call_at(due, self._on_due, client) if due < math.inf else None

    def _on_due(self, client: Client) -> None:
        client.due, client.timer = math.inf, None
        try:
            for topic, command in self._side.expire(client.session, self._clock()):
                if self._stale():
                    client.helm.intent.refused(_STOOD_STILL)
                self._carry_out(client, topic, command)
        except Exception as error:
            self._leave_out("what a client said not taken", error)
        if client.helm.active:
            self._active.add(client)
        self._set_timer(client, self._side.deadline(client.session))

    def _follow_wanted(self) -> None:
        """Follow what clients want now and did not before, and no more what none of them wants."""
        wanted = {topic.path for topic in self._side.wanted()}
        for path in wanted - self._wanted:
            self._audience.also_follow(path, self._on_message)
        for path in self._wanted - wanted:
            self._audience.unfollow(path, self._on_message)
        self._wanted = wanted

    def _carry_out(self, client: Client, topic: Topic, command: FleetMessage) -> None:
        self._commands.value += 1
        try:
            if topic.delivery is Delivery.QUERY:
                self._ask(client, topic)
            else:
                client.helm.command(topic, command)
        except Refused as refusal:
            self._refuse(client, topic, refusal)

    def _refuse(self, client: Client, topic: Topic, refusal: Refused) -> None:
        """Count what a client may not, and tell its people, and everybody by way of ``control``."""
        client.session.traffic.refused += 1
        self._refused.value += 1
        self._tell(client, str(refusal))
        if self._audience.view.alive:
            self._teller.note(client.helm.who, topic.path.partition("/")[2], refusal)

    def _ask(self, client: Client, topic: Topic) -> None:
        """Ask the robot for a client; who asks the same meanwhile gets the same answer."""
        if topic.path not in _ANSWERED:
            raise Unsupported(f"robots are not asked for {topic.path}")
        asking = self._asked.get(topic.path)
        if asking is None:
            self._asked[topic.path] = [client]
            self._spawn(self._question(topic))
        elif client not in asking:
            asking.append(client)

    async def _question(self, topic: Topic) -> None:
        shown = _ANSWERED[topic.path]
        message: FleetMessage | None = None
        try:
            for answer in await self._bus.ask(self._keys.key(topic.path), timeout_s=ANSWER_S):
                if answer.error is None:
                    message = payloads.decode(shown.message, answer.payload)
        except (BusError, PayloadError) as error:
            log.debug("%s: %s: %s", self.name, topic.path, error)
        finally:
            asking = self._asked.pop(topic.path)
        for client in asking:
            if not client.session.over:
                self._send(client, lambda session, now: self._side.answer(session, topic, message, now))
