"""The device side of a gateway: one robot's links, its telemetry on the bus, commands and queries from the bus.

Wires sans-IO parts together: sessions and translation (from the protocol), control authority, links and bus.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from zbridge.address import DeviceAddress
from zbridge.bus import Bus, Handle, Publisher, Question
from zbridge.conditions import Conditions
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.lease_server import LeaseServer
from zbridge.control.motion_limits import MotionLimits
from zbridge.control.standstill import IDLE_STOP_S, STOP_REPEAT_S, Standstill
from zbridge.errors import BusError, ProtocolError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, Status
from zbridge.fleet.topics import Delivery, KeySpace, Topic
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import Robot, Translate
from zbridge.protocol.session import Session, State
from zbridge.protocol.session_table import SessionTable
from zbridge.robot.commands import LINK_BLOCKED, Commands
from zbridge.robot.connection import Connect, Connection, Hooks
from zbridge.robot.names import NAMES, NameBudget
from zbridge.robot.pending_queries import PendingQueries
from zbridge.transport.connect import connect

log = logging.getLogger("zbridge.robot.device")

HEARTBEAT_S = 1.0
"""Seconds between repetitions of ``status`` and ``control``."""
LEAVE_S = 0.7
"""Longest time the robot is given to hear that the gateway leaves."""
ATTEND_EVERY = 64
"""Messages of a read between two looks at the commands that wait."""
FLUSH_S = 0.2
"""Longest time the bus is given to take the last words."""
_LEAVING = "gateway stopped"
_ASKED = {topics.RPC_MAP.path: topics.MAP, topics.RPC_POSE.path: topics.POSE}


class Device:
    """One robot on the bus; ``run`` serves it."""

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
        clock: Callable[[], float] | None = None,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        clock = clock or asyncio.get_running_loop().time
        self._robot = robot
        self._protocol = protocol
        self._keys = keys
        self._bus = bus
        self._clock_ns = clock_ns
        self._conditions = conditions or Conditions()
        self._conditions.changed = self._publish_status
        self._publishers: dict[str, Publisher] = {}
        self._names = NameBudget()
        self._clock = clock
        self._translators: dict[type, Translate] = {}
        self._busy: str | None = None
        self._doubtful: str | None = None
        self._shown_doubts: tuple[str, ...] = ()
        self._leaving = False
        self._greeted: Session[Any] | None = None
        self._questions = PendingQueries(asyncio.get_running_loop())
        self._standstill = Standstill(
            robot,
            self._conditions,
            idle_stop_s=idle_stop_s,
            driven=lambda: authority.driven,
            pump=self._pump,
            clock=clock,
        )
        self._leases = LeaseServer(
            robot,
            authority,
            keys,
            metrics,
            audit,
            limits or MotionLimits(),
            self._standstill,
            publish=self._publish,
            clock=clock,
        )
        self._commands = Commands(
            robot, self._leases, keys, metrics, publish=self._publish, pump=self._pump, clock=clock
        )
        self._published = metrics.count("published")
        self._lost = metrics.count("commands_lost")
        self._untranslatable = metrics.count("untranslatable")
        self._stalls = metrics.count("link_stalls")
        self._unnamed = metrics.count("names_dropped")
        self._endpoints = [
            Connection(
                name,
                f"{keys.robot} {name}",
                address,
                Hooks(
                    session=partial(self._session, name, str(address)),
                    deliver=self._deliver,
                    session_changed=self._on_session,
                    state_changed=self._publish_status,
                    connect=connect,
                    manager=manager,
                    malformed=metrics.count("malformed"),
                    foreign=metrics.count("foreign_datagrams"),
                    clock=clock,
                    before=self._leases.look_at_time,
                    stalled=partial(self._on_stall, name),
                ),
            )
            for name, address in zip(robot.link_names, addresses, strict=True)
        ]

    def __repr__(self) -> str:
        return f"<Device {self._keys.robot} {self._endpoints[0].state}>"

    async def run(self) -> None:
        """Serve the robot until cancelled; then stop it if it moves, and take leave of it."""
        self._publish_status()
        self._leases.report()
        self._standstill.begin()
        self._bus.on_relief(self._resume)
        declared = [
            *self._leases.serve(self._bus),
            self._bus.subscribe(self._keys.key("@cmd/**"), self._commands.take, lane=self._leases.gate),
            self._bus.watch_connected(self._on_bus),
            *(self._bus.answer(self._keys.key(path), self._on_question) for path in _ASKED),
            *(self._watch_listeners(topic) for topic in self._robot.on_demand),
        ]
        for endpoint in self._endpoints:
            for direction in ("in", "out"):
                self._watch_frames(endpoint, direction)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._beat())
            for endpoint in self._endpoints:
                tasks.create_task(endpoint.run())
            try:
                await asyncio.Event().wait()
            finally:  # the links' tasks still run: the group ends them only after this
                await asyncio.shield(self._shut_down(declared))

    @property
    def reached(self) -> bool:
        """Whether the robot was ever reached."""
        return self._greeted is not None

    def refuse(self, command: str, refusal: Refused, who: str) -> None:
        """Show on ``control`` what was refused to somebody."""
        self._leases.authority.refuse(command, refusal, who)
        self._leases.settle()

    async def _shut_down(self, declared: list[Handle]) -> None:
        """Stop a moving robot, take leave of it, say so on the bus, and leave the robot's keys to others."""
        self._leaving = True
        self._commands.refuse_all(_LEAVING)
        self._leases.refuse_all(_LEAVING)
        if self._leases.authority.moving:
            self._leases.stop(_LEAVING)
        await asyncio.sleep(min(self._standstill.stopping_s, STOP_REPEAT_S))
        await asyncio.gather(*(endpoint.close(_LEAVING, LEAVE_S) for endpoint in self._endpoints))
        self._publish_status()
        self._standstill.close()
        self._leases.close()
        with contextlib.suppress(BusError, TimeoutError):
            async with asyncio.timeout(FLUSH_S):
                await self._bus.flush()
        self._conditions.changed = lambda: None
        for handle in (*declared, *self._publishers.values()):
            handle.close()

    # Links

    def _session(self, link: str, address: str) -> Session[Any]:
        """Make the session of a new connection; the names of the one before it are given up."""
        if link == self._robot.link_names[0]:
            for path in [path for path in self._publishers if _is_named(path)]:
                self._publishers.pop(path).close()
        return self._robot.session(link, address)

    def _on_session(self, session: Session[Any]) -> None:
        if session is not self._robot.driving:
            return
        busy, self._busy = self._busy, session.busy
        doubtful, self._doubtful = self._doubtful, session.doubtful
        if session.over:
            self._commands.blocked = False
            self._conditions.set("link", None)
            if session.version is not None:
                self._lost.value += len(session.outbox)
                if not self._leaving:
                    self._leases.hold_back("robot lost", stops=False)
                self._questions.refuse_all("the robot was lost")
        elif session.state is State.ESTABLISHED and session is not self._greeted:
            self._greeted = session
            with contextlib.suppress(Refused):  # whoever drove it before, it stands now
                self._standstill.stop()
            for topic, message in self._robot.begun(self._clock_ns()):
                self._publish(topic, message)
        elif busy != self._busy:
            self._leases.hold_back(self._busy or "no longer busy", stops=True)
        if self._doubtful and not doubtful:
            self._leases.hold_back(self._doubtful, stops=True)
        if session.doubts != self._shown_doubts and not session.over and self._endpoints[0].state == "established":
            self._publish_status()

    def _on_stall(self, name: str, stalled: bool) -> None:
        """Drive no robot whose link takes nothing: it would obey late, or lose its stop with the rest."""
        if name != self._endpoints[0].name:
            return
        self._commands.blocked = stalled
        self._conditions.set("link", f"{LINK_BLOCKED}: it is not driven" if stalled else None)
        if stalled:
            self._stalls.value += 1
            log.warning("%s: %s", self._keys.robot, LINK_BLOCKED)
        else:
            self._leases.hold_back("the robot's link took nothing", stops=True)

    def _pump(self) -> None:
        for endpoint in self._endpoints:
            endpoint.pump()

    def _resume(self) -> None:
        for endpoint in self._endpoints:
            endpoint.resume()

    def _on_bus(self, connected: bool) -> None:
        if not connected:
            self._leases.bus_lost()

    # Telemetry

    def _deliver(self, messages: list[Any]) -> None:
        """Publish what the robot sent; the newest wins where the bus is slower, unless it is told to block."""
        stamp_ns = self._clock_ns()
        encode, translators, waiting = payloads.encode, self._translators, self._questions.waiting
        streams: dict[str, list[bytes]] = {}
        flowing, states = True, 0
        for number, message in enumerate(messages, 1):
            if not number % ATTEND_EVERY:
                self._bus.attend()
            translate = translators.get(type(message)) or self._translator(type(message))
            try:
                for topic, telemetry in translate(message, stamp_ns):
                    payload = encode(telemetry)
                    stream = streams.get(topic.path)
                    if stream is not None:
                        stream.append(payload)
                    elif (publisher := self._publisher(topic)) is None:
                        self._unnamed.value += 1
                    elif topic.delivery is Delivery.STREAM:
                        streams[topic.path] = [payload]
                    else:
                        flowing = publisher.put(payload) and flowing
                        states += 1
                    if waiting:
                        self._questions.answer(topic, payload)
            except ProtocolError as error:
                self._untranslatable.value += 1
                log.debug("%s: %s", self._keys.robot, error)
        self._published.value += states + sum(map(len, streams.values()))
        if streams:
            batch = [(self._publishers[path], payload_list) for path, payload_list in streams.items()]
            flowing = self._bus.put_all(batch) and flowing
        if not flowing:
            for endpoint in self._endpoints:
                endpoint.pause()

    def _translator(self, kind: type) -> Translate:
        translate = self._translators[kind] = self._robot.translator(kind)
        return translate

    def _publish(self, topic: Topic, message: FleetMessage) -> None:
        publisher = self._publisher(topic)
        if publisher is not None:
            publisher.put(payloads.encode(message))

    def _publisher(self, topic: Topic) -> Publisher | None:
        """Give the publisher of a topic; None where the robot has too many names."""
        path = topic.path
        publisher = self._publishers.get(path)
        if publisher is None:
            if _is_named(path) and not self._names.admit(path, self._clock()):
                self._tell_names()
                return None
            publisher = self._publishers[path] = self._bus.publisher(self._keys.key(path), topic)
        return publisher

    def _tell_names(self) -> None:
        text = f"more than {NAMES} different names within an hour: the others are not published"
        self._conditions.set("names", text if self._names.over else None)

    def _watch_frames(self, endpoint: Connection, direction: str) -> None:
        """Publish the raw frames of one direction while somebody listens."""

        def listened(anybody: bool) -> None:
            endpoint.watch(direction, publisher.put if anybody else None)

        publisher = self._bus.frames(self._keys.key(f"@wire/{endpoint.name}/{direction}"), listened)

    def _watch_listeners(self, topic: Topic) -> Handle:
        """Tell the robot whether anybody listens to a topic."""

        def changed(anybody: bool) -> None:
            with contextlib.suppress(Refused):
                self._robot.listened(topic, anybody)
                self._pump()

        return self._bus.watch_listeners(self._keys.key(topic.path), changed)

    def _publish_status(self) -> None:
        first = self._endpoints[0]
        session = self._robot.driving
        agreed = session if session is not None and first.state == "established" else None
        self._shown_doubts = agreed.doubts if agreed is not None else ()
        self._publish(
            topics.STATUS,
            Status(
                stamp_ns=self._clock_ns(),
                state=first.state,
                reason="; ".join(filter(None, (first.reason, *self._shown_doubts, *self._conditions.texts))) or None,
                protocol=self._protocol,
                dialect=self._robot.dialect,
                version=(agreed.version or None) if agreed is not None else None,
                features=agreed.features if agreed is not None else (),
                links=tuple(endpoint.status() for endpoint in self._endpoints),
            ),
        )

    async def _beat(self) -> None:
        while True:
            await asyncio.sleep(HEARTBEAT_S)
            self._names.expire(self._clock())
            self._tell_names()
            self._publish_status()
            self._leases.beat()

    # Queries

    def _on_question(self, question: Question) -> None:
        topic = _ASKED[self._keys.path(question.key)]
        try:
            self._commands.require_ready()
            known = self._robot.known(topic)
            if known is not None:
                question.answer(payloads.encode(known))
                return
            self._commands.require_flowing()
            if self._questions.add(topic, question):
                self._robot.ask(topic)
                self._pump()
        except Refused as refusal:
            self._questions.remove(topic, question)
            question.refuse(refusal)


def _is_named(path: str) -> bool:
    """Tell a topic of a family, whose last chunk the robot chooses: ``sensor/front``."""
    return "/" in path
