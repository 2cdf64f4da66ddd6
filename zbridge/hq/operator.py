"""One HQ program's hand on the robot: carries out on the bus what its intent decides. Knows no protocol and no link."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec

from zbridge.bus import Bus, Handle, Publisher
from zbridge.control.proof import Signer
from zbridge.errors import BusError, Code, NotReady, PayloadError, Refused, TooFast, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Acquire, Control, Drive, FleetMessage, Lease, Mode, Motor, Raw, Refusal
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.fleet.view import RobotView
from zbridge.hq.intent import Action, Intent
from zbridge.protocol.rate_limit import RateLimit

log = logging.getLogger("zbridge.hq")

ASK_S = 1.0
"""Longest time a question about the lease waits for its answer."""
REPEAT_S = 0.1
"""Seconds between repetitions of what a client set once."""
WAITING = 64
"""Commands of one client that may wait for the bus besides motion; one more is refused."""
OPEN_HZ = 50.0
"""Commands a second of one client that need no lease: they share the robot's queue with everybody's."""
PUBLISHERS = 512
"""Keys that the clients of a listener command at a time; the oldest makes room."""
OURS_S = 1.0
"""Seconds within which a refusal that bears no name is taken for that of a client's command."""


class Bridge:
    """What the clients of a listener share: publishers, questions, and tasks. ``spawn`` starts a task."""

    def __init__(
        self, bus: Bus, keys: KeySpace, view: RobotView, spawn: Callable[[Coroutine[Any, Any, None]], object]
    ) -> None:
        self.bus = bus
        self.keys = keys
        self.view = view
        self.spawn = spawn
        self._publishers: dict[str, Publisher] = {}

    def __repr__(self) -> str:
        return f"<Bridge to {self.keys.robot}>"

    def put(self, topic: Topic, message: FleetMessage, signer: Signer | None = None) -> None:
        """Put a command on the bus; one that needs the lease is signed."""
        publisher = self._publishers.get(topic.path)
        if publisher is None:
            if len(self._publishers) >= PUBLISHERS:
                self._publishers.pop(next(iter(self._publishers))).close()
            publisher = self._publishers[topic.path] = self.bus.publisher(self.keys.key(topic.path), topic)
        payload = payloads.encode(message)
        publisher.put(payload, signer.command(publisher.key, payload) if signer is not None else None)

    async def acquire(self, request: Acquire) -> Lease:
        """Ask for the lease, in the name of the listener."""
        name = request.who.rpartition(".")[0]
        return await self._ask_lease(self.keys.key(topics.RPC_ACQUIRE(name).path), payloads.encode(request))

    async def ask_lease(self, topic: Topic, signer: Signer) -> Lease:
        """Renew or release a lease."""
        key = self.keys.key(topic.path)
        return await self._ask_lease(key, signer.question(key))

    async def _ask_lease(self, key: str, payload: bytes) -> Lease:
        """Ask one thing about the lease; where there is no answer, the answer is no, and says so."""
        why, code = "no gateway answers", None
        try:
            for answer in await self.bus.ask(key, payload, timeout_s=ASK_S):
                if answer.error is None:
                    return payloads.decode(Lease, answer.payload)
                if isinstance(answer.error, Refused):
                    why, code = str(answer.error), answer.error.code
        except (BusError, PayloadError) as error:
            why = str(error)
        return Lease(ok=False, reason=why, code=code)

    def close(self) -> None:
        """Give the keys up."""
        for publisher in self._publishers.values():
            publisher.close()


