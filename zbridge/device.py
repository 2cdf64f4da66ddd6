"""The device side of a gateway: one robot's links, its telemetry on the bus, commands from the bus.

Wires sans-IO parts together: sessions and translation (from the protocol), control authority, link and bus.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from typing import Any

from zbridge.bus import Bus, Publisher, Question, Sample
from zbridge.conversation import Conversation
from zbridge.errors import EncodeError, LinkError, PayloadError, ProtocolError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, LinkStatus, RobotState, Status
from zbridge.fleet.topics import Delivery, KeySpace, Topic
from zbridge.link import Address, connect
from zbridge.metrics import Metrics
from zbridge.protocol import Robot, Translate
from zbridge.questions import Questions
from zbridge.session.control import Authority
from zbridge.session.manager import Backoff, SessionManager
from zbridge.session.session import Session, State, Tap

log = logging.getLogger("zbridge.device")

HEARTBEAT_S = 1.0
"""Seconds between repetitions of ``status`` and ``control``."""
STOP_REPEAT_S = 1.0
"""Seconds for which a stop is repeated."""
_LOGGED = 64
_CONTROL_S = 0.05
"""Least time between two publications of ``control`` while refusals come in."""

_STATES: dict[State, RobotState] = {
    State.CONNECTING: "connecting",
    State.HANDSHAKING: "handshaking",
    State.ESTABLISHED: "established",
    State.CLOSING: "closing",
    State.CLOSED: "offline",
}


class _Endpoint:
    """One configured address of the robot, the conversation there when there is one, and who watches it."""

    def __init__(self, name: str, address: Address) -> None:
        self.watchers: dict[str, Publisher] = {}
        self.name = name
        self.address = address
        self.state: RobotState = "offline"
        self.reason: str | None = "not yet connected"
        self.conversation: Conversation | None = None

    def watch(self, direction: str, publisher: Publisher, *, watched: bool) -> None:
        """Show raw frames of one direction from now on, or no more."""
        if watched:
            self.watchers[direction] = publisher
        else:
            self.watchers.pop(direction, None)
        if self.conversation is not None:
            self.conversation.session.tap = self.tap

    @property
    def tap(self) -> Tap | None:
        """What shows the frames to whoever wants to see them; None while nobody does."""
        debugging = log.isEnabledFor(logging.DEBUG)
        return self._show if self.watchers or debugging else None

    def _show(self, direction: str, frame: bytes) -> None:
        if log.isEnabledFor(logging.DEBUG):
            log.debug("%s %s %s", "<" if direction == "in" else ">", self.name, frame[:_LOGGED].hex(" "))
        publisher = self.watchers.get(direction)
        if publisher is not None:
            publisher.put(frame)

    def status(self) -> LinkStatus:
        return LinkStatus(name=self.name, state=self.state, peer=str(self.address), reason=self.reason)


class Device:
    """One robot on the bus; ``run`` serves it."""

    def __init__(
        self,
        robot: Robot,
        addresses: tuple[Address, ...],
        *,
        protocol: str,
        keys: KeySpace,
        bus: Bus,
        authority: Authority,
        manager: SessionManager,
        metrics: Metrics,
        connect: Callable[[Address, Conversation], Any] = connect,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._robot = robot
        self._protocol = protocol
        self._keys = keys
        self._bus = bus
        self._authority = authority
        self._manager = manager
        self._connect = connect
        self._clock_ns = clock_ns
        self._loop = asyncio.get_running_loop()
        self._endpoints = [_Endpoint(name, at) for name, at in zip(robot.link_names, addresses, strict=True)]
        self._publishers: dict[str, Publisher] = {}
        self._translators: dict[type, Translate] = {}
        self._deadman: asyncio.TimerHandle | None = None
        self._control_due: asyncio.TimerHandle | None = None
        self._closing = False
        self._busy: str | None = None
        self._questions = Questions(self._loop)
        self._published = metrics.count("published")
        self._untranslatable = metrics.count("untranslatable")
        self._malformed = metrics.count("malformed")
        self._foreign = metrics.count("foreign_datagrams")
        self._refused = metrics.count("refused")
        self._commands = metrics.count("commands")

    def __repr__(self) -> str:
        return f"<Device {self._keys.robot} {self._endpoints[0].state}>"

    async def run(self) -> None:
        """Serve the robot until cancelled; then stop it if it moves, and take leave of it."""
        self._publish_status()
        self._publish_control()
        self._bus.on_relief(self._resume)
        self._bus.subscribe(self._keys.key("@cmd/**"), self._on_command, first=True)
        self._bus.watch_connected(self._on_bus)
        for topic in (topics.RPC_MAP, topics.RPC_POSE):
            self._bus.answer(self._keys.key(topic.path), self._on_question)
        for endpoint in self._endpoints:
            for direction in ("in", "out"):
                self._watch_frames(endpoint, direction)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._beat())
            for index, endpoint in enumerate(self._endpoints):
                tasks.create_task(self._keep_connected(index, endpoint))
            try:
                await asyncio.Event().wait()
            finally:  # the links' tasks still run: the group ends them only after this
                await asyncio.shield(self._shut_down())

    async def _shut_down(self) -> None:
        """Stop a moving robot, take leave of it, and say so on the bus; at most 1.7 s."""
        self._closing = True
        if self._authority.moving:
            self._halt("gateway stopped")
            await asyncio.sleep(STOP_REPEAT_S)
        conversations = [endpoint.conversation for endpoint in self._endpoints if endpoint.conversation]
        for conversation in conversations:
            conversation.close("gateway stopped")
        if conversations:
            await asyncio.wait([conversation.ended for conversation in conversations], timeout=0.7)
        for endpoint in self._endpoints:
            endpoint.state, endpoint.reason = "offline", "gateway stopped"
        self._publish_status()
        for timer in (self._deadman, self._control_due):
            if timer is not None:
                timer.cancel()

    # Links

    async def _keep_connected(self, index: int, endpoint: _Endpoint) -> None:
        """Connect, converse, and connect again, for ever."""
        backoff = Backoff()
        while not self._closing:
            reason, established = await self._converse(index, endpoint)
            if established:
                backoff.reset()
            delay_s = backoff.delay_s()
            log.info("%s: %s; next attempt in %.1f s", self._keys.robot, reason, delay_s)
            self._set_state(endpoint, "offline", reason)
            await asyncio.sleep(delay_s)

    async def _converse(self, index: int, endpoint: _Endpoint) -> tuple[str, bool]:
        """Hold one conversation to its end; tell why it ended and whether it was ever established."""
        session = self._robot.session(index, str(endpoint.address))
        session.name = endpoint.name
        session.tap = endpoint.tap
        conversation = Conversation(
            session,
            self._loop,
            deliver=self._deliver,
            changed=lambda: self._on_session(endpoint, session),
            malformed=self._malformed,
            foreign=self._foreign,
        )
        self._set_state(endpoint, "connecting", None)
        endpoint.conversation = conversation
        self._manager.add(session)
        try:
            await self._connect(endpoint.address, conversation)
            await conversation.ended
        except LinkError as error:
            session.lost(str(error))
        finally:
            conversation.abandon()
            endpoint.conversation = None
            self._manager.remove(session)
        return session.reason or "closed", session.version is not None

    def _on_session(self, endpoint: _Endpoint, session: Session[Any]) -> None:
        if session.state is State.ESTABLISHED:
            log.info(
                "%s: %s established, version %s, features %s",
                self._keys.robot,
                endpoint.address,
                session.version,
                ", ".join(session.features) or "none",
            )
        elif session is self._robot.driving and session.over and session.version is not None:
            self._authority.stopped("robot lost")
            self._watch_deadman()
            self._questions.refuse_all("the robot was lost")
            self._publish_control()
        if session is self._robot.driving and session.busy != self._busy:
            self._busy = session.busy
            self._halt(self._busy or "no longer busy")
        self._set_state(endpoint, _STATES[session.state], session.busy or session.reason)

    def _set_state(self, endpoint: _Endpoint, state: RobotState, reason: str | None) -> None:
        if (endpoint.state, endpoint.reason) != (state, reason):
            endpoint.state, endpoint.reason = state, reason
            self._publish_status()

    def _resume(self) -> None:
        for endpoint in self._endpoints:
            if endpoint.conversation is not None:
                endpoint.conversation.resume()

    # Telemetry

    def _deliver(self, messages: list[Any]) -> None:
        """Publish what the robot sent; the newest wins where the bus is slower, unless it is told to block."""
        stamp_ns = self._clock_ns()
        encode, translators, waiting = payloads.encode, self._translators, self._questions.waiting
        streams: dict[str, list[bytes]] = {}
        flowing, states = True, 0
        for message in messages:
            translate = translators.get(type(message)) or self._translator(type(message))
            try:
                for topic, telemetry in translate(message, stamp_ns):
                    payload = encode(telemetry)
                    stream = streams.get(topic.path)
                    if stream is not None:
                        stream.append(payload)
                    elif topic.delivery is Delivery.STREAM:
                        streams[topic.path] = [payload]
                        self._publisher(topic)
                    else:
                        flowing = self._publisher(topic).put(payload) and flowing
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
                if endpoint.conversation is not None:
                    endpoint.conversation.pause()

    def _watch_frames(self, endpoint: _Endpoint, direction: str) -> None:
        """Publish the raw frames of one direction while somebody listens."""
        key = self._keys.key(f"@wire/{endpoint.name}/{direction}")

        def listened(anybody: bool) -> None:
            endpoint.watch(direction, publisher, watched=anybody)

        publisher = self._bus.frames(key, listened)

    def _publish(self, topic: Topic, message: FleetMessage) -> None:
        self._publisher(topic).put(payloads.encode(message))

    def _publisher(self, topic: Topic) -> Publisher:
        publisher = self._publishers.get(topic.path)
        if publisher is None:
            publisher = self._publishers[topic.path] = self._bus.publisher(self._keys.key(topic.path), topic)
        return publisher

    def _translator(self, kind: type) -> Translate:
        translate = self._translators[kind] = self._robot.translator(kind)
        return translate

    def _publish_status(self) -> None:
        first = self._endpoints[0]
        session = self._robot.driving
        agreed = session is not None and first.state == "established"
        self._publish(
            topics.STATUS,
            Status(
                stamp_ns=self._clock_ns(),
                state=first.state,
                reason=first.reason,
                protocol=self._protocol,
                dialect=self._robot.dialect,
                version=session.version if session is not None and agreed else None,
                features=session.features if session is not None and agreed else (),
                links=tuple(endpoint.status() for endpoint in self._endpoints),
            ),
        )

    def _publish_control(self) -> None:
        self._control_due = None
        self._publish(topics.CONTROL, self._authority.report())

    async def _beat(self) -> None:
        while True:
            await asyncio.sleep(HEARTBEAT_S)
            self._publish_status()
            self._publish_control()

    # Commands

    def _on_command(self, sample: Sample) -> None:
        path = self._keys.path(sample.key)
        self._commands.value += 1
        try:
            self._carry_out(path, sample)
        except (Refused, PayloadError, EncodeError) as error:
            self._refuse(path.removeprefix("@cmd/"), str(error))

    def _carry_out(self, path: str, sample: Sample) -> None:
        topic = topics.find(path)
        if topic is None or topic.delivery is not Delivery.COMMAND:
            raise Refused("no such command")
        if topic is topics.CMD_STOP:  # whatever its payload
            self._halt("stop")
            return
        now = self._loop.time()
        command = payloads.decode(topic.message, sample.payload)
        if isinstance(command, Drive):
            self._drive(topic, command, now)
        else:
            self._require_ready()
            self._report(topic, self._robot.command(topic, command, now))
        self._pump()

    def _drive(self, topic: Topic, command: Drive, now: float) -> None:
        moving = command.moving
        self._authority.admit(moving=moving)
        try:
            self._require_ready()
        except Refused as refusal:
            if moving:
                self._authority.stopped(str(refusal))
            raise
        outcome = self._robot.command(topic, command, now)
        self._authority.applied(moving=moving, now=now)
        self._watch_deadman()
        self._report(topic, outcome)

    def _require_ready(self) -> None:
        if not self._robot.ready:
            raise Refused(self._busy or self._endpoints[0].state)

    def _report(self, topic: Topic, outcome: Any) -> None:
        for shown, message in outcome.telemetry:
            self._publish(shown, message)
        if outcome.left_out:
            self._refuse(topic.path.removeprefix("@cmd/"), outcome.left_out)

    def _refuse(self, command: str, reason: str) -> None:
        self._refused.value += 1
        self._authority.refuse(command, reason)
        if self._control_due is None and not self._closing:
            self._control_due = self._loop.call_later(_CONTROL_S, self._publish_control)

    def _pump(self) -> None:
        for endpoint in self._endpoints:
            if endpoint.conversation is not None:
                endpoint.conversation.pump()

    # Stopping

    def _halt(self, reason: str) -> None:
        """Stop the robot at once and for a second; motion needs a neutral drive afterwards."""
        now = self._loop.time()
        self._authority.stopped(reason)
        self._watch_deadman()
        self._publish_control()
        driving = self._robot.driving
        if driving is not None and driving.state is State.ESTABLISHED:
            log.info("%s: stop (%s)", self._keys.robot, reason)
            self._robot.stop(now, now + STOP_REPEAT_S)
            self._pump()

    def _watch_deadman(self) -> None:
        if self._deadman is not None:
            self._deadman.cancel()
            self._deadman = None
        deadline = self._authority.deadline()
        if deadline is not None:
            self._deadman = self._loop.call_at(deadline, self._on_deadman)

    def _on_deadman(self) -> None:
        self._deadman = None
        if self._authority.overdue(self._loop.time()):
            self._halt("deadman")
        else:
            self._watch_deadman()

    def _on_bus(self, connected: bool) -> None:
        if not connected and self._authority.moving:
            self._halt("bus lost")

    # Questions

    def _on_question(self, question: Question) -> None:
        asked = {topics.RPC_MAP.path: topics.MAP, topics.RPC_POSE.path: topics.POSE}
        topic = asked.get(self._keys.path(question.key))
        try:
            if topic is None:
                raise Refused("no such query")
            self._require_ready()
            if self._questions.add(topic, question):
                self._robot.ask(topic)
                self._pump()
        except Refused as refusal:
            if topic is not None:
                self._questions.remove(topic, question)
            question.refuse(str(refusal))
