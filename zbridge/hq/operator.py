"""Carries out on the bus what the intent of one HQ program decides: holds the lease for it, forwards its commands.

Knows no protocol and no link. :class:`Intent` decides what is said to the robot; :class:`LeaseHolder` gets and keeps
the lease; :class:`CommandQueue` keeps commands in order; the operator connects the three, and tells the program's
people what was refused. The client calls :meth:`Operator.command`, :meth:`Operator.tick` every ``ATTEND_S`` while
:attr:`Operator.active`, and :meth:`Operator.repeat` where its protocol says so; the broadcast calls
:meth:`Operator.look` for news from ``control``.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

from zbridge.errors import Code, NotReady, RateLimited, Unsupported
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Acquire
from zbridge.fleet.messages import Control, Drive, FleetMessage, Mode, Motor, Raw, Refusal
from zbridge.fleet.topics import Topic
from zbridge.hq.command_queue import CommandQueue
from zbridge.hq.context import Bridge
from zbridge.hq.intent import Intent
from zbridge.lease.lease_client import LeaseClient
from zbridge.lease.lease_events import LeaseEvent, LeaseEventKind
from zbridge.lease.lease_holder import LeaseHolder
from zbridge.lease.stick import StickAction
from zbridge.log import Log
from zbridge.protocol.kept import Exported
from zbridge.protocol.rate_limit import RateLimit

log = Log("zbridge.hq")

OPEN_HZ = 50.0
"""Commands a second of one client that need no lease: they share the robot's queue with those of all programs."""
OURS_S = 1.0
"""Seconds within which a refusal without a name is taken for that of a client's command."""


