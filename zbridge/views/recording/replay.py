"""Replays a recording onto the bus: which robots, under which names, with which listeners for HQ programs."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import msgspec

from zbridge.app.config import plan as plan_configuration
from zbridge.bus import Bus, Handle, Sample
from zbridge.control.latch import LatchRecord
from zbridge.errors import ConfigError, Held, PayloadError, ZbridgeError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Status
from zbridge.fleet.processes import Sessions
from zbridge.fleet.topics import Delivery, KeySpace, is_name, split_key
from zbridge.hq import Listener, ListenerPlan, RobotSubscription
from zbridge.metrics import Metrics
from zbridge.protocol.session_table import SessionTable
from zbridge.robot.claim import Claim, Standing
from zbridge.robot.ownership import Ownership
from zbridge.tasks import race, together
from zbridge.toml import read_toml
from zbridge.views.recording.contents import MSGPACK, is_wire
from zbridge.views.recording.player import Player
from zbridge.views.recording.reader import RecordedMessage, RecordingReader, open_recording
from zbridge.views.recording.replayed_robot import KEYS, PROTOCOL, ReplayedRobot
from zbridge.views.recording.selection import Selection
from zbridge.views.recording.summary import robots_of
from zbridge.views.recording.wire_tape import wire_links

CLAIM_S = 5.0
"""Longest time until the name of a replayed robot is claimed."""
SURVEYED = 200_000
"""Messages at the begin of a file that are looked through for robots."""
SUFFIX = "-replay"


class ReplayPlan(msgspec.Struct, frozen=True):
    """What is replayed. names: new name by recorded one. speed: seconds of the recording per second."""

    path: Path
    realm: str
    names: dict[str, str]
    selection: Selection = Selection()
    speed: float = 1.0
    loop: bool = False
    paused: bool = False
    listeners: tuple[ListenerPlan, ...] = ()
    statuses: dict[str, Status] = {}


class Survey(msgspec.Struct, frozen=True):
    """What a recording has: its robots, the first status of each that was established, its links with raw frames."""

    robots: tuple[str, ...]
    statuses: dict[str, Status]
    links: dict[str, list[str]]


def survey(path: Path) -> Survey:
    """Read the beginning of a recording; raise ConfigError if there is no robot."""
    keys: set[str] = set()
    statuses: dict[str, Status] = {}
    with open_recording(path) as file:
        reader = RecordingReader(file)
        for _, message in zip(range(SURVEYED), reader.messages(), strict=False):
            topic = message.channel.topic
            if message.channel.encoding == MSGPACK or is_wire(topic):
                keys.add(topic)
            split = split_key(topic)
            if split is not None and split[2] == topics.STATUS.path and split[1] not in statuses:
                with contextlib.suppress(PayloadError):
                    status = payloads.decode(Status, message.data)
                    if status.state == "established":
                        statuses[split[1]] = status
    robots = robots_of(keys)
    if not robots:
        raise ConfigError(f"{path}: no robot in it{f': {reader.fault}' if reader.fault else ''}")
    realms = {topic.partition("/")[0] for topic in keys}
    links = {robot: [link for realm in realms for link in wire_links(KeySpace(realm, robot), keys)] for robot in robots}
    return Survey(tuple(robots), statuses, links)


def plan_names(robots: Sequence[str], wanted: Sequence[str]) -> dict[str, str]:
    """Return the new name of each robot that is replayed; raise ConfigError.

    wanted: ``NEW`` where the recording has one robot, else ``RECORDED=NEW``; nothing: all, as ``<recorded>-replay``.
    """
    if not wanted:
        return {robot: robot + SUFFIX for robot in robots}
    names: dict[str, str] = {}
    for text in wanted:
        recorded, separator, new = text.rpartition("=")
        if not separator:
            if len(robots) > 1:
                raise ConfigError(f"robot = {text!r}: the recording has {', '.join(robots)}: give {robots[0]}={text}")
            recorded = robots[0]
        if recorded not in robots:
            raise ConfigError(f"robot = {text!r}: the recording has {', '.join(robots)}")
        if not is_name(new) or new in names.values():
            raise ConfigError(f"robot = {text!r}: expected a name of its own: letters, digits, '_', '.' and '-'")
        names[recorded] = new
    return names


def plan_listeners(wanted: Sequence[str]) -> tuple[ListenerPlan, ...]:
    """Return the listeners that were asked for; raise ConfigError.

    wanted: ``PROTOCOL:PORT``, ``PROTOCOL:HOST:PORT``, or a configuration with ``[[hq]]`` tables.
    """
    tables: list[dict[str, Any]] = []
    for text in wanted:
        if text.endswith(".toml"):
            tables += read_toml(Path(text)).get("hq", [])
            continue
        protocol, _, where = text.partition(":")
        host, _, port = where.rpartition(":")
        if not port.isdigit():
            raise ConfigError(f"hq = {text!r}: expected PROTOCOL:PORT, PROTOCOL:HOST:PORT or a file with [[hq]]")
        tables.append({"protocol": protocol, "listen": f"tcp://{host or '127.0.0.1'}:{port}"})
    return plan_configuration({"robot": {"name": "replay"}, "hq": tables}).listeners if tables else ()


class Replay:
    """One replay on a bus. :meth:`run` returns at its end."""

    def __init__(self, bus: Bus, plan: ReplayPlan, report: Callable[[str], object] = lambda text: None) -> None:
        self.fault: str | None = None
        """What is wrong with the file."""
        self.played = self.left_out = 0
        """Messages of the selected part that were published, and those that were not: of other robots, commands,
        queries, raw frames, pictures."""
        self.robots: dict[str, ReplayedRobot] = {}
        self._bus = bus
        self._plan = plan
        self._report = report
        self._ended = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._earlier: dict[str, RecordedMessage] = {}
        self._targets: dict[str, tuple[ReplayedRobot, str] | None] = {}
        self.player = Player(plan.path, plan.selection, self._play, self._on_end, speed=plan.speed, loop=plan.loop)
        if plan.paused:
            self.player.pause()

    def __repr__(self) -> str:
        return f"<Replay {self.player!r}>"

    async def run(self) -> None:
        """Replay until the end of the file; raise ZbridgeError if a name is alive, or is taken by a gateway."""
        async with contextlib.AsyncExitStack() as stack:
            watching = []
            for recorded, name in self._plan.names.items():
                ownership = await self._claim(name, stack)
                keys, status = KeySpace(self._plan.realm, name), self._plan.statuses.get(recorded)
                robot = ReplayedRobot(self._bus, keys, f"a recording of {recorded}", status)
                self.robots[recorded] = robot
                robot.open()
                stack.callback(robot.close)
                watching.append(self._watch(ownership, name))
            serving = [self._serve_hq(recorded) for recorded in self._plan.names if self._plan.listeners]
            stack.callback(self.player.close)
            self.player.start()
            await race(self._ended.wait(), *watching, *serving)

    async def _claim(self, name: str, stack: contextlib.AsyncExitStack) -> Ownership:
        """Claim a name as a gateway does, until the stack is left: gateways that come later wait, and say so."""
        keys, taken = KeySpace(self._plan.realm, name), Held(f"{name} is alive: replay it under another name")
        if await self._bus.alive(keys.alive("gateway")):
            raise taken
        ownership = Ownership(self._bus, keys)
        stack.callback(ownership.release)
        try:
            async with asyncio.timeout(CLAIM_S):
                await ownership.take()
        except TimeoutError:
            raise taken from None
        return ownership

    async def _watch(self, ownership: Ownership, name: str) -> None:
        await ownership.watch(_Replayed())
        raise ZbridgeError(f"a gateway serves {name}: the replay leaves the name to it")

    # The player's thread

    def _play(self, message: RecordedMessage, selected: bool) -> None:
        """Play a message; keep the last state of each key from before the selected part, and play these first."""
        if selected:
            earlier, self._earlier = self._earlier, {}
            for each in (*earlier.values(), message):
                self._play_now(each)
            return
        split = split_key(message.channel.topic)
        topic = topics.find(split[2]) if split is not None else None
        if topic is not None and topic.delivery is Delivery.STATE and len(self._earlier) < KEYS:
            self._earlier[message.channel.topic] = message

    def _play_now(self, message: RecordedMessage) -> None:
        topic = message.channel.topic
        if topic not in self._targets:  # as many as the file has channels
            self._targets[topic] = self._target(message)
        target = self._targets[topic]
        if target is not None and target[0].play(target[1], message):
            self.played += 1
        else:
            self.left_out += 1

    def _target(self, message: RecordedMessage) -> tuple[ReplayedRobot, str] | None:
        split = split_key(message.channel.topic)
        if split is None or not split[0] or message.channel.encoding != MSGPACK or split[1] not in self.robots:
            return None
        return self.robots[split[1]], split[2]

    def _on_end(self, fault: str | None) -> None:
        self.fault = fault
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._ended.set)

    # HQ programs

    async def _serve_hq(self, recorded: str) -> None:
        """Serve HQ programs, which see the robot as it was, not as a recording."""
        metrics, sessions = Metrics(), SessionTable()
        keys = KeySpace(self._plan.realm, self._plan.names[recorded])
        bus = AsRecorded(self._bus, self.robots[recorded])
        robot = RobotSubscription(cast("Bus", bus), keys, metrics)
        key = keys.key(topics.RPC_SESSIONS("gateway").path)
        shown = self._bus.answer(key, lambda query: query.answer(payloads.encode(Sessions(sessions.snapshots()))))
        listeners = [
            Listener(plan, f"replay-{number}", robot, sessions, metrics)
            for number, plan in enumerate(self._plan.listeners, 1)
        ]
        robot.open()
        try:
            serving = (listener.run() for listener in listeners)
            await together(*serving, *(self._report_ready(listener) for listener in listeners))
        finally:
            robot.close()
            shown.close()

    async def _report_ready(self, listener: Listener) -> None:
        await listener.ready.wait()
        self._report(f"HQ programs connect at {listener.address}")


class AsRecorded:
    """A bus on which the status of a replayed robot names the robot's own protocol. All else is the bus's."""

    def __init__(self, bus: Bus, robot: ReplayedRobot) -> None:
        self._bus = bus
        self._robot = robot

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def subscribe(self, key_expr: str, handler: Callable[[Sample], None], **options: Any) -> Handle:
        """Subscribe as :class:`zbridge.bus.Bus` does."""
        return self._bus.subscribe(key_expr, lambda sample: handler(self._original(sample)), **options)

    def _original(self, sample: Sample) -> Sample:
        if not sample.key.endswith(_STATUS):
            return sample
        try:
            status = payloads.decode(Status, sample.payload)
        except PayloadError:
            return sample
        if status.protocol != PROTOCOL or self._robot.recorded_protocol is None:
            return sample
        shown = msgspec.structs.replace(status, protocol=self._robot.recorded_protocol)
        return Sample(sample.key, payloads.encode(shown), sample.attachment)


class _Replayed:
    """What a replay has of a robot: less than any gateway that has a healthy one."""

    standing = Standing()
    must_stay = False

    def heard(self, claims: Mapping[str, Claim]) -> None:
        pass

    def merge(self, record: LatchRecord) -> None:
        pass

    async def step_aside(self) -> None:
        pass

    async def step_in(self) -> None:
        pass


_STATUS = f"/{topics.STATUS.path}"