class Operator:
    """What one client commands. ``tell`` says something to its people; who: its name on the bus, and its token's.

    protocol: of the client; only robots of the same one are told a control mode, and only where the client chose one.
    is_motion: whether a command is motion, see :meth:`zbridge.protocol.plugin.HqSide.is_motion`.
    """

    def __init__(
        self,
        intent: Intent,
        bridge: Bridge,
        *,
        who: str,
        protocol: str,
        is_motion: Callable[[Drive | Motor], bool],
        tell: Callable[[str], None],
        clock: Callable[[], float],
    ) -> None:
        self.intent = intent
        self.who = who
        self._bridge = bridge
        self._protocol = protocol
        self._is_motion = is_motion
        self._chose_mode = False
        self._tell = tell
        self._clock = clock
        self._signer: Signer | None = None
        self._light = False
        self._set: dict[str, tuple[Topic, FleetMessage]] = {}
        """What is in motion, by path."""
        self._pushed: dict[str, float] = {}
        """When motion was last said of each path, whether it was carried out or not; neutral takes it out."""
        self._queue: list[tuple[Topic, FleetMessage]] = []
        self._writing = False
        self._doubting = False
        self._returning = 0
        """Questions under way that give the robot back."""
        self._returned = asyncio.Event()
        self._returned.set()
        self._closed = False
        self._due = 0.0
        self._seen: dict[tuple[str | None, str, str, str], int] = {}
        self._allowance = RateLimit(OPEN_HZ)
        self._open: dict[str, float] = {}
        """When commands were last given that need no lease, and so bear no name."""
        self._handle: Handle | None = None
        if bridge.view.control is not None:  # what was refused to a client of our name before us
            self._new_refusals(bridge.view.control)

    def __repr__(self) -> str:
        return f"<Operator {self.who} {self.intent!r}>"

    @property
    def active(self) -> bool:
        """Whether :meth:`tick` has anything to do."""
        return self.intent.held or self.intent.asking

    # What the client says

    def command(self, topic: Topic, message: FleetMessage) -> None:
        """Carry out a command of the client; raise Refused with the reason where it may not be."""
        now = self._clock()
        if isinstance(message, Drive | Motor):
            self._move(topic, message, now)
        elif isinstance(message, Mode):
            self._choose(message, now)
        elif isinstance(message, Raw):
            self._require_robot()
            if topics.unescape(topic.path.rpartition("/")[2]) != self._bridge.view.protocol:
                raise Unsupported("the robot has no such packets")
            self._follow(self.intent.motion(now, lasts=False), topic, message)
        else:
            if not self._allowance.take(now):
                raise TooFast(f"more than {OPEN_HZ:g} commands a second that need no lease")
            self._open[topic.path.removeprefix("@cmd/")] = now
            self._bridge.put(topic, message)

    def tick(self) -> None:
        """Keep the lease or give it back; to be called every :data:`REPEAT_S` while active."""
        now, intent = self._clock(), self.intent
        intent.expire(now)
        if not intent.held:
            return
        if intent.held_back is not None:
            self._set.clear()
        if intent.wants_release(now):
            self._release("unused")
        elif intent.mode == "autonomous" and now >= self._due:
            self._due = now + intent.lease_s / 3
            self._doubt()

    def repeat(self) -> None:
        """Send again what is in motion, unless neutral is owed."""
        now, intent = self._clock(), self.intent
        intent.expire(now)
        if intent.held and intent.held_back is None:
            for topic, message in tuple(self._set.values()):
                intent.motion(now)
                self._send(topic, message)

    def let_go(self, why: str) -> None:
        """Give the robot back: whether the client still means what it said, nobody can tell."""
        if self.intent.held:
            self._release(why)
            self.intent.lost(why)

    def close(self) -> None:
        """Give the robot back: the client is gone; idempotent."""
        if not self._closed:
            self._closed = True
            if self.intent.held:
                self._release("disconnected")
            elif not self.intent.asking and not self._returning:
                self._forget_token()

    # What the robot's gateway says

    def look(self, control: Control) -> None:
        """Take news from ``control``: whether the robot is still ours, and what was refused."""
        if self._signer is not None and control.lease != self._signer.lease:
            self._doubt()
        elif control.holder == self.who and not (self.active or self._returning):
            self._forget_token()  # the answer that granted it was lost; so ends that lease
        for refusal in self._new_refusals(control):
            self._refused(refusal)

    def gateway_lost(self) -> None:
        """Take note that the robot's gateway is gone, and every lease with it."""
        if self.active:
            self._lose("the robot's gateway is gone")

    def _new_refusals(self, control: Control) -> list[Refusal]:
        news, seen, now = [], {}, self._clock()
        for refusal in control.refusals:
            lately = now - self._open.get(refusal.command, -math.inf) < OURS_S
            if refusal.by is None and (refusal.who == self.who or refusal.who is None):
                key = (refusal.who, refusal.command, refusal.code, refusal.reason)
                if refusal.count != self._seen.get(key, 0) and (refusal.who is not None or lately):
                    news.append(refusal)
                seen[key] = refusal.count
        self._seen = seen
        return news

    def _refused(self, refusal: Refusal) -> None:
        if refusal.code == Code.LEASE_ENDED:
            if self.intent.held:
                self._doubt()
        elif refusal.command != "acquire":
            if refusal.code == Code.NEUTRAL_FIRST:
                self.intent.refused("motion was refused")
            self._tell(f"{refusal.command}: {refusal.reason}")

    # Motion

    def _move(self, topic: Topic, message: Drive | Motor, now: float) -> None:
        intent = self.intent
        intent.expire(now)
        if intent.held_back is not None:
            self._set.clear()
        if not self._is_motion(message):
            if isinstance(message, Drive) and message.moving and not intent.may_steer:
                message = Drive(light=message.light)
            self._set.pop(topic.path, None)
            self._pushed.pop(topic.path, None)
            whole = all(now - said_at >= intent.deadman_s for said_at in self._pushed.values())
            self._follow(intent.neutral(now, whole=whole), topic, message)
            return
        self._pushed[topic.path] = now
        self._require_robot()
        do = intent.motion(now)
        self._set[topic.path] = (topic, message)
        self._follow(do, topic, message)

    def _lit(self, message: Drive) -> Drive:
        """Say how the light should be only where that is new: programs repeat it with every command."""
        if message.light is None:
            return message
        if message.light == self._light:
            return msgspec.structs.replace(message, light=None)
        self._light = message.light
        return message

    def _choose(self, message: Mode, now: float) -> None:
        self._chose_mode = True
        if message.mode == "autonomous":
            self._require_robot()
            if self._bridge.view.protocol != self._protocol:
                self._choose(Mode("manual"), now)
                raise Unsupported("the robot does not move by itself, only by the stick")
        do = self.intent.choose(message.mode, now)
        if do is Action.RELEASE:
            self._tell_mode(self._put)  # what waits is given up, so it overtakes nothing
            self._release("control mode none")
        elif do is Action.ACQUIRE:
            self._bridge.spawn(self._acquire())
        elif do is Action.SEND:
            self._tell_mode(self._send)

    def _follow(self, do: Action, topic: Topic, message: FleetMessage) -> None:
        match do:
            case Action.SEND:
                self._send(topic, message)
            case Action.WAIT:
                self._wait(topic, message)
            case Action.ACQUIRE:
                self._wait(topic, message)
                self._bridge.spawn(self._acquire())

    def _require_robot(self) -> None:
        missing = self._bridge.view.missing
        if missing is not None:
            self.intent.refused(missing)
            raise NotReady(missing)

    def _tell_mode(self, send: Callable[[Topic, FleetMessage], None]) -> None:
        """Tell the robot its control mode, if it is of a protocol that has any."""
        if self.intent.held and self._chose_mode and self._bridge.view.protocol == self._protocol:
            send(topics.CMD_MODE, Mode(self.intent.mode))  # type: ignore[arg-type]

    # The lease

    async def _acquire(self) -> None:
        bridge = self._bridge
        await self._returned.wait()  # or the robot would be held by ourselves
        if self._handle is None:
            self._handle = bridge.bus.announce(bridge.keys.alive(self.who))
        request = Acquire(who=self.who, deadman_s=self.intent.deadman_s, alive=self.who)
        lease = await bridge.acquire(request)
        if not lease.ok or lease.lease is None or lease.token is None:
            if self.intent.asking:
                self._lose(lease.reason or "refused")
        elif self._closed or not self.intent.asking:
            await bridge.ask_lease(topics.RPC_RELEASE, Signer(lease))
        else:
            self._begin(Signer(lease), lease.expires_in_s)
        if self._closed:
            self._forget_token()

    def _begin(self, signer: Signer, lease_s: float | None) -> None:
        intent, now = self.intent, self._clock()
        self._signer, self._light = signer, False
        intent.granted(lease_s or intent.lease_s)
        intent.expire(now)
        waiting, self._queue = self._queue, []
        self._tell_mode(self._send)
        for topic, message in waiting:
            if not self._overdue(message):
                self._send(topic, message)
        log.info("%s drives %s", self.who, self._bridge.keys.robot)

    def _doubt(self) -> None:
        """Ask whether the lease is still ours, which also renews it."""
        if not self._doubting and self._signer is not None:
            self._doubting = True
            self._bridge.spawn(self._verify(self._signer))

    async def _verify(self, signer: Signer) -> None:
        lease = await self._bridge.ask_lease(topics.RPC_RENEW, signer)
        self._doubting = False
        lost = not lease.ok and lease.code != Code.OUT_OF_ORDER  # somebody repeated the question, and came first
        if lost and signer is self._signer:
            self._lose(lease.reason or "the lease has ended")

    def _lose(self, why: str) -> None:
        self._drop(why)
        self.intent.lost(why)
        self._tell(f"not driving: {why}")

    def _release(self, why: str) -> None:
        signer = self._signer
        self._drop(why)
        self.intent.released()
        if signer is not None:
            self._returning += 1
            self._returned.clear()
            self._bridge.spawn(self._give_back(signer))

    async def _give_back(self, signer: Signer) -> None:
        with contextlib.suppress(BusError):  # what was commanded before, goes before
            await self._bridge.bus.flush()
        await self._bridge.ask_lease(topics.RPC_RELEASE, signer)
        self._returning -= 1
        if not self._returning:
            self._returned.set()
        if self._closed:
            self._forget_token()

    def _drop(self, why: str) -> None:
        level = logging.INFO if self.intent.held else logging.DEBUG
        log.log(level, "%s does not drive %s: %s", self.who, self._bridge.keys.robot, why)
        self._signer = None
        self._queue.clear()
        self._set.clear()

    def _forget_token(self) -> None:
        handle, self._handle = self._handle, None
        if handle is not None:
            handle.close()

    # The bus

    def _send(self, topic: Topic, message: FleetMessage) -> None:
        """Put a command on the bus, after those before it: they are numbered, and must not overtake each other."""
        if self._writing or self._signer is None:
            self._wait(topic, message)
        else:
            self._put(topic, message)

    def _put(self, topic: Topic, message: FleetMessage) -> None:
        assert self._signer is not None
        if isinstance(message, Drive):
            message = self._lit(message)
        self._bridge.put(topic, message, self._signer)
        if topic is not topics.CMD_DRIVE:  # goes by way of a thread
            self._writing = True
            self._bridge.spawn(self._written())

    def _wait(self, topic: Topic, message: FleetMessage) -> None:
        """Let a command wait; of motion the newest wins."""
        if isinstance(message, Drive | Motor):
            self._queue = [entry for entry in self._queue if entry[0].path != topic.path]
        elif len(self._queue) >= WAITING:
            raise NotReady(f"{WAITING} commands wait for the bus", Code.BUSY)
        self._queue.append((topic, message))

    async def _written(self) -> None:
        try:
            await self._bridge.bus.flush()
        except BusError as error:
            log.warning("%s: %s", self.who, error)
        self._writing = False
        self.intent.expire(self._clock())
        while self._queue and not self._writing and self._signer is not None:
            topic, message = self._queue.pop(0)
            if not self._overdue(message):
                self._send(topic, message)

    def _overdue(self, message: FleetMessage) -> bool:
        """Tell whether this is motion that waited until neutral had to come first."""
        neutral = isinstance(message, Drive | Motor) and not message.moving
        return self.intent.held_back is not None and not neutral and not isinstance(message, Mode)