class Operator:
    """The commands of one client, and its lease. ``tell``: shows a text to its people, and whether the client drives.

    who: the client's name on the bus and its liveliness token. protocol: of the client; only robots of the same one are
    told a control mode, and only once the client has chosen one. is_motion: whether a command is motion, see
    :meth:`zbridge.protocol.plugin.HqSide.is_motion`. clock: seconds. clock_ms: the raw clock, which dates commands.
    """

    def __init__(
        self,
        intent: Intent,
        bridge: Bridge,
        *,
        who: str,
        protocol: str,
        is_motion: Callable[[Drive | Motor], bool],
        tell: Callable[[str, bool], None],
        clock: Callable[[], float],
        clock_ms: Callable[[], float],
    ) -> None:
        self.intent = intent
        self.who = who
        self._bridge = bridge
        self._protocol = protocol
        self._is_motion = is_motion
        self._chose_mode = False
        self._tell = tell
        self._clock = clock
        request = Acquire(who=who, deadman_s=intent.deadman_s, alive=who)
        client = LeaseClient(bridge.keys, request, who.rpartition(".")[0], concerns=self._concerns, clock_ms=clock_ms)
        self._lease = LeaseHolder(bridge.bus, client, spawn=bridge.spawn, on_event=self._on_lease, clock=clock)
        self._queue = CommandQueue(bridge, client, who=who, late=self._late)
        self._set: dict[str, tuple[Topic, FleetMessage]] = {}
        """What is in motion, by path."""
        self._pushed: dict[str, float] = {}
        """When motion of each path was last said, whether it was carried out or not; neutral removes the path."""
        self._allowance = RateLimit(OPEN_HZ)
        self._open: dict[str, float] = {}
        """When commands that need no lease were last sent; their refusals bear no name."""
        if bridge.view.control is not None:  # what was refused to an earlier client of this name is no news
            client.news.take(bridge.view.control)

    def __repr__(self) -> str:
        return f"<Operator {self.who} {self.intent!r}>"

    @property
    def active(self) -> bool:
        """Whether :meth:`tick` has anything to do."""
        return self.intent.active

    # What the client says

    def command(self, topic: Topic, message: FleetMessage) -> None:
        """Carry out a command of the client; raise Refused with the reason if it may not be."""
        now = self._clock()
        if isinstance(message, Drive | Motor):
            self._move(topic, message, now)
        elif isinstance(message, Mode):
            self._choose(message, now)
        elif isinstance(message, Raw):
            self._require_robot()
            if topics.unescape(topic.path.rpartition("/")[2]) != self._bridge.view.protocol:
                raise Unsupported("the robot does not know such packets")
            self._follow(self.intent.motion(now, lasts=False), topic, message)
        else:
            if not self._allowance.take(now):
                raise RateLimited(f"more than {OPEN_HZ:g} commands a second that need no lease")
            self._open[topic.path.removeprefix("@cmd/")] = now
            self._bridge.put(topic, message)

    def tick(self) -> None:
        """Renew or release the lease; must be called every ``ATTEND_S`` while active."""
        now, intent = self._clock(), self.intent
        intent.expire(now)
        if not intent.held:
            return
        if intent.needs_neutral is not None:
            self._set.clear()
        if intent.wants_release(now):
            self._release("unused")
            return
        self._lease.client.renews = intent.mode == "autonomous"  # else motion and neutral renew it
        self._lease.expire()

    def repeat(self) -> None:
        """Send again what is in motion, unless neutral is needed."""
        now, intent = self._clock(), self.intent
        intent.expire(now)
        if intent.held and intent.needs_neutral is None:
            for topic, message in tuple(self._set.values()):
                intent.motion(now)
                self._queue.send(topic, message)

    def let_go(self, why: str) -> None:
        """Release the robot: the client may not mean any more what it said last."""
        if self.intent.held:
            self._release(why)
            self.intent.lost(why)

    def export(self) -> Exported:
        """Write what outlives a restart: the control mode, and when anything was received last. The lease does not."""
        return {"mode": self.intent.mode, "chose": self._chose_mode, "heard_at": self.intent.heard_at}

    def restore(self, state: Exported, why: str) -> None:
        """Continue for a program that another process of this machine served; it must send neutral before it drives."""
        self._chose_mode = bool(state["chose"])
        self.intent.restore(str(state["mode"]), why, float(state["heard_at"]))

    def close(self) -> None:
        """Release the robot: the client is gone; idempotent."""
        if self.intent.held:
            self._release("disconnected")
        self._lease.close()

    # What the robot's gateway says

    def look(self, control: Control) -> None:
        """Take news from ``control``: whether the lease is still held, and what was refused."""
        now = self._clock()
        for refusal in self._lease.read_control(control):
            lately = now - self._open.get(refusal.command, -math.inf) < OURS_S
            if refusal.command != "acquire" and (refusal.who is not None or lately):
                if refusal.code == Code.NEUTRAL_FIRST:
                    self.intent.refused("motion was refused")
                left_out = refusal.code == Code.UNSUPPORTED  # perhaps only a part: the robot may move
                self._tell(f"{refusal.command}: {refusal.reason}", left_out)

    def gateway_lost(self) -> None:
        """Record that the robot's gateway is gone, and every lease with it."""
        if self.active:
            self._lease.gateway_lost()

    def _concerns(self, refusal: Refusal) -> bool:
        return refusal.who is None or refusal.who == self.who

    # Motion

    def _move(self, topic: Topic, message: Drive | Motor, now: float) -> None:
        intent = self.intent
        intent.expire(now)
        if intent.needs_neutral is not None:
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

    def _choose(self, message: Mode, now: float) -> None:
        self._chose_mode = True
        if message.mode == "autonomous":
            self._require_robot()
            if self._bridge.view.protocol != self._protocol:
                self._choose(Mode("manual"), now)
                raise Unsupported("this robot has no autonomous mode; use the joystick")
        do = self.intent.choose(message.mode, now)
        if do is StickAction.RELEASE:
            self._tell_mode(self._queue.put)  # what waits is dropped, so it overtakes nothing
            self._release("control mode none")
        elif do is StickAction.ACQUIRE:
            self._lease.want()
        elif do is StickAction.SEND:
            self._tell_mode(self._queue.send)

    def _follow(self, do: StickAction, topic: Topic, message: FleetMessage) -> None:
        match do:
            case StickAction.SEND:
                self._queue.send(topic, message)
            case StickAction.WAIT:
                self._queue.wait(topic, message)
            case StickAction.ACQUIRE:
                self._queue.wait(topic, message)
                self._lease.want()

    def _require_robot(self) -> None:
        missing = self._bridge.view.missing
        if missing is not None:
            self.intent.refused(missing)
            raise NotReady(missing)

    def _tell_mode(self, send: Callable[[Topic, FleetMessage], None]) -> None:
        """Send the robot its control mode, if the client has chosen one and the robot is of the client's protocol."""
        if self.intent.held and self._chose_mode and self._bridge.view.protocol == self._protocol:
            send(topics.CMD_MODE, Mode(self.intent.mode))  # type: ignore[arg-type]

    # The lease

    def _on_lease(self, event: LeaseEvent) -> None:
        if event.kind is LeaseEventKind.GRANTED:
            self._begin(event.expires_in_s)
        else:
            why = str(event.error)
            self._drop(why)
            self.intent.lost(why)
            self._tell(f"not driving: {why}", False)

    def _begin(self, lease_s: float | None) -> None:
        self.intent.granted(lease_s)
        waiting = self._queue.begin()
        self._tell_mode(self._queue.send)
        self._queue.resume(waiting)
        log.info("hq_drives", "{session} drives {robot}", session=self.who, robot=self._bridge.keys.robot)

    def _release(self, why: str) -> None:
        self._drop(why)
        self.intent.released()
        self._lease.drop()

    def _drop(self, why: str) -> None:
        log.log(
            logging.INFO if self.intent.held else logging.DEBUG,
            "hq_drives_not",
            "{session} does not drive {robot}: {reason}",
            session=self.who,
            robot=self._bridge.keys.robot,
            reason=why,
        )
        self._queue.clear()
        self._set.clear()

    def _late(self) -> bool:
        """Return whether neutral must come before motion."""
        self.intent.expire(self._clock())
        return self.intent.needs_neutral is not None
